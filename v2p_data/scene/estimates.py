"""Tracks, poses and meshes become one `Estimate` per object: named, in metres, in the scene frame."""

import keyword
import re
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import mesh_for, parts_for
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import (
    Estimate,
    GroundedObjects,
    ObjectTrack,
    PlacedObject,
    Placement,
)
from v2p_data.scene.fitting.by_model import poses_by_worker
from v2p_data.scene.fitting.metric import clip_camera, metric_camera, scene_origin
from v2p_data.scene.fitting.ring_mask import without_hole
from v2p_data.scene.fitting.shape_fit import three
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.meshes import MeshedObject
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.schema import Observed, Shape
from v2p_data.scene.shapes.by_worker import mesh_by_worker
from v2p_data.video.clip import Clip

_OVER = np.diag([1.0, -1.0, -1.0, 1.0])
"""Half a turn about x: upside down."""
_STRAIGHT = 0.06
"""Tapers by less than this share are simulated as cylinders."""
_LEAST_QUALITY = 0.4
"""Quality, 0 to 1, of a mask that is kept in an object's mask track."""


@dataclass(frozen=True, kw_only=True)
class _Solid:
    """An object's mesh and poses [m], which the user's size and workers may override."""

    size_m: tuple[float, float, float]
    mesh: trimesh.Trimesh
    parts: tuple[trimesh.Trimesh, ...]
    is_primitive: bool
    """Whether the mesh is the noun's primitive of this size."""
    T_world_objs: Float[np.ndarray, "pose 4 4"]
    frames: tuple[int, ...]
    """Working frames with a pose."""
    confidences: tuple[float, ...]
    observed: tuple[Observed, ...]
    source: str
    """Where the mesh comes from, in words."""


def estimates_of(
    clip: Clip,
    grounded: GroundedObjects,
    placement: Placement,
    meshed: list[MeshedObject],
    kind: Kind,
    cfg: SceneConfig,
) -> list[Estimate]:
    """Return the objects, the manipulated one first.

    Raises:
        V2PError: a worker fails.
        ItemRejectedError: a worker refuses an object.
    """
    taken: set[str] = set()
    out = []
    for s, placed, made in zip(grounded.objects, placement.objects, meshed, strict=True):
        name = slug_for(s.phrase, taken)
        taken.add(name)
        solid = _from_outline(s, placed, made)
        if s.known_m:  # the user's word on the size outranks the outline's
            size = three(placement.height_m * np.array(placed.first.size))
            solid = _stretched(solid, s.noun, size)
        if s.noun.hollow and s.role in ("manipulated", "cover") and KINDS[kind].has_cover:
            solid = _mouth_down(solid)
        if cfg.mesh.worker:
            solid = _meshed_by_worker(clip, grounded.working, s, solid, cfg)
        if cfg.pose.worker and s.moves:
            solid = _posed_by_worker(
                clip, grounded.working, s, solid, clip_camera(clip, placement), cfg
            )
        masks = _mask_track(grounded.working, s, placed)
        if s.noun.bore:
            work = metric_camera(placement.camera, scene_origin(placement), placement.height_m)
            masks = _with_hole(masks, s.noun.bore, solid, grounded.working, work)
        out.append(_estimate(name, grounded.working, s, solid, masks))
    return out


def slug_for(phrase: str, taken: set[str]) -> str:
    """Return a Python identifier for an object phrase that is not taken yet."""
    base = re.sub(r"[^a-z0-9]+", "_", phrase.lower()).strip("_") or "object"
    if base[0].isdigit() or keyword.iskeyword(base):
        base = f"object_{base}"
    name, number = base, 2
    while name in taken:
        name, number = f"{base}_{number}", number + 1
    return name


def _from_outline(s: ObjectTrack, placed: PlacedObject, made: MeshedObject) -> _Solid:
    shape = made.shape
    return _Solid(
        size_m=shape.size_m,
        mesh=shape.mesh,
        parts=shape.parts,
        is_primitive=shape.kind == "primitive" and not s.noun.bore,
        T_world_objs=made.T_world_objs,
        frames=placed.frames,
        confidences=placed.confidences,
        observed=placed.observed,
        source=shape.reason,
    )


def _stretched(solid: _Solid, noun: Noun, size_m: tuple[float, float, float]) -> _Solid:
    """Return the mesh and its parts brought to these extents."""
    if solid.is_primitive:
        mesh, *parts = (
            mesh_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper),
            *parts_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper),
        )
        return replace(solid, size_m=size_m, mesh=mesh, parts=tuple(parts))
    T = np.diag([*(np.array(size_m) / solid.mesh.extents), 1.0])
    mesh, *parts = (one.copy().apply_transform(T) for one in (solid.mesh, *solid.parts))
    return replace(solid, size_m=size_m, mesh=mesh, parts=tuple(parts))


def _mouth_down(solid: _Solid) -> _Solid:
    """Return a cover in a frame of its own that has its mouth below, as it lies: so the simulator builds it."""
    mesh, *parts = (one.copy().apply_transform(_OVER) for one in (solid.mesh, *solid.parts))
    return replace(
        solid,
        mesh=mesh,
        parts=tuple(parts),
        T_world_objs=solid.T_world_objs @ _OVER,
        is_primitive=False,
    )


def _meshed_by_worker(
    clip: Clip, working: WorkingClip, s: ObjectTrack, solid: _Solid, cfg: SceneConfig
) -> _Solid:
    mesh, repair = mesh_by_worker(clip, working, s, solid.size_m, cfg.mesh)
    source = "made by the mesh worker from one picture, scaled to the outline"
    if repair != "none":
        source += f"; its mesh was not closed and was mended ({repair})"
    return replace(
        solid,
        size_m=three(mesh.extents),
        mesh=mesh,
        parts=(),
        is_primitive=False,
        source=source,
    )


def _posed_by_worker(
    clip: Clip,
    working: WorkingClip,
    s: ObjectTrack,
    solid: _Solid,
    camera: Camera,
    cfg: SceneConfig,
) -> _Solid:
    poses, sure = poses_by_worker(clip, working, s.masks, solid.mesh, camera, cfg.pose)
    return replace(
        solid,
        T_world_objs=poses,
        frames=tuple(range(len(poses))),
        confidences=tuple(float(one) for one in sure),
        observed=("full",) * len(poses),
    )


def _estimate(
    name: str,
    working: WorkingClip,
    s: ObjectTrack,
    solid: _Solid,
    masks: dict[int, Bool[np.ndarray, "h w"]],
) -> Estimate:
    image = working.rgb[s.at] if s.moves else working.late if s.at else working.early
    return Estimate(
        name=name,
        label=s.phrase,
        role=s.role,
        noun=s.noun,
        size_m=solid.size_m,
        rgba=_colour_in(image, s.first),
        frames=tuple(int(working.frame_idx[i]) for i in solid.frames),
        T_world_objs=solid.T_world_objs,
        confidences=tuple(round(one, 3) for one in solid.confidences),
        masks=masks,
        source={**_sources(s), "shape": solid.source},
        mass_kg=_mass(s.noun, solid.size_m),
        shape=_shape_of(solid, s.noun),
        mesh=solid.mesh,
        parts=solid.parts or (solid.mesh.convex_hull,),
        symmetry=s.noun.symmetry,
        observed=solid.observed,
    )


def _shape_of(solid: _Solid, noun: Noun) -> Shape:
    """Return the primitive that says all of an object, or `mesh`."""
    if not solid.is_primitive or noun.hollow:
        return "mesh"
    return "mesh" if noun.form == "cylinder" and abs(noun.taper - 1) >= _STRAIGHT else noun.form


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
    solid: _Solid,
    working: WorkingClip,
    camera: Camera,
) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Return a ring's masks without what is seen through it, posed as in the nearest frame that has a pose."""
    posed = working.frame_idx[list(solid.frames)]
    return {
        i: without_hole(
            mask, solid.size_m, bore, solid.T_world_objs[int(np.abs(posed - i).argmin())], camera
        )
        for i, mask in masks.items()
    }


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
