"""Recipes for what is moved on the table: pushed, tipped over, brought beside something, moved with a tool."""

import numpy as np

from v2p_data.task.templates.draft import Draft, Measured
from v2p_data.task.templates.phrases import (
    LEVEL,
    LOW,
    REF_MOVED,
    REF_STILL,
    STANDING,
    STILL_UPRIGHT,
    grasp_setup,
    is_still,
    push_point_setup,
    shifted,
)
from v2p_data.task.templates.variants import Variant


def push(m: Measured, v: Variant) -> Draft:
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
            f"goal_direction = {shifted('torch.zeros_like(obj_pos)', y=sign)}",
            "moved = ((obj_pos - obj_start) * goal_direction).sum(dim=-1)",
            "sideways = (obj_pos[:, 0] - obj_start[:, 0]).abs()",
        ],
        success=[
            ("is_there", f"moved > {way}"),
            ("is_straight", f"sideways < ({slant} * moved).clamp(min=0.05)"),
            ("is_down", LOW),
            ("is_upright", STILL_UPRIGHT),
            is_still(v),
        ],
        reward_setup=push_point_setup(clearance_m=0.02),
        target="push_point",
        progress=f"(moved / {way + 0.02:.3f}).clamp(-1.0, 1.0) * {LOW}.float() * {STANDING}",
        remaining=f"({way} - moved).clamp(min=0.0)",
        goal=shifted("obj_start", y=sign * (way + 0.02)),
        extras=[
            ("straight", "-0.5 * (sideways - 0.02).clamp(0.0, 0.2)"),
            ("not_too_far", f"-0.3 * (moved - {way + 0.07:.3f}).clamp(0.0, 1.0)"),
            LEVEL,
        ],
    )


def tip_over(_: Measured, v: Variant) -> Draft:
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
            is_still(v),
        ],
        reward_setup=[
            "up = torch.zeros_like(obj_pos)",
            "up[:, 2] = 1",
            "top = obj_pos + in_world_frame(obj_quat, in_body_frame(obj_start_quat, up)) * (0.7 * half_height).unsqueeze(-1)",
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


def push_next_to(_: Measured, v: Variant) -> Draft:
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
            REF_MOVED,
        ],
        success=[
            ("is_next_to", f"gap < {gap}"),
            ("is_left_alone", REF_STILL),
            ("is_down", LOW),
            ("is_upright", STILL_UPRIGHT),
            is_still(v),
        ],
        reward_setup=[
            *push_point_setup(clearance_m=0.012),
            "ahead = ((eef_pos - push_point) * goal_direction).sum(dim=-1)",
            "wanted_height = torch.where(distance_xy < 0.04, push_point[:, 2], torch.where(ahead > 0, push_point[:, 2] + 0.07, push_point[:, 2] + 0.02))",
        ],
        target="push_point",
        progress=f"(0.5 * (1 - gap / 0.15).clamp(-1.0, 1.0) + 0.5 * torch.exp(-gap.clamp(min=0.0) / 0.025)) * {LOW}.float() * {STANDING}",
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
            ("is_down", LOW),
            ("is_upright", STILL_UPRIGHT),
            is_still(v),
        ],
        reward_setup=[
            *grasp_setup("ref"),
            "tool_low = 1 - torch.tanh(10.0 * (ref_pos[:, 2] - ref_start[:, 2]).abs())",
            "closer = (1 - gap / 0.2).clamp(0.0, 1.0)",
        ],
        target="grasp_point",
        contact="ref_grasped * near",
        pays_contact=True,
        progress=f"(moved / {way + 0.02:.3f}).clamp(-1.0, 1.0) * contact * {LOW}.float() * {STANDING}",
        remaining=f"({way} - moved).clamp(min=0.0)",
        goal=shifted("obj_start", z=0.0) + f" + goal_direction * {way + 0.02:.3f}",
        extras=[
            ("tool_near", "0.4 * contact * tool_low * closer"),
            ("hands_off", "-0.3 * obj_touched"),
        ],
    )
