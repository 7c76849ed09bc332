"""Writes task code as text, without any model: one recipe per kind of task, eight samples that truly differ.

A recipe (`_RECIPES`) says in torch expressions what success demands and what the reward is made of, with thresholds from
the video's own tracked motion and the object's size. A `Variant` decides how strict, how smooth, in which
form and with which extra observations; sample 0 has the shapes that were measured to train fastest, the
others are the kinds of alternatives a language model writes, down to the naive success of the paper's figure 11.
To teach a new kind, add a recipe.
"""

import pprint
import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.probes import first_pose

NUM_VARIANTS = 8


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What makes one sample differ from the others."""

    idea: str
    """One sentence; goes into the reward's docstring."""
    strictness: float = 1.0
    """Factor on the distance that success demands."""
    still_m_s: float = 0.15
    """Success demands that the object is slower than this."""
    is_naive: bool = False
    """Success looks at the main condition only."""
    kernel: str = "tanh"
    """How nearness falls off with distance: `tanh`, `exp`, `mixed` or `rational`."""
    temperature: float = 8.0
    form: str = "sum"
    """`sum`: all parts at once; `staged`: later parts replace earlier ones; `product`: progress counts when near."""
    reach: float = 0.2
    contact: float = 0.2
    progress: float = 0.6
    speed: float = 0.0
    """Weight of the object's velocity towards the goal."""
    effort: float = 0.005
    step_cost: float = 0.0
    observes: tuple[str, ...] = ()
    """Extra observations: `distance`, `remaining`, `goal`."""


VARIANTS = (
    Variant(idea="Reach, then make progress; all parts add up."),
    Variant(
        idea="As gentle slopes as possible; the policy is told its distance from the object.",
        kernel="tanh",
        temperature=5.0,
        still_m_s=0.1,
        progress=0.8,
        observes=("distance",),
    ),
    Variant(
        idea="A coarse and a fine slope, so that neither far nor near is flat.",
        kernel="mixed",
        reach=0.3,
        contact=0.1,
        observes=("remaining",),
    ),
    Variant(
        idea="Stages: once in contact, only what follows counts.",
        form="staged",
        strictness=0.85,
        contact=0.3,
        progress=0.8,
    ),
    Variant(
        idea="Progress counts fully only while the gripper is near.",
        form="product",
        kernel="rational",
        temperature=12.0,
        progress=0.8,
        observes=("distance", "remaining"),
    ),
    Variant(
        idea="Moving towards the goal pays at once; every step costs.",
        kernel="exp",
        temperature=6.0,
        progress=0.4,
        speed=0.3,
        step_cost=0.01,
        strictness=1.15,
        observes=("goal",),
    ),
    Variant(
        idea="Only what the words say must be true, and the slopes are steep.",
        is_naive=True,
        temperature=20.0,
        reach=0.3,
        contact=0.0,
        progress=1.0,
        effort=0.0,
    ),
    Variant(
        idea="Nearly sparse: a small pull to the object, the rest must be found.",
        kernel="exp",
        temperature=10.0,
        reach=0.1,
        contact=0.0,
        progress=0.3,
        strictness=1.3,
        still_m_s=0.05,
        observes=("distance", "goal"),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What the video says about the manipulated object's motion, and about the sizes."""

    kind: str
    obj: SceneObject
    ref: SceneObject | None
    """The first other object."""
    move_m: tuple[float, float, float]
    """From the first to the last pose."""
    lift_m: float
    """The highest the centre came above its start."""

    @staticmethod
    def of(scene: Scene) -> "Measured":
        obj = scene.manipulated
        poses = np.array(obj.poses_world, float).reshape(-1, 7)
        if not len(poses):
            poses = first_pose(obj)[None]
        move = poses[-1, :3] - poses[0, :3]
        return Measured(
            kind=scene.kind,
            obj=obj,
            ref=scene.others[0] if scene.others else None,
            move_m=(float(move[0]), float(move[1]), float(move[2])),
            lift_m=float(poses[:, 2].max() - poses[0, 2]),
        )


@dataclass(kw_only=True)
class Draft:
    """A task in expressions; `eef_pos`, `obj_pos`, `ref_pos` and the like are defined before them."""

    thoughts: list[str]
    """The chain of thought: the steps of the task."""
    setup: list[str] = field(default_factory=list[str])
    """Lines that success and reward share."""
    success: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(name, bool expression), the main condition first."""
    target: str = "obj_pos"
    """Point to which the gripper should go."""
    contact: str = "near"
    """Float expression: 1 while the gripper has the object."""
    pays_contact: bool = False
    """Whether contact is worth something by itself: where the object must be grasped."""
    turn: bool = True
    """Whether grasping pays for turning the gripper to the manipulated object's narrow side."""
    progress: str = "obj_pos[:, 2] * 0"
    """Float expression, 0 at the start and 1 when done."""
    remaining: str = "obj_pos[:, 2] * 0"
    """Metres left to go."""
    goal: str = "obj_pos"
    """Where the object should be."""
    direction: str = "goal_direction"
    """Unit vector in which the object should move."""
    extras: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """Further reward components (name, expression), bonuses and penalties, with their weights."""
    reward_setup: list[str] = field(default_factory=list[str])


def write_samples(scene: Scene, count: int = NUM_VARIANTS) -> list[str]:
    """Return `count` task codes for the scene, the one that trained best so far first."""
    return [write_task(scene, VARIANTS[i % NUM_VARIANTS]) for i in range(count)]


def write_task(scene: Scene, variant: Variant) -> str:
    """Return one task code."""
    measured = Measured.of(scene)
    recipe = _RECIPES.get(scene.kind, _generic)
    needs_reference = recipe in _NEEDS_REFERENCE
    draft = (_generic if needs_reference and measured.ref is None else recipe)(measured, variant)
    return _text(scene, measured, variant, draft)


# --- recipes -------------------------------------------------------------------------------------------------

_LOW = "((obj_pos[:, 2] - obj_start[:, 2]).abs() < 0.02)"
_REF_STILL = "(ref_moved < 0.03)"
_REF_MOVED = "ref_moved = torch.norm((ref_pos - ref_start)[:, :2], dim=-1)"
_LEAVE_REF = ("leave_reference", "-1.0 * (ref_moved - 0.01).clamp(0.0, 0.3)")
_TOP = "grasp_point[:, 2] = obj_pos[:, 2] + (half_height - 0.035).clamp(min=0.0)"
_LEAN_SETUP = [
    "vertical = torch.zeros_like(eef_pos)",
    "vertical[:, 2] = 1",
    "lean = torch.norm(in_world_frame(eef_quat, vertical)[:, :2], dim=-1)",
]
_GRASP_SETUP = [
    *_LEAN_SETUP,
    "grasp_point = obj_pos.clone()",
    _TOP,
    # The pads close along the gripper's own y axis.
    "closing = torch.zeros_like(eef_pos)",
    "closing[:, 1] = 1",
    "closing = in_world_frame(eef_quat, closing)",
    "pads_apart = 2 * obj_half(obj_quat, obj_size, closing)",
]
_TURN = (
    "turn",
    "0.15 * reach * (1 - (pads_apart - 0.07) / (torch.norm(obj_size[:, :2], dim=-1) - 0.07).clamp(min=0.03)).clamp(0.0, 1.0)",
)
"""Without it, open fingers get wedged over the diagonal of a wide box, and closing them achieves nothing. It counts near
the object only: paid everywhere, turning is learned instead of reaching, and after 0.1 million steps the object is in
the gripper a tenth as often."""
_STILL_UPRIGHT = "(upright(obj_quat, obj_start_quat) > 0.9)"
# Withholds what pushing earns once the object topples. A penalty instead teaches not to touch tall objects at all:
# 0 % for a 5 x 8 cm cylinder.
_STANDING = "upright(obj_quat, obj_start_quat).clamp(0.0, 1.0)"
# A leaning finger pushes at the object's upper edge and rolls it over: 4 cm cubes in one episode out of seven.
_LEVEL = ("level", "-0.4 * lean")


def _lift(m: Measured, v: Variant) -> Draft:
    height = round(float(np.clip(0.7 * m.lift_m, 0.08, 0.12)) * v.strictness, 3)
    return Draft(
        thoughts=[
            "Reach the object.",
            "Close the gripper around it.",
            "Raise it and hold it still.",
        ],
        setup=["height = obj_pos[:, 2] - obj_start[:, 2]"],
        success=[
            ("is_high", f"height > {height}"),
            (
                "is_held",
                "(obj_grasped > 0.5) & (torch.norm(obj_pos - eef_pos, dim=-1) < reach_limit)",
            ),
            ("is_still", _still(v)),
        ],
        reward_setup=_GRASP_SETUP,
        target="grasp_point",
        contact="obj_grasped * near",
        pays_contact=True,
        progress=f"(height / {max(height + 0.02, 0.12):.3f}).clamp(0.0, 1.0) * contact",
        remaining=f"({height} - height).clamp(min=0.0)",
        goal=_shifted("obj_start", z=height + 0.03),
        direction=_shifted("torch.zeros_like(obj_pos)", z=1.0),
        extras=[
            ("not_too_high", "-2.0 * (height - 0.2).clamp(0.0, 0.3) * near"),
            # Without it, a lifted object is carried off to the side until the arm leaves the picture. It counts in
            # the gripper only: a fine for knocking the object away teaches to keep off.
            (
                "stay_above",
                "-1.0 * (torch.norm((obj_pos - obj_start)[:, :2], dim=-1) - 0.04).clamp(0.0, 0.3) * contact",
            ),
        ],
    )


def _push(m: Measured, v: Variant) -> Draft:
    sign = 1.0 if m.kind == "push_left" else -1.0
    way = round(float(np.clip(0.6 * abs(m.move_m[1]), 0.08, 0.15)) * v.strictness, 3)
    # Hands push at a slant; the words allow some of it.
    slant = round(
        float(np.clip(1.15 * abs(m.move_m[0]) / max(abs(m.move_m[1]), 1e-3), 0.5, 1.0)), 2
    )
    return Draft(
        thoughts=[
            f"Go behind the object, on its {'right' if sign > 0 else 'left'}.",
            f"Push it to the {'left' if sign > 0 else 'right'}, low above the table.",
            "Stop with it standing as before.",
        ],
        setup=[
            f"goal_direction = {_shifted('torch.zeros_like(obj_pos)', y=sign)}",
            "moved = ((obj_pos - obj_start) * goal_direction).sum(dim=-1)",
            "sideways = (obj_pos[:, 0] - obj_start[:, 0]).abs()",
        ],
        success=[
            ("is_there", f"moved > {way}"),
            ("is_straight", f"sideways < ({slant} * moved).clamp(min=0.05)"),
            ("is_down", _LOW),
            ("is_upright", _STILL_UPRIGHT),
            ("is_still", _still(v)),
        ],
        reward_setup=_push_point(clearance_m=0.02),
        target="push_point",
        progress=f"(moved / {way + 0.02:.3f}).clamp(-1.0, 1.0) * {_LOW}.float() * {_STANDING}",
        remaining=f"({way} - moved).clamp(min=0.0)",
        goal=_shifted("obj_start", y=sign * (way + 0.02)),
        extras=[
            ("straight", "-0.5 * (sideways - 0.02).clamp(0.0, 0.2)"),
            ("not_too_far", f"-0.3 * (moved - {way + 0.07:.3f}).clamp(0.0, 1.0)"),
            _LEVEL,
        ],
    )


def _tip_over(m: Measured, v: Variant) -> Draft:
    del m
    return Draft(
        thoughts=[
            "Go to the upper part of the object.",
            "Push it over.",
            "Let it come to rest on its side.",
        ],
        setup=["standing = upright(obj_quat, obj_start_quat)"],
        success=[
            ("is_tipped", f"standing < {round(min(0.3 / v.strictness, 0.4), 3)}"),
            ("is_down", "lowest_point(obj_pos, obj_quat, obj_size) < 0.015"),
            ("is_near", "torch.norm((obj_pos - obj_start)[:, :2], dim=-1) < 0.25"),
            ("is_still", _still(v)),
        ],
        reward_setup=[
            "up = torch.zeros_like(obj_pos)",
            "up[:, 2] = 1",
            "top = obj_pos + in_world_frame(obj_quat, in_body_frame(obj_start_quat, up)) * (0.7 * half_height).unsqueeze(-1)",
        ],
        target="top",
        progress="1 - standing.abs()",
        remaining="half_height * standing.clamp(min=0.0)",
        goal=_shifted("obj_start", z=-0.03),
        direction="torch.nn.functional.normalize(obj_pos - eef_pos, dim=-1)",
        extras=[
            (
                "stay_near",
                "-1.0 * (torch.norm((obj_pos - obj_start)[:, :2], dim=-1) - 0.12).clamp(0.0, 0.3)",
            )
        ],
    )


def _push_next_to(m: Measured, v: Variant) -> Draft:
    del m
    gap = round(0.02 / v.strictness, 3)
    return Draft(
        thoughts=[
            "Go behind the object, seen from the other one.",
            "Push it towards the other one until they are side by side.",
            "Do not move the other one.",
        ],
        setup=[
            "between = ref_pos - obj_pos",
            "between[:, 2] = 0",
            "goal_direction = torch.nn.functional.normalize(between, dim=-1)",
            "gap = torch.norm(between, dim=-1) - obj_half(obj_quat, obj_size, goal_direction)"
            " - ref_half(ref_quat, ref_size, goal_direction)",
            _REF_MOVED,
        ],
        success=[
            ("is_next_to", f"gap < {gap}"),
            ("is_left_alone", _REF_STILL),
            ("is_down", _LOW),
            ("is_upright", _STILL_UPRIGHT),
            ("is_still", _still(v)),
        ],
        reward_setup=[
            *_push_point(clearance_m=0.012),
            "ahead = ((eef_pos - push_point) * goal_direction).sum(dim=-1)",
            "wanted_height = torch.where(distance_xy < 0.04, push_point[:, 2], torch.where(ahead > 0, push_point[:, 2] + 0.07, push_point[:, 2] + 0.02))",
        ],
        target="push_point",
        progress=f"(0.5 * (1 - gap / 0.15).clamp(-1.0, 1.0) + 0.5 * torch.exp(-gap.clamp(min=0.0) / 0.025)) * {_LOW}.float() * {_STANDING}",
        remaining="gap.clamp(min=0.0)",
        goal="ref_pos",
        extras=[
            ("go_around", "0.1 * (1 - torch.tanh(10.0 * (eef_pos[:, 2] - wanted_height).abs()))"),
            ("leave_reference", "-3.0 * (ref_moved - 0.01).clamp(0.0, 0.3)"),
            _LEVEL,
        ],
    )


def _carry(
    m: Measured,
    v: Variant,
    *,
    thoughts: list[str],
    goal: list[str],
    arrived: str,
    conditions: list[tuple[str, str]],
) -> Draft:
    """Return a draft for all tasks that take the object somewhere and let it go.

    Args:
        m: what the video says.
        v: the variant.
        thoughts: steps of the task.
        goal: lines that define `goal_point`, where the object's centre comes to rest.
        arrived: bool expression: the object is over its goal.
        conditions: what success demands besides having let go.
    """
    del m
    return Draft(
        thoughts=thoughts,
        setup=[
            *goal,
            "height = obj_pos[:, 2] - obj_start[:, 2]",
            "to_goal = torch.norm((goal_point - obj_pos)[:, :2], dim=-1)",
            f"arrived = {arrived}",
            "above_goal = obj_pos[:, 2] - goal_point[:, 2]",
            _REF_MOVED,
        ],
        success=[
            *conditions,
            ("is_let_go", "obj_touched < 0.5"),
            ("is_left_alone", _REF_STILL),
            ("is_still", _still(v)),
        ],
        reward_setup=_GRASP_SETUP,
        target="grasp_point",
        contact="torch.maximum(obj_grasped * near, arrived.float())",
        pays_contact=True,
        progress=(
            "torch.where(arrived, 1.5 + 0.6 * (1 - torch.tanh(8.0 * above_goal.abs()))"
            " + 0.5 * (gripper_width / 0.085) * (above_goal < 0.025).float(),"
            " (0.3 * (height / 0.08).clamp(0.0, 1.0)"
            " + 0.8 * (1 - torch.tanh(5.0 * to_goal)) * (height / 0.05).clamp(0.0, 1.0)) * obj_grasped * near)"
        ),
        remaining="to_goal",
        goal="goal_point",
        direction="torch.nn.functional.normalize(goal_point - obj_pos, dim=-1)",
        extras=[
            _LEAVE_REF,
            ("not_too_high", "-1.0 * (height - 0.2).clamp(0.0, 0.3)"),
        ],
    )


def _insert(m: Measured, v: Variant) -> Draft:
    depth = round(0.5 / v.strictness, 3)
    return _carry(
        m,
        v,
        thoughts=[
            "Grasp the object.",
            "Carry it over the container.",
            "Open the gripper so that it falls in.",
        ],
        goal=[
            "goal_point = ref_pos.clone()",
            "rim = ref_pos[:, 2] + ref_size[:, 2] / 2",
            "inner = torch.minimum(ref_size[:, 0], ref_size[:, 1]) / 2",
        ],
        arrived="to_goal < 0.7 * inner",
        conditions=[
            ("is_inside", f"(to_goal < inner) & (obj_pos[:, 2] < rim + {depth} * half_height)"),
            ("is_not_below", "lowest_point(obj_pos, obj_quat, obj_size) > -0.01"),
        ],
    )


def _place_onto(m: Measured, v: Variant) -> Draft:
    return _carry(
        m,
        v,
        thoughts=["Grasp the object.", "Carry it over the other one.", "Set it down and let go."],
        goal=[
            "goal_point = ref_pos.clone()",
            "goal_point[:, 2] = ref_pos[:, 2] + ref_size[:, 2] / 2 + half_height",
            "inner = torch.minimum(ref_size[:, 0], ref_size[:, 1]) / 2",
        ],
        arrived="to_goal < (0.6 * inner).clamp(min=0.02)",
        conditions=[
            (
                "is_on_top",
                f"(to_goal < inner.clamp(min=0.02)) & (above_goal.abs() < {0.025 / v.strictness:.3f})",
            ),
        ],
    )


def _drop_in_front_of(m: Measured, v: Variant) -> Draft:
    tolerance = round(0.04 / v.strictness, 3)
    return _carry(
        m,
        v,
        thoughts=[
            "Grasp the object and lift it.",
            "Carry it to the near side of the other one.",
            "Lower it and let go.",
        ],
        goal=[
            "goal_point = ref_pos.clone()",
            "front = -torch.ones_like(goal_point[:, 0])",
            "room = torch.maximum(obj_size[:, 0], obj_size[:, 1]) / 2 + torch.maximum(ref_size[:, 0], ref_size[:, 1]) / 2",
            "goal_point[:, 0] = ref_pos[:, 0] + front * (room + 0.02)",
            "goal_point[:, 2] = obj_start[:, 2]",
        ],
        arrived="to_goal < 0.03",
        conditions=[
            ("is_in_front", f"(to_goal < {tolerance}) & (obj_pos[:, 0] < ref_pos[:, 0])"),
            ("is_down", "lowest_point(obj_pos, obj_quat, obj_size).abs() < 0.015"),
        ],
    )


def _cover(m: Measured, v: Variant) -> Draft:
    return _carry(
        m,
        v,
        thoughts=[
            "Grasp the cover.",
            "Carry it over the object.",
            "Lower it over the object and let go.",
        ],
        goal=["goal_point = ref_pos.clone()", "goal_point[:, 2] = obj_start[:, 2]"],
        arrived="to_goal < 0.02",
        conditions=[
            (
                "is_over",
                f"(to_goal < {0.025 / v.strictness:.3f}) & (obj_pos[:, 2] + 0.002 > ref_pos[:, 2])",
            ),
            ("is_upright", _STILL_UPRIGHT),
        ],
    )


def _uncover(m: Measured, v: Variant) -> Draft:
    height = round(0.08 * v.strictness, 3)
    return Draft(
        thoughts=[
            "Reach the top of the cover.",
            "Grasp it.",
            "Lift it off or carry it aside, upright, and leave what is under it alone.",
        ],
        setup=[
            "height = obj_pos[:, 2] - obj_start[:, 2]",
            _REF_MOVED,
            "aside = torch.norm((obj_pos - ref_pos)[:, :2], dim=-1)",
            "room = (torch.maximum(obj_size[:, 0], obj_size[:, 1]) + torch.maximum(ref_size[:, 0], ref_size[:, 1])) / 2",
            "standing = upright(obj_quat, obj_start_quat)",
        ],
        success=[
            (
                "is_off",
                f"((height > {height}) & (obj_grasped > 0.5)) | ((aside > room + 0.02) & (height.abs() < 0.02))",
            ),
            ("is_left_alone", _REF_STILL),
            ("is_upright", "standing > 0.9"),
            ("is_still", _still(v)),
        ],
        reward_setup=_GRASP_SETUP,
        target="grasp_point",
        contact="obj_grasped * near",
        pays_contact=True,
        progress=f"torch.maximum((height / {height + 0.02:.3f}).clamp(0.0, 1.0) * contact, (aside / (room + 0.03)).clamp(0.0, 1.0) * 0.6)",
        remaining=f"({height} - height).clamp(min=0.0)",
        goal=_shifted("obj_start", z=height + 0.03),
        direction=_shifted("torch.zeros_like(obj_pos)", z=1.0),
        extras=[
            _LEAVE_REF,
            ("upright", "-0.5 * (1 - standing).clamp(0.0, 1.0)"),
            ("not_too_high", "-2.0 * (height - 0.2).clamp(0.0, 0.3)"),
        ],
    )


def _throw_into(m: Measured, v: Variant) -> Draft:
    draft = _insert(m, v)
    draft.thoughts = [
        "Grasp the object.",
        "Swing it towards the container.",
        "Let go so that it flies in.",
    ]
    draft.extras = [
        ("flight", "0.3 * torch.tanh(4.0 * (obj_vel * torch.nn.functional.normalize(goal_point - obj_pos, dim=-1)).sum(dim=-1)) * (1 - obj_touched)"),
        *draft.extras[:1],
    ]  # fmt: skip
    return draft


def _push_with(m: Measured, v: Variant) -> Draft:
    """The tool is grasped and pushes; the gripper never touches the object."""
    way = round(float(np.clip(0.6 * np.hypot(m.move_m[0], m.move_m[1]), 0.07, 0.12)), 3)
    way = round(way * v.strictness, 3)
    return Draft(
        thoughts=[
            "Grasp the tool.",
            "Bring its end behind the object, on the side where the tool lay.",
            "Push the object with it, away from where the tool lay.",
        ],
        setup=[
            "goal_direction = obj_start - ref_start",
            "goal_direction[:, 2] = 0",
            "goal_direction = torch.nn.functional.normalize(goal_direction, dim=-1)",
            "moved = ((obj_pos - obj_start) * goal_direction).sum(dim=-1)",
            "between = obj_pos - ref_pos",
            "between[:, 2] = 0",
            "line = torch.nn.functional.normalize(between, dim=-1)",
            "gap = torch.norm(between, dim=-1) - obj_half(obj_quat, obj_size, line) - ref_half(ref_quat, ref_size, line)",
        ],
        success=[
            ("is_there", f"moved > {way}"),
            ("is_by_tool", "(ref_touched > 0.5) & (obj_touched < 0.5) & (gap < 0.1)"),
            ("is_down", _LOW),
            ("is_upright", _STILL_UPRIGHT),
            ("is_still", _still(v)),
        ],
        reward_setup=["tool_low = 1 - torch.tanh(10.0 * (ref_pos[:, 2] - ref_start[:, 2]).abs())"],
        target="ref_pos",
        contact="ref_grasped * near",
        pays_contact=True,
        turn=False,
        progress=f"(moved / {way + 0.02:.3f}).clamp(-1.0, 1.0) * contact * {_LOW}.float() * {_STANDING}",
        remaining=f"({way} - moved).clamp(min=0.0)",
        goal=_shifted("obj_start", z=0.0) + f" + goal_direction * {way + 0.02:.3f}",
        extras=[
            ("tool_near", "0.2 * contact * tool_low * (1 - torch.tanh(5.0 * gap.clamp(min=0.0)))"),
            ("hands_off", "-0.3 * obj_touched"),
        ],
    )


def _generic(m: Measured, v: Variant) -> Draft:
    """The object must come as far from its start as it did in the video."""
    move = np.array(m.move_m)
    distance = float(np.linalg.norm(move))
    wanted = float(np.clip(distance, 0.08, 0.25))
    move = move / distance * wanted if distance > 0.02 else np.array([0.0, 0.0, 0.1])
    lifts = move[2] > 0.05
    if not lifts:
        move[2] = 0.0
    x, y, z = (round(float(c), 3) for c in move)
    tolerance = round(float(np.clip(0.4 * wanted, 0.04, 0.08)) / v.strictness, 3)
    success = [
        ("is_there", f"remaining < {tolerance}"),
        (
            "is_on_its_way",
            f"((obj_pos - obj_start) * goal_direction).sum(dim=-1) > {0.5 * wanted:.3f}",
        ),
        ("is_still", _still(v)),
    ]
    if lifts:
        success.insert(1, ("is_held", "obj_grasped > 0.5"))
    return Draft(
        thoughts=["Reach the object.", "Move it as in the video.", "Keep it there."],
        setup=[
            f"goal_point = {_shifted('obj_start', x=x, y=y, z=z)}",
            f"goal_direction = torch.nn.functional.normalize({_shifted('torch.zeros_like(obj_pos)', x=x, y=y, z=z)}, dim=-1)",
            "remaining = torch.norm(goal_point - obj_pos, dim=-1)",
        ],
        success=success,
        reward_setup=_GRASP_SETUP if lifts else _push_point(clearance_m=0.02),
        target="grasp_point" if lifts else "push_point",
        contact="obj_grasped * near" if lifts else "near",
        pays_contact=bool(lifts),
        progress=f"(1 - remaining / {wanted:.3f}).clamp(-1.0, 1.0)",
        remaining="remaining",
        goal="goal_point",
    )


_RECIPES: dict[str, Callable[[Measured, Variant], Draft]] = {
    "lift_up": _lift,
    "push_left": _push,
    "push_right": _push,
    "tip_over": _tip_over,
    "push_next_to": _push_next_to,
    "slide_to": _push_next_to,
    "insert": _insert,
    "place_onto": _place_onto,
    "drop_in_front_of": _drop_in_front_of,
    "cover": _cover,
    "uncover": _uncover,
    "throw_into": _throw_into,
    "push_with": _push_with,
    "generic": _generic,
}
_NEEDS_REFERENCE = (
    _push_next_to,
    _insert,
    _place_onto,
    _drop_in_front_of,
    _cover,
    _uncover,
    _throw_into,
    _push_with,
)


def _still(v: Variant) -> str:
    return f"torch.norm(obj_vel, dim=-1) < {v.still_m_s}"


def _shifted(point: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> str:
    return f"{point} + torch.tensor([{x!r}, {y!r}, {z!r}], device=obj_pos.device)"


def _push_point(clearance_m: float) -> list[str]:
    """Lines for the point behind the object, seen along `goal_direction`, at which fingers push it."""
    return [
        "behind = obj_half(obj_quat, obj_size, goal_direction)",
        f"push_point = obj_pos - goal_direction * (behind + {clearance_m}).unsqueeze(-1)",
        "push_point[:, 2] = table_height + half_height.clamp(0.02, 0.025)",
        "distance_xy = torch.norm((push_point - eef_pos)[:, :2], dim=-1)",
        *_LEAN_SETUP,
    ]


# --- text ----------------------------------------------------------------------------------------------------

_HELPERS = [
    """def lowest_point(pos, quat, size):
    # Height of the object's lowest point above the table.
    up = torch.zeros_like(pos)
    up[:, 2] = 1
    return pos[:, 2] - obj_half(quat, size, up)""",
    """def upright(quat, start_quat):
    # 1 while the object stands as at the start, 0 when it lies on its side.
    up = torch.zeros_like(quat[:, 1:])
    up[:, 2] = 1
    return (in_body_frame(quat, up) * in_body_frame(start_quat, up)).sum(dim=-1)""",
    """def in_world_frame(quat, direction):
    w = quat[:, :1]
    v = quat[:, 1:]
    turned = torch.cross(v, direction, dim=-1)
    return direction + 2 * w * turned + 2 * torch.cross(v, turned, dim=-1)""",
    """def in_body_frame(quat, direction):
    # The direction as seen from the object's own axes; quat is wxyz.
    w = quat[:, :1]
    v = quat[:, 1:]
    turned = torch.cross(v, direction, dim=-1)
    return direction - 2 * w * turned + 2 * torch.cross(v, turned, dim=-1)""",
]

_HALF = {
    "box": "(in_body_frame(quat, direction).abs() * size).sum(dim=-1) / 2",
    "cylinder": (
        "torch.norm(in_body_frame(quat, direction)[:, :2], dim=-1) * size[:, 0] / 2"
        " + in_body_frame(quat, direction)[:, 2].abs() * size[:, 2] / 2"
    ),
    "sphere": "size[:, 0] / 2",
}


def _text(scene: Scene, m: Measured, v: Variant, d: Draft) -> str:
    caption = " ".join(scene.description.split())
    name = _class_name(caption, scene.kind)
    observations = _observations(v, d)
    parts = [
        "import torch\nfrom factory.tasks.task import Task\n",
        f"scene_info = {_scene_info(scene, name)}\n",
        f"class {name}(Task):",
        _indented(
            [
                f'"""{_plain(caption)}"""',
                "",
                "def __init__(self, envs, urdf_assets_root):",
                "    super().__init__(envs, urdf_assets_root, scene_info)",
                f"    self.task_description = {caption!r}",
                "",
                "def reset_objects_states(self, env_ids):",
                "    return super().reset_objects_states(env_ids)",
                "",
                "def compute_observation_key(self, states):",
                "    obs_keys = super().compute_observation_key(states)",
                *_indented_by_one(
                    _used(
                        _state_lines(m) + d.setup,
                        [line for key, text, _ in observations for line in _observe(key, text)],
                    )
                ),
                "    return obs_keys",
                "",
                "def get_observation_space(self):",
                "    obs_space = super().get_observation_space()",
                f"    return obs_space + {sum(dim for _, _, dim in observations)}",
                "",
                "def compute_success(self, states):",
                *_indented_by_one(_used(_state_lines(m) + d.setup, _success_lines(v, d))),
                "",
                "def compute_reward(self, actions, states):",
                "    return reward_function(actions, states)",
            ]
        ),
        "\n\n# REWARD FUNCTION\n@torch.jit.script\ndef reward_function(actions, states):",
        _indented(
            [
                "# type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]",
                *_docstring(v, d),
                *_used(_state_lines(m) + d.setup + d.reward_setup, _reward_lines(v, d)),
            ]
        ),
    ]
    return _with_helpers("\n".join(parts), m) + "\n"


def _class_name(caption: str, kind: str) -> str:
    words = re.findall(r"[A-Za-z][A-Za-z0-9]*", caption)[:10] or kind.split("_")
    return "".join(w[0].upper() + w[1:] for w in words)[:60] + "Task"


def _plain(text: str) -> str:
    return re.sub(r'["\\]', "", text)


def _scene_info(scene: Scene, class_name: str) -> str:
    objects = [
        {
            "name": o.name,
            "label": o.label,
            "role": o.role,
            "size_m": [round(s, 4) for s in o.size_m],
            "urdf": o.urdf,
            "first_position": [round(float(c), 4) for c in first_pose(o)[:3]],
            "last_position": [round(float(c), 4) for c in o.last_pose[:3]]
            if o.poses_world
            else [],
        }
        for o in scene.objects
    ]
    info = {
        "task_class_name": class_name,
        "video": scene.video,
        "task_description": scene.description,
        "objects": objects,
    }
    return pprint.pformat(info, sort_dicts=False, width=100)


def _indented(lines: list[str]) -> str:
    return "\n".join(f"    {line}" if line else "" for line in lines)


def _state_lines(m: Measured) -> list[str]:
    """Lines that give the states short names."""
    lines = [
        'eef_pos = states["eef_pos"]',
        'eef_quat = states["eef_quat"]',
        'gripper_width = states["gripper_width"]',
        'table_height = states["table_height"]',
    ]
    for short, obj in (("obj", m.obj), ("ref", m.ref)):
        if obj is None:
            continue
        n = obj.name
        lines += [
            f'{short}_pos = states["{n}_pos"]',
            f'{short}_quat = states["{n}_quat"]',
            f'{short}_size = states["{n}_size"]',
            f'{short}_start = states["{n}_start_pos"]',
            f'{short}_grasped = states["{n}_grasped"]',
            f'{short}_touched = states["{n}_touched"]',
        ]
    n = m.obj.name
    return [
        *lines,
        f'obj_start_quat = states["{n}_start_quat"]',
        f'obj_vel = states["{n}_vel_linear"]',
        "half_height = obj_start[:, 2] - table_height",
        "reach_limit = 0.05 + half_height",
    ]


def _success_lines(v: Variant, d: Draft) -> list[str]:
    conditions = d.success[:1] if v.is_naive else d.success
    lines = [f"{name} = {expression}" for name, expression in conditions]
    return [*lines, "return " + " & ".join(name for name, _ in conditions)]


def _observations(v: Variant, d: Draft) -> list[tuple[str, str, int]]:
    known = {
        "distance": ("distance_to_object", "torch.norm(obj_pos - eef_pos, dim=-1) * 5", 1),
        "remaining": ("distance_to_go", f"({d.remaining}) * 5", 1),
        "goal": ("goal_offset", f"({d.goal} - obj_pos) * 5", 3),
    }
    return [known[name] for name in v.observes]


def _observe(key: str, expression: str) -> list[str]:
    return [f'states["{key}"] = {expression}', f'obs_keys.append("{key}")']


def _indented_by_one(lines: list[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _used(definitions: list[str], body: list[str]) -> list[str]:
    """Return the body with those definitions before it that it needs, in their order."""
    kept, text = list(body), "\n".join(body)
    for line in reversed(definitions):
        name = re.match(r"\w+", line)
        if name and re.search(rf"\b{name[0]}\b", text):
            kept.insert(0, line)
            text += "\n" + line
    return kept


def _with_helpers(code: str, m: Measured) -> str:
    """Append the helper functions that the code calls, callers before what they call."""
    halves = [_half_function("obj_half", m.obj)]
    if m.ref is not None:
        halves.append(_half_function("ref_half", m.ref))
    text = code
    for helper in [*_HELPERS[:2], *halves, *_HELPERS[2:]]:
        name = helper.split("(")[0].removeprefix("def ")
        if f"{name}(" in text:
            text += "\n\n\n" + helper
    return text


def _docstring(v: Variant, d: Draft) -> list[str]:
    components = [name for name, *_ in _components(v, d)]
    return [
        '"""',
        "# Chain of Thoughts for reward designs:",
        *[f"{i}. {t}" for i, t in enumerate(d.thoughts, 1)],
        v.idea,
        "# Reward Components:",
        *[f"{i}. {c}" for i, c in enumerate(components, 1)],
        '"""',
    ]


def _near(v: Variant) -> str:
    t = v.temperature
    return {
        "tanh": f"1 - torch.tanh({t} * distance)",
        "exp": f"torch.exp(-{t} * distance)",
        "mixed": "0.5 * (1 - torch.tanh(3.0 * distance)) + 0.5 * (1 - torch.tanh(30.0 * distance))",
        "rational": f"1 / (1 + ({t} * distance) ** 2)",
    }[v.kernel]


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
        parts += [_TURN] if d.turn else []
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


def _reward_lines(v: Variant, d: Draft) -> list[str]:
    components = _components(v, d)
    return [
        f"distance = torch.norm({d.target} - eef_pos, dim=-1)",
        "near = (distance < 0.045).float()",
        f"reach = {_near(v)}",
        f"contact = {d.contact}",
        f"progress = {d.progress}",
        *([f"direction = {d.direction}"] if v.speed else []),
        "reward_components = {}",
        *[f'reward_components["{name}"] = {expression}' for name, expression in components],
        "total = 100.0 * ("
        + " + ".join(f'reward_components["{name}"]' for name, _ in components)
        + ")",
        "return total, reward_components",
    ]


def _half_function(name: str, obj: SceneObject) -> str:
    body = _HALF.get(obj.shape, _HALF["box"])
    return (
        f"def {name}(quat, size, direction):\n"
        f"    # Half the extent of the {_plain(obj.label)} along a direction.\n"
        f"    return {body}"
    )
