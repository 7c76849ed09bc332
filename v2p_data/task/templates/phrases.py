"""Expressions that recipes share; the names in them are defined by `six_parts` or by the phrase itself."""

from v2p_data.task.templates.variants import Variant

LOW = "((obj_pos[:, 2] - obj_start[:, 2]).abs() < 0.02)"
REF_STILL = "(ref_moved < 0.03)"
REF_MOVED = "ref_moved = torch.norm((ref_pos - ref_start)[:, :2], dim=-1)"
LEAVE_REF = ("leave_reference", "-1.0 * (ref_moved - 0.01).clamp(0.0, 0.3)")
HEIGHT = "height = obj_pos[:, 2] - obj_start[:, 2]"
_LEAN_SETUP = [
    "vertical = torch.zeros_like(eef_pos)",
    "vertical[:, 2] = 1",
    "lean = torch.norm(in_world_frame(eef_quat, vertical)[:, :2], dim=-1)",
]
# Withholds what pushing earns once the object topples. A penalty instead teaches not to touch tall objects at all:
# 0 % for a 5 x 8 cm cylinder.
STANDING = "upright(obj_quat, obj_start_quat).clamp(0.0, 1.0)"
# A leaning finger pushes at the object's upper edge and rolls it over: 4 cm cubes in one episode out of seven.
LEVEL = ("level", "-0.4 * lean")


def grasp_setup(name: str = "obj", *, by_wall: bool = False) -> list[str]:
    """Lines for the point at which the gripper holds an object, `obj` or `ref`, and for the side that it spans.

    While the gripper is beside a tall object the point is above that object: whoever comes straight at it presses on
    its rim and never gets the open fingers over it. `by_wall`: the point is in the nearer of the
    manipulated object's two walls.
    """
    height = "(tall - 0.035).clamp(min=0.0) + torch.minimum(1.5 * (beside - 0.01).clamp(min=0.0), 2 * tall)"
    lines = [
        *_LEAN_SETUP,
        f"grasp_point = {name}_pos.clone()",
        f"tall = {name}_start[:, 2] - table_height",
        f"beside = torch.norm(({name}_pos - eef_pos)[:, :2], dim=-1)",
        f"grasp_point[:, 2] = {name}_pos[:, 2] + {height}",
        # The pads close along the gripper's own y axis.
        "closing = torch.zeros_like(eef_pos)",
        "closing[:, 1] = 1",
        "closing = in_world_frame(eef_quat, closing)",
        f"pads_apart = 2 * {name}_half({name}_quat, {name}_size, closing)",
        # Closed fingers that press on the top of a cover touch it with both pads too.
        f"gripped = {name}_grasped * (eef_pos[:, 2] - {name}_pos[:, 2] < (tall - 0.002).clamp(min=0.02)).float()",
        f"diagonal = torch.norm({name}_size[:, :2], dim=-1)",
        f"snug = (torch.minimum({name}_size[:, 0], {name}_size[:, 1]) > 0.06).float()",
    ]
    return [*lines, *_by_wall(height)] if by_wall else lines


def _by_wall(height: str) -> list[str]:
    return [
        "across = torch.nn.functional.normalize(closing * torch.tensor([1.0, 1.0, 0.0], "
        "device=obj_pos.device), dim=-1)",
        "side = torch.sign(((eef_pos - obj_pos) * across).sum(dim=-1))",
        "middle = side * (obj_half(obj_quat, obj_size, across) - 0.005)",
        "grasp_point = obj_pos + across * middle.unsqueeze(-1)",
        "beside = torch.norm((grasp_point - eef_pos)[:, :2], dim=-1)",
        f"grasp_point[:, 2] = obj_pos[:, 2] + {height}",
        # Held by a wall it hangs at any angle.
        "grasp_point = torch.where((obj_grasped > 0.5).unsqueeze(-1), eef_pos, grasp_point)",
        "gripped = obj_grasped",
        "pads_apart = torch.full_like(gripped, 0.01)",
        "snug = torch.zeros_like(gripped)",
    ]


def is_still(v: Variant) -> tuple[str, str]:
    """Return the condition that the object has come to rest."""
    still = f"torch.norm(obj_vel, dim=-1) < {v.still_m_s}"
    if v.still_rad_s:
        still = f"({still}) & (torch.norm(obj_spin, dim=-1) < {v.still_rad_s})"
    return "is_still", still


def stands(v: Variant, *, is_asked: bool = True) -> list[tuple[str, str]]:
    """Return the condition that the object stands as at the start; none where it is not asked.

    Args:
        v: the variant.
        is_asked: whether the words of the kind of task ask for it.
    """
    lean = {"words": 0.9 if is_asked else 0.0, "any": 0.0, "strict": 0.95 if is_asked else 0.7}
    least = lean[v.upright]
    return [("is_upright", f"upright(obj_quat, obj_start_quat) > {least}")] if least else []


def shifted(point: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> str:
    """Return a point, or a direction, moved by metres."""
    return f"{point} + torch.tensor([{x!r}, {y!r}, {z!r}], device=obj_pos.device)"


def push_point_setup(clearance_m: float) -> list[str]:
    """Lines for the point behind the object, seen along `goal_direction`, at which fingers push it."""
    return [
        "behind = obj_half(obj_quat, obj_size, goal_direction)",
        f"push_point = obj_pos - goal_direction * (behind + {clearance_m}).unsqueeze(-1)",
        "push_point[:, 2] = table_height + half_height.clamp(0.02, 0.025)",
        "distance_xy = torch.norm((push_point - eef_pos)[:, :2], dim=-1)",
        *_LEAN_SETUP,
    ]
