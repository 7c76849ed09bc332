"""New rewards for a task whose old one led nowhere: from the templates, or straight from the task's success function.

The second kind works for any task code: the conditions of `compute_success` become slopes, with stages of reaching and
grasping before them.
"""

import ast
import re
from dataclasses import dataclass, replace
from typing import override

import numpy as np

from v2p_data.kinds import KINDS
from v2p_data.reward.code.expressions import names_in, number, stored_names
from v2p_data.reward.code.function_body import (
    FUNCTION,
    Replacer,
    UnreadableError,
    function_of,
    rows_of,
)
from v2p_data.reward.code.soften import conditions, softened
from v2p_data.scene.scene import Scene
from v2p_data.task.templates.reward_text import paid_lines
from v2p_data.task.templates.variants import VARIANTS
from v2p_data.task.templates.write import write_task

GRIP_DEPTH_M = 0.035
"""Fingers reach about this far down from an object's top."""
MAX_LOOKUPS = 200
"""Names looked up for one slope; a success function says what it wants in far fewer."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """A reward in place of another one."""

    code: str
    """The whole task code."""
    words: str
    """What kind of design it is."""


def target_of(scene: Scene) -> tuple[str, float]:
    """Return the object that the gripper must go to, and how far above its centre to hold it [m]."""
    with_tool = KINDS[scene.kind].grasps == "tool" and scene.others
    obj = scene.others[0] if with_tool else scene.manipulated
    return obj.name, round(max(obj.size_m[2] / 2 - GRIP_DEPTH_M, 0.0), 3)


def must_grasp(scene: Scene, code: str) -> bool:
    """Return whether the task needs the object in the gripper."""
    asks = f'"{scene.manipulated.name}_grasped"' in code.replace("'", '"')
    grasps = KINDS[scene.kind].grasps
    return grasps in ("manipulated", "tool") or (grasps == "unknown" and asks)


# --- stages --------------------------------------------------------------------------------------------------


def reach_text(scene: Scene, *, temperature: float = 6.0) -> str:
    """Return nearness of the gripper to the object, 0 to 1."""
    name, above = target_of(scene)
    point = f'states["{name}_pos"]'
    if above:
        point = f"({point} + torch.tensor([0.0, 0.0, {above}], device={point}.device))"
    return (
        f'1 - torch.tanh({number(temperature)} * torch.norm({point} - states["eef_pos"], dim=-1))'
    )


def grasp_text(scene: Scene) -> str:
    """Return 0 to 1: closing around the object, touching it, holding it."""
    name, above = target_of(scene)
    point = f'states["{name}_pos"]'
    if above:
        point = f"({point} + torch.tensor([0.0, 0.0, {above}], device={point}.device))"
    near = f'torch.exp(-20.0 * torch.norm({point} - states["eef_pos"], dim=-1))'
    closing = f'{near} * (1 - states["gripper_width"] / 0.085)'
    return f'(0.2 * {closing} + 0.2 * states["{name}_touched"] + 0.6 * states["{name}_grasped"])'


def touch_text(scene: Scene) -> str:
    """Return 1 where the gripper touches the object."""
    return f'states["{target_of(scene)[0]}_touched"]'


def raise_text(scene: Scene) -> str:
    """Return 0 to 1: the object in the gripper, raised by up to 12 cm."""
    name, _ = target_of(scene)
    height = f'(states["{name}_pos"][:, 2] - states["{name}_start_pos"][:, 2])'
    return f'states["{name}_grasped"] * ({height} / 0.12).clamp(0.0, 1.0)'


def goal_text(code: str) -> str | None:
    """Return the task's own success as a slope from 0 to 1, in terms of `states` alone; None where it has none."""
    try:
        made, expr = _success_of(code)
        soft = softened(expr, _Lookup(made))
        if soft is None:
            return None
        soft = _Names(made).replaced(soft)
    except UnreadableError:
        return None
    text = ast.unparse(ast.fix_missing_locations(soft))
    left = {n.id for n in ast.walk(soft) if isinstance(n, ast.Name)}
    return None if left & set(made) or "self" in left or len(text) > 4_000 else f"({text})"


# --- whole rewards -------------------------------------------------------------------------------------------


def from_template(code: str, scene: Scene, rng: np.random.Generator, index: int) -> Design:
    """Return the task code with the reward of a template variant, its weights varied after the first round."""
    variant = VARIANTS[index % len(VARIANTS)]
    words = f"template '{variant.idea.rstrip('.')}'"
    if index >= len(VARIANTS):
        variant = replace(
            variant,
            temperature=round(variant.temperature * float(rng.uniform(0.5, 1.6)), 2),
            reach=round(variant.reach * float(rng.uniform(0.5, 2.0)), 3),
            contact=round(max(variant.contact, 0.1) * float(rng.uniform(0.5, 2.0)), 3),
            progress=round(variant.progress * float(rng.uniform(0.7, 1.8)), 3),
        )
        words += (
            f", temperature {variant.temperature}, weights {variant.reach} (reach), {variant.contact} "
            f"(contact), {variant.progress} (progress)"
        )
    return Design(code=transplanted(code, write_task(scene, variant)), words=words)


def from_success(code: str, scene: Scene, rng: np.random.Generator | None = None) -> Design | None:
    """Return the task code with a reward in stages that ends in its own success; None where that has no slope."""
    try:
        lines, _ = _success_lines(code)
        slopes = _success_slopes(code)
    except UnreadableError:
        return None
    if not slopes:
        return None
    jitter = (lambda: 1.0) if rng is None else (lambda: float(rng.uniform(0.6, 1.6)))
    temperature = 6.0 * jitter()
    grasp = must_grasp(scene, code)
    parts = [
        ("reach", f"{number(0.2 * jitter())} * ({reach_text(scene, temperature=temperature)})")
    ]
    if grasp:
        parts.append(("grasp", f"{number(0.3 * jitter())} * {grasp_text(scene)}"))
        if KINDS[scene.kind].grasps != "tool":
            parts.append(("raise", f"{number(0.3 * jitter())} * {raise_text(scene)}"))
    else:
        parts.append(("touch", f"{number(0.05 * jitter())} * {touch_text(scene)}"))
    share = 0.8 / len(slopes)
    for i, (name, text, is_place) in enumerate(slopes):
        if is_place:
            weight = number(share * jitter())
            parts.append((f"toward_{name or f'condition_{i + 1}'}", f"{weight} * ({text})"))
    every = " * ".join(f"({text})" for _, text, _ in slopes)
    if len(slopes) > 1:
        parts.append(("all_at_once", f"{number(0.6 * jitter())} * ({every})"))
    parts.append(("effort", "-0.005 * (actions**2).sum(dim=-1)"))
    text = _function_text([ast.unparse(node) for node in lines], parts)
    words = f"stages that end in the {len(slopes)} conditions of the success function, as slopes"
    return Design(code=transplanted(code, text), words=words)


def transplanted(code: str, donor: str) -> str:
    """Return task code with another code's reward function, and the functions that this one calls."""
    rows = code.splitlines(keepends=True)
    functions = {n.name: n for n in ast.parse(code).body if isinstance(n, ast.FunctionDef)}
    given = {n.name: n for n in ast.parse(donor).body if isinstance(n, ast.FunctionDef)}
    if FUNCTION in functions:
        first, last = rows_of(functions[FUNCTION])
        rows[first:last] = [_text_of(donor, given[FUNCTION]) + "\n"]
        text = "".join(rows)
    else:
        text = _calling_function(code) + "\n\n" + _text_of(donor, given[FUNCTION]) + "\n"
    for name in _called(given[FUNCTION], given):
        if name not in functions:
            text = text.rstrip("\n") + "\n\n\n" + _text_of(donor, given[name]) + "\n"
        elif ast.dump(functions[name]) != ast.dump(given[name]):
            raise UnreadableError(f"'{name}' means something else in the code at hand")
    return text


def wrapped(code: str, scale: float, name: str, text: str) -> str:
    """Return task code whose reward is the old one, scaled, plus one component if it has a name.

    Raises:
        UnreadableError: it has no reward function of the usual name, or one without states.
    """
    function = function_of(code)
    names = [a.arg for a in function.args.args]
    if len(names) < 2:
        raise UnreadableError(f"its function '{FUNCTION}' is not one of actions and states")
    inner, i = "inner_reward", 2
    while inner in code:
        inner, i = f"inner_reward_{i}", i + 1
    rows = code.splitlines(keepends=True)
    _, last = rows_of(function)
    at = function.lineno - 1
    rows[at] = re.sub(rf"\bdef\s+{FUNCTION}\b", f"def {inner}", rows[at], count=1)
    added = ["extra = " + text, f'components["{name}"] = extra'] if name else []
    if added and "states" not in names:
        added.insert(0, f"states = {names[1]}")
    types = "    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]"
    total = "total" if scale == 1 else f"{number(scale)} * total"
    new = [
        "@torch.jit.script",
        f"def {FUNCTION}({ast.unparse(function.args)}):",
        *([types] if names == ["actions", "states"] else []),
        f"    total, components = {inner}({', '.join(names)})",
        *[f"    {line}" for line in added],
        f"    return {total}{' + extra' if name else ''}, components",
    ]
    rows[last:last] = ["\n\n", *[f"{line}\n" for line in new]]
    return "".join(rows)


# --- inside --------------------------------------------------------------------------------------------------


Made = dict[str, ast.expr | None]
"""What names stand for; None for what is changed in place."""


class _Names(Replacer):
    """Replaces names by what they stand for."""

    def __init__(self, made: Made) -> None:
        super().__init__()
        self.made = made

    @override
    def visit_Name(self, node: ast.Name) -> ast.AST:
        value = self.made.get(node.id)
        return node if value is None else self.replaced(value)


class _Lookup:
    """Looks up what names stand for, and gives up where a success function builds on itself too often."""

    def __init__(self, made: Made) -> None:
        self.made, self.count = made, 0

    def __call__(self, name: str) -> ast.expr | None:
        self.count += 1
        if self.count > MAX_LOOKUPS:
            raise UnreadableError(
                "the lines of its success function build on each other too often"
            )
        return self.made.get(name)


def _success_slopes(code: str) -> list[tuple[str, str, bool]]:
    """Return the conditions of `compute_success` as slopes: name, text, and whether it is about where things are.

    Raises:
        UnreadableError: it is not a list of assignments, or they build on each other too often.
    """
    made, expr = _success_of(code)
    slopes: list[tuple[str, str, bool]] = []
    for name, condition in conditions(expr, _Lookup(made)):
        soft = softened(condition, _Lookup(made))
        if soft is not None:
            text = ast.unparse(ast.fix_missing_locations(soft))
            slopes.append((name, text, _is_place(soft, made)))
    return slopes


def _is_place(soft: ast.expr, made: Made) -> bool:
    """Whether a slope is about where things are; being still or let go is worth something at the end only."""
    soft = _Names(made).replaced(soft)
    keys = {
        n.value for n in ast.walk(soft) if isinstance(n, ast.Constant) and isinstance(n.value, str)
    }
    return any(k.endswith(("_pos", "_quat", "_up")) and not k.endswith("start_pos") for k in keys)


def _success_lines(code: str) -> tuple[list[ast.stmt], ast.expr]:
    """Return the lines of `compute_success` and what it returns.

    Raises:
        UnreadableError: it is more than a list of assignments, or asks the task object something.
    """
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.FunctionDef) and node.name == "compute_success":
            body = [
                s
                for s in node.body
                if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))
            ]
            own = any(
                isinstance(n, ast.Name) and n.id == "self" for s in body for n in ast.walk(s)
            )
            if own or not all(isinstance(s, ast.Assign | ast.Return) for s in body):
                break
            last = body[-1] if body else None
            if isinstance(last, ast.Return) and last.value is not None:
                return body[:-1], last.value
    raise UnreadableError("its success function is more than a list of assignments")


def _success_of(code: str) -> tuple[Made, ast.expr]:
    """Return what each name of `compute_success` stands for in the end, and the result."""
    lines, expr = _success_lines(code)
    made: Made = {}
    for node in lines:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if name not in made:
                made[name] = value
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                old = made.pop(name)
                is_read = any(v is not None and name in names_in(v) for v in made.values())
                # `ok = ok & more` goes on from the old value, which nothing else may mean then.
                made[name] = (
                    None if old is None or is_read else _Names({name: old}).replaced(value)
                )
            case other:
                made |= dict.fromkeys(stored_names(other))
    return made, expr


def _function_text(lines: list[str], parts: list[tuple[str, str]]) -> str:
    body = [
        "# type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]",
        '"""',
        "Stages: reach the object, take hold of it where that is needed, then make the success come true.",
        "# Reward Components:",
        *[f"{i}. {name}" for i, (name, _) in enumerate(parts, 1)],
        '"""',
        *[row for line in lines for row in line.splitlines()],
        *paid_lines(parts),
    ]
    head = f"@torch.jit.script\ndef {FUNCTION}(actions, states):\n"
    return head + "".join(f"    {row}\n" for row in body)


def _text_of(source: str, node: ast.FunctionDef) -> str:
    first, last = rows_of(node)
    return "\n".join(source.splitlines()[first:last])


def _called(function: ast.FunctionDef, known: dict[str, ast.FunctionDef]) -> list[str]:
    """Return the functions that one calls, directly or not, callers first."""
    found: list[str] = []
    waiting = [function]
    while waiting:
        for node in ast.walk(waiting.pop(0)):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in known
                and node.func.id not in found
            ):
                found.append(node.func.id)
                waiting.append(known[node.func.id])
    return found


def _calling_function(code: str) -> str:
    """Return task code whose `compute_reward` hands over to a function of the module."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.FunctionDef) and node.name == "compute_reward":
            rows = code.splitlines(keepends=True)
            pad = re.match(r"\s*", rows[node.lineno - 1])
            inner = (pad[0] if pad else "") + "    "
            first, last = node.body[0].lineno - 1, node.end_lineno or node.lineno
            if first < node.lineno:
                raise UnreadableError("its compute_reward is written in one line")
            names = [a.arg for a in node.args.args[1:]]
            rows[first:last] = [f"{inner}return {FUNCTION}({', '.join(names)})\n"]
            return "".join(rows).rstrip("\n") + "\n"
    raise UnreadableError("it has no compute_reward")
