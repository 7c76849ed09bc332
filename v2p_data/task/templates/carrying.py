"""Recipes for what is grasped: lifted, carried somewhere and let go, taken off something."""

import numpy as np

from v2p_data.task.templates.draft import Draft, Measured
from v2p_data.task.templates.phrases import (
    HEIGHT,
    LEAVE_REF,
    REF_MOVED,
    REF_STILL,
    grasp_setup,
    is_still,
    shifted,
    stands,
)
from v2p_data.task.templates.variants import Variant, tolerance, way

_CARRY_PROGRESS = (
    "torch.where(arrived, 2.5 + lowered + 0.8 * opened, raised * (1 + carried) * gripped * near)"
)
"""Each stage pays more than the most that can be had by staying in the one before: 0 to 1 for raising, 1 to 2 for
carrying, from 2.5 on over the goal. None is flat."""
_CARRY_EXTRAS = (
    LEAVE_REF,
    ("not_too_high", "-2.0 * (height - 0.12).clamp(0.0, 0.3)"),
    # The straight way down to the object may lead through the other one: fingers knocked over its rim.
    ("clear_of_other", "-1.0 * low_over_other * (1 - gripped) * (1 - arrived.float())"),
    # Summed over the way it costs as much as it would earn at the goal, at whatever speed. It grows along the way and
    # is paid for what the pads drag, not for what fell: where it began at once, everything was held before that line.
    (
        "dragged",
        "-30.0 * carried.clamp(min=0.0) * obj_touched * torch.norm(obj_vel[:, :2], dim=-1).clamp(max=1.0)"
        " * ((height < 0.02) & ~arrived).float()",
    ),
)


def lift(m: Measured, v: Variant) -> Draft:
    height = way(float(np.clip(0.7 * m.lift_m, 0.08, 0.12)), v)
    rise = "lowest_point(obj_pos, obj_quat, obj_size)" if v.goal == "video" else "height"
    held = "(torch.norm(obj_pos - eef_pos, dim=-1) < reach_limit)"
    return Draft(
        thoughts=[
            "Reach the object.",
            "Close the gripper around it.",
            "Raise it and hold it still.",
        ],
        setup=[HEIGHT],
        success=[
            ("is_high", f"{rise} > {height}"),
            ("is_held", held if v.holds == "any" else f"(obj_grasped > 0.5) & {held}"),
            *stands(v, is_asked=False),
            is_still(v),
        ],
        reward_setup=grasp_setup(by_wall=m.by_wall),
        target="grasp_point",
        contact="gripped * near",
        pays_contact=True,
        progress=f"(height / {max(height + 0.02, 0.12):.3f}).clamp(0.0, 1.0) * contact",
        remaining=f"({height} - height).clamp(min=0.0)",
        goal=shifted("obj_start", z=height + 0.03),
        direction=shifted("torch.zeros_like(obj_pos)", z=1.0),
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


def insert(m: Measured, v: Variant) -> Draft:
    depth = round(0.5 + 0.15 * v.slack, 3)
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
        falls_m=0.15,
        conditions=[
            (
                "is_inside",
                f"(to_goal < {_near_enough(m, v, 'inner')}) & (obj_pos[:, 2] < rim + {depth} * half_height)",
            ),
            ("is_not_below", "lowest_point(obj_pos, obj_quat, obj_size) > -0.01"),
        ],
    )


def place_onto(m: Measured, v: Variant) -> Draft:
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
        falls_m=0.05,
        conditions=[
            (
                "is_on_top",
                f"(to_goal < {_near_enough(m, v, 'inner.clamp(min=0.02)')})"
                f" & (above_goal.abs() < {tolerance(0.025, v)})",
            ),
        ],
    )


def drop_in_front_of(m: Measured, v: Variant) -> Draft:
    x, y = (round(c, 3) for c in m.beside_m)
    there = (
        f"torch.norm((obj_pos - ref_pos)[:, :2] - torch.tensor([{x!r}, {y!r}], device=obj_pos.device), dim=-1)"
        if v.goal == "video"
        else "to_goal"
    )
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
            "room = torch.maximum(obj_size[:, 0], obj_size[:, 1]) / 2 + torch.maximum(ref_size[:, "
            "0], ref_size[:, 1]) / 2",
            "goal_point[:, 0] = ref_pos[:, 0] + front * (room + 0.02)",
            "goal_point[:, 2] = obj_start[:, 2]",
        ],
        arrived="to_goal < 0.03",
        falls_m=0.12,
        conditions=[
            ("is_in_front", f"({there} < {tolerance(0.04, v)}) & (obj_pos[:, 0] < ref_pos[:, 0])"),
            ("is_down", "lowest_point(obj_pos, obj_quat, obj_size).abs() < 0.015"),
        ],
    )


def cover(m: Measured, v: Variant) -> Draft:
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
        falls_m=0.05,
        conditions=[
            (
                "is_over",
                f"(to_goal < {_near_enough(m, v, str(tolerance(0.025, v)))})"
                " & (obj_pos[:, 2] + 0.002 > ref_pos[:, 2])",
            ),
            *stands(v),
        ],
    )


def throw_into(m: Measured, v: Variant) -> Draft:
    draft = insert(m, v)
    draft.thoughts = [
        "Grasp the object.",
        "Swing it towards the container.",
        "Let go so that it flies in.",
    ]
    draft.reward_setup += [
        "drop = (obj_pos[:, 2] - rim).clamp(min=0.0)",
        "airtime = (obj_vel[:, 2] + (obj_vel[:, 2] ** 2 + 19.62 * drop).sqrt()) / 9.81",
        "landing = obj_pos[:, :2] + obj_vel[:, :2] * airtime.unsqueeze(-1)",
        # The point of landing after a release at this moment. It is constant in flight.
        "aim = 1 - torch.tanh(3.0 * torch.norm(goal_point[:, :2] - landing, dim=-1))",
    ]
    # A release pays in the air only. When it paid on the table too, PPO rolled the ball to the container.
    draft.progress = (
        "torch.where(arrived, 2.5 + lowered,"
        " raised * (0.4 + 0.6 * aim) * gripped * near + 1.2 * aim * (1 - obj_touched) * (height > 0.02).float())"
    )
    draft.extras = draft.extras[:1]
    return draft


def uncover(m: Measured, v: Variant) -> Draft:
    height = way(0.08, v)
    held = "" if v.holds == "any" else " & (obj_grasped > 0.5)"
    off = f"(height > {height}){held}"
    if v.goal == "video":
        moved = way(max(0.6 * float(np.linalg.norm(m.move_m)), 0.08), v)
        off = f"(torch.norm(obj_pos - obj_start, dim=-1) > {moved}) & ({off} | (height.abs() < 0.02))"
    elif v.holds != "strict":
        aside = f"(aside > room + {tolerance(0.02, v)}) & (height.abs() < 0.02)"
        off = f"({off}) | ({aside})"
    return Draft(
        thoughts=[
            "Reach the top of the cover.",
            "Grasp it.",
            "Lift it off or carry it aside, upright, and leave what is under it alone.",
        ],
        setup=[
            HEIGHT,
            REF_MOVED,
            "aside = torch.norm((obj_pos - ref_pos)[:, :2], dim=-1)",
            "room = (torch.maximum(obj_size[:, 0], obj_size[:, 1]) + torch.maximum(ref_size[:, "
            "0], ref_size[:, 1])) / 2",
            "standing = upright(obj_quat, obj_start_quat)",
        ],
        success=[
            ("is_off", off),
            ("is_left_alone", REF_STILL),
            *stands(v),
            is_still(v),
        ],
        reward_setup=grasp_setup(by_wall=m.by_wall),
        target="grasp_point",
        contact="gripped * near",
        pays_contact=True,
        # A factor, not a fine: fined for every tilt, a policy learns to stay away from the cover.
        progress=f"torch.maximum((height / {height + 0.02:.3f}).clamp(0.0, 1.0) * contact, (aside "
        "/ (room + 0.03)).clamp(0.0, 1.0) * 0.6) * standing.clamp(0.0, 1.0)",
        remaining=f"({height} - height).clamp(min=0.0)",
        goal=shifted("obj_start", z=height + 0.03),
        direction=shifted("torch.zeros_like(obj_pos)", z=1.0),
        extras=[
            LEAVE_REF,
            ("not_too_high", "-2.0 * (height - 0.2).clamp(0.0, 0.3)"),
        ],
    )


def _near_enough(m: Measured, v: Variant, words: str) -> str:
    """Return how near its goal the object must be: as an expression of the words, or as near as in the video [m]."""
    return words if v.goal == "words" else str(tolerance(float(np.hypot(*m.beside_m)) + 0.02, v))


def _carry(
    m: Measured,
    v: Variant,
    *,
    thoughts: list[str],
    goal: list[str],
    arrived: str,
    falls_m: float,
    conditions: list[tuple[str, str]],
) -> Draft:
    """Return a draft for all tasks that take the object somewhere and let it go.

    Args:
        m: what the video says.
        v: the variant.
        thoughts: steps of the task.
        goal: lines that define `goal_point`, where the object's centre comes to rest.
        arrived: bool expression: the object is over its goal.
        falls_m: opening pays from this height above the goal, more the lower it is.
        conditions: what success demands besides having let go.
    """
    return Draft(
        thoughts=thoughts,
        setup=[
            *goal,
            HEIGHT,
            "to_goal = torch.norm((goal_point - obj_pos)[:, :2], dim=-1)",
            f"arrived = {arrived}",
            "above_goal = obj_pos[:, 2] - goal_point[:, 2]",
            REF_MOVED,
        ],
        success=[
            *conditions,
            *([] if v.holds == "any" else [("is_let_go", "obj_touched < 0.5")]),
            *(
                stands(v, is_asked=False)
                if m.stood and "is_upright" not in dict(conditions)
                else []
            ),
            ("is_left_alone", REF_STILL),
            is_still(v),
        ],
        reward_setup=[*grasp_setup(by_wall=m.by_wall), *_carry_stages(falls_m)],
        target="grasp_point",
        contact="torch.maximum(gripped * near, arrived.float())",
        pays_contact=True,
        progress=_CARRY_PROGRESS,
        remaining="to_goal",
        goal="goal_point",
        direction="torch.nn.functional.normalize(goal_point - obj_pos, dim=-1)",
        extras=list(_CARRY_EXTRAS),
    )


def _carry_stages(falls_m: float) -> list[str]:
    """Return lines of the reward that measure raising, carrying, lowering, opening and being low."""
    return [
        "raised = (height / 0.08).clamp(0.0, 1.0)",
        "way = torch.norm((goal_point - obj_start)[:, :2], dim=-1).clamp(min=0.05)",
        "carried = (1 - to_goal / way).clamp(-1.0, 1.0)",
        # From any height: with a slope that ended at 15 cm, a matchbox was held 20 cm above its goal for good.
        "lowered = 0.5 * (1 - above_goal / 0.4).clamp(0.0, 1.0) + 0.5 * (1 - above_goal / 0.1).clamp(0.0, 1.0)",
        f"opened = (gripper_width / 0.085).clamp(0.0, 1.0) * (1 - above_goal / {falls_m}).clamp(0.0, 1.0)",
        "from_other = torch.norm((eef_pos - ref_pos)[:, :2], dim=-1) - torch.maximum(ref_size[:, "
        "0], ref_size[:, 1]) / 2",
        "too_low = ((ref_pos[:, 2] + ref_size[:, 2] / 2 + 0.06 - eef_pos[:, 2]) / 0.06).clamp(0.0, 1.0)",
        "low_over_other = too_low * (1 - from_other / 0.05).clamp(0.0, 1.0)",
    ]
