"""What has the same rules everywhere in a program: constants, arithmetic, types, the functions of torch and math."""

import ast
import re

from v2p_data.task.sandbox import allowed, source_text
from v2p_data.task.sandbox.reader.refusal import Here

_WIDE_FORMAT = re.compile(r"%(?:\(\w*\))?[-+ #0]*(?:\d{3,}|\*|\d{0,2}\.(?:\d{3,}|\*))")
_LIBRARY = frozenset(
    {f"math.{name}" for name in allowed.MATH}
    | {f"torch.{name}" for name in allowed.TORCH}
    | {f"torch.{s}.{name}" for s, names in allowed.TORCH_NAMESPACES.items() for name in names}
)


def library_path(node: ast.Attribute) -> str | None:
    """Return `torch.linalg.norm` for such an expression, None for others."""
    parts, at = [node.attr], node.value
    while isinstance(at, ast.Attribute):
        parts.append(at.attr)
        at = at.value
    if isinstance(at, ast.Name) and at.id in allowed.MODULES:
        return ".".join([at.id, *reversed(parts)])
    return None


class Values:
    """Reads values.

    Args:
        here: where the reading is.
    """

    def __init__(self, here: Here) -> None:
        self.here = here

    def read_path(self, path: str) -> None:
        """Read what `library_path` returns."""
        if path not in _LIBRARY:
            root = path.partition(".")[0]
            close = {known for known in _LIBRARY if known.startswith(root)}
            self.here.refuse(f"'{path[:60]}' is not allowed.", name=path, known=close)

    def read_constant(self, node: ast.Constant) -> None:
        """Read a single constant."""
        match node.value:
            case str() as text:
                self._read_text(text)
            case bool() | None:
                pass
            case int() as number if abs(number) > allowed.MAX_NUMBER:
                self.here.refuse(
                    f"the whole number is larger than {allowed.MAX_NUMBER:g}; write it as 1e9 if "
                    "no size or count is meant"
                )
            case int() | float():
                pass
            case value if value is not Ellipsis:
                self.here.refuse(f"{type(value).__name__} constants are not allowed")

    def _read_text(self, text: str) -> None:
        if len(text) > allowed.MAX_STRING_CHARS:
            self.here.refuse(
                f"a string of {len(text)} characters; {allowed.MAX_STRING_CHARS} are allowed"
            )
        if _WIDE_FORMAT.search(text):
            self.here.refuse("format strings with a width are not allowed")
        # What an escape such as backslash-x-1-b puts into a string.
        found = source_text.hidden_character(text.replace("\r", ""))
        if found:
            self.here.refuse("a string: " + found[0])

    def read_literal(self, node: ast.expr) -> None:
        """Read what is constant by its form: constants, and lists, tuples and dicts of them."""
        for child in ast.walk(node):
            self.here.move_to(child)
            match child:
                case ast.Constant():
                    self.read_constant(child)
                case ast.BinOp():
                    self._read_sum(child)
                case ast.UnaryOp(op=ast.USub()) | ast.operator() | ast.unaryop():
                    pass
                case ast.List() | ast.Tuple() | ast.Dict() | ast.expr_context():
                    pass
                case ast.Attribute() if (library_path(child) or "").startswith("math."):
                    self.read_path(ast.unparse(child))
                case ast.Name(id="math"):
                    pass
                case _:
                    self.here.refuse(
                        f"{type(child).__name__} is not allowed in a constant; write its value"
                    )

    def _read_sum(self, node: ast.BinOp) -> None:
        """Read arithmetic on numbers, such as `0.5 * math.pi`; a text or a list times a number can fill the memory."""
        self.read_operation(node)
        for side in (node.left, node.right):
            match side:
                case ast.BinOp() | ast.UnaryOp() | ast.Attribute():
                    pass
                case ast.Constant(value=int() | float()):
                    pass
                case _:
                    self.here.refuse("only numbers can be calculated with in a constant")

    def read_operation(self, node: ast.BinOp) -> None:
        """Read what an operation does to its two sides; the sides themselves are not read."""
        match node.op:
            case ast.Pow():
                if not _is_small_exponent(node.right):
                    self.here.refuse(
                        f"the exponent of '**' must be a number of at most {allowed.MAX_EXPONENT}"
                    )
                if _is_power_of_numbers(node.left):
                    self.here.refuse(
                        "powers of powers of numbers are not allowed; write the value"
                    )
            case ast.LShift() | ast.RShift():
                self.here.refuse("shifts are not allowed")
            case ast.Mult() if _is_sequence(node.left) or _is_sequence(node.right):
                self.here.refuse("lists and strings cannot be multiplied; use torch.full")

    def read_annotation(self, node: ast.expr) -> None:
        """Read a type."""
        for child in ast.walk(node):
            self.here.move_to(child)
            match child:
                case ast.Name():
                    if child.id not in allowed.TYPES:
                        self.here.refuse(f"type {child.id} is not known")
                case ast.Attribute():
                    if ast.unparse(child) != "torch.Tensor":
                        self.here.refuse(f"type {ast.unparse(child)[:60]} is not known")
                case ast.Constant(value=None) | ast.Subscript() | ast.Tuple() | ast.expr_context():
                    pass
                case ast.BinOp(op=ast.BitOr()) | ast.BitOr():
                    pass
                case _:
                    self.here.refuse(f"{type(child).__name__} is not allowed in an annotation")


def _is_small_exponent(node: ast.expr) -> bool:
    match node:
        case ast.Constant(value=int() | float() as number):
            return abs(number) <= allowed.MAX_EXPONENT
    return False


def _is_power_of_numbers(node: ast.expr) -> bool:
    parts = list(ast.walk(node))
    return any(isinstance(p, ast.Pow) for p in parts) and not any(
        isinstance(p, ast.Name) for p in parts
    )


def _is_sequence(node: ast.expr) -> bool:
    match node:
        case ast.List() | ast.Tuple() | ast.JoinedStr() | ast.Constant(value=str()):
            return True
    return False
