"""Conditions become slopes: where a condition is not yet true, its softened form says how far off it is."""

import ast
import copy
from collections.abc import Callable

STEEPNESS = 10.0
"""Per unit (metres, mostly): 5 cm short of a threshold a condition is worth one half."""

Definition = Callable[[str], ast.expr | None]


def softened(condition: ast.expr, definition: Definition) -> ast.expr | None:
    """Return a float expression that is 1 where the condition is true and falls off smoothly; None if it has no slope.

    Args:
        condition: comparisons, joined by `&`, `|` or torch's and Python's words for them.
        definition: what a name stands for; None where it should be left alone.
    """
    match condition:
        case ast.Name(id=name):
            made = definition(name)
            return None if made is None else softened(made, definition)
        case ast.BinOp(left=left, op=ast.BitAnd(), right=right):
            return _joined(left, right, ast.Mult(), definition)
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            a, b = softened(left, definition), softened(right, definition)
            if a is None or b is None:
                return a or b
            return _call("torch.maximum", a, b)
        case ast.Call(func=ast.Attribute(attr="logical_and"), args=[left, right]):
            return _joined(left, right, ast.Mult(), definition)
        case ast.Call(func=ast.Attribute(value=inner, attr="float" | "bool"), args=[]):
            return softened(inner, definition)
        case ast.Compare(left=left, ops=[ast.Lt() | ast.LtE()], comparators=[right]):
            return _within(left, right, definition)
        case ast.Compare(left=left, ops=[ast.Gt() | ast.GtE()], comparators=[right]):
            return _within(right, left, definition)
    return None


def conditions(expr: ast.expr, definition: Definition) -> list[tuple[str, ast.expr]]:
    """Return the conditions that are joined by `and`, each with its name, if it has one."""
    match expr:
        case ast.BinOp(left=left, op=ast.BitAnd(), right=right):
            return conditions(left, definition) + conditions(right, definition)
        case ast.Call(func=ast.Attribute(attr="logical_and"), args=[left, right]):
            return conditions(left, definition) + conditions(right, definition)
        case ast.Name(id=name):
            made = definition(name)
            inside = [] if made is None else conditions(made, definition)
            if len(inside) > 1:
                return inside
            return [(name, expr)] if made is None else [(name, made)]
    return [("", expr)]


def gates_softened(expr: ast.expr, definition: Definition) -> tuple[ast.expr, int]:
    """Return an expression with its conditions-as-numbers (`(a < b).float()`) softened, and how many there were."""
    softener = _Softener(definition)
    return softener.visit(copy.deepcopy(expr)), softener.count


class _Softener(ast.NodeTransformer):
    def __init__(self, definition: Definition) -> None:
        self.definition = definition
        self.count = 0

    def visit_Call(self, node: ast.Call) -> ast.AST:
        match node:
            case ast.Call(func=ast.Attribute(value=inner, attr="float"), args=[]):
                soft = softened(inner, self.definition)
                if soft is not None:
                    self.count += 1
                    return soft
            case ast.Call(
                func=ast.Attribute(attr="where"),
                args=[choice, ast.expr() as yes, ast.expr() as no],
            ) if _is_number(no) or _is_inert(no):
                soft = softened(choice, self.definition)
                if soft is not None:
                    self.count += 1
                    return ast.BinOp(soft, ast.Mult(), self.visit(yes))
        return self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        made = self.definition(node.id)
        if made is None:
            return node
        before = self.count
        soft = self.visit(copy.deepcopy(made))
        return soft if self.count > before else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        """A grasp comes after a touch: half of it for the touch."""
        key = _flag_of(node, self.definition)
        if key is not None and key.endswith("_grasped"):
            self.count += 1
            return _with_touch(key)
        return self.generic_visit(node)


def _joined(
    left: ast.expr, right: ast.expr, op: ast.operator, definition: Definition
) -> ast.expr | None:
    a, b = softened(left, definition), softened(right, definition)
    if a is None or b is None:
        return a or b
    return ast.BinOp(a, op, b)


def _within(low: ast.expr, high: ast.expr, definition: Definition) -> ast.expr:
    """Return `1 - tanh(k * max(low - high, 0))`; a share that is asked to be above one half is the slope itself."""
    for side, other in ((high, low), (low, high)):
        key = _flag_of(side, definition)
        if key is not None and _is_number(other):
            flag = _with_touch(key) if key.endswith("_grasped") else _state(key)
            return flag if side is high else ast.BinOp(ast.Constant(1.0), ast.Sub(), flag)
    short = ast.BinOp(low, ast.Sub(), high)
    clamped = ast.Call(
        ast.Attribute(short, "clamp", ast.Load()), [], [ast.keyword("min", ast.Constant(0.0))]
    )
    scaled = ast.BinOp(ast.Constant(STEEPNESS), ast.Mult(), clamped)
    return ast.BinOp(ast.Constant(1.0), ast.Sub(), _call("torch.tanh", scaled))


def _flag_of(node: ast.expr, definition: Definition) -> str | None:
    """Return the key of a 0-or-1 state that an expression is."""
    match node:
        case ast.Name(id=name):
            made = definition(name)
            return None if made is None else _flag_of(made, definition)
        case ast.Subscript(value=ast.Name(id="states"), slice=ast.Constant(value=str() as key)):
            return key if key.endswith(("_grasped", "_touched")) else None
    return None


def _with_touch(key: str) -> ast.expr:
    """A grasp comes after a touch: half of its worth for the touch."""
    both = ast.BinOp(_state(key), ast.Add(), _state(f"{key.removesuffix('_grasped')}_touched"))
    return ast.BinOp(ast.Constant(0.5), ast.Mult(), both)


def _state(key: str) -> ast.expr:
    return ast.Subscript(ast.Name("states", ast.Load()), ast.Constant(key), ast.Load())


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def _is_inert(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and getattr(node.func, "attr", "") in {"zeros_like", "zeros"}


def _call(path: str, *args: ast.expr) -> ast.Call:
    func = ast.parse(path, mode="eval").body
    return ast.Call(func, list(args), [])
