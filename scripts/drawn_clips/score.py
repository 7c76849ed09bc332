"""How far a reconstruction is from the truth of a rendered clip, and which stage failed.

Both sides are in the scene frame (origin under the manipulated object's first position, +x away, +y left, +z up) and in
metres, so numbers compare directly. A stage fails as in table 4 of the Video2Policy paper: what it gives is broken, or
it is the wrong object. A clip fails where one of its named objects does.

What is compared is what can be seen or used, not how somebody named the axes: the own frame of a reconstructed object
is arbitrary, so boxes compare with their sides in the most favourable order and round things by their axis alone.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import QhullError

from v2p_data.geometry.mesh import mesh_for
from v2p_data.geometry.pose import angle_between, apply, inverse
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.data_types import Reconstruction
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
MIN_CAVITY = 0.1
"""Of the convex hull; with less room inside a thing is not hollow."""
SAME_SIDES = 1.15
"""Two orders of a box's sides are alike where the worse fits no more than by this factor worse."""
_AT_REST_M = 0.002
FRAME_SLACK = 2
"""File frames between two masks that still show the same moment, for clips thinned out while decoding."""
_GRID = 40


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
    """Whether the reconstruction says that it knows how far away the first pose is; of what is in a hand it does not."""
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
    """Of the centre of the bounding box, in the scene frame; of a pose whose depth the scene declares unseen, across the
    line of sight."""
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


def found_of(reconstruction: Reconstruction) -> FoundClip:
    """Return what is compared of a reconstruction; frames become those of the file."""
    file_frame = reconstruction.clip.source_frame
    things = []
    for thing in reconstruction.objects:
        masks = {int(file_frame[f]): mask for f, mask in thing.masks.items()}
        noun = thing.noun
        mesh = thing.mesh
        # What arches is no vessel: a spoon has room under its handle.
        hollow = noun.hollow and (mesh is None or opening(mesh) is not None)
        if mesh is None:
            mesh = mesh_for(noun.form, thing.size_m, hollow=hollow, taper=noun.taper)
        things.append(
            FoundThing(
                phrase=thing.label,
                size_m=thing.size_m,
                hollow=hollow,
                is_round=noun.form == "cylinder",
                is_ball=noun.form == "sphere",
                mesh=mesh,
                T_world_first=thing.T_world_objs[0],
                T_world_last=thing.T_world_objs[-1],
                first_frame=int(file_frame[thing.frames[0]]),
                last_frame=int(file_frame[thing.frames[-1]]),
                first_depth_seen=not thing.observed or thing.observed[0] == "full",
                last_depth_seen=not thing.observed or thing.observed[-1] == "full",
                masks=masks,
            )
        )
    return FoundClip(
        kind=reconstruction.kind,
        things=tuple(things),
        T_world_cam=reconstruction.camera.T_world_cam,
    )


def rejected(true: TrueClip, slug: str) -> ClipScore:
    """Return the score of a clip of which nothing was made."""
    things = tuple(ThingScore(phrase=thing.phrase) for thing in true.things)
    return ClipScore(kind_true=true.kind, kind_found=None, slug=slug, things=things)


def score_clip(true: TrueClip, found: FoundClip) -> ClipScore:
    """Compare a reconstruction with the truth.

    Objects are compared by phrase; where a phrase was understood differently, the manipulated one with the manipulated
    one and the others in their order.
    """
    pairs = zip(true.things, _matched(true, found), strict=True)
    things = tuple(
        ThingScore(phrase=t.phrase) if f is None else _score_thing(t, f, true, found)
        for t, f in pairs
    )
    return ClipScore(kind_true=true.kind, kind_found=found.kind, slug=None, things=things)


def shape_ious(
    true: trimesh.Trimesh,
    found: trimesh.Trimesh,
    *,
    hollow: tuple[bool, bool],
    cavity_matters: bool,
) -> tuple[float, float]:
    """Return volume IoU and shape IoU of two meshes stretched to one bounding box, at the best of 24 turns.

    Args:
        true: a closed mesh.
        found: a closed mesh.
        hollow: whether the true and the found one are vessels; their outsides are compared with the cavity closed.
        cavity_matters: whether the cavities are compared too.
    """
    a, b = _Solid.of(true), _Solid.of(found)
    best = (0.0, 0.0)
    for order, signs in _turns():
        c = b.turned(order, signs)
        shape = _iou(a.outside(hollow[0]), c.outside(hollow[1]))
        if cavity_matters:
            shape = min(shape, _iou(a.cavity, c.cavity))
        best = max(best, (shape, _iou(a.filled, c.filled)))
    return best[1], best[0]


def opening(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3"] | None:
    """Return the signed axis of the mesh's own frame towards which it is open; None for what is not hollow."""
    return _Solid.of(mesh).opening


def turn_between(
    true: TrueThing,
    found: FoundThing,
    R_true: Float[np.ndarray, "3 3"],
    R_found: Float[np.ndarray, "3 3"],
) -> float:
    """Return the angle between two posed objects [rad], up to what cannot be told apart.

    A ball has no orientation; where one was found for an egg, that shows in its shape. Of a round thing only the axis counts, and which way it points only where it is open on
    one side. A box, and anything without symmetry, is compared as a posed box: the found one's axes are renamed so that
    its sides fit the true ones, the six ways of equal sides and turns by 180 degrees included; what is open on one
    side keeps the side. Where a solid of revolution was found for it, that one's axis counts alone.
    """
    if true.symmetry == "sphere" or found.is_ball:
        return 0.0
    open_true = opening(true.mesh) if true.hollow else None
    open_found = opening(found.mesh) if found.hollow else None
    if true.symmetry == "round":
        if open_true is not None and open_found is not None:
            cosine = float((R_true @ open_true) @ (R_found @ open_found))
        else:
            cosine = abs(float(R_true[:, 2] @ R_found[:, _round_axis(true, found)]))
        return float(np.arccos(np.clip(cosine, -1, 1)))
    if found.is_round and open_true is not None and open_found is not None:
        # A mug with its handle is longer than high, the round one found for it is not: sides do not tell the axis.
        cosine = float((R_true @ open_true) @ (R_found @ open_found))
        return float(np.arccos(np.clip(cosine, -1, 1)))
    angles: list[float] = []
    for order, signs in _fitting_turns(true.size_m, found.size_m):
        rename = np.zeros((3, 3))  # true axis i is the found axis order[i], with its sign
        rename[list(order), range(3)] = signs
        if (
            open_true is not None
            and open_found is not None
            and float(open_found @ rename @ open_true) < 0.5
        ):
            continue
        if found.is_round:  # nobody says how it is turned about its own axis
            i = order.index(2)
            cosine = float(R_true[:, i] @ (R_found @ rename)[:, i])
            angles.append(float(np.arccos(np.clip(cosine, -1, 1))))
        else:
            angles.append(angle_between(R_true, R_found @ rename))
    return min(angles) if angles else float(np.pi)


def size_sides(
    true: TrueThing, found: FoundThing
) -> tuple[Float[np.ndarray, "side"], Float[np.ndarray, "side"]]:
    """Return the true and the found lengths that belong together [m]: diameter and height, or sorted sides."""
    if true.symmetry == "round":
        sides = np.array(true.size_m)
        k = _round_axis(true, found)
        across = float(np.mean(np.delete(np.array(found.size_m), k)))
        return np.array([sides[:2].mean(), sides[2]]), np.array([across, found.size_m[k]])
    return np.sort(true.size_m), np.sort(found.size_m)


def _matched(true: TrueClip, found: FoundClip) -> list[FoundThing | None]:
    left = list(found.things)
    pairs: dict[str, FoundThing] = {}
    for thing in true.things:
        same = next((f for f in left if f.phrase == thing.phrase), None)
        if same is not None:
            pairs[thing.phrase] = same
            left = [f for f in left if f is not same]
    for thing in true.things:
        # what is left has another name than in the truth: the manipulated object comes first, the others follow
        spare = [f for f in left if (f is found.things[0]) == thing.manipulated]
        if thing.phrase not in pairs and spare:
            pairs[thing.phrase] = spare[0]
            left = [f for f in left if f is not spare[0]]
    return [pairs.get(thing.phrase) for thing in true.things]


def _score_thing(
    true: TrueThing, found: FoundThing, clip: TrueClip, understood: FoundClip
) -> ThingScore:
    last = min(found.last_frame, len(true.T_world_objs) - 1)
    begins = 0 if _seen_at_first(true) else min(found.first_frame, last)
    T_first, T_last = true.T_world_objs[begins], true.T_world_objs[last]
    sides, ours = size_sides(true, found)
    ratio = np.maximum(sides / ours, ours / sides)
    hollow_matters = true.hollow and KINDS[clip.kind].needs_hollow
    volume_iou, shape_iou = shape_ious(
        true.mesh,
        found.mesh,
        hollow=(true.hollow, found.hollow),
        cavity_matters=true.hollow and (found.hollow or hollow_matters),
    )
    centre_true, centre_found = (m.bounds.mean(axis=0)[None] for m in (true.mesh, found.mesh))
    ends = []
    for T, T_found, depth_seen in (
        (T_first, found.T_world_first, found.first_depth_seen),
        (T_last, found.T_world_last, found.last_depth_seen),
    ):
        here, there = apply(T, centre_true), apply(T_found, centre_found)
        away, along = float(np.linalg.norm(here - there)), None
        if not depth_seen:
            away, along = _by_sight(here[0], there[0], clip.T_world_cam[:3, 3])
        in_camera = apply(inverse(clip.T_world_cam), here)
        in_camera_found = apply(inverse(understood.T_world_cam), there)
        ends.append(
            (
                away,
                along,
                float(np.linalg.norm(in_camera - in_camera_found)),
                turn_between(true, found, T[:3, :3], T_found[:3, :3]),
            )
        )
    ious = _mask_ious(true, found)
    return ThingScore(
        phrase=true.phrase,
        box_iou=_grounding_iou(true, found),
        iou_first=ious[0] if ious else None,
        iou_last=ious[-1] if ious else None,
        iou_mean=float(np.mean(ious)) if ious else None,
        size_error_m=float(np.abs(sides - ours).mean()),
        size_error_share=float((np.abs(sides - ours) / sides).mean()),
        size_right=bool(
            ((ratio <= MAX_SIZE_RATIO) | (np.abs(sides - ours) <= SIZE_SLACK_M)).all()
        ),
        position_first_m=ends[0][0],
        position_last_m=ends[1][0],
        position_first_depth_m=ends[0][1],
        position_last_depth_m=ends[1][1],
        position_first_cam_m=ends[0][2],
        position_last_cam_m=ends[1][2],
        turn_first_rad=ends[0][3],
        turn_last_rad=ends[1][3],
        travel_share=_travel_share(true, last, clip.things[0]),
        watertight=bool(found.mesh.is_watertight),
        hollow_agrees=true.hollow == found.hollow,
        hollow_matters=hollow_matters,
        volume_iou=volume_iou,
        shape_iou=shape_iou,
    )


def _by_sight(
    true: Float[np.ndarray, "3"], found: Float[np.ndarray, "3"], eye: Float[np.ndarray, "3"]
) -> tuple[float, float]:
    """Return how far two points are apart across and along the line of sight to the true one."""
    sight = (true - eye) / np.linalg.norm(true - eye)
    along = float((found - true) @ sight)
    return float(np.linalg.norm(found - true - along * sight)), abs(along)


def _travel_share(true: TrueThing, last: int, manipulated: TrueThing) -> float | None:
    """Return how much of its way it had gone by that frame; None for what stays. A way may lead out and back.

    A tool's way ends where what it moves comes to rest: then it is taken away, out of the picture.
    """
    places = true.T_world_objs[:, :3, 3]
    if not true.manipulated:
        goal = manipulated.T_world_objs[-1, :3, 3]
        ahead_m = np.linalg.norm(manipulated.T_world_objs[:, :3, 3] - goal, axis=1)
        under_way = np.flatnonzero(ahead_m > _AT_REST_M)
        places = places[: under_way[-1] + 2] if len(under_way) else places
    if np.linalg.norm(places - places[0], axis=1).max() < 0.02:
        return None
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum()])
    return float(way[min(last, len(way) - 1)] / way[-1])


def _seen_frames(true: TrueThing) -> list[int]:
    areas = {frame: int(mask.sum()) for frame, mask in true.masks.items()}
    least = max(MIN_SEEN_PX, MIN_SEEN_SHARE * max(areas.values(), default=0))
    return sorted(frame for frame, area in areas.items() if area >= least)


def _seen_at_first(true: TrueThing) -> bool:
    """Return whether it is in the picture when the clip begins; a tool comes later, or is hidden by what it lies under."""
    frames = _seen_frames(true)
    return not frames or frames[0] == min(true.masks)


def _mask_ious(true: TrueThing, found: FoundThing) -> list[float]:
    out = []
    for frame in _seen_frames(true):
        near = _nearest(found, frame)
        if near is not None and abs(near - frame) <= FRAME_SLACK:
            out.append(_iou(true.masks[frame], found.masks[near]))
    return out


def shown_at(true: TrueThing) -> int | None:
    """Return the frame of the file in which a person would point at it: the first, or the one that shows most of what comes later.

    None where it is never seen. Of equals the latest: what is uncovered lies free at the end.
    """
    if not _seen_frames(true):
        return None
    if _seen_at_first(true):
        return min(true.masks)
    return max(true.masks, key=lambda frame: (int(true.masks[frame].sum()), frame))


def _grounding_iou(true: TrueThing, found: FoundThing) -> float:
    frame = shown_at(true)
    if frame is None or not found.masks:
        return 0.0
    near = _nearest(found, frame)
    assert near is not None
    return _box_iou(true.masks[frame], found.masks[near])


def _nearest(found: FoundThing, frame: int) -> int | None:
    return min(found.masks, key=lambda other: abs(other - frame), default=None)


def _iou(a: Bool[np.ndarray, "*shape"], b: Bool[np.ndarray, "*shape"]) -> float:
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 0.0


def _box_iou(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    if not a.any() or not b.any():
        return 0.0
    (a0, a1), (b0, b1) = ((p.min(0), p.max(0) + 1) for p in (np.argwhere(a), np.argwhere(b)))
    both = float(np.prod(np.clip(np.minimum(a1, b1) - np.maximum(a0, b0), 0, None)))
    return both / (float(np.prod(a1 - a0) + np.prod(b1 - b0)) - both)


_Turn = tuple[tuple[int, ...], tuple[int, ...]]


def _turns() -> list[_Turn]:
    """Return the 24 turns that take a cube to itself, as an order of axes and their signs."""
    out = []
    for order in itertools.permutations(range(3)):
        even = order in {(0, 1, 2), (1, 2, 0), (2, 0, 1)}
        for signs in itertools.product((1, -1), repeat=3):
            if (np.prod(signs) > 0) == even:
                out.append((order, signs))
    return out


def _fitting_turns(
    true_m: tuple[float, float, float], found_m: tuple[float, float, float]
) -> list[_Turn]:
    """Return the turns under which the found sides fit the true ones about as well as they can."""
    worst = {
        order: float(np.abs(np.log(np.array(found_m)[list(order)] / np.array(true_m))).max())
        for order in itertools.permutations(range(3))
    }
    bar = min(worst.values()) + np.log(SAME_SIDES)
    return [(order, signs) for order, signs in _turns() if worst[order] <= bar]


def _round_axis(true: TrueThing, found: FoundThing) -> int:
    """Return which of the found object's axes stands for a round thing's axis of revolution."""
    if found.is_round:
        return 2
    across, along = np.mean(true.size_m[:2]), true.size_m[2]
    size = np.array(found.size_m)
    costs = [
        np.abs(np.log(np.array([np.delete(size, k).mean() / across, size[k] / along]))).sum()
        for k in range(3)
    ]
    return int(np.argmin(costs))


@dataclass(frozen=True)
class _Solid:
    """A mesh as voxels of its bounding box."""

    filled: Bool[np.ndarray, "n n n"]
    hull: Bool[np.ndarray, "n n n"]
    cavity: Bool[np.ndarray, "n n n"]
    """Room inside the hull that is reached from the open side without meeting the mesh."""
    opening: Float[np.ndarray, "3"] | None

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> "_Solid":
        low, high = mesh.bounds
        filled = _voxels(mesh, low, high)
        try:
            hull = _voxels(mesh.convex_hull, low, high)
        except QhullError:  # a broken mesh without volume
            hull = filled
        best, towards = np.zeros_like(hull), None
        # Walls thinner than a cell are not seen from the side: up comes first, and others must be clearly roomier.
        for axis, sign in itertools.product((2, 0, 1), (1, -1)):
            from_there = np.flip(filled, axis) if sign > 0 else filled
            met = np.maximum.accumulate(from_there, axis=axis)
            room = hull & ~(np.flip(met, axis) if sign > 0 else met)
            if room.sum() > max(1.05 * best.sum(), MIN_CAVITY * hull.sum()):
                best, towards = room, sign * np.eye(3)[axis]
        return cls(filled, hull, best, towards)

    def outside(self, hollow: bool) -> Bool[np.ndarray, "n n n"]:
        """Return the solid; of a vessel with its cavity closed."""
        return self.filled | self.cavity if hollow else self.filled

    def turned(self, order: tuple[int, ...], signs: tuple[int, ...]) -> "_Solid":
        def turn(voxels: Bool[np.ndarray, "n n n"]) -> Bool[np.ndarray, "n n n"]:
            flipped = [i for i, sign in enumerate(signs) if sign < 0]
            return np.flip(voxels.transpose(order), flipped)

        return _Solid(turn(self.filled), turn(self.hull), turn(self.cavity), self.opening)


def _voxels(
    mesh: trimesh.Trimesh, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "n n n"]:
    """Return which cells of the box have their centre inside the mesh, by counting crossings along columns.

    A cell is inside where the surfaces above it, counted with the direction they face, do not cancel: parts that
    overlap and faces that are turned inside out as a whole do no harm.
    """
    n = _GRID
    # Centres are moved a little off: a column through an edge would cross both of its triangles.
    x, y = (np.arange(n) + 0.5 + 1e-3) / n, (np.arange(n) + 0.5 + 3.1e-3) / n
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = ((mesh.vertices - low) / np.maximum(high - low, 1e-9))[mesh.faces]
    crossings = np.zeros((n * n, n + 1), np.int32)
    for a, b, c in (corners[k : k + 256].swapaxes(0, 1) for k in range(0, len(corners), 256)):
        ab, ac = (b - a)[:, None, :2], (c - a)[:, None, :2]
        area = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
        to = columns[None] - a[:, None, :2]
        seen = np.where(np.abs(area) > 1e-12, area, np.nan)  # upright faces are no crossing
        s = (to[..., 0] * ac[..., 1] - to[..., 1] * ac[..., 0]) / seen
        t = (ab[..., 0] * to[..., 1] - ab[..., 1] * to[..., 0]) / seen
        face, column = np.nonzero((s >= 0) & (t >= 0) & (s + t <= 1))
        s, t = s[face, column], t[face, column]
        z = a[face, 2] + s * (b - a)[face, 2] + t * (c - a)[face, 2]
        below = np.clip(np.ceil(z * n - 0.5), 0, n).astype(int)
        facing = np.sign(area[face, 0]).astype(np.int32)
        np.add.at(crossings, (column, np.zeros_like(column)), facing)
        np.add.at(crossings, (column, below), -facing)
    return (crossings.cumsum(axis=1)[:, :n] != 0).reshape(n, n, n)
