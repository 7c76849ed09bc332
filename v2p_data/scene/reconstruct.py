"""The order of steps from a clip to a scene.

working clip -> camera still? -> what moved, what stayed, frame by frame -> camera, shapes and poses in camera heights -> metres
-> does the motion fit the caption? -> confidence
"""

import keyword
import logging
import re
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.kinds import Kind
from v2p_data.scene.backends.config import (
    DepthConfig,
    GroundConfig,
    MeshConfig,
    PoseConfig,
    SegmentConfig,
)
from v2p_data.scene.confidence import (
    Cue,
    by_stage,
    check_confidence,
    check_motion,
    confidence_of,
    cues_of,
    held_at_first,
)
from v2p_data.scene.data_types import (
    CameraGuess,
    GroundedObjects,
    ObjectTrack,
    PlacedObject,
    Placement,
)
from v2p_data.scene.fitting.by_model import camera_from_depth, poses_by_worker
from v2p_data.scene.fitting.placement import UNSEEN_IOU, place, with_noun_variants
from v2p_data.scene.fitting.refine_pose import refine_pose, warped_trajectory
from v2p_data.scene.fitting.ring_mask import without_hole
from v2p_data.scene.fitting.silhouette import three
from v2p_data.scene.frames.segmentation import Segmentation, passers_by, segment_clip
from v2p_data.scene.frames.stabilise import stabilised
from v2p_data.scene.frames.working_clip import WorkingClip, camera_shift_px, working_clip_of
from v2p_data.scene.grounding.by_model import DETECTORS, detected, segmented
from v2p_data.scene.grounding.ground_objects import ground_objects, without_asides
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.schema import Observed, Role, Symmetry
from v2p_data.scene.shapes.by_worker import mesh_by_worker
from v2p_data.scene.shapes.shape import ShapeChoice, ShapeConfig, best_shape
from v2p_data.scene.shapes.silhouette_view import SilhouetteView
from v2p_data.video.captions import parse_caption
from v2p_data.video.clip import Clip

log = logging.getLogger(__name__)

_CLOSE_RIVAL = 0.02
"""In units of IoU: below, which face of a box is down was as good as drawn by lot."""
_OVER = np.diag([1.0, -1.0, -1.0, 1.0])
"""Upside down, about x."""
_USUAL_PITCH_RAD = 0.61
"""35 degrees, for a camera on a stand at a table."""
_USUAL_FOV_RAD = 1.01
"""58 degrees, for web cameras and phones filming wide."""
_FOCAL_SD = 0.15
"""Of the logarithm of a guessed focal length, on drawn clips."""
_HELD_SURE = 0.3
"""How far to believe a first pose on the table of what a hand seems to hold in the air."""
_WIDTH_DOUBT = 1.4
"""The network is surer of the table's width than it may be by this factor, on clips that it was not trained on."""
_LEAST_QUALITY = 0.4
"""Masks that are believed less are left out of an object's track."""


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How a scene is rebuilt, and how sure we must be."""

    min_confidence: float = 0.55
    """Scenes below are rejected."""
    min_found: float = 0.5
    """Objects that are found less surely are rejected."""
    max_camera_shift_px: float = 3.0
    """Of a picture 320 px wide. Everything here takes the camera to stand still."""
    check_motion: bool = True
    """Reject what does not move as its caption says."""
    camera_height_m: float | None = None
    """Of the camera above the table, where you measured it: with pitch and field of view it gives all sizes, which are guesses otherwise."""
    pitch_rad: float | None = None
    """How far the camera looks below the horizon, where you know it."""
    pitch_spread_rad: float = 0.14
    """How far silhouettes may pull the pitch from the expected one."""
    fov_rad: float | None = None
    """Horizontal field of view of the camera, where you know it."""
    camera_spread: float = 0.02
    """How far off what you give of the camera may be: standard deviation of the pitch in radians, and of the height's logarithm. 0.02
    with a tape and a level; 'v2p scene camera' says how sure it is."""
    max_poses: int = 150
    """Poses kept per object, the first and last among them."""
    ground: GroundConfig = field(default_factory=GroundConfig)
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < 1:
            raise ValueError(f"min_confidence must lie in 0..1, got {self.min_confidence}")
        if not 0 <= self.min_found < 1:
            raise ValueError(f"min_found must lie in 0..1, got {self.min_found}")
        for name, low, high in (
            ("camera_height_m", 0.05, 5.0), ("pitch_rad", 0.1, 1.5), ("fov_rad", 0.3, 2.2),
            ("camera_spread", 0.0, 1.0),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not low < value < high:
                raise ValueError(f"{name} must lie in {low}..{high}, got {value}")
        if self.max_poses < 2:
            raise ValueError(f"max_poses must be at least 2, got {self.max_poses}")

    def without_gate(self) -> "SceneConfig":
        """Return settings that turn nothing away for being unsure: for measuring, not for use."""
        return replace(self, min_confidence=0.0, min_found=0.0, check_motion=False)


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
    mesh: trimesh.Trimesh | None = field(default=None, repr=False)
    """Best mesh, own frame, centred on its bounding box [m]; None means the noun's primitive of this size."""
    parts: tuple[trimesh.Trimesh, ...] = field(default=(), repr=False)
    """Convex solids that collide for `mesh`, in the same frame; empty where only the hull is known."""
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


def reconstruct(clip: Clip, cfg: SceneConfig, rng: np.random.Generator) -> Reconstruction:
    """Return the scene that the clip shows.

    Raises:
        ItemRejectedError: `camera_moves`, `nothing_moves`, `no_hand`, `not_there_at_first`, `object_not_found`, `reference_not_found`,
            `motion_contradicts_caption` or `low_confidence`, with the number that decided.
    """
    meaning = parse_caption(clip.caption, clip.objects)
    working = working_clip_of(clip)
    _check_change(working)
    steady = stabilised(clip, working)
    if steady is not clip:
        clip, working = steady, working_clip_of(steady)
    segmentation = segment_clip(clip, working) if cfg.ground.backend == "network" else None
    _check_still(working, segmentation, cfg)
    boxes = None
    if cfg.ground.backend in DETECTORS:
        boxes = detected(clip, working, meaning.phrases, cfg.ground)
    grounded = ground_objects(clip, working, meaning, segmentation, cfg.min_found, boxes)
    if cfg.segment.backend != "flow":
        grounded = replace(
            grounded, objects=segmented(clip, grounded.working, grounded.objects, cfg.segment)
        )
    guess = _camera_guess(grounded, cfg)
    grounded = replace(
        grounded,
        objects=with_noun_variants(grounded.working, grounded.objects, guess, meaning.kind),
    )
    if cfg.depth.backend != "none":
        guess = camera_from_depth(clip, grounded.working, grounded.objects, guess, cfg.depth, rng)
    placement = place(
        grounded.working,
        grounded.objects,
        meaning.kind,
        guess,
        cfg.max_poses,
        grounded.segmentation,
    )
    placement, shaped = _shaped(grounded, placement)
    objects = _estimates(clip, grounded, placement, shaped, meaning.kind, cfg)
    contradiction = None
    try:
        poses = [thing.T_world_objs for thing in objects]
        check_motion(meaning.kind, grounded, placement, poses, objects[0].size_m)
    except ItemRejectedError as error:
        if cfg.check_motion:
            raise
        contradiction = error.detail
    cues = cues_of(grounded, placement, meaning.kind)
    if confidence_of(cues) < cfg.min_confidence:
        kept, warnings = without_asides(grounded, meaning, clip)
        objects = [objects[k] for k in kept]
        placement = replace(placement, objects=tuple(placement.objects[k] for k in kept))
        grounded = replace(
            grounded,
            objects=tuple(grounded.objects[k] for k in kept),
            warnings=(*grounded.warnings, *warnings),
        )
        cues = cues_of(grounded, placement, meaning.kind)
    origin = _origin(placement)
    return Reconstruction(
        clip=clip,
        kind=meaning.kind,
        objects=tuple(objects),
        camera=_clip_camera(clip, placement, origin),
        confidence=check_confidence(cues, cfg.min_confidence),
        stages=by_stage(cues),
        cues=cues,
        scale_spread=placement.scale_spread,
        least_found=min(s.sure for s in grounded.objects),
        contradiction=contradiction,
        warnings=(
            *grounded.warnings,
            *_remarks(meaning.kind, grounded, placement, len(clip.frames)),
        ),
    )


def slug_for(phrase: str, taken: set[str]) -> str:
    """Return a Python identifier for an object phrase that is not taken yet."""
    base = re.sub(r"[^a-z0-9]+", "_", phrase.lower()).strip("_") or "object"
    if base[0].isdigit() or keyword.iskeyword(base):
        base = f"object_{base}"
    name, number = base, 2
    while name in taken:
        name, number = f"{base}_{number}", number + 1
    return name


def _check_still(
    working: WorkingClip, segmentation: Segmentation | None, cfg: SceneConfig
) -> None:
    shift = camera_shift_px(working, None if segmentation is None else passers_by(segmentation))
    if shift > cfg.max_camera_shift_px:
        raise ItemRejectedError(
            "camera_moves",
            f"the camera moves by {shift:.1f} px of 320, at most {cfg.max_camera_shift_px:.0f} px can be understood, and its "
            "frames could not be aligned: film from a stand, or hold it stiller",
            round(shift, 2),
        )


def _check_change(working: WorkingClip) -> None:
    change = np.zeros(working.shape, np.float32)
    for lab in working.lab[1:]:
        np.maximum(change, np.linalg.norm(lab - working.lab[0], axis=-1), out=change)
    share = float((change > 15).mean())
    if share < 0.003:
        raise ItemRejectedError(
            "nothing_moves",
            f"only {share:.2%} of the picture changes; the clip shows no manipulation",
            round(share, 5),
        )


def _camera_guess(grounded: GroundedObjects, cfg: SceneConfig) -> CameraGuess:
    """Return what is known of the camera: the user's word goes before the network's, that before what is usual."""
    seen = None if grounded.segmentation is None else grounded.segmentation.camera
    guess = CameraGuess(
        pitch_rad=_USUAL_PITCH_RAD, pitch_sd_rad=cfg.pitch_spread_rad, fov_rad=_USUAL_FOV_RAD
    )
    if seen is not None:
        guess = CameraGuess(
            pitch_rad=seen.pitch_rad,
            pitch_sd_rad=float(np.clip(seen.pitch_sd_rad, 0.05, cfg.pitch_spread_rad)),
            fov_rad=float(2 * np.arctan(0.5 / seen.focal_widths)),
            table_width_m=seen.table_width_m,
            table_width_sd=_WIDTH_DOUBT * seen.table_width_sd,
        )
    return with_measured_camera(guess, cfg)


def with_measured_camera(guess: CameraGuess, cfg: SceneConfig) -> CameraGuess:
    """Return a guess of the camera with what the user measured in place of what was guessed.

    How large things are that one sees follows from the height together with pitch and focal length: where these are guessed,
    a measured height says no more than they do.
    """
    spread = cfg.camera_spread
    if cfg.pitch_rad is not None:
        guess = replace(guess, pitch_rad=cfg.pitch_rad, pitch_sd_rad=cfg.camera_spread)
    else:
        spread = float(np.hypot(spread, guess.pitch_sd_rad / np.tan(guess.pitch_rad)))
    if cfg.fov_rad is not None:
        guess = replace(guess, fov_rad=cfg.fov_rad)
    else:
        spread = float(np.hypot(spread, _FOCAL_SD))
    if cfg.camera_height_m is not None:
        guess = replace(guess, height_m=cfg.camera_height_m, height_sd=spread)
    return guess


def _origin(placement: Placement) -> Float[np.ndarray, "3"]:
    """Return the table point under the manipulated object's first position [camera heights]."""
    return placement.objects[0].first.T_world_obj[:3, 3] * np.array([1, 1, 0])


@dataclass(frozen=True, kw_only=True)
class _Shaped:
    """An object's mesh, and its poses in the scene frame [m]."""

    shape: ShapeChoice
    T_world_objs: Float[np.ndarray, "pose 4 4"]


def _shaped(grounded: GroundedObjects, placement: Placement) -> tuple[Placement, list[_Shaped]]:
    """Return the objects' meshes and poses, and the placement knowing how well the meshes cover the last outlines."""
    origin, height = _origin(placement), placement.height_m
    work = _metric(placement.camera, origin, height)
    objects, out = list(placement.objects), []
    for k, (s, placed) in enumerate(zip(grounded.objects, placement.objects, strict=True)):
        length, width, tall = (float(v) * height for v in placed.first.size)
        seen = placed.T_world_objs[0] if placed.T_world_seen is None else placed.T_world_seen
        at_first, *rest = (
            transform(T[:3, :3], (T[:3, 3] - origin) * height)
            for T in (seen, *placed.T_world_objs)
        )
        poses = np.stack(rest)
        first = SilhouetteView(mask=s.first, T_world_obj=at_first, hidden=placed.hidden)
        last = SilhouetteView(
            mask=placed.last_mask, T_world_obj=poses[-1], hidden=placed.last_hidden
        )
        shape = best_shape(
            [last if placed.lifted_off else first],
            work,
            (length, width, tall),
            s.noun,
            ShapeConfig(handles=s.known_m is None),
        )
        poses = poses @ shape.T_obj_shape
        shows_it = (
            s.moves
            and not s.hidden_in_container
            and placed.last.iou > UNSEEN_IOU
            and not s.in_hand
        )
        if shows_it and shape.kind != "primitive" and not placed.lifted_off:
            in_air = placed.observed[-1] == "no_depth"
            view = replace(last, T_world_obj=poses[-1])
            found = refine_pose(view, poses[0], shape.mesh, work, in_air=in_air)
            if found is not None:
                poses = warped_trajectory(poses, found.T_world_mesh)
                covered = replace(placed.last, iou=max(placed.last.iou, found.iou))
                objects[k] = replace(placed, last=covered)
        out.append(_Shaped(shape=shape, T_world_objs=poses))
    return replace(placement, objects=tuple(objects)), out


def _estimates(
    clip: Clip,
    grounded: GroundedObjects,
    placement: Placement,
    shaped: list[_Shaped],
    kind: Kind,
    cfg: SceneConfig,
) -> list[Estimate]:
    working, height = grounded.working, placement.height_m
    work = _metric(placement.camera, _origin(placement), height)
    taken: set[str] = set()
    out = []
    for s, placed, made in zip(grounded.objects, placement.objects, shaped, strict=True):
        name = slug_for(s.phrase, taken)
        taken.add(name)
        shape, poses = made.shape, made.T_world_objs
        frames, sure, observed = placed.frames, placed.confidences, placed.observed
        if not out and held_at_first(grounded, placement):
            sure = (min(sure[0], _HELD_SURE), *sure[1:])
        size, mesh, parts, how = shape.size_m, shape.mesh, shape.parts, shape.reason
        plain = shape.kind == "primitive" and not s.noun.bore and not cfg.mesh.worker
        if s.known_m:  # the user's word on the size outranks the outline's
            size = three(height * np.array(placed.first.size))
            mesh, parts = _stretched(size, mesh, *parts)
        if s.noun.hollow and s.role in ("manipulated", "cover") and kind in ("cover", "uncover"):
            # A cover's own frame has its mouth below, as it lies: so the simulator builds it.
            plain = False
            poses = poses @ _OVER
            mesh, parts = _turned(mesh), tuple(_turned(part) for part in parts)
        if cfg.mesh.worker:
            mesh, repair = mesh_by_worker(clip, working, s, size, cfg.mesh)
            parts, how = (), "made by the mesh worker from one picture, scaled to the outline"
            if repair != "none":
                how += f"; its mesh was not closed and was mended ({repair})"
            size = three(mesh.extents)
        if cfg.pose.worker and s.moves:
            camera = _clip_camera(clip, placement, _origin(placement))
            poses, marks = poses_by_worker(clip, working, s.masks, mesh, camera, cfg.pose)
            frames, sure = tuple(range(len(poses))), tuple(float(c) for c in marks)
            observed = ("full",) * len(poses)
        image = working.rgb[s.at] if s.moves else working.late if s.at else working.early
        masks = _mask_track(working, s, placed)
        if s.noun.bore:
            masks = _with_hole(masks, s.noun.bore, size, frames, working, poses, work)
        out.append(
            Estimate(
                name=name,
                label=s.phrase,
                role=s.role,
                noun=s.noun,
                size_m=size,
                rgba=_colour_in(image, s.first),
                frames=tuple(int(working.frame_idx[i]) for i in frames),
                T_world_objs=poses,
                confidences=tuple(round(c, 3) for c in sure),
                masks=masks,
                source={**_sources(s), "shape": how},
                mass_kg=_mass(s.noun, size),
                mesh=None if plain else mesh,
                parts=() if plain else parts,
                symmetry=s.noun.symmetry,
                observed=observed,
            )
        )
    return out


def _stretched(
    size_m: tuple[float, float, float], mesh: trimesh.Trimesh, *parts: trimesh.Trimesh
) -> tuple[trimesh.Trimesh, tuple[trimesh.Trimesh, ...]]:
    """Return a mesh brought to these extents, and its parts with it."""
    T = np.diag([*(np.array(size_m) / mesh.extents), 1.0])
    first, *rest = (solid.copy().apply_transform(T) for solid in (mesh, *parts))
    return first, tuple(rest)


def _turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.copy().apply_transform(_OVER)


def _metric(camera: Camera, origin: Float[np.ndarray, "3"], height_m: float) -> Camera:
    """Return a camera given in camera heights in the scene frame and metres."""
    T = camera.T_world_cam.copy()
    T[:3, 3] = (T[:3, 3] - origin) * height_m
    return replace(camera, T_world_cam=T)


def _mask_track(
    working: WorkingClip, s: ObjectTrack, placed: PlacedObject
) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Return the believable masks by clip frame."""
    masks = {
        int(working.frame_idx[i]): s.masks[i]
        for i in range(len(s.masks))
        if s.quality[i] > _LEAST_QUALITY and s.masks[i].any()
    }
    masks[int(working.frame_idx[s.at])] = s.first
    if s.moves and not (s.hidden_in_container or placed.hidden_in_hand):
        masks[int(working.frame_idx[placed.last_i])] = placed.last_mask
    return dict(sorted(masks.items()))


def _with_hole(
    masks: dict[int, Bool[np.ndarray, "h w"]],
    bore: float,
    size_m: tuple[float, float, float],
    frames: tuple[int, ...],
    working: WorkingClip,
    T_world_objs: Float[np.ndarray, "pose 4 4"],
    camera: Camera,
) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Return a ring's masks without what is seen through it, posed as in the nearest frame that has a pose."""
    posed = working.frame_idx[list(frames)]
    return {
        i: without_hole(mask, size_m, bore, T_world_objs[int(np.abs(posed - i).argmin())], camera)
        for i, mask in masks.items()
    }


def _remarks(
    kind: Kind, grounded: GroundedObjects, placement: Placement, num_frames: int
) -> list[str]:
    spread = placement.scale_spread
    by_network = " and from what the network makes of the picture" if grounded.segmentation else ""
    out = [
        f"scale comes from usual sizes{by_network}: all lengths may be off by {spread:.0%} together"
    ]
    out += [
        f"'{s.phrase}' is no known noun; its size is a guess"
        for s in grounded.objects
        if not s.noun.known
    ]
    out += [
        f"outlines hardly tell how '{s.phrase}' lies: the next best way covers them {placed.rival:.3f} worse"
        for s, placed in zip(grounded.objects, placement.objects, strict=True)
        if placed.rival is not None and placed.rival < _CLOSE_RIVAL
    ]
    thing = placement.objects[0]
    if thing.unseen:
        phrase, goal = (s.phrase for s in grounded.objects[:2])
        out.append(
            f"nothing shows where '{phrase}' ends: it is taken to lie in the middle of '{goal}'"
        )
    if held_at_first(grounded, placement):
        out.append(
            f"'{grounded.objects[0].phrase}' seems {np.expm1(thing.log_growth):.0%} larger at first than at the end, as if a hand held it in the "
            "air: its first pose is where it would stand on the table"
        )
    last_frame = int(grounded.working.frame_idx[thing.last_i])
    if kind == "lift_up":
        out.append("one view shows no depth in mid-air: the lift is taken to go straight up")
        if thing.hidden_in_hand:
            out.append("the hand hides what it lifts: it is taken to go with the hand")
        if last_frame < num_frames - 1:
            out.append(f"the lift is highest at frame {last_frame}; what comes after is left out")
    return out


def _clip_camera(clip: Clip, placement: Placement, origin: Float[np.ndarray, "3"]) -> Camera:
    work = _metric(placement.camera, origin, placement.height_m)
    h, w = clip.frames.shape[1:3]
    K = np.diag([w / work.width_px, h / work.height_px, 1.0]) @ work.K
    return replace(work, width_px=w, height_px=h, K=K)


def _colour_in(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> tuple[float, float, float, float]:
    r, g, b = np.median(image[mask], axis=0) / 255
    return round(float(r), 3), round(float(g), 3), round(float(b), 3), 1.0


def _sources(s: ObjectTrack) -> dict[str, str]:
    word = f"usual for '{s.noun.word}'" if s.noun.known else "a guess for an unknown noun"
    size = "given by the user" if s.known_m else f"outline in the video, scale {word}"
    return {"size": size, "mass": f"{word}, scaled with volume", "friction": word}


def _mass(noun: Noun, size: tuple[float, float, float]) -> float:
    ratio = float(np.prod(size) / np.prod(noun.size_m))
    return round(noun.mass_kg * float(np.clip(ratio, 0.4, 2.5)), 4)
