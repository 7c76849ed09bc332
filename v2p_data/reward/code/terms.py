"""Follows a reward's total to its summands and matches each with a component: what is really paid, and how much of it.

The total is `scale * (part + part + ...)`; components that are no summand are logged only, and those that are sums of
other components are no parts at all.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass

from v2p_data.reward.code.components import Components
from v2p_data.reward.code.expressions import constant, free_name, split_constant, times
from v2p_data.reward.code.function_body import Body, UnreadableError


@dataclass(frozen=True, kw_only=True)
class Part:
    """One summand of the total."""

    name: str
    text: str
    """Its expression, weight included."""
    position: int
    """Where it stood in the function; names mean what they meant there."""
    is_paid: bool = True
    """Otherwise it is logged only."""
    note: str = ""
    """Why it was changed; becomes a comment."""

    @property
    def expr(self) -> ast.expr:
        """Its expression, parsed."""
        return ast.parse(self.text.strip(), mode="eval").body

    @property
    def weight(self) -> float:
        """The constant in front of its expression."""
        return split_constant(self.expr)[0]


@dataclass(frozen=True)
class _Term:
    """A summand of the total."""

    node: ast.expr
    position: int
    name: str | None
    """The component that it is."""
    factor: float
    """What remains in front of it if the components carry their own weights."""


def returned(body: Body) -> tuple[ast.expr, ast.expr]:
    """Return what the function returns: the total and its components.

    Raises:
        UnreadableError: it ends in another way.
    """
    match [line.node for line in body.lines[-1:]]:
        case [ast.Return(value=ast.Tuple(elts=[total, holder]))]:
            return total, holder
    raise UnreadableError("it does not end by returning a total and its components")


def taken_apart(
    body: Body, total: ast.expr, components: Components
) -> tuple[float, tuple[Part, ...]]:
    """Return the scale of the total and its parts, those that are logged only among them.

    Raises:
        UnreadableError: the total has nothing to do with the components.
    """
    known: dict[str, tuple[float, str]] = {}
    for name, (position, expr) in components.found.items():
        factor, core = split_constant(body.inlined(expr, position))
        known[name] = (factor, ast.dump(core))
    single = {k: v for k, v in known.items() if not _is_sum_of_others(k, body, components, known)}
    terms = _Sum(body, components, single).terms(total, len(body.lines) - 1)
    factors = [t.factor for t in terms]
    scale = max(set(factors), key=factors.count) if terms else 1.0
    parts = [_component_part(name, terms, scale, components) for name in single]
    rest = [t for t in terms if t.name is None]
    for i, term in enumerate(rest):
        name = free_name("rest" if i == 0 else f"rest_{i}", set(components.found))
        text = components.text_of(term.node, term.position)
        if constant(term.node) is not None and parts:
            text = f"torch.full_like({parts[0].text}, {text})"
        text = _weighted(text, term.factor / scale)
        parts.append(Part(name=name, text=text, position=term.position))
    if not any(p.is_paid for p in parts):
        raise UnreadableError("the total is made of none of its components")
    _demand_one_meaning(parts, body)
    return scale, tuple(parts)


def _is_sum_of_others(
    name: str, body: Body, components: Components, known: dict[str, tuple[float, str]]
) -> bool:
    position, expr = components.found[name]
    others = {k: v for k, v in known.items() if k != name}
    terms = _Sum(body, components, others).terms(expr, position)
    return len(terms) > 1 and any(t.name for t in terms)


def _component_part(name: str, terms: list[_Term], scale: float, components: Components) -> Part:
    position, expr = components.found[name]
    share = sum(t.factor for t in terms if t.name == name) / scale
    text = components.text_of(expr, position)
    if share:
        text = _weighted(text, share)
    return Part(name=name, text=text, position=position, is_paid=share != 0)


def _weighted(text: str, factor: float) -> str:
    return text if abs(factor - 1) < 1e-9 else times(text, factor)


def _demand_one_meaning(parts: list[Part], body: Body) -> None:
    """Refuse rewards in which a name means one thing to a part and another at the end."""
    end = len(body.lines)
    for part in parts:
        for node in ast.walk(part.expr):
            if isinstance(node, ast.Name) and body.is_set_between(node.id, part.position, end):
                raise UnreadableError(f"it gives '{node.id}' two meanings")


class _Sum:
    """Takes sums apart.

    Args:
        body: the reward function.
        components: its components.
        known: of the components that count as summands, constant factor and dumped rest with names inlined.
    """

    def __init__(
        self, body: Body, components: Components, known: dict[str, tuple[float, str]]
    ) -> None:
        self.body, self.components, self.known = body, components, known

    def terms(self, expr: ast.expr, position: int) -> list[_Term]:
        """Return the summands of an expression that are not always 0, each with the component that it is."""
        found = [t for t in self._summands(expr, position, 1.0) if t.factor]
        return [t for t in found if not _is_zeros(self.body.inlined(t.node, t.position))]

    def _summands(self, node: ast.expr, at: int, factor: float) -> Iterator[_Term]:
        found = self._component(node, at)
        if found is not None:
            name, share = found
            yield _Term(node, at, name, factor * share)
            return
        inner = self._opened(node, at, factor)
        if inner is not None:
            for part in inner:
                yield from self._summands(*part)
        elif constant(node) != 0:
            yield _Term(node, at, None, factor)

    def _component(self, node: ast.expr, at: int) -> tuple[str, float] | None:
        """Return the component that an expression is, and how many times it."""
        key = self.components.entry(node)
        if key in self.known:
            return key, 1.0
        factor, core = split_constant(self.body.inlined(node, at))
        if isinstance(core, ast.Constant):
            return None
        dump = ast.dump(core)
        for name, (weight, other) in self.known.items():
            if dump == other and weight:
                return name, factor / weight
        return None

    def _opened(
        self, node: ast.expr, at: int, factor: float
    ) -> list[tuple[ast.expr, int, float]] | None:
        """Return what a sum or a multiple is made of: expression, position, factor; None for anything else."""
        match node:
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                return [
                    (left, at, factor),
                    (right, at, -factor if isinstance(op, ast.Sub) else factor),
                ]
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                for one, rest in ((left, right), (right, left)):
                    value = constant(one)
                    if value is not None:
                        return [(rest, at, factor * value)]
            case ast.BinOp(left=left, op=ast.Div(), right=right) if constant(right):
                return [(left, at, factor / (constant(right) or 1.0))]
            case ast.UnaryOp(op=ast.USub(), operand=inner):
                return [(inner, at, -factor)]
            case ast.Name(id=name):
                made = self.body.definition(name, at)
                if made is not None and _is_worth_opening(made[1]):
                    return [(made[1], made[0], factor)]
            case ast.Call(
                func=ast.Name(id="sum"),
                args=[ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="values"))],
            ) if name == self.components.dict_name:
                return [(expr, p, factor) for p, expr in self.components.settings_before(at)]
        return None


def _is_worth_opening(node: ast.expr) -> bool:
    """Whether what a name stands for is to be taken apart rather than called by the name."""
    match node:
        case ast.BinOp(op=ast.Add() | ast.Sub()) | ast.Name():
            return True
        case ast.Call(func=ast.Name(id="sum")):
            return True
        case ast.Subscript(slice=ast.Constant()):
            return True
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right):
            if constant(left) is not None:
                return _is_worth_opening(right)
            return constant(right) is not None and _is_worth_opening(left)
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return _is_worth_opening(inner)
    return False


def _is_zeros(node: ast.expr) -> bool:
    match node:
        case ast.Call(func=ast.Attribute(attr="zeros" | "zeros_like")):
            return True
    return False
