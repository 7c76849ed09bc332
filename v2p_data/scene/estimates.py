"""Tracks, poses and meshes become one `Estimate` per object: named, in metres, in the scene frame."""

import keyword
import re
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, UInt8

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
from v2p_data.scene.fitting.metric import clip_camera
from v2p_data.scene.fitting.shape_fit import three
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.meshes import MeshedObject
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.schema import Shape
from v2p_data.scene.shapes.by_worker import mesh_by_worker
from v2p_data.video.clip import Clip

_OVER = np.diag([1.0, -1.0, -1.0, 1.0])
"""Half a turn about x: upside down."""
_STRAIGHT = 0.06
"""Tapers by less than this share are simulated as cylinders."""
_LEAST_QUALITY = 0.4
"""Quality, 0 to 1, of a mask that is kept in an object's mask track."""


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
        thing = _outlined(name, grounded.working, s, placed, made)
        if s.known_m:  # the user's word on the size outranks the outline's
            size = three(placement.height_m * np.array(placed.first.size))
            thing = _stretched(thing, size, is_primitive=_is_primitive(s, made))
        if s.noun.hollow and s.role in ("manipulated", "cover") and KINDS[kind].has_cover:
            thing = _mouth_down(thing)
        if cfg.mesh.worker:
            thing = _meshed_by_worker(clip, grounded.working, s, thing, cfg)
        if cfg.pose.worker and s.moves:
            camera = clip_camera(clip, placement)
            thing = _posed_by_worker(clip, grounded.working, s, thing, camera, cfg)
        masks = _mask_track(grounded.working, s, placed)
        out.append(replace(thing, masks=masks, mass_kg=_mass(s.noun, thing.size_m)))
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


def _outlined(
    name: str, working: WorkingClip, s: ObjectTrack, placed: PlacedObject, made: MeshedObject
) -> Estimate:
    """Return an object as its outlines show it, without masks yet."""
    image = working.rgb[s.at] if s.moves else working.late if s.at else working.early
    shape = made.shape
    return Estimate(
        name=name,
        label=s.phrase,
        role=s.role,
        noun=s.noun,
        size_m=shape.size_m,
        rgba=_colour_in(image, s.first),
        frames=tuple(int(working.frame_idx[i]) for i in placed.frames),
        T_world_objs=made.T_world_objs,
        confidences=tuple(round(one, 3) for one in placed.confidences),
        masks={},
        source={**_sources(s), "shape": shape.reason},
        mass_kg=s.noun.mass_kg,
        shape=_simulated_as(s.noun) if _is_primitive(s, made) else "mesh",
        mesh=shape.mesh,
        parts=shape.parts,
        symmetry=s.noun.symmetry,
        observed=placed.observed,
    )


def _is_primitive(s: ObjectTrack, made: MeshedObject) -> bool:
    """Return whether the mesh is the noun's primitive of its size."""
    return made.shape.kind == "primitive"


def _simulated_as(noun: Noun) -> Shape:
    """Return what a noun's primitive is in the simulator: `mesh` for what is hollow or tapers."""
    if noun.hollow or (noun.form == "cylinder" and abs(noun.taper - 1) >= _STRAIGHT):
        return "mesh"
    return noun.form


def _stretched(
    thing: Estimate, size_m: tuple[float, float, float], *, is_primitive: bool
) -> Estimate:
    """Return the object with its mesh and parts brought to these extents."""
    noun = thing.noun
    if is_primitive:
        mesh = mesh_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper)
        parts = parts_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper)
        return replace(thing, size_m=size_m, mesh=mesh, parts=parts)
    T = np.diag([*(np.array(size_m) / thing.mesh.extents), 1.0])
    mesh, *parts = (one.copy().apply_transform(T) for one in (thing.mesh, *thing.parts))
    return replace(thing, size_m=size_m, mesh=mesh, parts=tuple(parts))


def _mouth_down(thing: Estimate) -> Estimate:
    """Return a cover in a frame of its own that has its mouth below, as it lies: so the simulator builds it."""
    mesh, *parts = (one.copy().apply_transform(_OVER) for one in (thing.mesh, *thing.parts))
    poses = thing.T_world_objs @ _OVER
    return replace(thing, shape="mesh", mesh=mesh, parts=tuple(parts), T_world_objs=poses)


def _meshed_by_worker(
    clip: Clip, working: WorkingClip, s: ObjectTrack, thing: Estimate, cfg: SceneConfig
) -> Estimate:
    mesh, repair = mesh_by_worker(clip, working, s, thing.size_m, cfg.mesh)
    source = "made by the mesh worker from one picture, scaled to the outline"
    if repair != "none":
        source += f"; its mesh was not closed and was mended ({repair})"
    return replace(
        thing,
        size_m=three(mesh.extents),
        shape="mesh",
        mesh=mesh,
        parts=(mesh.convex_hull,),
        source={**thing.source, "shape": source},
    )


def _posed_by_worker(
    clip: Clip,
    working: WorkingClip,
    s: ObjectTrack,
    thing: Estimate,
    camera: Camera,
    cfg: SceneConfig,
) -> Estimate:
    poses, sure = poses_by_worker(clip, working, s.masks, thing.mesh, camera, cfg.pose)
    return replace(
        thing,
        T_world_objs=poses,
        frames=tuple(working.frame_idx.tolist()),
        confidences=tuple(round(float(one), 3) for one in sure),
        observed=("full",) * len(poses),
    )


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
