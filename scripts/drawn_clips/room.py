"""The room of a drawn clip as MuJoCo geometry: table, walls, clutter, a person's trunk, lamps, things, hand and arm."""

# mujoco's classes come from a compiled module that declares none of them.
# pyright: reportAttributeAccessIssue=false

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from drawn_clips.hand import Hand, Pose, skin_of
from drawn_clips.props import Prop, shape_of
from drawn_clips.shapes import Shape, patch_uv, revolved
from drawn_clips.textures import (
    Rgb,
    any_colour,
    colour_called,
    pixels_of,
    printed,
    smooth_noise,
    surface,
)

LABEL_BACKGROUND, LABEL_HAND, LABEL_THING, LABEL_TABLE = 0, 1, 2, 255
"""Labels of masks; things count on from the manipulated one."""
SLEEVE_M = 0.75


@dataclass(frozen=True, kw_only=True)
class Room:
    """What surrounds the things."""

    table: str = "wood"
    table_base: Rgb = (0.64, 0.46, 0.30)
    table_accent: Rgb = (0.9, 0.9, 0.9)
    table_repeat: float = 1.0
    table_far_m: float = 0.62
    table_side_m: float = 0.9
    yaw_rad: float = 0.0
    """How the table and the room are turned against the camera's heading."""
    specular: float = 0.05
    wall: str = "plain"
    wall_base: Rgb = (0.72, 0.73, 0.70)
    wall_accent: Rgb = (0.5, 0.5, 0.5)
    wall_far_m: float = 1.2
    """From the table's far edge to the wall."""
    floor: Rgb = (0.36, 0.34, 0.33)
    clutter: int = 4
    """Boxes and blobs behind the table, and things on the wall."""
    person: bool = False
    """A trunk behind the table's far edge."""
    shirt: Rgb = (0.3, 0.3, 0.4)
    lamp_azimuth_rad: float = 2.2
    lamp_elevation_rad: float = 1.0
    lamp: Rgb = (0.6, 0.58, 0.55)
    second_lamp: Rgb = (0.16, 0.17, 0.19)
    second_azimuth_rad: float = 4.0
    ambient: float = 0.34


def random_room(rng: np.random.Generator, person: bool) -> Room:
    """Return a room with everything drawn at random."""
    kinds = (
        "wood",
        "planks",
        "plain",
        "plain",
        "cloth",
        "marble",
        "gingham",
        "dots",
        "stripes",
        "flowers",
    )
    table = str(rng.choice(kinds, p=(0.22, 0.12, 0.16, 0.10, 0.12, 0.10, 0.05, 0.04, 0.05, 0.04)))
    if table in ("wood", "planks"):
        tone = rng.uniform(0.35, 1.35)
        base = np.array((0.62, 0.45, 0.30)) * tone + rng.uniform(-0.06, 0.06, 3)
    elif table in ("plain", "marble") or rng.random() < 0.5:
        base = np.array(
            colour_called(str(rng.choice(["white", "grey", "black", "white", "brown"])), rng)
        )
        base = base * (1, 1 - rng.uniform(0, 0.05), 1 - rng.uniform(0, 0.15))
    else:
        base = np.array(any_colour(rng))
    warm = rng.uniform(-0.12, 0.14)
    light = rng.uniform(0.35, 0.8)
    lamp = (light * (1 + warm), light, light * (1 - warm))
    fill = rng.uniform(0.02, 0.3)
    return Room(
        table=table,
        table_base=_rgb(base),
        table_accent=any_colour(rng) if rng.random() < 0.6 else (0.92, 0.91, 0.88),
        table_repeat=float(rng.uniform(0.8, 2.5)),
        table_far_m=float(rng.uniform(0.35, 1.3)),
        table_side_m=float(rng.uniform(0.55, 1.4)),
        yaw_rad=float(rng.normal(0, 0.15)),
        specular=float(rng.choice([0.0, 0.05, 0.2, 0.4])),
        wall=str(rng.choice(["plain", "plain", "cloth", "wood", "stripes", "flowers", "planks"])),
        wall_base=_rgb(rng.uniform(0.3, 0.95) + rng.uniform(-0.12, 0.12, 3)),
        wall_accent=any_colour(rng),
        wall_far_m=float(rng.uniform(0.15, 2.0)),
        floor=_rgb(rng.uniform(0.1, 0.7) + rng.uniform(-0.08, 0.08, 3)),
        clutter=int(rng.integers(0, 9)),
        person=person,
        shirt=any_colour(rng),
        lamp_azimuth_rad=float(rng.uniform(0, 6.28)),
        lamp_elevation_rad=float(rng.uniform(0.8, 1.45)),
        lamp=lamp,
        second_lamp=(fill, fill, fill * float(rng.uniform(0.8, 1.2))),
        second_azimuth_rad=float(rng.uniform(0, 6.28)),
        ambient=float(rng.uniform(0.3, 0.5)),
    )


def build(
    props: list[Prop],
    room: Room,
    hand: Hand,
    gestures: tuple[Pose, ...],
    fovy_rad: float,
    size_px: tuple[int, int],
    rng: np.random.Generator,
) -> mujoco.MjModel:
    """Return the model. Mocap bodies: `thing<i>`, `hand`, `arm`, `trunk`, `camera`; camera `view`; geoms `hand<k>`."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = size_px
    visual.quality.shadowsize, visual.quality.offsamples = 1024, 2
    visual.headlight.ambient = [room.ambient] * 3
    visual.headlight.diffuse = [0.08] * 3
    visual.headlight.specular = [0.0] * 3
    # shadows are sharp where the map's pixels are small: it covers what matters, not the whole room
    spec.stat.extent, spec.stat.center = 0.6, [0.0, 0.0, 0.1]
    visual.map.znear, visual.map.zfar = 0.05, 20.0
    _add_lamps(spec, room)
    _add_surroundings(spec, room, hand.skin, rng)
    for i, prop in enumerate(props):
        pixels = printed(prop.print, prop.base, prop.accent, prop.second, prop.detail, rng)
        _add_material(spec, f"thing{i}", pixels, prop.specular)
        body = spec.worldbody.add_body(name=f"thing{i}", mocap=True)
        smooth = prop.kind in {"ball", "duck"}
        _add_mesh(spec, body, f"thing{i}", shape_of(prop), f"thing{i}", smooth=smooth)
    _add_hand(spec, hand, gestures, rng)
    spec.worldbody.add_body(name="camera", mocap=True).add_camera(
        name="view", fovy=math.degrees(fovy_rad)
    )
    return spec.compile()


def labels_of(model: mujoco.MjModel) -> UInt8[np.ndarray, "geom"]:
    """Return each geom's label in masks."""
    labels = np.zeros(model.ngeom, np.uint8)
    for geom in range(model.ngeom):
        name = model.body(model.geom_bodyid[geom]).name
        if name in ("hand", "arm"):
            labels[geom] = LABEL_HAND
        elif name.startswith("thing"):
            labels[geom] = LABEL_THING + int(name.removeprefix("thing"))
        elif name == "table":
            labels[geom] = LABEL_TABLE
    return labels


def _rgb(values: Float[np.ndarray, "3"]) -> Rgb:
    r, g, b = values.clip(0.02, 0.98).tolist()
    return r, g, b


def _add_lamps(spec: mujoco.MjSpec, room: Room) -> None:
    lamps = (
        (room.lamp_azimuth_rad, room.lamp_elevation_rad, room.lamp, True),
        (room.second_azimuth_rad, 0.9, room.second_lamp, False),
    )
    for azimuth, elevation, colour, shadow in lamps:
        c = math.cos(elevation)
        towards = np.array([c * math.cos(azimuth), c * math.sin(azimuth), math.sin(elevation)])
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=2.0 * towards,
            dir=-towards,
            diffuse=list(colour),
            specular=[0.25 if shadow else 0.0] * 3,
            castshadow=shadow,
        )


def _add_surroundings(
    spec: mujoco.MjSpec, room: Room, skin: Rgb, rng: np.random.Generator
) -> None:
    c, s = math.cos(room.yaw_rad / 2), math.sin(room.yaw_rad / 2)
    base = spec.worldbody.add_body(name="room", quat=[c, 0, 0, s])
    table = spec.worldbody.add_body(name="table", quat=[c, 0, 0, s])
    far, near, side = room.table_far_m, -1.6, room.table_side_m
    _add_material(
        spec,
        "top",
        surface(room.table, room.table_base, room.table_accent, rng),
        room.specular,
        room.table_repeat,
    )
    _add_material(
        spec, "wall", surface(room.wall, room.wall_base, room.wall_accent, rng), 0.0, 1.5
    )
    middle, half = (far + near) / 2, (far - near) / 2
    geom = mujoco.mjtGeom
    table.add_geom(
        type=geom.mjGEOM_PLANE, size=[half, side, 0.1], pos=[middle, 0, 0], material="top"
    )
    edge = [*(0.7 * np.array(room.table_base)), 1]
    table.add_geom(
        type=geom.mjGEOM_BOX, size=[half, side, 0.012], pos=[middle, 0, -0.014], rgba=edge
    )
    base.add_geom(
        type=geom.mjGEOM_PLANE, size=[6, 6, 0.1], pos=[0, 0, -0.74], rgba=[*room.floor, 1]
    )
    q = math.sqrt(0.5)
    wall = far + room.wall_far_m
    base.add_geom(
        type=geom.mjGEOM_PLANE,
        size=[3, 6, 0.1],
        pos=[wall, 0, 0],
        quat=[q, 0, -q, 0],
        material="wall",
    )
    for _ in range(room.clutter):
        y, size = rng.uniform(-1.2, 1.2), rng.uniform(0.03, 0.25, 3)
        if rng.random() < 0.4:  # a poster or a switch on the wall
            at, size[0] = [wall - 0.005, y, rng.uniform(-0.2, 0.9)], 0.004
        else:
            at = [rng.uniform(far + 0.3, max(wall, far + 0.5)), y, rng.uniform(-0.7, 0.3)]
        kind = [geom.mjGEOM_BOX, geom.mjGEOM_ELLIPSOID, geom.mjGEOM_CYLINDER][int(rng.integers(3))]
        if at[0] > wall - 0.01:
            kind = geom.mjGEOM_BOX
        base.add_geom(type=kind, size=size.tolist(), pos=at, rgba=[*any_colour(rng), 1])
    if room.person:
        cloth = surface("cloth", room.shirt, room.shirt, rng)
        _add_material(spec, "shirt", cloth, 0.0, 2.0)
        trunk = spec.worldbody.add_body(name="trunk", mocap=True)
        parts = (([0.12, 0.20, 0.40], [0, 0, -0.06]), ([0.11, 0.22, 0.17], [0, 0, 0.22]))
        for size, at in parts:
            trunk.add_geom(type=geom.mjGEOM_ELLIPSOID, size=size, pos=at, material="shirt")
        tone = [*skin, 1.0]
        trunk.add_geom(
            type=geom.mjGEOM_CYLINDER, size=[0.055, 0.08, 0], pos=[0, 0, 0.40], rgba=tone
        )
        trunk.add_geom(
            type=geom.mjGEOM_ELLIPSOID, size=[0.095, 0.078, 0.125], pos=[-0.02, 0, 0.56], rgba=tone
        )


def _add_mesh(
    spec: mujoco.MjSpec,
    body: Any,
    name: str,
    shape: Shape,
    material: str,
    *,
    smooth: bool,
) -> Any:
    spec.add_mesh(
        name=name,
        uservert=shape.vertices.ravel().tolist(),
        usertexcoord=shape.uv.ravel().tolist(),
        userface=shape.faces.ravel().tolist(),
        userfacetexcoord=shape.faces.ravel().tolist(),
        smoothnormal=smooth,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    return body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=material,
        contype=0,
        conaffinity=0,
    )


def _add_hand(
    spec: mujoco.MjSpec, hand: Hand, gestures: tuple[Pose, ...], rng: np.random.Generator
) -> None:
    skin = np.array(hand.skin)
    tone = (
        1
        + 0.07 * smooth_noise((128, 128), (9, 9), rng)
        + 0.04 * smooth_noise((128, 128), (60, 60), rng)
    )
    red = np.stack([1 + 0.04 * smooth_noise((128, 128), (5, 5), rng), *np.ones((2, 128, 128))], -1)
    _add_material(spec, "skin", pixels_of(skin * tone[..., None] * red), 0.12)
    root = spec.worldbody.add_body(name="hand", mocap=True)
    for k, gesture in enumerate(gestures):
        _add_mesh(spec, root, f"hand{k}", skin_of(gesture, hand), "skin", smooth=True)
    arm, s = spec.worldbody.add_body(name="arm", mocap=True), hand.scale
    # along +z from the wrist; forearms widen to the elbow and are a little flat
    bare = revolved(
        [
            (0, -0.012),
            (0.021, -0.006),
            (0.025, 0.02),
            (0.036, 0.12),
            (0.043, 0.22),
            (0.047, 0.75),
            (0, 0.75),
        ],
        [0] * 6,
        24,
    )
    flat = Shape(vertices=bare.vertices * (0.86 * s, 1.08 * s, s), uv=bare.uv, faces=bare.faces)
    _add_mesh(spec, arm, "forearm", flat, "skin", smooth=True)
    if hand.sleeve is not None:
        c, wide = hand.cuff_m, 0.034 + 0.06 * hand.cuff_m
        cuff = [
            (0.8 * wide, c),
            (wide + 0.003, c),
            (wide + 0.004, c + 0.02),
            (wide + 0.002, c + 0.03),
        ]
        folds = [
            (wide + 0.010 + 0.02 * x + rng.uniform(-0.003, 0.003), c + 0.03 + x * SLEEVE_M)
            for x in np.linspace(0.05, 1, 12)
        ]
        sleeve = revolved(
            [*cuff, *folds, (0, c + 0.03 + SLEEVE_M)], [0] * (len(cuff) + len(folds)), 24
        )
        sleeve = Shape(
            vertices=sleeve.vertices * (0.92, 1.06, 1),
            uv=patch_uv(0, sleeve.uv),
            faces=sleeve.faces,
        )
        kind = {"plain": "cloth", "stripes": "stripes", "checker": "gingham"}[hand.sleeve_print]
        _add_material(spec, "sleeve", surface(kind, hand.sleeve, any_colour(rng), rng), 0.0)
        _add_mesh(spec, arm, "sleeve", sleeve, "sleeve", smooth=True)


def _add_material(
    spec: mujoco.MjSpec,
    name: str,
    pixels: UInt8[np.ndarray, "h w 3"],
    specular: float,
    repeat: float = 1.0,
) -> None:
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=pixels.shape[1],
        height=pixels.shape[0],
        nchannel=3,
    )
    texture.data = pixels.tobytes()
    material = spec.add_material(
        name=name, texrepeat=[repeat, repeat], specular=specular, shininess=0.4
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
