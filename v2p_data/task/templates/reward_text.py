"""The lines of a generated reward function: its docstring, its named components, their weighted sum."""

from v2p_data.task.templates.draft import Draft
from v2p_data.task.templates.variants import Variant

_TURN = (
    "turn",
    "0.15 * reach * (1 - (pads_apart - 0.07) / (diagonal - 0.07).clamp(min=0.03)).clamp(0.0, 1.0)",
)
"""Without it, open fingers get wedged over the diagonal of a wide box, and closing them achieves
nothing. It counts near the object only: paid everywhere, turning is learned instead of reaching,
and after 0.1 million steps the object is in the gripper a tenth as often."""
_FINGERS = (
    "fingers",
    "0.05 * snug * torch.where(distance < 0.025, (gripper_width > pads_apart - 0.004).float()"
    " * (2 - (gripper_width - pads_apart) / 0.085).clamp(0.0, 2.0),"
    " reach * ((gripper_width - pads_apart) / 0.01).clamp(0.0, 1.0))",
)
"""Wide enough on the way, then ever closer around the object, for what nearly fills the gripper:
fingers that wander do not fit over it. Fingers that have closed above it are narrower than it.
Paid for a box of 4 x 6 cm too, it teaches to keep the fingers open: the box was in them half as
often after 0.12 million steps."""

_SIDEWAYS_FIRST = (
    "distance = torch.norm(torch.cat([way_there[:, :2] * (1 + 1.5 * "
    "snug).unsqueeze(-1), way_there[:, 2:]], dim=-1), dim=-1)"
)
"""The point to reach sinks as the gripper comes over a tall object, and open fingers can follow it
only over the middle of one that nearly fills them. Counted once, the last three centimetres to the
middle lead away from the point: covering ended there."""


def docstring_lines(v: Variant, d: Draft) -> list[str]:
    """Return the docstring as the paper's rewards have it: the steps of the task, the names of the components."""
    return [
        '"""',
        "# Chain of Thoughts for reward designs:",
        *[f"{i}. {t}" for i, t in enumerate(d.thoughts, 1)],
        v.idea,
        "# Reward Components:",
        *[f"{i}. {name}" for i, (name, _) in enumerate(_components(v, d), 1)],
        '"""',
    ]


def reward_lines(v: Variant, d: Draft) -> list[str]:
    """Return the function's lines after its docstring, in terms of what the draft defines."""
    return [
        f"way_there = {d.target} - eef_pos",
        "distance = torch.norm(way_there, dim=-1)",
        "near = (distance < 0.045).float()",
        *([_SIDEWAYS_FIRST] if v.contact and d.pays_contact else []),
        f"reach = {_near(v)}",
        f"contact = {d.contact}",
        f"progress = {d.progress}",
        *([f"direction = {d.direction}"] if v.speed else []),
        *paid_lines(_components(v, d)),
    ]


def paid_lines(components: list[tuple[str, str]]) -> list[str]:
    """Return the end of a reward function: each component under its name, the total, both returned.

    Args:
        components: names and weighted expressions.
    """
    return [
        "reward_components = {}",
        *[f'reward_components["{name}"] = {expression}' for name, expression in components],
        "total = 100.0 * ("
        + " + ".join(f'reward_components["{name}"]' for name, _ in components)
        + ")",
        "return total, reward_components",
    ]


def _components(v: Variant, d: Draft) -> list[tuple[str, str]]:
    """Return (name, weighted expression) of the reward, in terms of `reach`, `contact` and `progress`."""
    parts: list[tuple[str, str]] = []
    reach, progress = f"{v.reach} * reach", f"{v.progress} * progress"
    if v.form == "staged":
        reach = f"{v.reach} * torch.where(contact > 0.5, torch.ones_like(reach), reach)"
    elif v.form == "product":
        progress = f"{v.progress} * progress * (0.3 + 0.7 * reach)"
    parts.append(("reach", reach))
    if v.contact and d.pays_contact:
        parts += [_TURN, _FINGERS]
        parts.append(("contact", f"{v.contact} * contact"))
    parts.append(("progress", progress))
    if v.speed:
        parts.append(
            ("speed", f"{v.speed} * torch.tanh(4.0 * (obj_vel * direction).sum(dim=-1)) * near")
        )
    parts += d.extras
    if v.effort:
        parts.append(("effort", f"-{v.effort} * (actions**2).sum(dim=-1)"))
    if v.step_cost:
        parts.append(("step_cost", f"torch.full_like(reach, -{v.step_cost})"))
    return parts


def _near(v: Variant) -> str:
    t = v.temperature
    return {
        "tanh": f"1 - torch.tanh({t} * distance)",
        "exp": f"torch.exp(-{t} * distance)",
        "mixed": "0.5 * (1 - torch.tanh(3.0 * distance)) + 0.5 * (1 - torch.tanh(30.0 * distance))",
        "rational": f"1 / (1 + ({t} * distance) ** 2)",
    }[v.kernel]
