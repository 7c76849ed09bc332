"""What a frame of our datasets holds: names, shapes and units of every column.

State and action entries end in `.pos`, because `lerobot-rollout` drops other names without a word. Policies, LeRobot's
and ours, take as inputs what begins with `observation.`; no other column may begin so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from v2p_data.episodes.staging import Episode
from v2p_data.sim.robot.action_names import DELTA_NAMES as ACTION_NAMES
from v2p_data.sim.robot.action_names import Actions, actions_named, joint_names
from v2p_data.sim.robot.interface import ArmInterface

FPS = 20
ROBOT_TYPE = "v2p_franka"
MASK_KEY = "observation.images.mask"
WRIST_KEY = "observation.images.mask_wrist"
RGB_KEY = "observation.images.rgb"
STATE_KEY = "observation.state"
ACTION_KEY = "action"
SUCCESS_KEY = "next.success"
DONE_KEY = "next.done"
REWARD_KEY = "next.reward"
OBJECT_POSE_KEY = "privileged.object_pose"
CONTACT_KEY = "privileged.contact"
EXECUTED_KEY = "privileged.executed"
INTRINSICS_KEY = "camera.intrinsics"
CAMERA_POSE_KEY = "camera.pose"
INTERVENTION_KEY = "intervention"
"""Whether the expert acted, as LeRobot's DAgger recordings name it; True throughout in demonstrations."""
KEY_OF_CAMERA = {"mask": MASK_KEY, "mask_wrist": WRIST_KEY, "rgb": RGB_KEY}
CAMERA_OF_MASKS = {MASK_KEY: "mask", WRIST_KEY: "mask_wrist"}
DEMONSTRATION, HANDOVER = "demonstration", "handover"
"""Where an episode is from, in `METADATA_FILE` of datasets with handovers."""
METADATA_FILE = "meta/v2p.json"
EPISODE_COLUMN = "v2p"
"""Of the table of episodes: the episode's entry in `METADATA_FILE` as JSON. LeRobot's tools leave
the file out more often."""
METADATA_SCHEMA = 1
"""Palette, provenance and drawn parameters; LeRobot ignores it and uploads it."""

STATE_NAMES = (
    "eef_x.pos",
    "eef_y.pos",
    "eef_z.pos",
    "eef_rx.pos",
    "eef_ry.pos",
    "eef_rz.pos",
    "gripper.pos",
    "lead_x.pos",
    "lead_y.pos",
    "lead_z.pos",
    "target_gripper.pos",
)
"""Tool position [m], rotation vector from straight down [rad], gripper opening 0 to 1; then the controller's command:
target position minus tool position [m], target opening 0 to 1. Robot base frame."""
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
SLOTS = 7
"""Objects that masks can tell apart; slot 1 has the label 2, slot 2 the label 3, and so on."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of numbers, one a frame."""

    dtype: str = "float32"
    names: tuple[str, ...] | None = None
    """Of the entries; None for a single number."""
    meaning: str
    """For the card."""
    where: Literal["everywhere", "handovers", "simulation", "targets"] = "everywhere"
    """Which datasets have it: all, those with handovers, those of a simulator alone, those whose
    actions are targets."""

    @property
    def feature(self) -> dict[str, Any]:
        """In LeRobot's words."""
        names = None if self.names is None else list(self.names)
        return {"dtype": self.dtype, "shape": (len(self.names or " "),), "names": names}


COLUMNS = {
    SUCCESS_KEY: Column(
        dtype="bool",
        meaning="the task's success has held for 0.25 s by the end of this action",
    ),
    INTERVENTION_KEY: Column(
        dtype="bool",
        meaning="true where the expert acted, false where a student did",
        where="handovers",
    ),
    DONE_KEY: Column(dtype="bool", meaning="true in the last row of an episode"),
    REWARD_KEY: Column(
        meaning="the task's own shaped reward of what this action led to, 1 is a full one, and 1 "
        "more while it succeeds",
        where="simulation",
    ),
    OBJECT_POSE_KEY: Column(
        names=tuple(f"object_{k}.{axis}" for k in range(1, SLOTS + 1) for axis in _POSE),
        meaning="not for policies: per object the position of its centre [m] and its quaternion "
        "wxyz in the robot's base "
        "frame, before the action; object 1 has the label 2; 0 throughout where there is none",
        where="simulation",
    ),
    CONTACT_KEY: Column(
        dtype="bool",
        names=tuple(f"object_{k}.{s}" for k in range(1, SLOTS + 1) for s in ("left", "right")),
        meaning="not for policies: whether the left and the right finger's pad touches the object, before the action",
        where="simulation",
    ),
    INTRINSICS_KEY: Column(
        names=("fx", "fy", "cx", "cy"),
        meaning="focal lengths and principal point [px]; pixel centres are at integers plus one half",
        where="simulation",
    ),
    CAMERA_POSE_KEY: Column(
        names=_POSE,
        meaning="the camera's position [m] and quaternion wxyz in the robot's base frame; "
        "OpenCV's axes: x right, y down, "
        "z forward",
        where="simulation",
    ),
    EXECUTED_KEY: Column(
        names=ACTION_NAMES,
        meaning="not for policies: the step of the tool that was carried out, each in [-1, 1]; of "
        "these episodes `action` is a target",
        where="targets",
    ),
}
"""All columns but pictures, state and action, in their order. Shapes do not depend on the task, so
that datasets go together.

A new column has an entry here and its values in `Rollouts.simulated`, or, without a simulator, in `columns_of`."""
SIMULATED = tuple(key for key, column in COLUMNS.items() if column.where == "simulation")
"""Numbers that a simulator knows; a robot's recordings lack them."""


def columns_of(episode: Episode) -> dict[str, np.ndarray]:
    """Return what an episode's rows hold, by column; pictures and numbering aside."""
    return {
        STATE_KEY: episode.state,
        ACTION_KEY: episode.action,
        SUCCESS_KEY: episode.success,
        INTERVENTION_KEY: episode.expert_acted,
        DONE_KEY: np.arange(episode.num_frames) == episode.num_frames - 1,
        **episode.simulated,
    }


def actions_in(info: Mapping[str, Any]) -> Actions | None:
    """Return what the actions of a dataset with this `meta/info.json` say, None where they are not ours."""
    return actions_named(info.get("features", {}).get(ACTION_KEY, {}).get("names"))


def state_names(num_states: int) -> tuple[str, ...]:
    """Return the names of a state of so many entries: those after the tool's are the angles of joints."""
    return (*STATE_NAMES, *joint_names(num_states - len(STATE_NAMES)))


def interface_in(info: Mapping[str, Any]) -> ArmInterface:
    """Return what a dataset with this `meta/info.json` holds; the actions of others are taken for steps of the tool."""
    names = info.get("features", {}).get(STATE_KEY, {}).get("names") or ()
    return ArmInterface(
        actions=actions_in(info) or "delta_tool",
        joint_state=tuple(names) != STATE_NAMES == tuple(names[: len(STATE_NAMES)]),
    )


def features(
    size_px: int,
    cameras: tuple[str, ...] = ("mask",),
    *,
    actions: Sequence[str] = ACTION_NAMES,
    states: Sequence[str] = STATE_NAMES,
    has_handovers: bool = False,
    is_simulated: bool = False,
) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table for pictures of `size_px` x `size_px` from these cameras.

    Args:
        size_px: width and height.
        cameras: which pictures there are.
        actions: names of the action's entries.
        states: names of the state's.
        has_handovers: some episodes were acted by a student at first, so there is a column that says who acted.
        is_simulated: all episodes are a simulator's, so there is what only a simulator knows.
    """
    has = {
        "everywhere": True,
        "handovers": has_handovers,
        "simulation": is_simulated,
        "targets": tuple(actions) != ACTION_NAMES,
    }
    return {
        **{
            KEY_OF_CAMERA[camera]: {
                "dtype": "video",
                "shape": (size_px, size_px, 3),
                "names": ["height", "width", "channels"],
            }
            for camera in cameras
        },
        STATE_KEY: {
            "dtype": "float32",
            "shape": (len(states),),
            "names": list(states),
        },
        ACTION_KEY: {"dtype": "float32", "shape": (len(actions),), "names": list(actions)},
        **{key: column.feature for key, column in COLUMNS.items() if has[column.where]},
    }
