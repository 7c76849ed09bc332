"""Functions that generated task code may call: an object's extent, its lowest point, how upright it stands."""

import re

from v2p_data.scene.scene import SceneObject
from v2p_data.task.templates.draft import Measured

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


def with_helpers(code: str, m: Measured) -> str:
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


def plain(text: str) -> str:
    """Return a stranger's text without what could end a string or a comment early."""
    return re.sub(r'["\\]', "", text)


def _half_function(name: str, obj: SceneObject) -> str:
    body = _HALF.get(obj.shape, _HALF["box"])
    return (
        f"def {name}(quat, size, direction):\n"
        f"    # Half the extent of the {plain(obj.label)} along a direction.\n"
        f"    return {body}"
    )
