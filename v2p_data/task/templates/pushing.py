"""Recipes for what is moved on the table: pushed, tipped over, brought beside something, moved with a tool."""

import numpy as np

from v2p_data.task.templates.draft import Draft, Measured
from v2p_data.task.templates.phrases import (
    LEVEL,
    LOW,
    REF_MOVED,
    REF_STILL,
    STANDING,
    grasp_setup,
    is_still,
    push_point_setup,
    shifted,
    stands,
)
from v2p_data.task.templates.variants import Variant, tolerance, way


def push(m: Measured, v: Variant) -> Draft:
    sign = 1.0 if m.kind == "push_left" else -1.0
    far = way(float(np.clip(0.6 * abs(m.move_m[1]), 0.08, 0.15)), v)
    # Hands push at a slant; the words allow some of it.
    slant = round(
        float(np.clip(1.15 * abs(m.move_m[0]) / max(abs(m.move_m[1]), 1e-3), 0.5, 1.0)), 2
    )
    there = "moved"
    if v.goal == "video":
        x, y = (round(c / float(np.hypot(*m.move_m[:2])), 3) for c in m.move_m[:2])
        there = f"({shifted('torch.zeros_like(obj_pos)', x=x, y=y)})"
        there = f"((obj_pos - obj_start) * {there}).sum(dim=-1)"
    return Draft(
        thoughts=[
            f"Go behind the object, on its {'right' if sign > 0 else 'left'}.",
            f"Push it to the {'left' if sign > 0 else 'right'}, low above the table.",
            "Stop with it standing as before.",
        ],
        setup=[
            f"goal_direction = {shifted('torch.zeros_like(obj_pos)', y=sign)}",
            "moved = ((obj_pos - obj_start) * goal_direction).sum(dim=-1)",
            "sideways = (obj_pos[:, 0] - obj_start[:, 0]).abs()",
        ],
        success=[
            ("is_there", f"{there} > {far}"),
            ("is_straight", f"sideways < ({slant} * moved).clamp(min=0.05)"),
            ("is_down", LOW),
            *stands(v),
            *_not_held(v),
            is_still(v),
        ],
        reward_setup=push_point_setup(clearance_m=0.02),
        target="push_point",
        progress=f"(moved / {far + 0.02:.3f}).clamp(-1.0, 1.0) * {LOW}.float() * {STANDING}",
        remaining=f"({far} - moved).clamp(min=0.0)",
        goal=shifted("obj_start", y=sign * (far + 0.02)),
        extras=[
            ("straight", "-0.5 * (sideways - 0.02).clamp(0.0, 0.2)"),
            ("not_too_far", f"-0.3 * (moved - {far + 0.07:.3f}).clamp(0.0, 1.0)"),
            LEVEL,
        ],
    )


def tip_over(_: Measured, v: Variant) -> Draft:
    # It came to lie on its side, not on its head.
    lies = "standing.abs()" if v.goal == "video" or v.upright == "strict" else "standing"
    return Draft(
        thoughts=[
            "Go to the upper part of the object.",
            "Push it over.",
            "Let it come to rest on its side.",
        ],
        setup=["standing = upright(obj_quat, obj_start_quat)"],
        success=[
            ("is_tipped", f"{lies} < {round(0.3 + 0.05 * v.slack, 3)}"),
            ("is_down", "lowest_point(obj_pos, obj_quat, obj_size) < 0.015"),
            ("is_near", "torch.norm((obj_pos - obj_start)[:, :2], dim=-1) < 0.25"),
            *([("is_let_go", "obj_touched < 0.5")] if v.holds == "strict" else []),
            is_still(v),
        ],
        reward_setup=[
            "up = torch.zeros_like(obj_pos)",
            "up[:, 2] = 1",
            "top = obj_pos + in_world_frame(obj_quat, in_body_frame(obj_start_quat, up)) * (0.7 * "
            "half_height).unsqueeze(-1)",
        ],
        target="top",
        progress="1 - standing.abs()",
        remaining="half_height * standing.clamp(min=0.0)",
        goal=shifted("obj_start", z=-0.03),
        direction="torch.nn.functional.normalize(obj_pos - eef_pos, dim=-1)",
        extras=[
            (
                "stay_near",
                "-1.0 * (torch.norm((obj_pos - obj_start)[:, :2], dim=-1) - 0.12).clamp(0.0, 0.3)",
            )
        ],
    )


def push_next_to(m: Measured, v: Variant) -> Draft:
    gap = tolerance(0.02, v)
    beside = f"gap < {gap}"
    if v.goal == "video":
        distance = round(float(np.hypot(*m.beside_m)), 3)
        beside = f"(torch.norm(between, dim=-1) - {distance}).abs() < {tolerance(0.02, v)}"
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
            REF_MOVED,
        ],
        success=[
            ("is_next_to", beside),
            ("is_left_alone", REF_STILL),
            ("is_down", LOW),
            *stands(v),
            *_not_held(v),
            is_still(v),
        ],
        reward_setup=[
            *push_point_setup(clearance_m=0.012),
            "ahead = ((eef_pos - push_point) * goal_direction).sum(dim=-1)",
            "wanted_height = torch.where(distance_xy < 0.04, push_point[:, 2], torch.where(ahead "
            "> 0, push_point[:, 2] + 0.07, push_point[:, 2] + 0.02))",
        ],
        target="push_point",
        progress="(0.5 * (1 - gap / 0.15).clamp(-1.0, 1.0) + 0.5 * torch.exp(-gap.clamp(min=0.0) "
        f"/ 0.025)) * {LOW}.float() * {STANDING}",
        remaining="gap.clamp(min=0.0)",
        goal="ref_pos",
        extras=[
            ("go_around", "0.1 * (1 - torch.tanh(10.0 * (eef_pos[:, 2] - wanted_height).abs()))"),
            ("leave_reference", "-3.0 * (ref_moved - 0.01).clamp(0.0, 0.3)"),
            LEVEL,
        ],
    )


def push_with(m: Measured, v: Variant) -> Draft:
    """The tool is grasped and pushes; the gripper never touches the object."""
    far = way(float(np.clip(0.6 * np.hypot(m.move_m[0], m.move_m[1]), 0.07, 0.12)), v)
    there = "moved"
    if v.goal == "video":
        there = "torch.norm((obj_pos - obj_start)[:, :2], dim=-1)"
    by_tool = {"words": "(ref_touched > 0.5) & ", "any": "", "strict": "(ref_grasped > 0.5) & "}
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
            "gap = torch.norm(between, dim=-1) - obj_half(obj_quat, obj_size, line) - "
            "ref_half(ref_quat, ref_size, line)",
        ],
        success=[
            ("is_there", f"{there} > {far}"),
            ("is_by_tool", by_tool[v.holds] + "(obj_touched < 0.5) & (gap < 0.1)"),
            ("is_down", LOW),
            *stands(v),
            is_still(v),
        ],
        reward_setup=[
            *grasp_setup("ref"),
            "tool_low = 1 - torch.tanh(10.0 * (ref_pos[:, 2] - ref_start[:, 2]).abs())",
            "closer = (1 - gap / 0.2).clamp(0.0, 1.0)",
        ],
        target="grasp_point",
        contact="gripped * near",
        pays_contact=True,
        progress=f"(moved / {far + 0.02:.3f}).clamp(-1.0, 1.0) * contact * {LOW}.float() * {STANDING}",
        remaining=f"({far} - moved).clamp(min=0.0)",
        goal=shifted("obj_start", z=0.0) + f" + goal_direction * {far + 0.02:.3f}",
        extras=[
            ("tool_near", "0.4 * contact * tool_low * closer"),
            ("hands_off", "-1.5 * obj_touched"),
        ],
    )


def _not_held(v: Variant) -> list[tuple[str, str]]:
    """Return the condition that the gripper does not have what it pushed."""
    return [("is_free", "obj_grasped < 0.5")] if v.holds == "strict" else []
