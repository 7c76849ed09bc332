"""Puts a new reward into a task without touching the rest: whoever writes rewards cannot move the goal.

Of the new code, `reward_function` is taken with the functions and constants that it uses. What has a name that the task
uses for something else is renamed, and constants that could be changed in place are copied, so that nothing which the
task's success, reset and observations read is replaced or shared.
"""

import ast

from v2p_data.errors import V2PError
from v2p_data.task.reader.check import checked_tree

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
    try:
        new = ast.parse(answer)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
        raise SpliceError(f"Your code is not Python{line}: {error}. Answer again.") from error
    there, offered = _definitions(old), _definitions(new)
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
    taken = {n.id for n in ast.walk(old) if isinstance(n, ast.Name)} | set(there)
    taken |= {n.name for n in old.body if isinstance(n, ast.ClassDef)}
    names: dict[str, str] = {}
    for name in sorted(own - {REWARD}):
        if name in taken:
            names[name] = _free(f"reward_{name}", taken | wanted | set(names.values()))
    parts = [
        ast.unparse(_Renamed(names).visit(node)) if names else _source(text, node)
        for tree, text in ((new, answer), (old, parent))
        for node in tree.body
        if _defined(node) in own and (tree is new or _defined(node) not in offered)
    ]
    made = _joined(parent, old, parts)
    try:
        is_kept = rest_part(made) == rest_part(parent)
    except SyntaxError as error:
        raise SpliceError(f"Your code cannot be put into the task: {error}.") from error
    if not is_kept:
        raise SpliceError("Your reward changes other parts of the task. Use names of your own.")
    return made


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
    return "\n\n\n".join(_source(code, node) for node in tree.body if _defined(node) in used)


def rest_part(code: str) -> str:
    """Return a normal form of everything but the reward: success, reset, observations, and what they use."""
    tree = ast.parse(code)
    there = _definitions(tree)
    methods = [n for n in _class_body(tree) if getattr(n, "name", "") != "compute_reward"]
    used = sorted(set().union(*(_reachable(n, there) for n in methods)))
    return "\n".join(ast.dump(n) for n in [*methods, *(there[name] for name in used)])


def _class_body(tree: ast.Module) -> list[ast.stmt]:
    return [n for c in tree.body if isinstance(c, ast.ClassDef) for n in c.body]


def _definitions(tree: ast.Module) -> dict[str, ast.stmt]:
    return {name: node for node in tree.body if (name := _defined(node))}


def _defined(node: ast.stmt) -> str:
    if isinstance(node, ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    return ""


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
    return isinstance(node, ast.Assign) and any(
        isinstance(n, ast.List | ast.Dict) for n in ast.walk(node.value)
    )


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
        if _defined(node) == REWARD:
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
