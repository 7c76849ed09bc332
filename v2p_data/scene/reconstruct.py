"""The order of steps from a clip to a scene, how sure each step is, and the gate that turns guesses away.

footage -> camera still? -> what moved, what stayed -> outlines -> camera pitch and shapes -> metres
-> poses at the first and last frame and between -> does the motion fit the caption? -> confidence
"""

import keyword
import logging
import re
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.colour import lab_of
from v2p_data.scene.footage import Footage, camera_shift_px, footage_of
from v2p_data.scene.ground import Found, Moved, find_moved, find_other
from v2p_data.scene.nouns import Noun, is_clear, noun_for
from v2p_data.scene.pose import (
    Fit,
    Silhouette,
    camera_above,
    fit_lifted,
    fit_pose,
    fit_shape,
    on_wall,
    orientations,
)
from v2p_data.scene.scale import (
    SizeVote,
    camera_height_m,
    disagreement,
    height_plausibility,
)
from v2p_data.scene.scene import Observed, Role, Symmetry
from v2p_data.scene.segment import bounding_box, from_box, from_points, grow, tidy
from v2p_data.scene.table import Table, find_table
from v2p_data.scene.track import Track, track
from v2p_data.video.captions import parse_caption
from v2p_data.video.clip import Clip

log = logging.getLogger(__name__)

_INSIDE_KINDS = ("insert", "throw_into", "place_onto")
_CARRY_KINDS = ("uncover", "generic", "drop_in_front_of")


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How a scene is rebuilt, and how sure we must be."""

    min_confidence: float = 0.5
    """Scenes below are rejected; the gate that accepted 14 right of 15 on measured clips."""
    max_camera_shift_px: float = 3.0
    """Of a picture 320 px wide. Everything here takes the camera to stand still."""
    min_object_score: float = 4.5
    """Of the cues that find the object without a hint; most findings below were wrong."""
    min_reference_score: float = 1.5
    """Of the cues that find the other object."""
    pitch_rad: float = 0.61
    """How far the camera usually looks down: 35 degrees for a camera on a stand at a table."""
    pitch_spread_rad: float = 0.14
    """How far silhouettes may pull the pitch from the usual one."""
    fov_rad: float = 1.01
    """Horizontal field of view; 58 degrees is usual for web cameras and phones filming wide."""
    max_poses: int = 14
    """Poses kept per object, the first and last among them."""

    def __post_init__(self) -> None:
        if not 0 < self.min_confidence < 1:
            raise ValueError(f"min_confidence must lie in 0..1, got {self.min_confidence}")
        if not 0.1 < self.pitch_rad < 1.5:
            raise ValueError(f"pitch_rad must lie in 0.1..1.5, got {self.pitch_rad}")
        if not 0.3 < self.fov_rad < 2.2:
            raise ValueError(f"fov_rad must lie in 0.3..2.2, got {self.fov_rad}")
        if self.max_poses < 2:
            raise ValueError(f"max_poses must be at least 2, got {self.max_poses}")


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
    """By clip frame, at working size."""
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
    kind: str
    objects: tuple[Estimate, ...]
    """The manipulated one first."""
    camera: Camera
    """For the clip's frames, in the scene frame."""
    confidence: float
    cues: dict[str, float]
    """What the confidence is the product of."""
    warnings: tuple[str, ...]
    track: Track = field(repr=False)
    footage_frames: tuple[int, ...]
    """Clip frame behind each mask of the track."""
    stages: dict[str, tuple[float, str]] = field(default_factory=dict[str, tuple[float, str]])
    """Per stage how sure it is, 0 to 1, and why it is not surer."""


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """An object in the picture, before geometry."""

    phrase: str
    role: Role
    noun: Noun
    first: Bool[np.ndarray, "h w"]
    hinted: bool
    known_m: tuple[float, float, float] | None
    score: float


def reconstruct(clip: Clip, cfg: SceneConfig, rng: np.random.Generator) -> Reconstruction:
    """Return the scene that the clip shows.

    Raises:
        ItemRejectedError: `camera_moves`, `nothing_moves`, `object_not_found`, `reference_not_found`,
            `motion_contradicts_caption`, `shape_unclear` or `low_confidence`, with the number that decided.
    """
    del rng  # every step here is deterministic; a sampling backend will need it
    meaning = parse_caption(clip.caption, clip.objects)
    footage = footage_of(clip)
    _check_still(footage, cfg)
    table = find_table(footage.always)
    moved, hinted = _find_manipulated(clip, footage, table, meaning.manipulated, meaning.kind, cfg)
    footage = footage.knowing(moved.look)
    warnings: list[str] = []
    seen = [
        _Seen(
            phrase=meaning.manipulated,
            role="manipulated",
            noun=noun_for(meaning.manipulated),
            first=moved.first,
            hinted=hinted,
            known_m=_known_size(clip, meaning.manipulated),
            score=moved.score,
        )
    ]
    taken = np.zeros(footage.shape, bool)
    for phrase, role in meaning.others:
        found, other_hinted = _find_other(clip, footage, table, phrase, meaning.kind, moved, taken)
        named = phrase.lower() in clip.caption.lower()
        if found is None or (not other_hinted and found.score < cfg.min_reference_score):
            score = found.score if found else None
            if named and meaning.kind not in ("lift_up", "push_left", "push_right", "tip_over"):
                raise ItemRejectedError(
                    "reference_not_found",
                    f"the '{phrase}' was not found in {clip.item}; mark it with a box in captions.json",
                    score,
                )
            warnings.append(f"the '{phrase}' was not found and is left out")
            continue
        taken |= grow(found.mask, 2)
        seen.append(
            _Seen(
                phrase=phrase,
                role=role,
                noun=noun_for(phrase),
                first=found.mask,
                hinted=other_hinted,
                known_m=_known_size(clip, phrase),
                score=found.score,
            )
        )
    followed = track(footage, moved, every=1 if len(footage.rgb) < 80 else 2)
    moved = replace(moved, last=followed.masks[-1])
    on_table = _stands_on(table, moved.first)
    geometry = _Geometry(footage, seen, moved, meaning.kind, cfg, followed)
    return _assemble(
        clip, footage, meaning.kind, seen, moved, geometry, followed, on_table, warnings, cfg
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


def _check_still(footage: Footage, cfg: SceneConfig) -> None:
    shift = camera_shift_px(footage)
    if shift > cfg.max_camera_shift_px:
        raise ItemRejectedError(
            "camera_moves",
            f"the camera moves by {shift:.1f} px of 320; at most {cfg.max_camera_shift_px:.0f} px can be "
            "understood: film from a stand",
            round(shift, 2),
        )
    change = np.linalg.norm(footage.lab[1:] - footage.lab[:1], axis=-1).max(0)
    share = float((change > 15).mean())
    if share < 0.003:
        raise ItemRejectedError(
            "nothing_moves",
            f"only {share:.2%} of the picture changes; the clip shows no manipulation",
            round(share, 5),
        )


def _find_manipulated(
    clip: Clip, footage: Footage, table: Table, phrase: str, kind: str, cfg: SceneConfig
) -> tuple[Moved, bool]:
    mask, at_end = _hinted_mask(clip, footage, phrase)
    if mask is None:
        moved = find_moved(footage, table, phrase, kind)
    elif at_end:
        moved = find_moved(footage, table, phrase, kind, last=mask)
    else:
        moved = find_moved(footage, table, phrase, kind, first=mask)
    if moved is None:
        raise ItemRejectedError(
            "object_not_found", f"nothing that moved looks like '{phrase}'", None
        )
    least = cfg.min_object_score - (1.0 if mask is not None else 0.0)
    if moved.score < least:
        raise ItemRejectedError(
            "object_not_found",
            f"the best match for '{phrase}' scores {moved.score:.1f}, below {least:.1f}; mark it with a box "
            "in captions.json",
            round(moved.score, 2),
        )
    return moved, mask is not None


def _find_other(
    clip: Clip,
    footage: Footage,
    table: Table,
    phrase: str,
    kind: str,
    moved: Moved,
    taken: Bool[np.ndarray, "h w"],
) -> tuple[Found | None, bool]:
    mask, _ = _hinted_mask(clip, footage, phrase)
    if mask is not None:
        return Found(mask=mask, score=5.0), True
    return find_other(footage, table, phrase, kind, moved, taken), False


def _stands_on(table: Table, mask: Bool[np.ndarray, "h w"]) -> bool:
    """Return whether the mask's foot lies on the table's part of the picture."""
    x, y, w, h = bounding_box(mask)
    foot = np.zeros_like(mask)
    foot[y + int(0.75 * h) : y + h, x : x + w] = True
    foot &= mask
    return float((foot & grow(table.hull, 6)).sum()) > 0.3 * float(foot.sum())


def _hinted_mask(
    clip: Clip, footage: Footage, phrase: str
) -> tuple[Bool[np.ndarray, "h w"] | None, bool]:
    """Return the mask that a user's box or points mean, and whether their frame is nearer to the end."""
    hint = clip.hints.get(phrase)
    if hint is None or not ("box" in hint or "points" in hint):
        return None, False
    frame = hint.get("frame", 0)
    at_end = frame > 0.5 * (len(clip.frames) - 1)
    image = footage.rgb[int(np.abs(footage.frame_idx - frame).argmin())]
    if "box" in hint:
        x0, y0, x1, y1 = (v * footage.px_scale for v in hint["box"])
        return from_box(image, (x0, y0, x1, y1)), at_end
    points = [(x * footage.px_scale, y * footage.px_scale) for x, y in hint["points"]]
    return from_points(image, points), at_end


def _known_size(clip: Clip, phrase: str) -> tuple[float, float, float] | None:
    hint = clip.hints.get(phrase)
    if hint is None or "size_m" not in hint:
        return None
    length, width, height = hint["size_m"]
    return length, width, height


class _Geometry:
    """Camera, shapes and the two end poses, in camera heights."""

    def __init__(
        self,
        footage: Footage,
        seen: list[_Seen],
        moved: Moved,
        kind: str,
        cfg: SceneConfig,
        followed: Track,
    ) -> None:
        self.seen, self.kind, self.cfg, self.footage = seen, kind, cfg, footage
        self._unknown = _hidden(footage, 0, moved.first, moved.last)
        self.pitch_rad, self.fits = self._best_pitch()
        self.camera = camera_above(footage.shape, self.pitch_rad, cfg.fov_rad)
        self.last_i = len(footage.rgb) - 1
        self.last_mask, self._first_mask = moved.last, moved.first
        if kind == "lift_up":
            self.last_i = _peak(followed, moved.first)
            self.last_mask = followed.masks[self.last_i]
        # One outline often fits a standing and a lying box alike; both ends together seldom do.
        options = self._options(0, self.camera, thorough=True)
        ends = [self._fit_last(first) for first in options]
        best = min(range(len(options)), key=lambda k: options[k].cost + ends[k][0].cost)
        self.fits[0] = options[best]
        self.last, self.upright_cost = ends[best]
        self.height_m, self.scale_spread = camera_height_m(
            [_vote(s, fit) for s, fit in zip(seen, self.fits, strict=True)]
        )

    def _best_pitch(self) -> tuple[float, list[Fit]]:
        """Try pitches around the usual one; the silhouettes decide, as far as the prior lets them."""
        cfg = self.cfg
        best: tuple[float, float, list[Fit]] | None = None
        tried: list[float] = []
        for offsets in ((-0.26, -0.13, 0.0, 0.13, 0.26), (-0.06, 0.06)):
            centre = cfg.pitch_rad if best is None else best[1]
            for offset in offsets:
                pitch = centre + offset
                if not 0.15 < pitch < 1.3 or any(abs(pitch - other) < 0.01 for other in tried):
                    continue
                tried.append(pitch)
                fits = self._fit_all(pitch, thorough=False)
                off = (pitch - cfg.pitch_rad) / cfg.pitch_spread_rad
                cost = sum(fit.cost for fit in fits) + 0.02 * off**2
                if best is None or cost < best[0]:
                    best = cost, pitch, fits
        assert best is not None
        return best[1], self._fit_all(best[1], thorough=len(self.seen) > 1)

    def _fit_all(self, pitch_rad: float, *, thorough: bool) -> list[Fit]:
        camera = camera_above(self.footage.shape, pitch_rad, self.cfg.fov_rad)
        return [
            min(self._options(i, camera, thorough=thorough), key=lambda fit: fit.cost)
            for i in range(len(self.seen))
        ]

    def _options(self, i: int, camera: Camera, *, thorough: bool) -> list[Fit]:
        """Return the best fit for every way in which the object may rest."""
        s = self.seen[i]
        silhouette = Silhouette(s.first, self._unknown if i == 0 else None, camera)
        rests = orientations(s.noun)
        fits = []
        for rest, extra in rests if thorough or i == 0 else rests[:1]:
            fit = fit_shape(silhouette, s.noun, rest, thorough=thorough)
            fit = replace(fit, cost=fit.cost + extra)
            fits.append(_upright_axes(fit) if s.noun.form == "box" else fit)
        return fits

    def _fit_last(self, first: Fit) -> tuple[Fit, float]:
        """Return the manipulated object's pose at the end, and what standing as at first would have cost."""
        noun = self.seen[0].noun
        unknown = _hidden(self.footage, self.last_i, self.last_mask, self._first_mask)
        silhouette = Silhouette(self.last_mask, unknown, self.camera)
        if self.kind == "lift_up":
            return fit_lifted(silhouette, noun, first.size, first.T_world_obj), 0.0
        rest = _rest_of(first.T_world_obj[:3, :3])
        yaw = _yaw_between(first.T_world_obj[:3, :3], rest)
        support = self._support()
        same = fit_pose(silhouette, noun, first.size, rest, yaw_near=yaw, support=support)
        if self.kind in _CARRY_KINDS:
            held = fit_lifted(silhouette, noun, first.size, first.T_world_obj)
            if held.cost + 0.1 < same.cost:  # the clip ends before it is put down
                return held, same.cost
        if self.kind != "tip_over" or noun.form == "sphere":
            return same, same.cost
        turned = []
        for axis in ("y", "x"):
            tipped = Rotation.from_euler(axis, 90, degrees=True).as_matrix() @ rest
            fit = fit_pose(silhouette, noun, first.size, tipped)
            turned.append(_tipped_along(fit, first.T_world_obj))
        return min(turned, key=lambda fit: fit.cost), same.cost

    def _support(self) -> float:
        """Return how high above the table the object comes to rest [camera heights]."""
        if self.kind not in (*_INSIDE_KINDS, "cover") or len(self.seen) < 2:
            return 0.0
        other, height = self.seen[1].noun, self.fits[1].size[2]
        if self.kind == "cover":
            return 0.0 if self.seen[0].noun.hollow else height
        return 0.15 * height if other.hollow else height


def _assemble(
    clip: Clip,
    footage: Footage,
    kind: str,
    seen: list[_Seen],
    moved: Moved,
    geometry: _Geometry,
    followed: Track,
    on_table: bool,
    warnings: list[str],
    cfg: SceneConfig,
) -> Reconstruction:
    height = geometry.height_m
    origin = geometry.fits[0].T_world_obj[:3, 3] * np.array([1, 1, 0])

    def metric(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        return transform(T[:3, :3], (T[:3, 3] - origin) * height)

    last_frame = int(footage.frame_idx[geometry.last_i])
    taken: set[str] = set()
    objects: list[Estimate] = []
    for i, (s, fit) in enumerate(zip(seen, geometry.fits, strict=True)):
        name = slug_for(s.phrase, taken)
        taken.add(name)
        size = _tuple3(np.array(fit.size) * height)
        T_first = metric(fit.T_world_obj)
        if i == 0:
            T_last = metric(geometry.last.T_world_obj)
            between = _between(footage, geometry, followed, cfg, metric)
            frames = [0, *(f for f, _, _ in between), last_frame]
            poses = [T_first, *(T for _, T, _ in between), T_last]
            sure = [fit.iou, *(c for _, _, c in between), geometry.last.iou]
            masks = {0: moved.first, last_frame: geometry.last_mask}
        else:
            frames, poses, sure = [0, last_frame], [T_first, T_first], [fit.iou, fit.iou]
            masks = {0: s.first, last_frame: s.first}
        objects.append(
            Estimate(
                name=name,
                label=s.phrase,
                role=s.role,
                noun=s.noun,
                size_m=size,
                rgba=_colour_in(footage.early if i else footage.rgb[0], s.first),
                frames=tuple(frames),
                T_world_objs=np.stack(poses),
                confidences=tuple(round(float(np.clip(c, 0, 1)), 3) for c in sure),
                masks=masks,
                source=_sources(s),
                mass_kg=_mass(s.noun, size),
            )
        )
    _check_motion(kind, objects, geometry, moved)
    cues = _cues(kind, seen, geometry, followed)
    if not on_table:
        cues["stands on the table at first"] = 0.6
    confidence = float(np.prod(list(cues.values())))
    if confidence < cfg.min_confidence:
        weakest = min(cues, key=lambda cue: cues[cue])
        raise ItemRejectedError(
            "low_confidence",
            f"the scene is sure to {confidence:.2f}, below {cfg.min_confidence:.2f}; weakest is {weakest} "
            f"with {cues[weakest]:.2f}; a box around the object in captions.json helps",
            round(confidence, 3),
        )
    warnings += _remarks(kind, seen, geometry, last_frame, len(clip.frames))
    return Reconstruction(
        clip=clip,
        kind=kind,
        objects=tuple(objects),
        camera=_clip_camera(clip, geometry, origin),
        confidence=confidence,
        cues=cues,
        warnings=tuple(warnings),
        track=followed,
        footage_frames=tuple(int(f) for f in footage.frame_idx),
    )


def _check_motion(kind: str, objects: list[Estimate], geometry: _Geometry, moved: Moved) -> None:
    """Turn away what does not do what its caption says: then something else was followed."""
    thing = objects[0]
    move = thing.T_world_objs[-1][:3, 3] - thing.T_world_objs[0][:3, 3]
    size = max(thing.size_m)
    value: float | None = None
    said = ""
    if kind == "lift_up":
        value, least, said = float(move[2]), 0.05, "rises"
    elif kind in ("push_left", "push_right"):
        value, least = float(move[1] if kind == "push_left" else -move[1]), max(0.04, 0.25 * size)
        said = "moves to the left" if kind == "push_left" else "moves to the right"
    elif kind == "tip_over":
        value, least = geometry.upright_cost - geometry.last.cost, -0.03
        said = "fits the picture better tipped than upright"
    elif (
        kind in ("push_next_to", "slide_to", "drop_in_front_of", "push_with") and len(objects) > 1
    ):
        other = objects[1]
        gaps = [
            float(np.linalg.norm((T[:3, 3] - other.T_world_objs[0][:3, 3])[:2]))
            for T in (thing.T_world_objs[0], thing.T_world_objs[-1])
        ]
        value, least, said = gaps[0] - gaps[1], 0.02, "comes nearer to the other"
    elif kind in (*_INSIDE_KINDS, "cover") and len(objects) > 1:
        goal = grow(objects[1].masks[0], 6)
        value, least = float((goal & moved.last).sum() / max(1, moved.last.sum())), 0.25
        said = "ends at the other"
    else:
        shift = float(np.linalg.norm(move))
        value, least, said = shift, 0.02, "moves"
    if value < least:
        raise ItemRejectedError(
            "motion_contradicts_caption",
            f"what was followed as '{thing.label}' hardly {said} ({value:.2f}, at least {least:.2f} needed), "
            "so it is probably something else; mark it with a box in captions.json",
            round(value, 3),
        )


def _cues(kind: str, seen: list[_Seen], geometry: _Geometry, followed: Track) -> dict[str, float]:
    cues: dict[str, float] = {}
    for i, s in enumerate(seen):
        which = "object" if i == 0 else f"the {s.phrase}"
        middle, width = (3.6, 0.8) if i == 0 else (1.0, 0.5)
        cues[f"finding {which}"] = 0.97 if s.hinted else _rise(s.score, middle, width)
        iou = geometry.fits[i].iou
        off = abs(disagreement(_vote(s, geometry.fits[i]), geometry.height_m))
        cues[f"size of {which}"] = float(np.exp(-0.5 * (max(0.0, off - 1.5) / 1.5) ** 2))
        cues[f"shape of {which}"] = float(np.clip(0.5 + (iou - 0.6) / 0.3 * 0.5, 0.1, 1))
    cues["pose at the end"] = float(np.clip(0.6 + (geometry.last.iou - 0.45) / 0.35 * 0.4, 0.1, 1))
    seen_at_end = geometry.last.visible / max(0.2, geometry.fits[0].visible)
    cues["seen at the end"] = float(np.clip(0.5 + 0.5 * seen_at_end / 0.5, 0.1, 1))
    cues["track from start to end"] = float(np.clip(0.65 + 0.7 * followed.meets, 0, 1))
    cues["camera height"] = height_plausibility(geometry.height_m)
    noun = seen[0].noun
    cues["noun"] = 1.0 if noun.known or seen[0].known_m else 0.9
    cues["matter"] = {"rigid": 1.0, "soft": 0.8, "clear": 0.7}[
        "clear" if is_clear(seen[0].phrase) else noun.matter
    ]
    if kind == "generic":
        cues["caption"] = 0.85
    return cues


def _remarks(
    kind: str, seen: list[_Seen], geometry: _Geometry, last_frame: int, num_frames: int
) -> list[str]:
    out = [
        f"scale comes from usual sizes: all lengths may be off by {geometry.scale_spread:.0%} together"
    ]
    out += [
        f"'{s.phrase}' is no known noun; its size is a guess" for s in seen if not s.noun.known
    ]
    if kind == "lift_up":
        out.append("one view shows no depth in mid-air: the lift is taken to go straight up")
        if last_frame < num_frames - 1:
            out.append(f"the lift is highest at frame {last_frame}; what comes after is left out")
    return out


def _between(
    footage: Footage,
    geometry: _Geometry,
    followed: Track,
    cfg: SceneConfig,
    metric,  # noqa: ANN001
) -> list[tuple[int, Float[np.ndarray, "4 4"], float]]:
    """Return poses at well-tracked frames between the ends: position from the mask's centre, rotation blended."""
    first, last = geometry.fits[0].T_world_obj, geometry.last.T_world_obj
    camera = geometry.camera
    spots = np.linspace(0, geometry.last_i, cfg.max_poses).round().astype(int)[1:-1]
    on_table = geometry.kind in (
        "push_left",
        "push_right",
        "push_next_to",
        "slide_to",
        "push_with",
    )
    turn = Rotation.from_matrix(last[:3, :3] @ first[:3, :3].T).as_rotvec()
    ends = [_centre(followed.masks[0]), _centre(geometry.last_mask)]
    bias = [
        centre - camera.project(T[None, :3, 3])[0]
        for centre, T in zip(ends, (first, last), strict=True)
    ]
    travel = ends[1] - ends[0]
    out = []
    for i in sorted(set(spots.tolist())):
        if followed.quality[i] < 0.5 or not 0 < i < geometry.last_i:
            continue
        centre = _centre(followed.masks[i])
        share = float(np.clip((centre - ends[0]) @ travel / max(1.0, travel @ travel), 0, 1))
        pixel = centre - (1 - share) * bias[0] - share * bias[1]
        if on_table:
            position = camera.on_plane(pixel[None], float(first[2, 3]))[0]
        else:
            position = on_wall(
                camera, pixel, float((1 - share) * first[0, 3] + share * last[0, 3])
            )
            position[2] = max(position[2], min(first[2, 3], last[2, 3]))
        if not np.isfinite(position).all():
            continue
        rotation = Rotation.from_rotvec(share * turn).as_matrix() @ first[:3, :3]
        sure = 0.7 * float(followed.quality[i])
        out.append((int(footage.frame_idx[i]), metric(transform(rotation, position)), sure))
    return out


def _peak(followed: Track, first: Bool[np.ndarray, "h w"]) -> int:
    """Return the footage frame at which a lift is highest in the picture, among the believable ones."""
    n = len(followed.masks)
    heights = np.full(n, -np.inf)
    start = _centre(first)[1]
    for i in range(n):
        if followed.quality[i] >= 0.5 and followed.masks[i].any():
            heights[i] = start - _centre(followed.masks[i])[1]
    top = heights.max()
    # The end of the clip counts as the peak when it is nearly as high: a hand that holds still trembles.
    near = np.flatnonzero(heights >= 0.93 * top)
    return int(near[-1]) if len(near) and top > 0 else n - 1


def _hidden(
    footage: Footage, i: int, mask: Bool[np.ndarray, "h w"], other_end: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return pixels near the mask that say nothing: what passes there (the hand, a shadow) may hide the object."""
    background = footage.late if i < len(footage.rgb) / 2 else footage.early
    passing = np.linalg.norm(footage.lab[i] - lab_of(background), axis=-1) > 12
    hidden = tidy(passing) & ~grow(other_end, 2) & ~mask
    x, y, w, h = bounding_box(mask)
    near = np.zeros_like(mask)
    pad = max(4, int(0.3 * max(w, h)))
    near[max(0, y - pad) : y + h + pad, max(0, x - pad) : x + w + pad] = True
    return hidden & near


def _upright_axes(fit: Fit) -> Fit:
    """Return the same box with its own axes such that at first its z points up."""
    rest = _rest_of(fit.T_world_obj[:3, :3])
    size = np.abs(rest) @ np.array(fit.size)
    yawed = fit.T_world_obj[:3, :3] @ rest.T
    T = transform(yawed, fit.T_world_obj[:3, 3])
    return replace(fit, size=_tuple3(size), T_world_obj=T)


def _rest_of(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the resting orientation of a pose without its yaw: identity for upright things."""
    if rotation[2, 2] > 0.7:
        return np.eye(3)
    if rotation[2, 2] < -0.7:
        return np.diag([1.0, -1.0, -1.0])
    axis = "y" if abs(rotation[2, 0]) > 0.7 else "x"
    return Rotation.from_euler(axis, 90, degrees=True).as_matrix()


def _yaw_between(rotation: Float[np.ndarray, "3 3"], rest: Float[np.ndarray, "3 3"]) -> float:
    turn = rotation @ rest.T
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


def _tipped_along(fit: Fit, T_first: Float[np.ndarray, "4 4"]) -> Fit:
    """Return the lying pose whose top points the way the object went: silhouettes do not tell top from bottom."""
    top = fit.T_world_obj[:3, 2]
    way = fit.T_world_obj[:3, 3] - T_first[:3, 3]
    if float(top[:2] @ way[:2]) >= 0:
        return fit
    T = fit.T_world_obj.copy()
    T[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ T[:3, :3]
    return replace(fit, T_world_obj=T)


def _clip_camera(clip: Clip, geometry: _Geometry, origin: Float[np.ndarray, "3"]) -> Camera:
    work = geometry.camera
    h, w = clip.frames.shape[1:3]
    K = np.diag([w / work.width_px, h / work.height_px, 1.0]) @ work.K
    T = work.T_world_cam.copy()
    T[:3, 3] = (T[:3, 3] - origin) * geometry.height_m
    return Camera(width_px=w, height_px=h, K=K, T_world_cam=T)


def _colour_in(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> tuple[float, float, float, float]:
    r, g, b = np.median(image[mask], axis=0) / 255
    return round(float(r), 3), round(float(g), 3), round(float(b), 3), 1.0


def _sources(s: _Seen) -> dict[str, str]:
    word = f"usual for '{s.noun.word}'" if s.noun.known else "a guess for an unknown noun"
    size = "given by the user" if s.known_m else f"outline in the video, scale {word}"
    return {"size": size, "mass": f"{word}, scaled with volume", "friction": word}


def _mass(noun: Noun, size: tuple[float, float, float]) -> float:
    ratio = float(np.prod(size) / np.prod(noun.size_m))
    return round(noun.mass_kg * float(np.clip(ratio, 0.4, 2.5)), 4)


def _centre(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "2"]:
    y, x = np.nonzero(mask)
    return np.array([x.mean() + 0.5, y.mean() + 0.5]) if len(x) else np.array([np.nan, np.nan])


def _vote(s: _Seen, fit: Fit) -> SizeVote:
    return SizeVote(size=fit.size, noun=s.noun, trust=max(0.1, fit.iou), known_m=s.known_m)


def _tuple3(values: np.ndarray) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in values)
    return a, b, c


def _rise(x: float, middle: float, width: float) -> float:
    return float(1 / (1 + np.exp(-(x - middle) / width)))
