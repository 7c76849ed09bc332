"""The truth of a drawn clip beside what was found of it, and when a stage counts as failed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from v2p_data.kinds import Kind
from v2p_data.scene.schema import Symmetry

Stage = Literal["grounding", "segmentation", "mesh", "pose"]
STAGES: tuple[Stage, ...] = ("grounding", "segmentation", "mesh", "pose")
MIN_BOX_IOU = 0.5
"""Of bounding boxes, for the right object to count as found: the usual bar of detection benchmarks (PASCAL VOC)."""
MIN_MASK_IOU = 0.6
"""Mean over frames; a mask below lacks a third of the object or holds half as much again: no shape comes of it."""
MIN_SHAPE_IOU = 0.5
"""Of shapes stretched to one size; a cylinder for a box has 0.79, a ball for a box 0.52, a solid for a bowl about 0."""
MAX_POSITION_M = 0.05
"""About half a household object: farther off, a robot that goes there grasps air."""
MAX_TURN_RAD = np.radians(30.0)
"""Between upright and lying there are 90 degrees, between the sides of a square box 45; 30 separates both."""
MAX_SIZE_RATIO = 1.5
"""A side that is wrong by more no longer fits the gripper or the container that the real thing fits."""
SIZE_SLACK_M = 0.005
"""A side that is this near is right whatever the ratio: half a centimetre is about two pixels of a working picture."""
MIN_SEEN_SHARE = 0.2
"""Frames count where at least this share of the object's largest visible area shows: a rim says nothing."""
MIN_SEEN_PX = 12
"""At working size; what shows fewer pixels is as good as invisible."""
MIN_TRAVEL_SHARE = 0.7
"""The last frame of the reconstruction must lie after so much of the true motion, or it shows no end."""


@dataclass(frozen=True, kw_only=True)
class TrueThing:
    """A named object as it was drawn."""

    phrase: str
    """What the caption calls it."""
    manipulated: bool
    """Whether it is the one that the clip is about."""
    size_m: tuple[float, float, float]
    hollow: bool
    symmetry: Symmetry
    mesh: trimesh.Trimesh = field(repr=False)
    """In its own frame [m]."""
    T_world_objs: Float[np.ndarray, "time 4 4"] = field(repr=False)
    """For every frame of the file."""
    masks: Mapping[int, Bool[np.ndarray, "h w"]] = field(repr=False)
    """What is visible of it, by frame of the file, at working size."""


@dataclass(frozen=True, kw_only=True)
class TrueClip:
    """What a rendered clip really shows."""

    kind: Kind
    things: tuple[TrueThing, ...]
    """The named objects, the manipulated one first."""
    T_world_cam: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class FoundThing:
    """An object as it was reconstructed."""

    phrase: str
    size_m: tuple[float, float, float]
    hollow: bool
    is_round: bool
    """Whether its own z is an axis of revolution."""
    is_ball: bool
    """Whether every axis is one."""
    mesh: trimesh.Trimesh = field(repr=False)
    """In its own frame [m]."""
    T_world_first: Float[np.ndarray, "4 4"]
    T_world_last: Float[np.ndarray, "4 4"]
    first_frame: int = 0
    """Of the file: later only for what a hand brings."""
    last_frame: int
    """Of the file."""
    first_depth_seen: bool = True
    """Whether the reconstruction says that it knows how far away the first pose is; of what is in
    a hand it does not."""
    last_depth_seen: bool = True
    """The same for the last pose; in mid-air it does not."""
    masks: Mapping[int, Bool[np.ndarray, "h w"]] = field(repr=False)
    """By frame of the file, at working size."""


@dataclass(frozen=True, kw_only=True)
class FoundClip:
    """What was understood of a clip."""

    kind: Kind
    things: tuple[FoundThing, ...]
    """The manipulated one first."""
    T_world_cam: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class ThingScore:
    """One named object against its truth. Numbers are None where the object is missing or never seen."""

    phrase: str
    box_iou: float = 0.0
    """Of the bounding boxes at the first frame, or for what is not seen there, in the one that shows most of it."""
    iou_first: float | None = None
    iou_last: float | None = None
    iou_mean: float | None = None
    """Over all frames with both masks in which the object is visible."""
    size_error_m: float | None = None
    """Mean over the sides: a box's sorted by length, a round thing's diameter and height."""
    size_error_share: float | None = None
    """The same, each side as a share of its true length."""
    size_right: bool = False
    """Every side within MAX_SIZE_RATIO or SIZE_SLACK_M."""
    position_first_m: float | None = None
    """Of the centre of the bounding box, in the scene frame; of a pose whose depth the scene
    declares unseen, across the line of sight."""
    position_last_m: float | None = None
    position_first_depth_m: float | None = None
    """Of such a pose, along the line of sight: what it declares not to know."""
    position_last_depth_m: float | None = None
    position_first_cam_m: float | None = None
    """The same in the camera's frame, where a wrong distance to the whole scene shows."""
    position_last_cam_m: float | None = None
    turn_first_rad: float | None = None
    """Angle between the orientations, up to the object's symmetry."""
    turn_last_rad: float | None = None
    travel_share: float | None = None
    """How much of the true motion had happened by the reconstruction's last frame."""
    watertight: bool = False
    hollow_agrees: bool = False
    hollow_matters: bool = False
    volume_iou: float | None = None
    """Of the meshes stretched to one size, with their walls: a wall twice as thick halves it."""
    shape_iou: float | None = None
    """The same for outside and cavity, the worse of the two: what another object meets."""

    def failures(self) -> dict[Stage, str]:
        """Return the stages that failed on this object, each with the number that says so."""
        out: dict[Stage, str] = {}
        if self.box_iou < MIN_BOX_IOU:
            out["grounding"] = f"box IoU {self.box_iou:.2f}"
        if self.iou_mean is None or self.iou_mean < MIN_MASK_IOU:
            out["segmentation"] = f"mask IoU {self.iou_mean or 0:.2f}"
        if not self.watertight:
            out["mesh"] = "not watertight"
        elif self.hollow_matters and not self.hollow_agrees:
            out["mesh"] = "solid where it must be hollow"
        elif self.shape_iou is None or self.shape_iou < MIN_SHAPE_IOU:
            out["mesh"] = f"shape IoU {self.shape_iou or 0:.2f}"
        wrong = self._pose_failure()
        if wrong:
            out["pose"] = wrong
        return out

    def _pose_failure(self) -> str | None:
        for when, metres, turn in (
            ("first", self.position_first_m, self.turn_first_rad),
            ("last", self.position_last_m, self.turn_last_rad),
        ):
            if metres is None or turn is None:
                return f"no {when} pose"
            if metres > MAX_POSITION_M:
                return f"{when} position off by {100 * metres:.1f} cm"
            if turn > MAX_TURN_RAD:
                return f"{when} orientation off by {np.degrees(turn):.0f} deg"
        if self.travel_share is not None and self.travel_share < MIN_TRAVEL_SHARE:
            return f"ends after {self.travel_share:.0%} of the motion"
        return None


@dataclass(frozen=True, kw_only=True)
class ClipScore:
    """A whole clip against its truth."""

    kind_true: str
    kind_found: str | None
    """None where the clip was rejected."""
    slug: str | None
    """Why it was rejected."""
    things: tuple[ThingScore, ...]

    @property
    def failures(self) -> dict[Stage, str]:
        """The stages that failed for at least one named object, with the first reason; all of a rejected clip."""
        if self.slug is not None:
            return dict.fromkeys(STAGES, self.slug)
        out: dict[Stage, str] = {}
        for stage in STAGES:
            for thing in self.things:
                if stage in thing.failures():
                    out[stage] = f"'{thing.phrase}': {thing.failures()[stage]}"
                    break
        return out

    @property
    def usable(self) -> bool:
        """Whether a task made of this scene would be the one in the clip.

        Right kind, every named object found, sizes right, meshes and both end poses not failed. Masks count only
        through what is made of them.
        """
        return self.trouble is None

    @property
    def trouble(self) -> tuple[str, str] | None:
        """The first thing that makes the scene unusable, as stage and reason; None for a usable scene."""
        if self.slug is not None:
            return "rejected", self.slug
        failures = self.failures
        if "grounding" in failures:
            return "grounding", failures["grounding"]
        if self.kind_found != self.kind_true:
            return "kind", f"{self.kind_found} instead of {self.kind_true}"
        for stage in ("mesh", "pose"):
            if stage in failures:
                return stage, failures[stage]
        for thing in self.things:
            if not thing.size_right:
                return "size", f"'{thing.phrase}': off by {thing.size_error_share or 0:.0%}"
        return None
