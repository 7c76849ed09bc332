"""A reconstruction becomes a folder: `scene.json`, meshes with their convex parts, masks, and models for simulators.

`meshes/` holds per object OBJ, PLY and convex parts, `masks/` its mask track, `urdf/` and `mjcf/`
the object alone, `scene.xml` all of them in MJCF: the scene as the video showed it, without a
robot, with the keyframes `first` and `last`. The simulator builds its own worlds from
`scene.json`.
"""

import shutil
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Float

from v2p_data.geometry.camera import mujoco_xyaxes, poses_over_table
from v2p_data.geometry.mesh import mass_properties, mesh_for, write_obj, write_ply
from v2p_data.geometry.pose import pose_from_transform
from v2p_data.scene.data_types import Estimate, Reconstruction
from v2p_data.scene.files import own_file
from v2p_data.scene.overlay import write_overlay
from v2p_data.scene.scene import (
    Scene,
    SceneObject,
    StageConfidence,
    friction_attribute,
    write_masks,
)
from v2p_data.scene.schema import MAX_FILE_BYTES

MJCF_FILE = "scene.xml"


@dataclass(frozen=True, kw_only=True)
class _Body:
    """An object with what its models need beside `scene.json`."""

    thing: SceneObject
    com: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    """About the centre of mass [kg m2]."""


def write_scene(reconstruction: Reconstruction, folder: Path) -> Scene:
    """Write the scene with all its files into `folder` and return it."""
    for name in ("meshes", "urdf", "mjcf", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    clip = reconstruction.clip
    bodies = [_write_object(thing, folder) for thing in reconstruction.objects]
    scene = Scene(
        title=clip.item,
        video=clip.path.name,
        description=clip.caption,
        kind=reconstruction.kind,
        objects=tuple(body.thing for body in bodies),
        camera=reconstruction.camera,
        fps=float(clip.fps),
        num_frames=len(clip.frames),
        confidence=round(reconstruction.confidence, 4),
        confidences={
            stage: StageConfidence(value=round(value, 4), reason=reason)
            for stage, (value, reason) in reconstruction.stages.items()
        },
        scale_spread=round(reconstruction.scale_spread, 4),
        T_world_cams=None
        if clip.to_filmed is None
        else poses_over_table(reconstruction.camera, clip.to_filmed),
        crop_px=None if clip.crop is None else clip.crop.in_file(clip.source_size_px),
        warnings=(*clip.warnings, *reconstruction.warnings),
        folder=folder,
    )
    (folder / MJCF_FILE).write_text(_xml(_scene_mjcf(scene, bodies)), encoding="utf-8")
    write_overlay(reconstruction, folder)
    for name, frame in (("first", clip.frames[0]), ("last", clip.frames[-1])):
        cv2.imwrite(str(folder / f"frame_{name}.jpg"), frame[..., ::-1])
    scene.save(folder)
    return scene


def _scene_mjcf(scene: Scene, bodies: list[_Body]) -> ET.Element:
    """Return the scene as MJCF: a table top at z = 0, the objects free on it, the video's camera."""
    root = ET.Element("mujoco", model=scene.title)
    ET.SubElement(root, "compiler", meshdir="meshes", angle="radian")
    ET.SubElement(root, "option", gravity=_numbers(scene.gravity_m_s2))
    camera = scene.camera
    ET.SubElement(
        ET.SubElement(root, "visual"),
        "global",
        offwidth=str(camera.width_px),
        offheight=str(camera.height_px),
    )
    asset, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 0 2", dir="0 0 -1")
    ET.SubElement(
        world,
        "geom",
        name="table",
        type="plane",
        size="1 1 0.1",
        friction=friction_attribute(),
        rgba="0.8 0.75 0.7 1",
    )
    ET.SubElement(
        world,
        "camera",
        name="video",
        pos=_numbers(camera.T_world_cam[:3, 3]),
        xyaxes=_numbers(mujoco_xyaxes(camera.T_world_cam)),
        fovy=f"{np.degrees(2 * np.arctan(camera.height_px / 2 / camera.K[1, 1])):.4f}",
    )
    for body in bodies:
        _add_body(world, asset, body, body.thing.first_pose)
    keyframes = ET.SubElement(root, "keyframe")
    for name in ("first", "last"):
        poses = [o.first_pose if name == "first" else o.last_pose for o in scene.objects]
        ET.SubElement(keyframes, "key", name=name, qpos=_numbers(np.concatenate(poses)))
    return root


def _object_mjcf(body: _Body) -> ET.Element:
    root = ET.Element("mujoco", model=body.thing.name)
    ET.SubElement(root, "compiler", meshdir="../meshes", angle="radian")
    asset, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    _add_body(world, asset, body, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    return root


def _add_body(
    world: ET.Element, asset: ET.Element, body: _Body, pose: Float[np.ndarray, "7"]
) -> None:
    """Add a free body: a primitive is one geom; else the mesh is seen and its convex parts collide."""
    thing, i = body.thing, body.inertia
    element = ET.SubElement(
        world, "body", name=thing.name, pos=_numbers(pose[:3]), quat=_numbers(pose[3:])
    )
    ET.SubElement(element, "freejoint", name=f"{thing.name}_free")
    ET.SubElement(
        element,
        "inertial",
        pos=_numbers(body.com),
        mass=f"{thing.mass_kg:.6g}",
        fullinertia=_numbers([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]),
    )
    look = {"rgba": _numbers(thing.rgba)}
    touch = {"friction": friction_attribute(thing.friction)}
    if thing.shape != "mesh":
        axes = {"box": [0, 1, 2], "sphere": [0], "cylinder": [0, 2]}[thing.shape]
        form = {"type": thing.shape, "size": _numbers(np.array(thing.size_m)[axes] / 2)}
        ET.SubElement(element, "geom", {"name": thing.name, **form, **look, **touch})
        return
    for file in dict.fromkeys((thing.mesh, *thing.parts)):
        # The body's own inertia counts; MuJoCo refuses thin solids unless it takes them for shells.
        ET.SubElement(asset, "mesh", name=Path(file).stem, file=Path(file).name, inertia="shell")
    seen = {"type": "mesh", "mesh": Path(thing.mesh).stem, "contype": "0", "conaffinity": "0"}
    ET.SubElement(element, "geom", {"name": thing.name, "group": "2", **seen, **look})
    for k, file in enumerate(thing.parts):
        form = {"type": "mesh", "mesh": Path(file).stem, "group": "3"}
        ET.SubElement(element, "geom", {"name": f"{thing.name}_{k}", **form, **look, **touch})


def _urdf(body: _Body) -> ET.Element:
    """Return one object as URDF; the `mujoco` element lets MuJoCo find the mesh in its own folder."""
    thing = body.thing
    robot = ET.Element("robot", name=thing.name)
    ET.SubElement(
        ET.SubElement(robot, "mujoco"),
        "compiler",
        meshdir="../meshes",
        strippath="true",
        discardvisual="false",
        fusestatic="false",
    )
    link = ET.SubElement(robot, "link", name=thing.name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_numbers(body.com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=f"{thing.mass_kg:.6g}")
    moments = {
        f"i{'xyz'[a]}{'xyz'[b]}": f"{body.inertia[a, b]:.6g}"
        for a in range(3)
        for b in range(a, 3)
    }
    ET.SubElement(inertial, "inertia", moments)
    visual = _urdf_mesh(link, "visual", thing.mesh)
    material = ET.SubElement(visual, "material", name=f"{thing.name}_colour")
    ET.SubElement(material, "color", rgba=_numbers(thing.rgba))
    for file in thing.parts:
        _urdf_mesh(link, "collision", file)
    return robot


def _urdf_mesh(link: ET.Element, use: str, file: str) -> ET.Element:
    element = ET.SubElement(link, use)
    ET.SubElement(ET.SubElement(element, "geometry"), "mesh", filename=f"../{file}")
    return element


def _write_object(thing: Estimate, folder: Path) -> _Body:
    noun, name = thing.noun, thing.name
    written = SceneObject(
        name=name,
        label=thing.label,
        role=thing.role,
        shape=thing.shape,
        size_m=thing.size_m,
        mass_kg=thing.mass_kg,
        friction=noun.friction,
        hollow=noun.hollow,
        mesh=f"meshes/{name}.obj",
        mesh_ply=f"meshes/{name}.ply",
        urdf=f"urdf/{name}.urdf",
        mjcf=f"mjcf/{name}.xml",
        mask_track=f"masks/{name}.npz",
        symmetry=thing.symmetry,
        rgba=thing.rgba,
        source=thing.source,
        frames=thing.frames,
        poses_world=tuple(
            tuple(round(float(v), 6) for v in pose_from_transform(T)) for T in thing.T_world_objs
        ),
        confidences=thing.confidences,
        observed=thing.observed or ("full",) * len(thing.frames),
    )
    write_masks(folder / written.mask_track, thing.masks)
    return _write_models(written, thing.mesh, thing.parts, folder)


def _write_models(
    thing: SceneObject, mesh: trimesh.Trimesh, parts: tuple[trimesh.Trimesh, ...], folder: Path
) -> _Body:
    """Write an object's mesh, convex parts, URDF and MJCF where it says that they are."""
    thing = replace(thing, parts=_write_parts(mesh, parts, thing.name, folder))
    com, inertia = mass_properties(mesh, thing.mass_kg)
    body = _Body(thing=thing, com=com, inertia=inertia)
    write_obj(mesh, folder / thing.mesh)
    write_ply(mesh, folder / thing.mesh_ply)
    (folder / thing.urdf).write_text(_xml(_urdf(body)), encoding="utf-8")
    (folder / thing.mjcf).write_text(_xml(_object_mjcf(body)), encoding="utf-8")
    return body


def write_relative(
    scene: Scene,
    title: str,
    thing: SceneObject,
    mesh: trimesh.Trimesh,
    parts: tuple[trimesh.Trimesh, ...],
    folder: Path,
) -> Scene:
    """Write a scene with another manipulated object, which no video shows: without masks and pictures.

    Args:
        scene: where the others come from.
        title: of the new scene.
        thing: what is manipulated instead.
        mesh: of it.
        parts: its convex solids.
        folder: that exists and is empty.
    """
    for name in ("meshes", "urdf", "mjcf"):
        (folder / name).mkdir()
    name = thing.name
    files = {"mesh": f"meshes/{name}.obj", "mesh_ply": f"meshes/{name}.ply"}
    models = {"urdf": f"urdf/{name}.urdf", "mjcf": f"mjcf/{name}.xml"}
    thing = replace(thing, **files, **models, mask_track="")
    bodies = [_write_models(thing, mesh, parts, folder)]
    for other in scene.others:
        for file in {other.mesh, other.mesh_ply, other.urdf, other.mjcf, *other.parts} - {""}:
            (folder / file).parent.mkdir(exist_ok=True)
            shutil.copy(own_file(scene.folder, file, MAX_FILE_BYTES), folder / file)
        solid = (
            trimesh.load_mesh(folder / other.mesh)
            if other.mesh
            else mesh_for(other.shape, other.size_m, hollow=other.hollow)
        )
        com, inertia = mass_properties(solid, other.mass_kg)
        bodies.append(_Body(thing=replace(other, mask_track=""), com=com, inertia=inertia))
    made = replace(
        scene,
        title=title,
        family=scene.family or scene.title,
        video="",
        objects=tuple(body.thing for body in bodies),
        folder=folder,
    )
    (folder / MJCF_FILE).write_text(_xml(_scene_mjcf(made, bodies)), encoding="utf-8")
    made.save(folder)
    return made


def _write_parts(
    mesh: trimesh.Trimesh, parts: tuple[trimesh.Trimesh, ...], name: str, folder: Path
) -> tuple[str, ...]:
    """Write the parts and return their files; the only part of a convex mesh is the mesh."""
    if len(parts) == 1 and np.isclose(parts[0].volume, mesh.volume, rtol=1e-4):
        return (f"meshes/{name}.obj",)
    files = tuple(f"meshes/{name}_part_{k:02d}.obj" for k in range(len(parts)))
    for part, file in zip(parts, files, strict=True):
        write_obj(part, folder / file)
    return files


def _xml(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _numbers(values) -> str:  # noqa: ANN001
    return " ".join(f"{float(v):.6g}" for v in values)
