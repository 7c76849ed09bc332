"""Reads task code without running it and refuses, with line and reason, whatever is not on the allow-lists.

What it does and does not protect against is said in `sandbox`.
"""

import ast
import builtins
import re
import typing
import warnings

import torch

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.task import allowed, source_text
from v2p_data.task.task import Task

MAX_SOURCE_CHARS = 40_000
MAX_NODES = 10_000
MAX_DEPTH = 40
MAX_LOOP_DEPTH = 2
MAX_STRING_CHARS = 4_000
MAX_NUMBER = 1e6
MAX_EXPONENT = 8
_WIDE_FORMAT = re.compile(r"%(?:\(\w*\))?[-+ #0]*(?:\d{3,}|\*|\d{0,2}\.(?:\d{3,}|\*))")


class TaskCodeError(V2PError):
    """Task code that is refused, with the line and the reason.

    Args:
        reason: one sentence.
        line: line number from 1; None where it is the whole text.
    """

    def __init__(self, reason: str, line: int | None = None) -> None:
        where = f"task code, line {line}" if line else "task code"
        super().__init__(f"{where}: {reason}")
        self.reason = reason
        self.line = line


def check_code(source: str) -> None:
    """Read task code without running it.

    Raises:
        TaskCodeError: something in it is not on the allow-list.
    """
    checked_tree(source)


_EXPRESSIONS = (
    ast.BoolOp,
    ast.BinOp,
    ast.UnaryOp,
    ast.IfExp,
    ast.Compare,
    ast.Call,
    ast.Constant,
    ast.Attribute,
    ast.Subscript,
    ast.Name,
    ast.List,
    ast.Tuple,
    ast.Dict,
    ast.Slice,
    ast.ListComp,
    ast.comprehension,
    ast.JoinedStr,
    ast.FormattedValue,
    ast.keyword,
    ast.expr_context,
    ast.operator,
    ast.boolop,
    ast.unaryop,
    ast.cmpop,
)
_STATEMENTS = (
    ast.Return,
    ast.Assign,
    ast.AugAssign,
    ast.AnnAssign,
    ast.For,
    ast.If,
    ast.Expr,
    ast.Pass,
    ast.Break,
    ast.Continue,
    ast.arguments,
    ast.arg,
)
_TOP_LEVEL = (
    ast.Import,
    ast.ImportFrom,
    ast.ClassDef,
    ast.FunctionDef,
    ast.Assign,
    ast.AnnAssign,
    ast.Expr,
)
_WORDS = {
    "While": "while loops are not allowed; use tensor operations, or for with range",
    "Lambda": "lambda is not allowed; write a function at module level",
    "GeneratorExp": "generators are not allowed; use a list or a tensor operation",
    "Try": "try is not allowed; an error should be seen",
    "With": "with is not allowed; no gradients are kept anyway",
    "Global": "global is not allowed; keep state in tensors",
    "Nonlocal": "nonlocal is not allowed",
    "NamedExpr": "':=' is not allowed; assign on a line of its own",
    "Starred": "'*' is not allowed here; name the values",
    "Assert": "assert is not allowed",
    "Raise": "raise is not allowed",
    "Delete": "del is not allowed",
    "Yield": "yield is not allowed",
    "Match": "match is not allowed; use if",
}


def checked_tree(source: str) -> ast.Module:
    if len(source) > MAX_SOURCE_CHARS:
        raise TaskCodeError(f"it has {len(source)} characters; {MAX_SOURCE_CHARS} are allowed")
    _refuse_text(source_text.hidden_character(source))
    try:
        with warnings.catch_warnings():  # a backslash in a docstring is no matter
            warnings.simplefilter("ignore", SyntaxWarning)
            tree = ast.parse(source)
    except SyntaxError as error:
        raise TaskCodeError(f"it is not Python: {error.msg}", error.lineno) from error
    except (ValueError, MemoryError, RecursionError) as error:
        raise TaskCodeError(
            f"it cannot be parsed ({type(error).__name__}: {error}); nest less deeply"
        ) from error
    _refuse_text(source_text.foreign_name(source))
    _check_amount(tree)
    _Reader(tree).read()
    return tree


def _refuse_text(found: tuple[str, int] | None) -> None:
    if found:
        raise TaskCodeError(*found)


def _check_amount(tree: ast.Module) -> None:
    """Bound nodes, depth and the length of names, without recursion."""
    count, level = 0, [tree]
    line = 1
    for _ in range(MAX_DEPTH):
        count += len(level)
        line = next((n.lineno for n in level if hasattr(n, "lineno")), line)  # pyright: ignore[reportAttributeAccessIssue]
        for node in level:
            longest = max((len(getattr(node, f, None) or "") for f in _names_of(node)), default=0)
            if longest > source_text.MAX_WORD_CHARS:
                raise TaskCodeError(
                    f"a name of {longest} characters; {source_text.MAX_WORD_CHARS} are allowed",
                    getattr(node, "lineno", line),
                )
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if count > MAX_NODES:
            raise TaskCodeError(f"it has more than {MAX_NODES} syntax nodes; write less")
        if not level:
            return
    raise TaskCodeError(f"it is nested more than {MAX_DEPTH} levels deep; split it up", line)


def _names_of(node: ast.AST) -> tuple[str, ...]:
    """Return the fields of a node that hold a name."""
    if isinstance(node, ast.Constant):
        return ()
    return tuple(
        f for f in ("id", "attr", "arg", "name", "module") if isinstance(getattr(node, f, 0), str)
    )


class _Reader:
    """Walks a tree and refuses what is not on the lists."""

    def __init__(self, tree: ast.Module) -> None:
        self.tree = tree
        self.line = 1
        self.top_names: set[str] = set()
        """Functions, classes and constants of the module."""
        self.own_attributes: set[str] = set()
        """Methods, and attributes assigned on `self`."""
        self.local_names: set[str] = set()
        self.in_class = False

    def read(self) -> None:
        classes = [n for n in self.tree.body if isinstance(n, ast.ClassDef)]
        if len(classes) != 1:
            raise TaskCodeError(
                f"it must define exactly one class, derived from Task, but defines {len(classes)}"
            )
        for node in self.tree.body:
            self._at(node)
            if not isinstance(node, _TOP_LEVEL):
                self._refuse(
                    f"{type(node).__name__} is not allowed at module level; only imports, constants, "
                    "functions and the class are"
                )
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                self._new_name(node.name)
                self.top_names.add(node.name)
            if isinstance(node, ast.Assign | ast.AnnAssign):
                self.top_names.update(self._constant_names(node, "at module level"))
        self._collect_own_attributes(classes[0])
        for node in self.tree.body:
            self._at(node)
            match node:
                case ast.Import() | ast.ImportFrom():
                    self._import(node)
                case ast.ClassDef():
                    self._class(node)
                case ast.FunctionDef():
                    self._function(node)
                case ast.Assign() | ast.AnnAssign():
                    self._constant_value(node)
                case ast.Expr():
                    self._docstring(node)

    # -- statements

    def _constant_names(self, node: ast.Assign | ast.AnnAssign, where: str) -> list[str]:
        names: list[str] = []
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            if not isinstance(target, ast.Name):
                self._refuse(f"only plain names are assigned {where}")
            self._new_name(target.id)
            names.append(target.id)
        return names

    def _constant_value(self, node: ast.Assign | ast.AnnAssign) -> None:
        if isinstance(node, ast.AnnAssign):
            self._annotation(node.annotation)
        if node.value is not None:
            self._literal(node.value)

    def _import(self, node: ast.Import | ast.ImportFrom) -> None:
        names = [a.name for a in node.names]
        if any(a.asname for a in node.names):
            self._refuse("'import ... as' is not allowed; keep the names torch and math")
        if isinstance(node, ast.Import):
            for name in names:
                if name not in {"torch", "math"}:
                    self._refuse(
                        f"import {name} is not allowed; torch, math and typing are", name=name
                    )
            return
        known = {
            "torch": frozenset({"Tensor"}),
            "typing": allowed.TYPING,
            "factory.tasks.task": frozenset({"Task"}),
        }
        if node.level or node.module not in known:
            self._refuse(
                f"import from {node.module} is not allowed; from typing and factory.tasks.task it is"
            )
        for name in names:
            if name not in known[str(node.module)]:
                self._refuse(f"importing {name} from {node.module} is not allowed")

    def _class(self, node: ast.ClassDef) -> None:
        base = node.bases[0] if len(node.bases) == 1 else None
        if not (isinstance(base, ast.Name) and base.id == "Task") or node.keywords:
            self._refuse("the class must derive from Task and nothing else")
        if node.decorator_list:
            self._refuse("decorators on the class are not allowed")
        if node.type_params:
            self._refuse("type parameters are not allowed")
        for item in node.body:
            self._at(item)
            match item:
                case ast.FunctionDef():
                    self.in_class = True
                    self._function(item)
                    self.in_class = False
                case ast.Assign() | ast.AnnAssign():
                    self._constant_names(item, "in the class body")
                    self._constant_value(item)
                case ast.Expr():
                    self._docstring(item)
                case ast.Pass():
                    pass
                case _:
                    self._refuse(f"{type(item).__name__} is not allowed in the class body")

    def _function(self, node: ast.FunctionDef) -> None:
        a = node.args
        if node.type_params:
            self._refuse("type parameters are not allowed")
        if a.vararg or a.kwarg or a.posonlyargs or a.kwonlyargs:
            self._refuse("'*' and '**' parameters are not allowed")
        is_static = False
        for decorator in node.decorator_list:
            self._at(decorator)
            name = ast.unparse(decorator)
            if name == allowed.STATIC_DECORATOR and self.in_class:
                is_static = True
            elif name != allowed.SCRIPT_DECORATOR:
                self._refuse(
                    f"decorator {name[:60]!a} is not allowed; torch.jit.script is, and staticmethod on a method"
                )
        self._at(node)
        for default in a.defaults:
            self._literal(default)
        names = [p.arg for p in a.args]
        is_method = self.in_class and not is_static
        if is_static and node.name in allowed.TASK_METHODS:
            self._refuse(f"{node.name} cannot be a staticmethod")
        if is_method and (not names or names[0] != "self"):
            self._refuse(f"the first parameter of method {node.name} must be self")
        for name in names[1:] if is_method else names:
            self._new_name(name)
        for annotation in [p.annotation for p in a.args] + [node.returns]:
            if annotation is not None:
                self._annotation(annotation)
        self.local_names = set(names)
        for child in ast.walk(ast.Module(body=node.body, type_ignores=[])):
            if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                self._at(child)
                self._new_name(child.id)
                self.local_names.add(child.id)
        body = node.body
        if ast.get_docstring(node, clean=False) is not None:
            self._docstring(body[0])
            body = body[1:]
        for statement in body:
            self._walk(statement, loops=0)
        self.local_names = set()

    def _docstring(self, node: ast.stmt) -> None:
        value = node.value if isinstance(node, ast.Expr) else None
        if not (isinstance(value, ast.Constant) and isinstance(value.value, str)):
            self._refuse("only a docstring may stand here")

    def _literal(self, node: ast.expr) -> None:
        """Constants, and lists, tuples and dicts of them."""
        for child in ast.walk(node):
            self._at(child)
            match child:
                case ast.Constant():
                    self._constant(child)
                case ast.BinOp():
                    self._constant_sum(child)
                case ast.UnaryOp(op=ast.USub()) | ast.operator() | ast.unaryop():
                    pass
                case ast.List() | ast.Tuple() | ast.Dict() | ast.expr_context():
                    pass
                case ast.Attribute() if (self._path(child) or "").startswith("math."):
                    self._check_path(ast.unparse(child))
                case ast.Name(id="math"):
                    pass
                case _:
                    self._refuse(
                        f"{type(child).__name__} is not allowed in a constant; write its value"
                    )

    def _constant_sum(self, node: ast.BinOp) -> None:
        """Arithmetic on numbers, such as `0.5 * math.pi`; a text or a list times a number can fill the memory."""
        self._operation(node)
        for side in (node.left, node.right):
            match side:
                case ast.BinOp() | ast.UnaryOp() | ast.Attribute():
                    pass
                case ast.Constant(value=int() | float()):
                    pass
                case _:
                    self._refuse("only numbers can be calculated with in a constant")

    def _annotation(self, node: ast.expr) -> None:
        for child in ast.walk(node):
            self._at(child)
            match child:
                case ast.Name():
                    if child.id not in allowed.TYPING | {
                        "Tensor", "torch", "str", "int", "float", "bool", "dict", "list", "tuple",
                    }:  # fmt: skip
                        self._refuse(f"type {child.id} is not known")
                case ast.Attribute():
                    if ast.unparse(child) != "torch.Tensor":
                        self._refuse(f"type {ast.unparse(child)[:60]} is not known")
                case ast.Constant(value=None) | ast.Subscript() | ast.Tuple() | ast.expr_context():
                    pass
                case ast.BinOp(op=ast.BitOr()) | ast.BitOr():
                    pass
                case _:
                    self._refuse(f"{type(child).__name__} is not allowed in an annotation")

    def _walk(self, node: ast.AST, loops: int) -> None:
        self._at(node)
        kind = type(node).__name__
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            self._refuse("functions and classes inside functions are not allowed")
        if isinstance(node, ast.Import | ast.ImportFrom):
            self._refuse("import inside a function is not allowed; put it at the top")
        if not isinstance(node, _EXPRESSIONS + _STATEMENTS):
            self._refuse(_WORDS.get(kind, f"{kind} is not allowed"))
        match node:
            case ast.For() | ast.ListComp():
                loops += 1
                if loops > MAX_LOOP_DEPTH or len(getattr(node, "generators", [])) > 1:
                    self._refuse(f"loops are nested more than {MAX_LOOP_DEPTH} deep")
            case ast.Constant():
                self._constant(node)
            case ast.JoinedStr() | ast.FormattedValue():
                self._f_string(node)
            case ast.Name():
                self._name(node)
            case ast.Attribute():
                self._attribute(node)
            case ast.Call():
                self._call(node)
            case ast.BinOp():
                self._operation(node)
            case ast.AugAssign():
                # Looked at as the operation it stands for: 'n **= m' is 'n = n ** m'.
                self._operation(ast.BinOp(left=node.target, op=node.op, right=node.value))
            case ast.comprehension(is_async=1):
                self._refuse("async is not allowed")
            case ast.AnnAssign():
                self._annotation(node.annotation)
                for part in (node.target, node.value):
                    if part is not None:
                        self._walk(part, loops)
                return
        if isinstance(node, ast.Attribute) and self._path(node) is not None:
            return  # torch.norm: looked at as a whole
        if isinstance(node, ast.Call) and self._is_super(node.func):
            for argument in [*node.args, *[k.value for k in node.keywords]]:
                self._walk(argument, loops)
            return
        for child in ast.iter_child_nodes(node):
            self._walk(child, loops)

    # -- expressions

    def _constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, str):
            if len(value) > MAX_STRING_CHARS:
                self._refuse(
                    f"a string of {len(value)} characters; {MAX_STRING_CHARS} are allowed"
                )
            if _WIDE_FORMAT.search(value):
                self._refuse("format strings with a width are not allowed")
            self._hidden(value)
        elif isinstance(value, bool) or value is None or value is Ellipsis:
            pass
        elif isinstance(value, int | float):
            if isinstance(value, int) and abs(value) > MAX_NUMBER:
                self._refuse(
                    f"the whole number is larger than {MAX_NUMBER:g}; write it as 1e9 if no size or count is meant"
                )
        else:
            self._refuse(f"{type(value).__name__} constants are not allowed")

    def _hidden(self, value: str) -> None:
        """What an escape such as backslash-x-1-b puts into a string."""
        found = source_text.hidden_character(value.replace("\r", ""))
        if found:
            self._refuse("a string: " + found[0])

    def _f_string(self, node: ast.JoinedStr | ast.FormattedValue) -> None:
        if isinstance(node, ast.FormattedValue) and (
            not isinstance(node.value, ast.Name) or node.format_spec or node.conversion != -1
        ):
            self._refuse("f-strings may hold plain names only")

    def _name(self, node: ast.Name) -> None:
        name = node.id
        if isinstance(node.ctx, ast.Store):
            return
        if name in {"torch", "math"}:
            self._refuse(f"'{name}' is not a value; use {name}.<function>")
        if name == "super":
            self._refuse("super() may only be used to call a method of the base class")
        known = (self.local_names, self.top_names, allowed.BUILTINS)
        if name == "Tensor" or any(name in names for names in known):
            return
        what = "builtin" if hasattr(builtins, name) else "name"
        if name in allowed.INSTEAD:
            self._refuse(f"{what} '{name}' is not allowed; {allowed.INSTEAD[name]}")
        self._refuse(f"{what} '{name}' is not allowed.", name=name, known=set(allowed.BUILTINS))

    def _attribute(self, node: ast.Attribute) -> None:
        is_own = isinstance(node.value, ast.Name) and node.value.id == "self"
        if not isinstance(node.ctx, ast.Load) and not (is_own and self.in_class):
            self._refuse("attributes can only be assigned on self")
        path = self._path(node)
        if path is not None:
            self._check_path(path)
            return
        if self._is_super(node):
            self._refuse("methods of the base class may only be called")
        name = node.attr
        if (name.startswith("_") or name.endswith("_")) and name not in allowed.IN_PLACE:
            self._refuse(
                f"attribute '{name}' is not allowed; none with an underscore at either end is"
            )
        if name in allowed.ATTRIBUTES or (is_own and name in self.own_attributes):
            return
        self._refuse(f"attribute '{name}' is not allowed.", name=name, known=allowed.ATTRIBUTES)

    def _path(self, node: ast.Attribute) -> str | None:
        """Return `torch.linalg.norm` for such an expression, None for others."""
        parts, at = [node.attr], node.value
        while isinstance(at, ast.Attribute):
            parts.append(at.attr)
            at = at.value
        if isinstance(at, ast.Name) and at.id in {"torch", "math"}:
            return ".".join([at.id, *reversed(parts)])
        return None

    def _check_path(self, path: str) -> None:
        root, _, rest = path.partition(".")
        known = {f"math.{n}" for n in allowed.MATH} | {f"torch.{n}" for n in allowed.TORCH}
        known |= {f"torch.{s}.{n}" for s, ns in allowed.TORCH_NAMESPACES.items() for n in ns}
        if path not in known:
            close = {k for k in known if k.startswith(root)}
            del rest
            self._refuse(f"'{path[:60]}' is not allowed.", name=path, known=close)

    def _is_super(self, node: ast.expr) -> bool:
        return (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Call)
            and isinstance(node.value.func, ast.Name)
            and node.value.func.id == "super"
        )

    def _call(self, node: ast.Call) -> None:
        for keyword in node.keywords:
            if keyword.arg is None:
                self._refuse("'**' in a call is not allowed; name the arguments")
            if keyword.arg == "out" or keyword.arg.startswith("_"):
                self._refuse(f"argument '{keyword.arg}' is not allowed; assign the result")
            is_off = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            if keyword.arg in {"requires_grad", "pin_memory"} and not is_off:
                self._refuse(f"argument '{keyword.arg}' is not allowed; leave it out")
        if self._is_super(node.func):
            if not self.in_class:
                self._refuse("super() may only be used in a method of the class")
            inner = node.func.value  # pyright: ignore[reportAttributeAccessIssue]
            method = node.func.attr  # pyright: ignore[reportAttributeAccessIssue]
            if inner.args or inner.keywords or method not in allowed.TASK_METHODS:
                self._refuse(
                    f"super() may only call {', '.join(sorted(allowed.TASK_METHODS))}, not '{method}'"
                )
        elif not isinstance(node.func, ast.Name | ast.Attribute):
            self._refuse("only functions and methods with a name may be called")

    def _operation(self, node: ast.BinOp) -> None:
        if isinstance(node.op, ast.Pow) and not (
            isinstance(node.right, ast.Constant)
            and isinstance(node.right.value, int | float)
            and abs(node.right.value) <= MAX_EXPONENT
        ):
            self._refuse(f"the exponent of '**' must be a number of at most {MAX_EXPONENT}")
        if isinstance(node.op, ast.Pow) and self._is_power_of_numbers(node.left):
            self._refuse("powers of powers of numbers are not allowed; write the value")
        if isinstance(node.op, ast.LShift | ast.RShift):
            self._refuse("shifts are not allowed")
        texts = (ast.List, ast.Tuple, ast.JoinedStr)
        if isinstance(node.op, ast.Mult) and any(
            isinstance(s, texts) or (isinstance(s, ast.Constant) and isinstance(s.value, str))
            for s in (node.left, node.right)
        ):
            self._refuse("lists and strings cannot be multiplied; use torch.full")

    def _is_power_of_numbers(self, node: ast.expr) -> bool:
        parts = list(ast.walk(node))
        return any(isinstance(p, ast.Pow) for p in parts) and not any(
            isinstance(p, ast.Name) for p in parts
        )

    # -- helpers

    def _collect_own_attributes(self, node: ast.ClassDef) -> None:
        constants = {
            id(t)
            for item in node.body
            if isinstance(item, ast.Assign | ast.AnnAssign)
            for t in (item.targets if isinstance(item, ast.Assign) else [item.target])
        }
        for child in ast.walk(node):
            self._at(child)
            name = None
            if isinstance(child, ast.FunctionDef):
                name = child.name
                if name in allowed.TASK_METHODS:
                    self.own_attributes.add(name)
                    continue
            elif isinstance(child, ast.Name) and id(child) in constants:
                name = child.id
            elif isinstance(child, ast.Attribute) and isinstance(child.ctx, ast.Store):
                if not (isinstance(child.value, ast.Name) and child.value.id == "self"):
                    self._refuse("attributes can only be assigned on self")
                name = child.attr
                if name in {"envs", "scene_info", "urdf_assets_root"}:
                    self._refuse(f"self.{name} belongs to the base class")
                if name == "task_description":
                    continue
            if name is None:
                continue
            if name.startswith("_") or name.endswith("_"):
                self._refuse(f"'{name}': names with an underscore at either end are not allowed")
            # A method called on something else than self must not reach what tensors can do.
            if hasattr(torch.Tensor, name) or hasattr(Task, name) or hasattr(dict, name):
                self._refuse(f"'{name}' is taken; choose another name")
            self.own_attributes.add(name)

    def _new_name(self, name: str) -> None:
        if name.startswith("_") and name != "_" and not (self.in_class and name == "__init__"):
            self._refuse(f"name '{name}' is not allowed; none with an underscore in front is")
        if name in {"torch", "math", "super", "self", "Task", "Tensor"}:
            self._refuse(f"'{name}' cannot be redefined")
        if not name.isascii():
            self._refuse(f"name '{name}' is not ASCII")

    def _at(self, node: ast.AST) -> None:
        self.line = getattr(node, "lineno", self.line)

    def _refuse(
        self, reason: str, *, name: str = "", known: set[str] | frozenset[str] | None = None
    ) -> typing.NoReturn:
        if known:
            hint = did_you_mean(name, known)
            reason += hint if len(hint) < 400 else hint.split(" Known:")[0]
        raise TaskCodeError(reason.strip(), self.line)
