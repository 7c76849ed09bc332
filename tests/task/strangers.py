"""Task folders that are damaged or malicious: each case spoils a good one, which `good_task` makes.

`CASES` maps a name to a function that spoils a folder. Opening any of them must end in a
`V2PError` that names a file or the folder, within seconds. `CODE` holds task codes that only the
trial run can find out, as replacements of `task.py`.
"""

import gzip
import json
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from v2p_data.geometry.camera import Camera, intrinsics, look_at
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples

Spoil = Callable[[Path], None]
CASES: dict[str, Spoil] = {}
TASK, SCENE, CODE_FILE = "task.json", "scene/scene.json", "task.py"
MESH, PART = "scene/meshes/cube.obj", "scene/meshes/part.stl"
ROBOT = "robot/arm.xml"
OUTSIDE = "/etc/passwd"
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


# --- the good one --------------------------------------------------------------------------------------------


def good_scene(folder: Path) -> Scene:
    """Return a scene with a mesh and a plain reference object, its files in `folder`."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    mesh = trimesh.creation.box((0.04, 0.04, 0.05))
    mesh.export(folder / "meshes/cube.obj")
    mesh.export(folder / "meshes/cube.ply")
    mesh.export(folder / "meshes/part.stl")
    cube = SceneObject(
        name="cube",
        label="cube",
        role="manipulated",
        shape="mesh",
        size_m=(0.04, 0.04, 0.05),
        mass_kg=0.12,
        friction=0.8,
        mesh="meshes/cube.obj",
        mesh_ply="meshes/cube.ply",
        parts=("meshes/part.stl",),
        frames=(0, 10),
        confidences=(1.0, 1.0),
        poses_world=((0.0, 0.0, 0.025, *UPRIGHT), (0.0, 0.0, 0.2, *UPRIGHT)),
    )
    plate = replace(
        cube,
        name="plate",
        label="plate",
        role="reference",
        shape="box",
        size_m=(0.1, 0.1, 0.02),
        mesh="",
        mesh_ply="",
        parts=(),
        poses_world=((0.0, 0.2, 0.01, *UPRIGHT),) * 2,
    )
    camera = Camera(
        width_px=64,
        height_px=48,
        K=intrinsics(64, 48, 1.0),
        T_world_cam=look_at(np.array([-0.5, 0.0, 0.5]), np.zeros(3)),
    )
    return Scene(
        title="lift_cube",
        video="clip.mp4",
        description="lifting a cube",
        kind="lift_up",
        objects=(cube, plate),
        camera=camera,
        fps=20.0,
        num_frames=11,
        confidence=1.0,
        folder=folder,
    )


def good_task(folder: Path) -> Path:
    """Write a task folder that can be opened, and return it."""
    place = folder.with_name(folder.name + "_scene")
    scene = good_scene(place)
    scene.save(place)
    code = write_samples(scene, 1)[0]
    TaskBundle(
        title=scene.title,
        description=scene.description,
        kind=scene.kind,
        class_name=class_name(code),
        code=code,
        scene=scene,
        horizon_steps=60,
    ).save(folder)
    shutil.rmtree(place)
    return folder


# --- how folders are spoiled -----------------------------------------------------------------------------------


def case(name: str) -> Callable[[Spoil], Spoil]:
    def keep(spoil: Spoil) -> Spoil:
        assert name not in CASES
        CASES[name] = spoil
        return spoil

    return keep


def changed(file: str, change: Callable[[dict[str, Any]], Any]) -> Spoil:
    """Return what loads a JSON file, changes it (or takes what `change` returns) and writes it again."""

    def spoil(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        made = change(data)
        (folder / file).write_text(json.dumps(data if made is None else made))

    return spoil


def with_value(file: str, path: str, value: Any) -> Spoil:
    """Return what puts a value at a dotted path."""

    def change(data: Any) -> None:
        *way, last = [int(p) if p.isdigit() else p for p in path.split(".")]
        for part in way:
            data = data[part]
        data[last] = value

    return changed(file, change)


def without(file: str, path: str) -> Spoil:
    def change(data: Any) -> None:
        *way, last = [int(p) if p.isdigit() else p for p in path.split(".")]
        for part in way:
            data = data[part]
        del data[last]

    return changed(file, change)


def written(file: str, content: bytes | str) -> Spoil:
    """Return what replaces a file by other content."""

    def spoil(folder: Path) -> None:
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return spoil


def removed(file: str) -> Spoil:
    return lambda folder: (folder / file).unlink()


def linked(file: str, target: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / file).unlink(missing_ok=True)
        (folder / file).symlink_to(target)

    return spoil


def as_folder(file: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / file).unlink()
        (folder / file).mkdir()

    return spoil


def as_pipe(file: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / file).unlink()
        os.mkfifo(folder / file)

    return spoil


def with_bytes(file: str, change: Callable[[bytes], bytes]) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / file).write_bytes(change((folder / file).read_bytes()))

    return spoil


def sparse(file: str, size: int) -> Spoil:
    """Return what makes a file say that it has `size` bytes, without writing them."""

    def spoil(folder: Path) -> None:
        with (folder / file).open("r+b") as stream:
            stream.truncate(size)

    return spoil


# --- any file ------------------------------------------------------------------------------------------------

for _file in (TASK, SCENE, CODE_FILE, MESH):
    CASES[f"{_file} missing"] = removed(_file)
    CASES[f"{_file} links to /etc/passwd"] = linked(_file, OUTSIDE)
    CASES[f"{_file} links to nothing"] = linked(_file, "nothing")
    CASES[f"{_file} links to itself"] = linked(_file, Path(_file).name)
    CASES[f"{_file} is a folder"] = as_folder(_file)
    CASES[f"{_file} is a pipe"] = as_pipe(_file)
    CASES[f"{_file} of 8 GB"] = sparse(_file, 8 * 2**30)
for _file in (TASK, SCENE, CODE_FILE):
    CASES[f"{_file} empty"] = written(_file, "")
    CASES[f"{_file} in bad UTF-8"] = with_bytes(
        _file, lambda data: data[:20] + b"\xff\xfe" + data[20:]
    )
    CASES[f"{_file} of NUL bytes"] = written(_file, b"\x00" * 1000)
    CASES[f"{_file} in UTF-16"] = with_bytes(_file, lambda data: data.decode().encode("utf-16"))
for _file in (TASK, SCENE):
    CASES[f"{_file} cut off"] = with_bytes(_file, lambda data: data[: len(data) // 2])
    CASES[f"{_file} with a BOM"] = with_bytes(_file, lambda data: b"\xef\xbb\xbf" + data)
    CASES[f"{_file} null"] = written(_file, "null")
    CASES[f"{_file} a list"] = written(_file, "[]")
    CASES[f"{_file} a number"] = written(_file, "1" * 5000)
    CASES[f"{_file} nested 100,000 deep"] = written(_file, "[" * 100_000)
    CASES[f"{_file} with objects 100,000 deep"] = written(_file, '{"a":' * 100_000)
    CASES[f"{_file} packed"] = with_bytes(_file, gzip.compress)
    CASES[f"{_file} with an unknown field"] = with_value(_file, "run_at_load", "rm -rf")
    CASES[f"{_file} with an unknown field with control characters"] = with_value(
        _file, "\x1b[2J\n", 1
    )

# --- task.json ------------------------------------------------------------------------------------------------

WRONG: tuple[Any, ...] = (None, True, 7, 1.5, "text", [], ["x"], {"x": 1})
"""One of each type; those that a field takes are left out below."""
TASK_FIELDS: dict[str, tuple[type, ...]] = {
    "title": (str,),
    "description": (str,),
    "kind": (str,),
    "class_name": (str,),
    "horizon_steps": (int,),
    "motion_scale": (int, float),
    "robot": (),
    "audit": (),
}


def _wrong_for(kinds: tuple[type, ...]) -> list[Any]:
    return [v for v in WRONG if type(v) not in kinds]


for _field, _kinds in TASK_FIELDS.items():
    for _value in _wrong_for(_kinds):
        if _field in ("robot", "audit") and not isinstance(_value, dict | list | str):
            continue
        if _field in ("robot", "audit") and not _value:
            continue
        CASES[f"task.{_field} = {_value!r}"] = with_value(TASK, _field, _value)
for _field in ("title", "description", "kind", "class_name"):
    CASES[f"task.{_field} missing"] = without(TASK, _field)
for _name, _value in {
    "with a slash": "../../outside",
    "absolute": "/etc",
    "with a newline": "a\nb",
    "hidden": ".ssh",
    "empty": "",
    "of 100,000 letters": "a" * 100_000,
    "that turns the line": "a\u202eb",
}.items():
    CASES[f"task.title {_name}"] = with_value(TASK, "title", _value)
for _name, _value in {
    "with an escape sequence": "\x1b[31mred",
    "of 100,000 letters": "a" * 100_000,
}.items():
    CASES[f"task.description {_name}"] = with_value(TASK, "description", _value)
for _value in (0, -1, 10**9, 10**400):
    CASES[f"task.horizon_steps = {float(_value) if _value < 1e300 else 'huge'}"] = with_value(
        TASK, "horizon_steps", _value
    )
for _value in (0.0, -1.0, 1e9, float("nan"), float("inf")):
    CASES[f"task.motion_scale = {_value}"] = with_value(TASK, "motion_scale", _value)
CASES["task.kind with a quote"] = with_value(TASK, "kind", 'lift_up"/>')
CASES["task.kind unknown"] = with_value(TASK, "kind", "juggle")
CASES["task.class_name with code"] = with_value(TASK, "class_name", "A()")
CASES["task.audit half"] = with_value(TASK, "audit", {"checks": []})
CASES["task.audit deep"] = with_value(TASK, "audit", {"checks": [[[[[[]]]]]]})

# --- scene.json ------------------------------------------------------------------------------------------------

SCENE_FIELDS: dict[str, tuple[type, ...]] = {
    "title": (str,),
    "video": (str,),
    "description": (str,),
    "kind": (str,),
    "objects": (),
    "camera": (),
    "fps": (int, float),
    "num_frames": (int,),
    "confidence": (),
    "confidences": (),
    "scale_spread": (int, float),
    "table": (),
    "gravity_m_s2": (),
    "schema": (),
    "objects.0.name": (str,),
    "objects.0.label": (str,),
    "objects.0.role": (),
    "objects.0.shape": (),
    "objects.0.size_m": (),
    "objects.0.mass_kg": (int, float),
    "objects.0.friction": (int, float),
    "objects.0.hollow": (bool,),
    "objects.0.mesh": (),
    "objects.0.mesh_ply": (),
    "objects.0.urdf": (),
    "objects.0.mjcf": (),
    "objects.0.mask_track": (),
    "objects.0.symmetry": (),
    "objects.0.rgba": (),
    "objects.0.source": (),
    "objects.0.poses_world": (),
}


for _field, _kinds in SCENE_FIELDS.items():
    for _value in _wrong_for(_kinds)[::3]:
        if _value == [] and _field in ("objects.0.poses_world",):
            continue
        CASES[f"scene.{_field} = {_value!r}"] = with_value(SCENE, _field, _value)
for _field in (
    "title",
    "objects",
    "camera",
    "table",
    "schema",
    "objects.0.name",
    "objects.0.size_m",
):
    CASES[f"scene.{_field} missing"] = without(SCENE, _field)
for _path in ("objects.0.colour", "camera.zoom", "table.colour", "objects.0.first_to_last.speed"):
    CASES[f"scene.{_path} unknown"] = with_value(SCENE, _path, 1)
for _name, _value in {
    "a quote": 'cube"/><include file="/etc/passwd"/><x y="',
    "a slash": "a/b",
    "dots": "..",
    "a newline": "a\nb",
    "a space": "a b",
    "nothing": "",
    "10,000 letters": "a" * 10_000,
    "underscores": "__class__",
    "another object's": "plate",
    "the table's": "table",
    "the robot's": "finger_left",
}.items():
    CASES[f"object named {_name}"] = with_value(SCENE, "objects.0.name", _value)
for _name, _value in {
    "NaN": [float("nan"), 0.04, 0.04],
    "negative": [-0.04, 0.04, 0.04],
    "zero": [0.0, 0.04, 0.04],
    "infinite": [0.04, 0.04, float("inf")],
    "1e300": [1e300, 0.04, 0.04],
    "1e-300": [1e-300, 0.04, 0.04],
    "80 m": [80.0, 60.0, 60.0],
    "two numbers": [0.04, 0.04],
    "four numbers": [0.04, 0.04, 0.04, 0.04],
    "texts": ["0.04", "0.04", "0.04"],
    "a million numbers": [0.04] * 1_000_000,
}.items():
    CASES[f"object size {_name}"] = with_value(SCENE, "objects.0.size_m", _value)
for _field, _values in {
    "objects.0.mass_kg": (0.0, -1.0, 1e300, float("nan"), 1e3),
    "objects.0.friction": (-1.0, 1e300, float("nan")),
    "fps": (0.0, -20.0, float("inf")),
    "num_frames": (-1, 10**30),
    "confidence": (-1.0, 2.0, float("nan")),
    "table.normal": ([0.0, 0.0, 0.0], [float("nan"), 0.0, 1.0]),
    "table.offset_m": (1e300,),
    "gravity_m_s2": ([0.0, 0.0, -1e9],),
    "camera.K": ([[1e300] * 3] * 3, [[1.0] * 3] * 2, []),
    "camera.width_px": (0, -1, 10**9),
    "objects.0.rgba": ([2.0, 0.0, 0.0, 1.0], [0.1, 0.1, 0.1]),
    "objects.0.poses_world": ([[0.0] * 7] * 2, [[0.0] * 6] * 2, [[1e9, 0.0, 0.0, *UPRIGHT]] * 2),
    "objects.0.frames": ([0], [-1, 3]),
    "objects.0.confidences": ([1.0] * 3,),
}.items():
    for _value in _values:
        CASES[f"scene.{_field} = {str(_value)[:40]}"] = with_value(SCENE, _field, _value)
CASES["scene without objects"] = with_value(SCENE, "objects", [])
CASES["scene with an empty object"] = with_value(SCENE, "objects", [{}])
CASES["scene of another version"] = with_value(SCENE, "schema", 1)


@case("scene with 400 objects")
def _many_objects(folder: Path) -> None:
    def change(data: dict[str, Any]) -> None:
        plate = data["objects"][1]
        data["objects"] += [{**plate, "name": f"plate_{k}"} for k in range(400)]

    changed(SCENE, change)(folder)


@case("scene with two objects of one name")
def _doubles(folder: Path) -> None:
    changed(SCENE, lambda data: data["objects"].append(data["objects"][1]))(folder)


@case("scene with more objects than the table holds")
def _crowd(folder: Path) -> None:
    def change(data: dict[str, Any]) -> None:
        plate = {**data["objects"][1], "size_m": [0.44, 0.44, 0.02]}
        data["objects"] += [{**plate, "name": f"plate_{k}"} for k in range(6)]

    changed(SCENE, change)(folder)


@case("scene with 100,000 poses")
def _long(folder: Path) -> None:
    with_value(SCENE, "objects.0.poses_world", [[0.0, 0.0, 0.0, *UPRIGHT]] * 100_000)(folder)


CASES["scene with 1,000 parts"] = with_value(SCENE, "objects.0.parts", ["meshes/part.stl"] * 1000)

# --- meshes ---------------------------------------------------------------------------------------------------

for _name, _value in {
    "absolute": OUTSIDE,
    "absolute OBJ": "/usr/share/thing.obj",
    "above": "../../../thing.obj",
    "above by a detour": "meshes/../../../thing.obj",
    "with a backslash": "..\\thing.obj",
    "of a pickle": "meshes/cube.pkl",
    "of a GLB": "meshes/cube.glb",
    "of a zip": "meshes/cube.zip",
    "with a newline": "meshes/cu\nbe.obj",
    "on the network": "http://localhost/cube.obj",
    "that is missing": "meshes/missing.obj",
}.items():
    CASES[f"mesh path {_name}"] = with_value(SCENE, "objects.0.mesh", _value)
    if _name != "that is missing":  # one part is not looked at: it can only be the hull
        CASES[f"part path {_name}"] = with_value(SCENE, "objects.0.parts", [_value])
for _file in ("mesh_ply", "urdf", "mjcf", "mask_track"):
    CASES[f"{_file} outside"] = with_value(SCENE, f"objects.0.{_file}", OUTSIDE)
NAN_VERTEX = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv nan 0 0.1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"
for _name, _value in {
    "empty": "",
    "of NUL bytes": b"\x00" * 1000,
    "of noise": bytes(np.random.Generator(np.random.PCG64(0)).integers(0, 256, 4000, np.uint8)),
    "with NaN": NAN_VERTEX,
    "with infinity": NAN_VERTEX.replace("nan", "1e999"),
    "of one point": "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n",
    "without volume": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n",
    "with a missing vertex": NAN_VERTEX.replace("nan", "0").replace("f 1 2 3", "f 1 2 9"),
    "with vertex 10**30": NAN_VERTEX.replace("nan", "0").replace("f 1 2 3", "f 1 2 1" + "0" * 30),
    "with words for numbers": "v a b c\nf 1 2 3\n",
    "that is a zip": b"PK\x03\x04" + b"\x00" * 100,
    "packed": gzip.compress(b"v 0 0 0\n" * 100_000),
}.items():
    CASES[f"mesh {_name}"] = written(MESH, _value)
CASES["mesh whose folder is a link"] = lambda folder: _folder_linked(folder / "scene/meshes")
CASES["scene folder is a link"] = lambda folder: _folder_linked(folder / "scene")


def _folder_linked(path: Path) -> None:
    elsewhere = path.parent.with_name(path.parent.name + "_elsewhere")
    shutil.move(path, elsewhere)
    path.symlink_to(elsewhere)


def with_mesh(name: str, content: bytes | str) -> Spoil:
    """Return what makes a file of another kind the mesh."""

    def spoil(folder: Path) -> None:
        written(f"scene/meshes/{name}", content)(folder)
        with_value(SCENE, "objects.0.mesh", f"meshes/{name}")(folder)

    return spoil


CASES["STL that says it has 4 billion triangles"] = with_mesh(
    "a.stl", b"\x00" * 80 + struct.pack("<I", 2**32 - 1) + b"\x00" * 500
)
CASES["STL cut off"] = with_mesh("a.stl", b"\x00" * 80 + struct.pack("<I", 12) + b"\x00" * 100)
CASES["STL in words"] = with_mesh("a.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0")
_PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
_PLY += "property list uchar int vertex_indices\nend_header\n"
CASES["PLY that says it has 10**12 vertices"] = with_mesh(
    "a.ply", _PLY.format("binary_little_endian", 10**12, 10**12)
)
CASES["PLY in words, cut off"] = with_mesh("a.ply", _PLY.format("ascii", 8, 12) + "0 0 0\n")
CASES["PLY without an end of its header"] = with_mesh("a.ply", "ply\nformat ascii 1.0\n")
CASES["PLY of negative counts"] = with_mesh("a.ply", _PLY.format("ascii", -8, -12) + "0 0 0\n")

# --- robots -----------------------------------------------------------------------------------------------------

ROBOT_ENTRY: dict[str, Any] = {
    "path": ROBOT,
    "eef_site": "tcp",
    "eef_offset_m": [0, 0, 0],
    "eef_turn_wxyz": [1, 0, 0, 0],
    "fingers": ["left", "right"],
    "pads": ["pad_left", "pad_right"],
    "home_qpos": [0, 0, 0, 0, 0, 0],
    "base_pos_m": [0, 0, 0],
    "base_yaw_rad": 0,
}
ARM = (
    '<mujoco model="arm"><worldbody><body name="a"><geom size="0.1"/></body></worldbody></mujoco>'
)


def with_robot(content: bytes | str, **entry: Any) -> Spoil:
    """Return what gives the task a robot."""

    def spoil(folder: Path) -> None:
        written(ROBOT, content)(folder)
        with_value(TASK, "robot", {**ROBOT_ENTRY, **entry})(folder)

    return spoil


def _arm(inside: str, before: str = "") -> str:
    return f'<mujoco model="arm">{before}<worldbody>{inside}</worldbody></mujoco>'


BOMB = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10 if k else "x" * 10}">' for k in range(10))
for _name, _value in {
    "of 100,000 bodies": _arm('<body><geom size="0.1"/></body>' * 100_000),
    "of 20 MB": _arm(f"<!--{'x' * 20_000_000}-->"),
    "of bodies 5,000 deep": _arm("<body>" * 5_000 + "</body>" * 5_000),
    "of 100,000 geoms": _arm("<geom size='0.1'/>" * 100_000),
    "that replicates": _arm(
        '<replicate count="3000000"><body><geom size="1"/></body></replicate>'
    ),
    "that is composite": _arm('<composite type="grid" count="3000 3000 1"/>'),
    "with a flexible part": _arm('<flexcomp name="f" type="grid" count="900 900 90"/>'),
    "with an entity bomb": f"<!DOCTYPE m [{BOMB}]><mujoco>&a9;</mujoco>",
    "with an outer entity": f'<!DOCTYPE m [<!ENTITY x SYSTEM "file://{OUTSIDE}">]><mujoco>&x;</mujoco>',
    "with an include of /etc/passwd": _arm("", f'<include file="{OUTSIDE}"/>'),
    "with an include above": _arm("", '<include file="../../outside.xml"/>'),
    "that includes itself": _arm("", '<include file="arm.xml"/>'),
    "that includes a missing file": _arm("", '<include file="missing.xml"/>'),
    "with a mesh outside": _arm("", '<asset><mesh file="/usr/share/thing.stl"/></asset>'),
    "with a mesh above": _arm("", '<asset><mesh file="../scene/../../thing.stl"/></asset>'),
    "with a mesh folder outside": _arm(
        "", '<compiler meshdir="/usr"/><asset><mesh file="a.stl"/></asset>'
    ),
    "with a picture outside": _arm("", f'<asset><texture type="2d" file="{OUTSIDE}"/></asset>'),
    "with a height field outside": _arm("", f'<asset><hfield name="h" file="{OUTSIDE}"/></asset>'),
    "with a missing mesh": _arm("", '<asset><mesh file="missing.stl"/></asset>'),
    "with a plugin": _arm("", '<extension><plugin plugin="mujoco.sdf.bolt"/></extension>'),
    "with another model": _arm("", '<asset><model name="m" file="arm.xml"/></asset>'),
    "that reserves a terabyte": _arm("", '<size memory="1T"/>'),
    "that reserves 10**12 numbers": _arm("", '<size nuserdata="1000000000000"/>'),
    "with a picture of 10**10 pixels": _arm(
        "",
        '<asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>',
    ),
    "with a height field of 10**12 cells": _arm(
        "", '<asset><hfield name="h" nrow="1000000" ncol="1000000" size="1 1 1 1"/></asset>'
    ),
    "with a mesh made up": _arm(
        "", '<asset><mesh name="m" builtin="sphere" params="12"/></asset>'
    ),
    "that is a URDF": '<robot name="r"><link name="l"/></robot>',
    "that is no XML": "arm",
    "empty": "",
    "cut off": ARM[:50],
    "in bad UTF-8": b'<mujoco model="\xff\xfe"/>',
    "of NUL bytes": b"\x00" * 100,
    "without an arm": ARM,
    "with NaN": _arm('<body><geom size="nan"/></body>'),
    "of no size": _arm('<body><geom size="-1"/></body>'),
}.items():
    CASES[f"robot {_name}"] = with_robot(_value)
for _name, _entry in {
    "outside": {"path": OUTSIDE},
    "above": {"path": "robot/../../arm.xml"},
    "in the scene": {"path": "scene/scene.json"},
    "missing": {"path": "robot/other.xml"},
    "with a NaN": {"base_yaw_rad": float("nan")},
    "with a million joints": {"home_qpos": [0.0] * 1_000_000},
    "with another field": {"run": "x"},
    "far away": {"base_pos_m": [1e9, 0, 0]},
}.items():
    CASES[f"robot entry {_name}"] = with_robot(ARM, **_entry)


@case("robot links to /etc/passwd")
def _robot_link(folder: Path) -> None:
    with_robot(ARM)(folder)
    linked(ROBOT, OUTSIDE)(folder)


@case("robot's picture of a billion pixels")
def _robot_picture_bomb(folder: Path) -> None:
    side = (30_000).to_bytes(4)
    head = b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4) + b"IHDR" + side + side + bytes(9)
    (folder / "robot").mkdir(exist_ok=True)
    (folder / "robot/a.png").write_bytes(head)
    with_robot(_arm("", '<asset><texture name="t" type="2d" file="a.png"/></asset>'))(folder)


@case("robot's mesh links outside")
def _robot_mesh_link(folder: Path) -> None:
    with_robot(_arm("", '<asset><mesh file="a.stl"/></asset>'))(folder)
    outside = folder.with_name(f"{folder.name}_outside.stl")
    shutil.copyfile(folder / PART, outside)
    linked("robot/a.stl", str(outside))(folder)


@case("robot that includes 150 bodies twice")
def _robot_twice(folder: Path) -> None:
    part = f"<mujocoinclude>{'<body><geom size="1"/></body>' * 150}</mujocoinclude>"
    written("robot/a.xml", part)(folder)
    written("robot/b.xml", part)(folder)
    with_robot(_arm('<include file="a.xml"/><include file="b.xml"/>'))(folder)


@case("robot that includes a file that links outside")
def _robot_include_link(folder: Path) -> None:
    with_robot(_arm('<include file="a.xml"/>'))(folder)
    linked("robot/a.xml", OUTSIDE)(folder)


# --- task.py ----------------------------------------------------------------------------------------------------

for _name, _value in {
    "that imports os": "import os\nos.system('touch /tmp/x')\n",
    "that opens a file": "class T(Task):\n    x = open('/etc/passwd').read()\n",
    "of one name": "x",
    "of 10,000 brackets": "(" * 10_000,
    "of 10,000 minus signs": "x = " + "-" * 10_000 + "1",
    "of 100,000 lines": "x = 1\n" * 30_000,
    "without a class": "import torch\n",
    "that does not parse": "class T(Task:\n",
    "with a huge number": "x = 10 ** 10 ** 10\n",
    "of HTML": "<html></html>",
}.items():
    CASES[f"code {_name}"] = written(CODE_FILE, _value)

_CODE = """
import torch
from factory.tasks.task import Task
scene_info = {{}}

def busy(x):
    for i in range(1000):
        for j in range(1000):
            x = x + torch.sin(x)
    return x

class T(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
        {init}
    def reset_objects_states(self, env_ids):
        {reset}
        return self.envs.sample_object_poses(env_ids)
    def compute_success(self, states):
        {success}
        return states["cube_pos"][:, 2] > states["cube_start_pos"][:, 2] + 0.1
    def compute_observation_key(self, states):
        {keys}
        return ["base_observation"]
    def get_observation_space(self):
        {space}
        return 90
    def compute_reward(self, actions, states):
        return reward_function(actions, states)

def reward_function(actions, states):
    {reward}
    height = states["cube_pos"][:, 2] - states["cube_start_pos"][:, 2]
    return height + 1, {{"height": height}}
"""
METHODS = ("init", "reset", "success", "keys", "space", "reward")


def code_with(**lines: str) -> str:
    """Return task code with a line of its own in some of its methods."""
    return _CODE.format(**{m: "pass" for m in METHODS} | lines)


CODE: dict[str, str] = {
    **{f"loops in {m}": code_with(**{m: "busy(torch.zeros(1000))"}) for m in METHODS},
    **{
        f"asks for memory in {m}": code_with(**{m: "torch.zeros(1000000, 100000)"})
        for m in METHODS
    },
    **{f"raises in {m}": code_with(**{m: "torch.zeros(2)[5]"}) for m in METHODS},
    "success of numbers": code_with(success='return states["cube_pos"][:, 2]'),
    "success of one": code_with(success="return torch.zeros(1) > 1"),
    "success of nothing": code_with(success="return None"),
    "reward of nothing": code_with(reward="return None"),
    "reward of NaN": code_with(
        reward='return torch.log(states["eef_pos"][:, 0] * 0 - 1), {"a": states["eef_pos"][:, 0]}'
    ),
    "unknown key": code_with(keys='return ["nothing"]'),
    "other length": code_with(space="return 7"),
    "poses of nobody": code_with(reset="return {}"),
    "writes into states": code_with(success='states["cube_pos"].mul_(2)'),
}
