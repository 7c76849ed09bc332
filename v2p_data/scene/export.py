"""A reconstruction becomes a folder: `scene.json`, meshes, URDF per object, one MJCF of all, and the overlay.

The MJCF shows the scene as the video did, without a robot, with the keyframes `first` and `last`; the simulator builds
its own worlds from `scene.json`.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from v2p_data.geometry.camera import mujoco_xyaxes
from v2p_data.geometry.mesh import mesh_for, write_obj
from v2p_data.geometry.pose import pose_from_transform
from v2p_data.scene.overlay import write_overlay
from v2p_data.scene.reconstruct import Estimate, Reconstruction
from v2p_data.scene.scene import Scene, SceneObject, Shape

MJCF_FILE = "scene.xml"


def write_scene(reconstruction: Reconstruction, folder: Path) -> Scene:
    """Write the scene with all its files into `folder` and return it."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "urdf").mkdir(exist_ok=True)
    clip = reconstruction.clip
    objects = tuple(_write_object(thing, folder) for thing in reconstruction.objects)
    scene = Scene(
        title=clip.item,
        video=clip.path.name,
        description=clip.caption,
        kind=reconstruction.kind,
        objects=objects,
        camera=reconstruction.camera,
        fps=float(clip.fps),
        num_frames=len(clip.frames),
        confidence=round(reconstruction.confidence, 4),
        warnings=(*clip.warnings, *reconstruction.warnings),
        folder=folder,
    )
    (folder / MJCF_FILE).write_text(_xml(mjcf_of(scene)))
    write_overlay(reconstruction, folder)
    scene.save(folder)
    return scene


def mjcf_of(scene: Scene) -> ET.Element:
    """Return the scene as MJCF: a table top at z = 0, the objects free on it, the video's camera."""
    root = ET.Element("mujoco", model=scene.title)
    ET.SubElement(root, "compiler", meshdir="meshes", angle="radian")
    camera = scene.camera
    ET.SubElement(
        ET.SubElement(root, "visual"),
        "global",
        offwidth=str(camera.width_px),
        offheight=str(camera.height_px),
    )
    asset, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 0 2", dir="0 0 -1")
    table = {"name": "table", "type": "plane", "size": "1 1 0.1", "rgba": "0.8 0.75 0.7 1"}
    ET.SubElement(world, "geom", table)
    ET.SubElement(
        world,
        "camera",
        name="video",
        pos=_numbers(camera.T_world_cam[:3, 3]),
        xyaxes=_numbers(mujoco_xyaxes(camera.T_world_cam)),
        fovy=f"{np.degrees(2 * np.arctan(camera.height_px / 2 / camera.K[1, 1])):.4f}",
    )
    for thing in scene.objects:
        pose = thing.first_pose
        body = ET.SubElement(
            world, "body", name=thing.name, pos=_numbers(pose[:3]), quat=_numbers(pose[3:])
        )
        ET.SubElement(body, "freejoint", name=f"{thing.name}_free")
        look = {
            "rgba": _numbers(thing.rgba),
            "mass": f"{thing.mass_kg:.6g}",
            "friction": f"{thing.friction:.4g} 0.005 0.0001",
        }
        half = np.array(thing.size_m) / 2
        if thing.shape == "box":
            look |= {"type": "box", "size": _numbers(half)}
        elif thing.shape == "sphere":
            look |= {"type": "sphere", "size": _numbers(half[:1])}
        elif thing.shape == "cylinder":
            look |= {"type": "cylinder", "size": _numbers(half[[0, 2]])}
        else:
            ET.SubElement(
                asset, "mesh", name=thing.name, file=Path(thing.mesh).name, inertia="shell"
            )
            look |= {"type": "mesh", "mesh": thing.name}
        ET.SubElement(body, "geom", {"name": thing.name, **look})
    keyframes = ET.SubElement(root, "keyframe")
    for name in ("first", "last"):
        poses = [o.first_pose if name == "first" else o.last_pose for o in scene.objects]
        ET.SubElement(keyframes, "key", name=name, qpos=_numbers(np.concatenate(poses)))
    return root


def urdf_of(thing: SceneObject) -> ET.Element:
    """Return one object as URDF; the `mujoco` element lets MuJoCo find the mesh in its own folder."""
    robot = ET.Element("robot", name=thing.name)
    ET.SubElement(
        ET.SubElement(robot, "mujoco"),
        "compiler",
        meshdir="../meshes",
        strippath="true",
        discardvisual="false",
        balanceinertia="true",
    )
    link = ET.SubElement(robot, "link", name=thing.name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=f"{thing.mass_kg:.6g}")
    a, b, c = thing.size_m
    moments = thing.mass_kg / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    names = ("ixx", "iyy", "izz")
    values = {n: f"{max(m, 1e-9):.6g}" for n, m in zip(names, moments, strict=True)}
    ET.SubElement(inertial, "inertia", {"ixy": "0", "ixz": "0", "iyz": "0", **values})
    for part in ("visual", "collision"):
        element = ET.SubElement(link, part)
        geometry = ET.SubElement(element, "geometry")
        ET.SubElement(geometry, "mesh", filename=f"../{thing.mesh}")
        if part == "visual":
            material = ET.SubElement(element, "material", name=f"{thing.name}_colour")
            ET.SubElement(material, "color", rgba=_numbers(thing.rgba))
    return robot


def _write_object(thing: Estimate, folder: Path) -> SceneObject:
    noun = thing.noun
    mesh_file, urdf_file = f"meshes/{thing.name}.obj", f"urdf/{thing.name}.urdf"
    mesh = mesh_for(noun.form, thing.size_m, hollow=noun.hollow, taper=noun.taper)
    write_obj(mesh, folder / mesh_file)
    primitive = not noun.hollow and (noun.form != "cylinder" or abs(noun.taper - 1) < 0.06)
    shape: Shape = noun.form if primitive else "mesh"
    written = SceneObject(
        name=thing.name,
        label=thing.label,
        role=thing.role,
        shape=shape,
        size_m=thing.size_m,
        mass_kg=thing.mass_kg,
        friction=noun.friction,
        hollow=noun.hollow,
        mesh=mesh_file,
        urdf=urdf_file,
        rgba=thing.rgba,
        source=thing.source,
        frames=thing.frames,
        poses_world=tuple(
            tuple(round(float(v), 6) for v in pose_from_transform(T)) for T in thing.T_world_objs
        ),
        confidences=thing.confidences,
    )
    (folder / urdf_file).write_text(_xml(urdf_of(written)))
    return written


def _xml(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _numbers(values) -> str:  # noqa: ANN001
    return " ".join(f"{float(v):.6g}" for v in values)
