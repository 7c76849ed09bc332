"""Puts a new reward into a task without touching the rest: whoever writes rewards cannot move the goal.

Of the new code, `reward_function` is taken with the functions and constants that it uses, each as
a statement of its own that binds one name. What has a name that the task uses for something else
is renamed, and what could be changed in place is copied, so that nothing which the task's success,
reset and observations read is replaced or shared.
"""

import ast
from collections.abc import Iterator
from copy import deepcopy

from v2p_data.errors import V2PError
from v2p_data.task.sandbox.reader.check import check_amount, checked_tree
from v2p_data.task.sandbox.reader.refusal import TaskCodeError

REWARD = "reward_function"


class SpliceError(Exception):
    """Code that holds no reward which could be put into the task, in words for its writer."""


def with_reward(parent: str, answer: str) -> str:
    """Return the parent's code with the answer's `reward_function`; everything else is the parent's.

    Args:
        parent: a task code that passes the guard.
        answer: module-level code with `reward_function`.

    Raises:
        SpliceError: the answer does not parse, holds no reward, or the parent's.
        V2PError: the parent's success, reset or observations call its reward, so that they would change with it.
    """
    old = checked_tree(parent)
    offered = _definitions(_answered(answer))
    there = _definitions(old)
    if not isinstance(offered.get(REWARD), ast.FunctionDef):
        raise SpliceError(f"`{REWARD}` must be a function at module level. Answer again.")
    _demand_independent(old, there)
    both = there | offered
    wanted = _reachable(offered[REWARD], both) | {REWARD}
    own = {n for n in wanted & set(offered) if n not in there or not _same(there[n], offered[n])}
    while more := {n for n in wanted & set(offered) if _reachable(offered[n], both) & own} - own:
        own |= more
    if not own:
        raise SpliceError("This is the reward that was there before. Write another one.")
    own |= {REWARD} | {n for n in wanted if _is_mutable(both[n])}
    while more := {n for n in wanted if _reachable(both[n], both) & own} - own:
        own |= more
    taken = {n.id for n in ast.walk(old) if isinstance(n, ast.Name)}
    taken |= {name for node in old.body for name in _bound(node)}
    names: dict[str, str] = {}
    for name in sorted(own - {REWARD}):
        if name in taken:
            names[name] = _free(f"reward_{name}", taken | wanted | set(names.values()))
    renamed = _Renamed(names)
    parts = [
        ast.unparse(renamed.visit(deepcopy(node))) for name, node in both.items() if name in own
    ]
    made = _joined(parent, old, parts)
    try:
        is_kept = rest_part(made) == rest_part(parent)
    except SyntaxError as error:
        raise SpliceError(f"Your code cannot be put into the task: {error}.") from error
    if not is_kept:
        raise SpliceError("Your reward changes other parts of the task. Use names of your own.")
    return made


def _answered(answer: str) -> ast.Module:
    """Return an answer's tree.

    Raises:
        SpliceError: it does not parse, or binds names in another way than by functions and plain constants.
    """
    try:
        tree = ast.parse(answer)
        check_amount(tree)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
        raise SpliceError(f"Your code is not Python{line}: {error}. Answer again.") from error
    except TaskCodeError as error:
        raise SpliceError(f"Your code is too large: {error}. Answer again.") from error
    for node in tree.body:
        is_left_out = isinstance(node, ast.Import | ast.ImportFrom | ast.ClassDef) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        )
        if not is_left_out and not any(_definitions_in(node)):
            raise SpliceError(
                f"Line {node.lineno} of your code may change what else the task reads "
                f"({type(node).__name__}). Write only "
                "functions without `global`, and constants as NAME = value."
            )
    return tree


def reward_part(code: str) -> str:
    """Return a normal form of a code's reward and what it uses: equal for equal rewards, whatever their comments."""
    there = _definitions(ast.parse(code))
    used = sorted(_reachable(there[REWARD], there) | {REWARD})
    return "\n".join(ast.dump(_bare(there[name])) for name in used)


def reward_source(code: str) -> str:
    """Return the text of a code's reward and of what it uses, for a reader."""
    tree = ast.parse(code)
    there = _definitions(tree)
    used = _reachable(there[REWARD], there) | {REWARD}
    return "\n\n\n".join(_source(code, node) for node in tree.body if set(_bound(node)) & used)


def rest_part(code: str) -> str:
    """Return a normal form of everything but the reward: success, reset, observations and what they use."""
    tree = ast.parse(code)
    methods = [n for n in _class_body(tree) if getattr(n, "name", "") != "compute_reward"]
    kept: list[ast.stmt] = []
    ahead = [n for n in tree.body if not isinstance(n, ast.ClassDef)]
    more = methods
    while more:
        used = {n.id for part in more for n in ast.walk(part) if isinstance(n, ast.Name)}
        more = [n for n in ahead if not _bound(n) or _bound(n) & used]
        ahead = [n for n in ahead if n not in more]
        kept += more
    return "\n".join(ast.dump(n) for n in [*methods, *(n for n in tree.body if n in kept)])


def _class_body(tree: ast.Module) -> list[ast.stmt]:
    return [n for c in tree.body if isinstance(c, ast.ClassDef) for n in c.body]


def _definitions(tree: ast.Module) -> dict[str, ast.stmt]:
    """Return the functions and constants of a module by name, the last one where there are several."""
    return {name: node for part in tree.body for name, node in _definitions_in(part)}


def _definitions_in(node: ast.stmt) -> Iterator[tuple[str, ast.stmt]]:
    """Yield what a statement defines as statements of one name each; nothing where it does anything else besides."""
    match node:
        case ast.FunctionDef(name=name) if _bound(node) == {name}:
            yield name, node
        case ast.Assign() | ast.AnnAssign(value=ast.expr()):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [t for t in targets if isinstance(t, ast.Name)]
            if len(names) == len(targets) and _bound(node) == {t.id for t in names}:
                for name in names:
                    alone = ast.Assign(targets=[name], value=node.value)  # pyright: ignore[reportArgumentType]
                    yield name.id, ast.copy_location(alone, node)


def _bound(node: ast.stmt) -> set[str]:
    """Return the names of the module that a statement binds or deletes, in whatever way."""
    within = list(ast.walk(node))
    found = {name for n in within if isinstance(n, ast.Global) for name in n.names}
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        found.add(node.name)
        heads = [n for n in ast.iter_child_nodes(node) if n not in node.body]
        within = [n for head in heads for n in ast.walk(head)]
    for n in within:
        match n:
            case ast.Name(ctx=ast.Store() | ast.Del()):
                found.add(n.id)
            case ast.alias():
                found.add(n.asname or n.name)
    return found


def _reachable(node: ast.AST, there: dict[str, ast.stmt]) -> set[str]:
    """Return the names of module-level things that a node uses, and those use."""
    found: set[str] = set()
    ahead = [node]
    while ahead:
        for part in ast.walk(ahead.pop()):
            if isinstance(part, ast.Name) and part.id in there and part.id not in found:
                found.add(part.id)
                ahead.append(there[part.id])
    return found


def _demand_independent(old: ast.Module, there: dict[str, ast.stmt]) -> None:
    for node in _class_body(old):
        name = getattr(node, "name", "the class body")
        calls = any(
            isinstance(n, ast.Attribute) and n.attr == "compute_reward" for n in ast.walk(node)
        )
        if name != "compute_reward" and (calls or REWARD in _reachable(node, there)):
            raise V2PError(
                f"{name} of this task code calls its reward, so that another reward would change what it says; "
                "take a task whose success and observations stand by themselves"
            )


def _is_mutable(node: ast.stmt) -> bool:
    """Return whether a definition keeps a list or dict from call to call, parameters' defaults included."""
    kept: list[ast.expr] = []
    match node:
        case ast.Assign(value=value):
            kept = [value]
        case ast.FunctionDef(args=ast.arguments(defaults=defaults)):
            kept = defaults
    return any(isinstance(n, ast.List | ast.Dict) for part in kept for n in ast.walk(part))


def _same(a: ast.stmt, b: ast.stmt) -> bool:
    return ast.dump(_bare(a)) == ast.dump(_bare(b))


def _bare(node: ast.stmt) -> ast.stmt:
    """Return a copy without docstring, decorators and annotations."""
    node = ast.parse(ast.unparse(node)).body[0]
    if isinstance(node, ast.FunctionDef):
        node.decorator_list, node.returns = [], None
        for parameter in node.args.args:
            parameter.annotation = None
        if ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return node


def _free(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "2"
    return name


class _Renamed(ast.NodeTransformer):
    def __init__(self, names: dict[str, str]) -> None:
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.Name:
        node.id = self.names.get(node.id, node.id)
        return node

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.arg = self.names.get(node.arg, node.arg)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        node.name = self.names.get(node.name, node.name)
        self.generic_visit(node)
        return node


def _source(text: str, node: ast.stmt) -> str:
    """Return a statement as it was written, comments and decorators with it."""
    return "\n".join(text.split("\n")[_first_line(node) - 1 : node.end_lineno])


def _first_line(node: ast.stmt) -> int:
    return min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])


def _joined(parent: str, old: ast.Module, parts: list[str]) -> str:
    """Return the parent's lines with `compute_reward` calling the new reward, which takes the old one's place."""
    lines = parent.split("\n")
    put = "\n\n\n".join(parts).split("\n")
    cuts: list[tuple[int, int, list[str]]] = []
    for node in old.body:
        if REWARD in _bound(node):
            cuts.append((_first_line(node), int(node.end_lineno or node.lineno), put))
            put = []
    for node in _class_body(old):
        if isinstance(node, ast.FunctionDef) and node.name == "compute_reward":
            indent = " " * node.col_offset
            call = [
                f"{indent}def compute_reward(self, actions, states):",
                f"{indent}    return {REWARD}(actions, states)",
            ]
            cuts.append((node.lineno, int(node.end_lineno or node.lineno), call))
    for first, last, by in sorted(cuts, key=lambda cut: -cut[0]):
        lines[first - 1 : last] = by
    if put:
        lines += ["", "", *put]
    return "\n".join(lines).rstrip() + "\n"
