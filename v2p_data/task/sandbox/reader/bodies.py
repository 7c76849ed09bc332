"""What stands inside functions: every statement and expression, and every name that is read there."""

import ast
import builtins

from v2p_data.task.sandbox import allowed
from v2p_data.task.sandbox.reader.names import Names, is_on_self
from v2p_data.task.sandbox.reader.refusal import Here
from v2p_data.task.sandbox.reader.values import Values, library_path


class Bodies:
    """Reads the bodies of functions.

    Args:
        here: where the reading is.
        names: what the program has named; `names.local` is the function's own.
        values: reads constants and types.
    """

    def __init__(self, here: Here, names: Names, values: Values) -> None:
        self.here, self.names, self.values = here, names, values

    def read(self, node: ast.AST, loops: int = 0) -> None:
        """Read a statement or expression with all that is in it.

        Args:
            node: any node.
            loops: how many loops it stands in.
        """
        self.here.move_to(node)
        self._read_kind(node)
        if isinstance(node, ast.For | ast.ListComp):
            loops += 1
            if loops > allowed.MAX_LOOP_DEPTH or len(getattr(node, "generators", [])) > 1:
                self.here.refuse(f"loops are nested more than {allowed.MAX_LOOP_DEPTH} deep")
        match node:
            case ast.Constant():
                self.values.read_constant(node)
            case ast.FormattedValue():
                self._read_formatted(node)
            case ast.Name() if not isinstance(node.ctx, ast.Store):
                self._read_name(node.id)
            case ast.Attribute():
                self._read_attribute(node)
            case ast.Call():
                self._read_call(node)
            case ast.BinOp():
                self.values.read_operation(node)
            case ast.AugAssign():
                # Looked at as the operation it stands for: 'n **= m' is 'n = n ** m'.
                self.values.read_operation(
                    ast.BinOp(left=node.target, op=node.op, right=node.value)
                )
            case ast.comprehension(is_async=1):
                self.here.refuse("async is not allowed")
            case ast.AnnAssign():
                self.values.read_annotation(node.annotation)
        for child in _left_to_read(node):
            self.read(child, loops)

    def _read_kind(self, node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            self.here.refuse("functions and classes inside functions are not allowed")
        if isinstance(node, ast.Import | ast.ImportFrom):
            self.here.refuse("import inside a function is not allowed; put it at the top")
        if not isinstance(node, allowed.IN_FUNCTIONS):
            kind = type(node).__name__
            self.here.refuse(allowed.INSTEAD_OF_SYNTAX.get(kind, f"{kind} is not allowed"))

    def _read_formatted(self, node: ast.FormattedValue) -> None:
        if not isinstance(node.value, ast.Name) or node.format_spec or node.conversion != -1:
            self.here.refuse("f-strings may hold plain names only")

    def _read_name(self, name: str) -> None:
        if name in allowed.MODULES:
            self.here.refuse(f"'{name}' is not a value; use {name}.<function>")
        if name == "super":
            self.here.refuse("super() may only be used to call a method of the base class")
        known = (self.names.local, self.names.top, allowed.BUILTINS)
        if name == "Tensor" or any(name in names for names in known):
            return
        what = "builtin" if hasattr(builtins, name) else "name"
        if name in allowed.INSTEAD:
            self.here.refuse(f"{what} '{name}' is not allowed; {allowed.INSTEAD[name]}")
        self.here.refuse(f"{what} '{name}' is not allowed.", name=name, known=allowed.BUILTINS)

    def _read_attribute(self, node: ast.Attribute) -> None:
        is_own = is_on_self(node)
        if not isinstance(node.ctx, ast.Load) and not (is_own and self.names.in_class):
            self.here.refuse("attributes can only be assigned on self")
        path = library_path(node)
        if path is not None:
            self.values.read_path(path)
            return
        if _super_method(node) is not None:
            self.here.refuse("methods of the base class may only be called")
        name = node.attr
        if (name.startswith("_") or name.endswith("_")) and name not in allowed.IN_PLACE:
            self.here.refuse(
                f"attribute '{name}' is not allowed; none with an underscore at either end is"
            )
        if name in allowed.ATTRIBUTES or (is_own and name in self.names.own):
            return
        self.here.refuse(
            f"attribute '{name}' is not allowed.", name=name, known=allowed.ATTRIBUTES
        )

    def _read_call(self, node: ast.Call) -> None:
        for keyword in node.keywords:
            self._read_argument(keyword)
        called = _super_method(node.func)
        if called is not None:
            if not self.names.in_class:
                self.here.refuse("super() may only be used in a method of the class")
            inner, method = called
            if inner.args or inner.keywords or method not in allowed.TASK_METHODS:
                self.here.refuse(
                    f"super() may only call {', '.join(sorted(allowed.TASK_METHODS))}, not '{method}'"
                )
            if method == "__init__" and self.names.function != method:
                self.here.refuse("super().__init__ may only be called in __init__, once for all")
        elif not isinstance(node.func, ast.Name | ast.Attribute):
            self.here.refuse("only functions and methods with a name may be called")

    def _read_argument(self, keyword: ast.keyword) -> None:
        name = keyword.arg
        if name is None:
            self.here.refuse("'**' in a call is not allowed; name the arguments")
        if name == "out" or name.startswith("_"):
            self.here.refuse(f"argument '{name}' is not allowed; assign the result")
        is_off = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
        if name in {"requires_grad", "pin_memory"} and not is_off:
            self.here.refuse(f"argument '{name}' is not allowed; leave it out")
        if name == "rounding_mode" and ast.unparse(keyword.value) not in ("None", "'floor'"):
            self.here.refuse(
                "argument 'rounding_mode' may only be 'floor': the least whole number divided by -1 with 'trunc' ends"
                " the process; write torch.trunc(a / b)"
            )


def _left_to_read(node: ast.AST) -> list[ast.AST]:
    """Return the children of a node, without those that were read with it."""
    match node:
        case ast.AnnAssign(target=target, value=value):
            return [target] if value is None else [target, value]
        case ast.Attribute() if library_path(node) is not None:
            return []  # torch.norm: looked at as a whole
        case ast.Call(func=func, args=args, keywords=keywords) if _super_method(func) is not None:
            return [*args, *(k.value for k in keywords)]
    return list(ast.iter_child_nodes(node))


def _super_method(node: ast.expr) -> tuple[ast.Call, str] | None:
    """Return the call of `super` and the method's name for `super().method`, None for anything else."""
    match node:
        case ast.Attribute(value=ast.Call(func=ast.Name(id="super")) as call, attr=method):
            return call, method
    return None
