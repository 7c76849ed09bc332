"""What a frame of our datasets holds: names, shapes and units of every column.

State and action entries end in `.pos`, because `lerobot-rollout` drops other names without a word. Policies, LeRobot's
and ours, take as inputs what begins with `observation.`; no other column may begin so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from v2p_data.episodes.staging import Episode
from v2p_data.sim.robot.action_names import DELTA_NAMES as ACTION_NAMES
from v2p_data.sim.robot.action_names import TOOL_NAMES, Actions, actions_named, joint_names
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

BASE, TOOL = "base", "tool"
FRAMES = {
    BASE: "the robot's base: x forward, y left, z up; turns are about these axes",
    TOOL: (
        "the tool, which points straight down in the vector 0: x forward, y right, z down; turns are about these axes"
    ),
}
OPENING = "0 closed to 1 open"


class Part(NamedTuple):
    """Entries of a column that follow each other, of one unit and one frame of `FRAMES`."""

    names: tuple[str, ...]
    unit: str = ""
    frame: str = ""


STATE_PARTS = (
    Part(("eef_x.pos", "eef_y.pos", "eef_z.pos"), "m", BASE),
    Part(("eef_rx.pos", "eef_ry.pos", "eef_rz.pos"), "rad", TOOL),
    Part(("gripper.pos",), OPENING),
    Part(("lead_x.pos", "lead_y.pos", "lead_z.pos"), "m", BASE),
    Part(("target_gripper.pos",), OPENING),
)
STATE_NAMES = tuple(name for part in STATE_PARTS for name in part.names)
ACTION_PARTS: dict[Actions, tuple[Part, ...]] = {
    "delta_tool": (
        Part(ACTION_NAMES[:3], "x 0.03 m", BASE),
        Part(ACTION_NAMES[3:6], "x 0.2 rad", BASE),
        Part(ACTION_NAMES[6:], "x 0.012 m of finger travel, + closes"),
    ),
    "absolute_tool": (
        Part(TOOL_NAMES[:3], "m", BASE),
        Part(TOOL_NAMES[3:6], "rad", TOOL),
        Part(TOOL_NAMES[6:], OPENING),
    ),
}
TOUCHING = ("pad_left", "pad_right", "hand")
SLOTS = 7
"""Objects that masks can tell apart; slot 1 has the label 2, slot 2 the label 3, and so on."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of numbers, one a frame."""

    dtype: str = "float32"
    parts: tuple[Part, ...] = ()
    """The entries, in order; empty for a single number."""
    meaning: str
    """For the card."""
    where: Literal["everywhere", "handovers", "simulation", "targets"] = "everywhere"
    """Which datasets have it: all, those with handovers, those of a simulator alone, those whose
    actions are targets."""

    @property
    def width(self) -> int:
        """How many entries a row has."""
        return sum(len(part.names) for part in self.parts) or 1

    @property
    def feature(self) -> dict[str, Any]:
        """In LeRobot's words; `info` tells what each entry is."""
        each = [(name, part.unit, part.frame) for part in self.parts for name in part.names]
        names, units, frames = map(list, zip(*each, strict=True)) if each else (None, None, None)
        info = {"units": units, "frames": frames, "meaning": self.meaning}
        return {"dtype": self.dtype, "shape": (self.width,), "names": names, "info": info}

    @property
    def entries(self) -> str:
        """The entries in words; of many objects those of the first."""
        shown = [
            f"{', '.join(names)} [{', '.join(told)}]"
            if (told := [*filter(None, of)])
            else ", ".join(names)
            for names, *of in self.parts
        ]
        return "; ".join(shown if len(shown) < SLOTS else [*shown[: len(shown) // SLOTS], "..."])


def _pose(of: str) -> tuple[Part, ...]:
    """Return the entries of a position and a quaternion."""
    groups = ((("x", "y", "z"), "m"), (("qw", "qx", "qy", "qz"), ""))
    return tuple(Part(tuple(of + name for name in names), unit, BASE) for names, unit in groups)


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
        parts=tuple(part for k in range(1, SLOTS + 1) for part in _pose(f"object_{k}.")),
        meaning="not for policies: each object's centre and quaternion before the action; object 1 has the label 2; "
        "0 throughout where there is none",
        where="simulation",
    ),
    CONTACT_KEY: Column(
        dtype="bool",
        parts=tuple(
            Part(tuple(f"object_{k}.{part}" for part in TOUCHING)) for k in range(1, SLOTS + 1)
        ),
        meaning="not for policies: whether the left and the right finger's pad touches the object, before the action, "
        "and whether any part of hand or arm, pads included, touched it since the row before",
        where="simulation",
    ),
    INTRINSICS_KEY: Column(
        parts=(Part(("fx", "fy", "cx", "cy"), "px"),),
        meaning="focal lengths and principal point; pixel centres are at integers plus one half",
        where="simulation",
    ),
    CAMERA_POSE_KEY: Column(
        parts=_pose(""),
        meaning="the camera's position and quaternion; OpenCV's axes: x right, y down, z forward",
        where="simulation",
    ),
    EXECUTED_KEY: Column(
        parts=ACTION_PARTS["delta_tool"],
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


def state_column(names: Sequence[str]) -> Column:
    """Return what a state of these entries holds; those after the tool's are the angles of joints."""
    parts = tuple(part for part in STATE_PARTS if set(part.names) <= set(names))
    joints = tuple(name for name in names if name not in STATE_NAMES)
    return Column(
        parts=parts + ((Part(joints, "rad, of slides m"),) if joints else ()),
        meaning="the tool's position, rotation vector from straight down and opening; the controller's target minus "
        "that position, and its target opening",
    )


def action_column(names: Sequence[str]) -> Column:
    """Return what an action of these entries holds."""
    actions = actions_named(names) or "delta_tool"
    joints = (Part(tuple(names[:-1]), "rad, of slides m"), Part(tuple(names[-1:]), OPENING))
    return Column(
        parts=ACTION_PARTS.get(actions, joints),
        meaning="a step, each entry in [-1, 1]; the task's motion_scale stretches the way"
        if actions == "delta_tool"
        else "where the tool or the joints shall be after this step",
    )


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
        STATE_KEY: state_column(states).feature,
        ACTION_KEY: action_column(actions).feature,
        **{key: column.feature for key, column in COLUMNS.items() if has[column.where]},
    }
