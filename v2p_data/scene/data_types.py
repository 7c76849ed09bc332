"""What the rooms of this package hand to each other: objects in the picture, then a camera and poses.

`frames` and `scale` lie below this file, `grounding`, `shapes` and `fitting` above it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from v2p_data.geometry.camera import Camera
from v2p_data.kinds import Kind
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.camera_height import table_width_m
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.schema import Observed, Role, Shape, Symmetry
from v2p_data.video.clip import Clip


@dataclass(frozen=True, kw_only=True)
class ObjectTrack:
    """One object of the caption in the picture, before geometry."""

    phrase: str
    role: Role
    noun: Noun
    masks: Bool[np.ndarray, "time h w"] = field(repr=False)
    """Its visible pixels in every working frame."""
    quality: Float[np.ndarray, "time"] = field(repr=False)
    """How far to believe each mask, 0 to 1."""
    moves: bool
    at: int
    """Working frame that shows where it stands at first; the last one for what is uncovered."""
    known_m: tuple[float, float, float] | None
    """Its size where the user gave it."""
    sure: float
    """That these are the object's pixels, 0 to 1."""
    why: str
    """Why not surer."""
    agreement: float = 1.0
    """How well the track from the start agrees with the one from the end, 0 to 1."""
    hinted: bool = False
    hidden_in_container: bool = False
    """Whether it was last seen going into what hides it at the end; the masks from then on repeat the last one seen."""
    in_hand: bool = False
    """Whether a hand brings it and takes it away: it never rests on the table."""
    brought: bool = False
    """Whether a hand brings it and leaves it: only its end is seen at rest."""

    @property
    def first(self) -> Bool[np.ndarray, "h w"]:
        return self.masks[self.at]

    @property
    def last(self) -> Bool[np.ndarray, "h w"]:
        return self.masks[-1]


@dataclass(frozen=True, kw_only=True)
class GroundedObjects:
    """Everything seen in a clip."""

    objects: tuple[ObjectTrack, ...]
    """The manipulated one first."""
    working: WorkingClip
    """As given, now knowing the hand's colours."""
    table: Table
    segmentation: Segmentation
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class CameraGuess:
    """What is known of the camera before the outlines are looked at."""

    pitch_rad: float
    pitch_sd_rad: float
    fov_rad: float
    """Horizontal field of view."""
    height_m: float | None = None
    """Over the table, where something measured it."""
    height_sd: float = 0.12
    """Standard deviation of its logarithm."""
    table_width_m: float | None = None
    """How much of the table the picture shows from left to right at its middle, where something saw it."""
    table_width_sd: float = 0.2
    """Standard deviation of its logarithm."""

    def heights(self, pitch_rad: float) -> list[tuple[float, float]]:
        """Return what this says of the height [m], with the logarithm's standard deviation, at a fitted pitch."""
        out = []
        if self.height_m is not None:
            out.append((self.height_m, self.height_sd))
        if self.table_width_m is not None:
            focal_widths = 0.5 / np.tan(self.fov_rad / 2)
            shown = table_width_m(pitch_rad, focal_widths, 1.0)
            out.append((self.table_width_m / shown, self.table_width_sd))
        return out


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A shape whose silhouette matches a mask, in camera heights."""

    size: tuple[float, float, float]
    T_world_obj: Float[np.ndarray, "4 4"]
    iou: float
    visible: float
    """Share of the silhouette that the mask confirms; the rest is hidden or wrong."""
    cost: float
    """1 - IoU plus what the proportions cost: comparable between fits of one mask."""


@dataclass(frozen=True, kw_only=True)
class PlacedObject:
    """One object in camera heights."""

    first: Fit
    last: Fit
    last_i: int
    """Working frame of the last pose."""
    last_mask: Bool[np.ndarray, "h w"]
    hidden: Bool[np.ndarray, "h w"]
    """Where something may stand in front of it at first."""
    last_hidden: Bool[np.ndarray, "h w"]
    """The same at the last pose."""
    frames: tuple[int, ...]
    """Working frames with a pose, the first and the last among them."""
    T_world_objs: Float[np.ndarray, "pose 4 4"]
    confidences: tuple[float, ...]
    observed: tuple[Observed, ...]
    rival: float | None
    """By how much the next best way of lying covers the outlines worse; None where there is no other."""
    hidden_in_hand: bool = False
    """Whether a hand hides it from the camera: then its poses go with the hand."""
    unseen: bool = False
    """Whether nothing shows where it ends: then it is put in the middle of its container."""
    lifted_off: bool = False
    """Whether it lies on something at first: then its last outline, on the table, shows its shape."""
    T_world_seen: Float[np.ndarray, "4 4"] | None = None
    """Where the object tracks's first outline shows it, if that is not its first pose."""


@dataclass(frozen=True, kw_only=True)
class RestingObject:
    """An object that a hand moves, where it rests on the table, and the camera that sees both."""

    masks: Bool[np.ndarray, "time h w"]
    """Its masks in every working frame."""
    rests: Sequence[tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "3"]]]
    """Its outline and its position [camera heights] where it rests: at first, and at last where
    the table carries it there."""
    camera: Camera
    """One camera height above the table."""
    pitch_rad: float
    """How far the camera looks below the horizon."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Camera and objects, in the order of the object tracks."""

    camera: Camera
    """At working size, one camera height above the table."""
    pitch_rad: float
    objects: tuple[PlacedObject, ...]
    height_m: float
    """Metres per camera height."""
    scale_spread: float
    """Standard deviation of the logarithm of `height_m`."""
    upright_cost: float
    """What standing as at first would have cost the manipulated object at the end."""


@dataclass(frozen=True, kw_only=True)
class Cue:
    """One reason to trust a scene or not."""

    stage: str
    what: str
    value: float
    """0 to 1."""
    advice: str = ""
    """What a person can do that raises it; empty where nothing does."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One object as far as it was understood, in the scene frame and in metres."""

    name: str
    label: str
    role: Role
    noun: Noun
    size_m: tuple[float, float, float]
    rgba: tuple[float, float, float, float]
    frames: tuple[int, ...]
    """Clip frames with a pose."""
    T_world_objs: Float[np.ndarray, "pose 4 4"]
    confidences: tuple[float, ...]
    masks: dict[int, Bool[np.ndarray, "h w"]] = field(repr=False)
    """Its visible pixels by clip frame, at working size."""
    source: dict[str, str]
    """Where size, mass and friction come from, in words."""
    mass_kg: float
    shape: Shape
    """A primitive where that says all, else `mesh`."""
    mesh: trimesh.Trimesh = field(repr=False)
    """In its own frame, centred on its bounding box [m]."""
    parts: tuple[trimesh.Trimesh, ...] = field(repr=False)
    """Convex solids that collide for `mesh`, in the same frame."""
    symmetry: Symmetry = "none"
    observed: tuple[Observed, ...] = ()
    """Per pose whether one view shows its depth; empty means that all are fully observed."""


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """A scene before it is written; `clip` is kept for the overlay."""

    clip: Clip = field(repr=False)
    kind: Kind
    objects: tuple[Estimate, ...]
    """The manipulated one first."""
    camera: Camera
    """For the clip's frames, in the scene frame."""
    confidence: float
    warnings: tuple[str, ...]
    stages: dict[str, tuple[float, str]]
    """Per stage how sure it is, 0 to 1, and why it is not surer."""
    cues: tuple[Cue, ...] = ()
    """All that the confidence is the product of."""
    scale_spread: float = 0.0
    """Standard deviation of the logarithm of all lengths together: one view does not show scale."""
    least_found: float = 1.0
    """How sure the least sure finding is, 0 to 1."""
    contradiction: str | None = None
    """How the motion contradicts the caption, where nothing is rejected for it."""
