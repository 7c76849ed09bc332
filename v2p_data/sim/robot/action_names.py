"""The three kinds of actions that a dataset may hold, and how their entries are named."""

from typing import Any, Literal, get_args

from v2p_data.sim.robot.robot import NUM_ARM_JOINTS

Actions = Literal["delta_tool", "absolute_tool", "joints"]
"""The tool's step, the tool's target after it, or the joint angles of that target."""
DELTA_NAMES = (
    "delta_x.pos",
    "delta_y.pos",
    "delta_z.pos",
    "delta_rx.pos",
    "delta_ry.pos",
    "delta_rz.pos",
    "gripper_close.pos",
)
"""Units and frames: `episodes.dataset.features.ACTION_PARTS`."""
TOOL_NAMES = (
    "target_x.pos",
    "target_y.pos",
    "target_z.pos",
    "target_rx.pos",
    "target_ry.pos",
    "target_rz.pos",
    "target_gripper.pos",
)
JOINT_NAME, OPENING_NAME = "joint_{}.pos", "gripper.pos"
"""The arm's joints from 1 on [rad; m of slides], then the gripper's opening 0 to 1."""


def joint_names(num_joints: int) -> tuple[str, ...]:
    """Return the names of the joints' angles, in order."""
    return tuple(JOINT_NAME.format(k + 1) for k in range(num_joints))


def action_names(actions: Actions, num_joints: int = NUM_ARM_JOINTS) -> tuple[str, ...]:
    """Return the names of an action's entries, in order."""
    named = {"delta_tool": DELTA_NAMES, "absolute_tool": TOOL_NAMES}
    return named.get(actions, (*joint_names(num_joints), OPENING_NAME))


def actions_named(names: Any) -> Actions | None:
    """Return what actions with these names say, None where they are not ours."""
    told = tuple(names) if isinstance(names, list | tuple) else ()
    known: tuple[Actions, ...] = get_args(Actions)
    return next((a for a in known if told == action_names(a, len(told) - 1)), None)
