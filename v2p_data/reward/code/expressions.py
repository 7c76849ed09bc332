"""Constant factors, numbers and names in the expressions of a reward."""

import ast
import copy


def split_constant(expr: ast.expr) -> tuple[float, ast.expr]:
    """Return the constant factors of a product, multiplied, and the rest."""
    match expr:
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            factor, rest = split_constant(inner)
            return -factor, rest
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            for one, other in ((left, right), (right, left)):
                value = constant(one)
                if value is not None:
                    factor, rest = split_constant(other)
                    return value * factor, rest
            factor, rest = split_constant(left)
            if factor != 1.0:
                return factor, ast.BinOp(rest, ast.Mult(), right)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            factor, rest = split_constant(left)
            if factor != 1.0:
                return factor, ast.BinOp(rest, ast.Div(), right)
    return 1.0, expr


def constant(node: ast.AST) -> float | None:
    """Return the number that an expression is."""
    match node:
        case ast.Constant(value=bool()):
            return None
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            value = constant(inner)
            return None if value is None else -value
    return None


def number(value: float) -> str:
    """Return a number as it stands in code."""
    text = repr(float(f"{value:.4g}"))
    return text.removesuffix("e+00")


def times(text: str, factor: float) -> str:
    """Return an expression multiplied, in its leading constant where it has one."""
    text = text.strip()
    expr = ast.parse(text, mode="eval").body
    leading = _leading_constant(expr)
    if leading is not None:
        return with_number(text, leading, (constant(leading) or 0.0) * factor)
    if constant(expr) is not None:
        return number((constant(expr) or 0.0) * factor)
    is_whole = isinstance(expr, ast.Name | ast.Call | ast.Subscript | ast.Attribute)
    return f"{number(factor)} * {text if is_whole else f'({text})'}"


def _leading_constant(node: ast.expr) -> ast.expr | None:
    match node:
        case ast.BinOp(op=ast.Mult(), right=right) if constant(right) is not None:
            return right
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div()) if constant(left) is None:
            return _leading_constant(left)
        case ast.BinOp(left=left, op=ast.Mult()):
            return left
    return None


def with_number(text: str, node: ast.AST, value: float) -> str:
    """Return a text of one line with a number in the place of a node that was parsed from it."""
    data = text.encode()  # the parser counts bytes
    begin, end = getattr(node, "col_offset", 0), getattr(node, "end_col_offset", 0)
    return data[:begin].decode() + number(value) + data[end:].decode()


def copy_with_number(statement: ast.stmt, node: ast.AST, value: float) -> ast.stmt:
    """Return a copy of a statement with a number in the place of one of its nodes."""
    # What is in the memo counts as copied already.
    memo = {id(node): ast.parse(number(value), mode="eval").body}
    return ast.fix_missing_locations(copy.deepcopy(statement, memo))


def stored_names(node: ast.AST) -> set[str]:
    """Return the names that a statement sets or changes in place."""
    names = {
        n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }
    for child in ast.walk(node):
        if isinstance(child, ast.Subscript | ast.Attribute) and isinstance(child.ctx, ast.Store):
            inner: ast.AST = child
            while isinstance(inner, ast.Subscript | ast.Attribute):
                inner = inner.value
            names |= {inner.id} if isinstance(inner, ast.Name) else set()
    if isinstance(node, ast.Expr):  # a call may change what it is called on: parts.update(...)
        names |= set(names_in(node))
    return names


def names_in(node: ast.AST) -> list[str]:
    """Return the names in an expression or statement, those that it sets included, as often as they occur."""
    return [n.id for n in ast.walk(node) if isinstance(n, ast.Name)]


def free_name(name: str, taken: set[str]) -> str:
    """Return a name that is not taken, as near to the wanted one as can be."""
    while name in taken:
        name += "_"
    return name
