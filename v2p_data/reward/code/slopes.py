"""The slopes inside rewards: how nearness or speed is pressed into a range, and by which temperature."""

import ast
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from v2p_data.reward.code.expressions import constant, split_constant
from v2p_data.reward.code.parts import Reward
from v2p_data.reward.code.terms import Part

Kind = Literal["1 - tanh", "exp", "rational", "tanh", "sigmoid", "clamp"]

HALFWAY = {"1 - tanh": 0.549, "exp": 0.693, "rational": 1.0, "tanh": 0.549, "clamp": 0.5}
"""Temperature times distance at which a kernel is worth one half."""


@dataclass(frozen=True)
class Kernel:
    """One slope and where its temperature is written."""

    kind: Kind
    statement: int
    """See `Reward.written`."""
    node: ast.AST
    """The number."""
    temperature: float
    is_divisor: bool
    """`exp(-x / t)`: the number is the temperature's inverse."""

    def changed(self, reward: Reward, part: str, factor: float) -> Reward:
        """Return the reward with this kernel `factor` times as steep."""
        value = constant(self.node) or 1.0
        new = value / factor if self.is_divisor else value * factor
        return reward.with_constant(part, self.statement, self.node, new)


def kernels_of(reward: Reward, part: Part) -> list[Kernel]:
    """Return the kernels in a part, the outermost first."""
    nodes = list(reward.written(part))
    falling = {
        id(n.right)
        for _, n in nodes
        if isinstance(n, ast.BinOp) and isinstance(n.op, ast.Sub) and constant(n.left) is not None
    }
    found: list[Kernel] = []
    for statement, node in nodes:
        inner = _argument(node)
        if inner is None:
            continue
        kind, argument = inner
        if kind == "tanh" and id(node) in falling:
            kind = "1 - tanh"
        place = _temperature(argument, statement, nodes, reward, part)
        if place is not None:
            at, number_node, is_divisor = place
            value = abs(constant(number_node) or 0.0)
            if value > 0 and all(k.node is not number_node for k in found):
                found.append(
                    Kernel(kind, at, number_node, 1 / value if is_divisor else value, is_divisor)
                )
    return found


def simple_kind(reward: Reward, part: Part) -> tuple[Kind, float] | None:
    """Return kernel and weight of a part that is nothing but a weight times one kernel."""
    weight, core = split_constant(reward.inlined(part.expr, part.position))
    match core:
        case ast.BinOp(left=one, op=ast.Sub(), right=ast.Call(func=func)) if (
            constant(one) == 1 and getattr(func, "attr", "") == "tanh"
        ):
            return "1 - tanh", weight
    inner = _argument(core)
    return None if inner is None else (inner[0], weight)


def centring_factor(kind: Kind, level: float) -> float | None:
    """Return by how much to steepen a kernel whose typical value is `level`, so that it becomes one half there."""
    u = min(max(level, 1e-4), 1 - 1e-4)
    argument = {
        "1 - tanh": lambda: math.atanh(1 - u),
        "exp": lambda: -math.log(u),
        "rational": lambda: math.sqrt(1 / u - 1),
        "tanh": lambda: math.atanh(u),
        "clamp": lambda: u,
    }.get(kind)
    return None if argument is None else HALFWAY[kind] / argument()


def _argument(node: ast.AST) -> tuple[Kind, ast.expr] | None:
    match node:
        case ast.Call(func=ast.Attribute(value=owner, attr="tanh" | "exp" | "sigmoid" as name)):
            is_torch = isinstance(owner, ast.Name) and owner.id == "torch"
            argument = node.args[0] if is_torch and node.args else owner
            return name, argument
        case ast.BinOp(
            left=one,
            op=ast.Div(),
            right=ast.BinOp(op=ast.Add(), right=ast.BinOp(left=inner, op=ast.Pow())),
        ) if constant(one) == 1:
            return "rational", inner
        case ast.Call(
            func=ast.Attribute(value=ast.BinOp(op=ast.Div()) as inner, attr="clamp" | "clip")
        ):
            return "clamp", inner
    return None


def _temperature(
    argument: ast.expr,
    statement: int,
    nodes: list[tuple[int, ast.AST]],
    reward: Reward,
    part: Part,
) -> tuple[int, ast.AST, bool] | None:
    """Return the number that multiplies or divides a kernel's argument, and its statement."""
    for node, is_divisor in _factors(argument):
        value = constant(node)
        if value:
            return statement, node.operand if isinstance(node, ast.UnaryOp) else node, is_divisor
        if isinstance(node, ast.Name):
            at = part.position if statement < 0 else statement
            made = reward.definition(node.id, at)
            if made is not None and constant(made[1]) and any(n is made[1] for _, n in nodes):
                return made[0], made[1], is_divisor
    return None


def _factors(node: ast.expr) -> Iterator[tuple[ast.expr, bool]]:
    match node:
        case ast.UnaryOp(operand=inner) if constant(node) is None:
            yield from _factors(inner)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            yield from _factors(left)
            yield from _factors(right)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            yield right, True
            yield from _factors(left)
        case _:
            yield node, False
