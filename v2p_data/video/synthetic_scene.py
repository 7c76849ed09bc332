"""The MuJoCo scene behind a rendered clip: a table in a room, textured objects, and a hand with a sleeve.

Nothing is simulated here. Objects and hand are mocap bodies, the fingers are hinges set by angle, and a frame
is drawn after forward kinematics. World frame as in a scene from video: origin under the manipulated object's
first position, +x away from the camera, +y to the left of the picture, +z up, metres.
"""

# mujoco's classes come from a compiled module that declares none of them.
# pyright: reportAttributeAccessIssue=false

import itertools
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

Rgb = tuple[float, float, float]
Side = Literal["left", "right"]

PALM_HALF_M = (0.045, 0.014, 0.038)
FINGER_R_M = 0.0088
FINGER_LENGTHS_M = (0.042, 0.026, 0.020)
FINGER_HEIGHTS_M = (0.028, 0.0095, -0.0095, -0.028)
"""Index to little finger, above the middle of the palm."""
WRIST_M = (-0.040, -0.012, 0.0)
SLEEVE_LENGTH_M = 0.60
LABEL_BACKGROUND, LABEL_HAND, LABEL_OBJECT = 0, 1, 2
"""Labels of masks; further objects count on from the manipulated one."""


@dataclass(frozen=True, kw_only=True)
class Thing:
    """An object: its shape and what is printed on it."""

    label: str
    """Words for captions, such as `red box`."""
    shape: Literal["box", "cylinder"]
    size_m: tuple[float, float, float]
    """Extents along its own x, y, z. Cylinders: (diameter, diameter, height)."""
    base: Rgb
    """Main colour, 0 to 1."""
    accent: Rgb
    """Colour of what is printed."""
    print: Literal["label", "stripes", "checker", "speckle"] = "label"


@dataclass(frozen=True, kw_only=True)
class Placed:
    """An object that stands still."""

    thing: Thing
    xy_m: tuple[float, float]
    yaw_rad: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Room:
    """What surrounds the objects."""

    wood: Rgb = (0.64, 0.46, 0.30)
    grain: float = 0.10
    """Contrast of the wood, 0 to 1."""
    table_far_m: float = 0.62
    """Where the table ends behind the objects."""
    wall: Rgb = (0.72, 0.73, 0.70)
    light_azimuth_rad: float = 2.2
    """Where the lamp stands, from +x towards +y."""
    light_elevation_rad: float = 1.0
    light: float = 0.62
    """Strength of the lamp that throws shadows."""
    ambient: float = 0.34
    """Strength of the light from everywhere."""


@dataclass(frozen=True, kw_only=True)
class Hand:
    """A hand, which holds and pushes with its palm towards the object."""

    side: Side = "right"
    """On which side of the object it works."""
    skin: Rgb = (0.80, 0.58, 0.46)
    sleeve: Rgb = (0.25, 0.30, 0.42)
    arm: tuple[float, float, float] = (-0.80, -0.50, 0.16)
    """From the wrist to the elbow, for a hand on the right; mirrored for the left."""

    @property
    def sign(self) -> int:
        """+1 when the palm looks to +y, -1 when it looks to -y."""
        return 1 if self.side == "right" else -1

    @property
    def arm_direction(self) -> Float[np.ndarray, "3"]:
        arm = np.array(self.arm) * (1, self.sign, 1)
        return arm / np.linalg.norm(arm)


def build(
    thing: Thing,
    others: tuple[Placed, ...],
    room: Room,
    hand: Hand,
    fovy_rad: float,
    size_px: tuple[int, int],
    rng: np.random.Generator,
) -> mujoco.MjModel:
    """Return the model. Bodies: `thing` and `hand` (mocap), `other<i>`; camera `view` on mocap body `camera`."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = size_px
    visual.quality.shadowsize, visual.quality.offsamples = 2048, 4
    visual.headlight.ambient = [room.ambient] * 3
    visual.headlight.diffuse = [0.12] * 3
    visual.headlight.specular = [0.0] * 3
    # shadows are sharp where the map's pixels are small: it covers what matters, not the whole room
    spec.stat.extent, spec.stat.center = 0.6, [0.0, 0.0, 0.1]
    visual.map.znear, visual.map.zfar = 0.05, 20.0
    _add_lights(spec, room)
    _add_room(spec, room, rng)
    _add_thing(spec, "thing", thing, rng).mocap = True
    for i, placed in enumerate(others):
        body = _add_thing(spec, f"other{i}", placed.thing, rng)
        body.pos = [*placed.xy_m, placed.thing.size_m[2] / 2]
        body.quat = [np.cos(placed.yaw_rad / 2), 0, 0, np.sin(placed.yaw_rad / 2)]
    _add_hand(spec, hand, thing)
    camera = spec.worldbody.add_body(name="camera", mocap=True)
    camera.add_camera(name="view", fovy=float(np.degrees(fovy_rad)))
    return spec.compile()


def labels_of(model: mujoco.MjModel) -> UInt8[np.ndarray, "geom"]:
    """Return each geom's label in masks."""
    labels = np.zeros(model.ngeom, np.uint8)
    for geom in range(model.ngeom):
        name = model.body(model.body_rootid[model.geom_bodyid[geom]]).name
        if name == "hand":
            labels[geom] = LABEL_HAND
        elif name == "thing":
            labels[geom] = LABEL_OBJECT
        elif name.startswith("other"):
            labels[geom] = LABEL_OBJECT + 1 + int(name.removeprefix("other"))
    return labels


def thumb_at_m(thing: Thing) -> float:
    """Return the thumb's place along the hand's x so that it closes on the near face."""
    return PALM_HALF_M[0] - thing.size_m[0] - 3 * FINGER_R_M


def knuckles_past_centre_m(thing: Thing) -> float:
    """Return how far the palm's middle lies behind the object's when the fingers close on the far face."""
    return thing.size_m[0] / 2 + FINGER_R_M - PALM_HALF_M[0]


def _add_lights(spec: mujoco.MjSpec, room: Room) -> None:
    azimuth, elevation = room.light_azimuth_rad, room.light_elevation_rad
    towards = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=2.0 * towards,
        dir=-towards,
        diffuse=[room.light, room.light * 0.97, room.light * 0.92],
        specular=[0.15] * 3,
        castshadow=True,
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[-1.0, 1.0, 2.0],
        dir=[0.5, -0.4, -0.7],
        diffuse=[0.16, 0.17, 0.19],
        specular=[0.0] * 3,
        castshadow=False,
    )


def _add_room(spec: mujoco.MjSpec, room: Room, rng: np.random.Generator) -> None:
    _add_material(spec, "wood", _wood(room, rng), repeat=(1.0, 1.0))
    _add_material(
        spec, "carpet", _noise_texture((0.36, 0.36, 0.38), 0.18, 1, rng), repeat=(6.0, 6.0)
    )
    _add_material(spec, "plaster", _noise_texture(room.wall, 0.03, 5, rng), repeat=(1.0, 1.0))
    far, near, half_wide = room.table_far_m, -1.1, 1.1
    middle, half = (far + near) / 2, (far - near) / 2
    # The plane carries the texture; a thin slab gives the table its edge.
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[half, half_wide, 0.1],
        pos=[middle, 0, 0],
        material="wood",
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half, half_wide, 0.012],
        pos=[middle, 0, -0.020],
        rgba=[*(0.7 * np.array(room.wood)), 1],
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[4, 4, 0.1], pos=[0, 0, -0.74], material="carpet"
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2, 4, 0.1],
        pos=[far + 1.1, 0, 0],
        quat=[np.sqrt(0.5), 0, -np.sqrt(0.5), 0],
        material="plaster",
    )


def _add_thing(
    spec: mujoco.MjSpec, name: str, thing: Thing, rng: np.random.Generator
) -> "mujoco.MjsBody":
    vertices, uv, faces = _box_mesh(thing) if thing.shape == "box" else _cylinder_mesh(thing)
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel().tolist(),
        usertexcoord=uv.ravel().tolist(),
        userface=faces.ravel().tolist(),
        userfacetexcoord=faces.ravel().tolist(),
        smoothnormal=False,
    )
    _add_material(spec, name, _printed(thing, rng), repeat=(1.0, 1.0), specular=0.25)
    body = spec.worldbody.add_body(name=name)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        contype=0,
        conaffinity=0,
    )
    return body


def _add_hand(spec: mujoco.MjSpec, hand: Hand, thing: Thing) -> None:
    """Origin: the middle of the palm's surface. x along the fingers, z towards the thumb's side."""
    s = hand.sign
    skin, dark = [*hand.skin, 1.0], [*(0.93 * np.array(hand.skin)), 1.0]
    mirror = np.array([1.0, s, 1.0])
    root = spec.worldbody.add_body(name="hand", mocap=True)

    def capsule(
        body: "mujoco.MjsBody", a: np.ndarray, b: np.ndarray, r: float, rgba: list
    ) -> None:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*a, *b],
            size=[r, 0, 0],
            rgba=rgba,
            contype=0,
            conaffinity=0,
        )

    # Metacarpals side by side make a palm that is flat inside and knuckled outside.
    for z in FINGER_HEIGHTS_M:
        a = np.array([-PALM_HALF_M[0] * 0.75, -PALM_HALF_M[1], 0.72 * z]) * mirror
        b = np.array([PALM_HALF_M[0] - 0.004, -PALM_HALF_M[1], z]) * mirror
        capsule(root, a, b, 0.0125, skin)
    root.add_geom(
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=[PALM_HALF_M[0] * 1.02, PALM_HALF_M[1] * 0.9, PALM_HALF_M[2] * 0.95],
        pos=np.array([-0.006, -PALM_HALF_M[1], 0.0]) * mirror,
        rgba=skin,
        contype=0,
        conaffinity=0,
    )
    for finger, z in enumerate(FINGER_HEIGHTS_M):
        scale = (0.95, 1.08, 1.0, 0.8)[finger]
        parent, at = root, np.array([PALM_HALF_M[0], -0.011, z]) * mirror
        for joint, length in enumerate(FINGER_LENGTHS_M):
            parent = parent.add_body(
                name=f"finger{finger}_{joint}", pos=at, mass=0.01, inertia=[1e-6] * 3
            )
            parent.add_joint(
                name=f"finger{finger}_{joint}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, s]
            )
            at = np.array([length * scale, 0, 0])
            radius = FINGER_R_M * (1.0, 0.94, 0.88)[joint] * (0.9 if finger == 3 else 1.0)
            capsule(parent, np.zeros(3), at, radius, skin if joint < 2 else dark)
    base = np.array([thumb_at_m(thing), -0.012, 0.022]) * mirror
    thumb = root.add_body(name="thumb_0", pos=base, mass=0.01, inertia=[1e-6] * 3)
    thumb.add_joint(name="thumb_0", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, s])
    knuckle = np.array([0, 0.042, 0.004]) * mirror
    capsule(thumb, np.zeros(3), knuckle, 0.0115, skin)
    tip = thumb.add_body(name="thumb_1", pos=knuckle, mass=0.01, inertia=[1e-6] * 3)
    tip.add_joint(name="thumb_1", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, s])
    capsule(tip, np.zeros(3), np.array([0, 0.026, 0.0]) * mirror, 0.0100, dark)
    heel = np.array([-0.035, -0.014, 0.012]) * mirror
    capsule(root, heel, base, 0.0135, skin)
    wrist, arm = np.array(WRIST_M) * mirror, hand.arm_direction
    capsule(root, wrist, wrist + 0.10 * arm, 0.0255, skin)
    capsule(
        root, wrist + 0.12 * arm, wrist + 0.13 * arm, 0.0375, [*(0.8 * np.array(hand.sleeve)), 1]
    )
    capsule(root, wrist + 0.13 * arm, wrist + SLEEVE_LENGTH_M * arm, 0.0385, [*hand.sleeve, 1.0])


def _add_material(
    spec: mujoco.MjSpec,
    name: str,
    pixels: UInt8[np.ndarray, "h w 3"],
    repeat: tuple[float, float],
    specular: float = 0.05,
) -> None:
    height, width = pixels.shape[:2]
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=width,
        height=height,
        nchannel=3,
    )
    texture.data = pixels.tobytes()
    material = spec.add_material(
        name=name, texrepeat=list(repeat), specular=specular, shininess=0.3
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


# --- what is drawn on things ---------------------------------------------------------------------------------


def _smooth_noise(
    shape: tuple[int, int], cells: tuple[float, float], rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Return noise in about [-1, 1] with the given number of bumps down and across."""
    h, w = shape
    rows, columns = max(2, round(cells[0]) + 1), max(2, round(cells[1]) + 1)
    grid = rng.uniform(-1, 1, (rows, columns))
    y, x = np.linspace(0, rows - 1, h), np.linspace(0, columns - 1, w)
    y0, x0 = np.minimum(y.astype(int), rows - 2), np.minimum(x.astype(int), columns - 2)
    fy, fx = (y - y0)[:, None], (x - x0)[None]
    fy, fx = fy * fy * (3 - 2 * fy), fx * fx * (3 - 2 * fx)
    top = grid[y0][:, x0] * (1 - fx) + grid[y0][:, x0 + 1] * fx
    bottom = grid[y0 + 1][:, x0] * (1 - fx) + grid[y0 + 1][:, x0 + 1] * fx
    return top * (1 - fy) + bottom * fy


def _pixels(values: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (values.clip(0, 1) * 255).round().astype(np.uint8)


def _noise_texture(
    base: Rgb, contrast: float, cells_px: int, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    noise = _smooth_noise((256, 256), (256 / cells_px, 256 / cells_px), rng)
    return _pixels(np.array(base) * (1 + contrast * noise[..., None]))


def _wood(room: Room, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Return planks along the picture's width, each with its own tone and fine, long grain."""
    size, planks = 1024, 9
    image = np.zeros((size, size))
    edges = [round(e) for e in np.linspace(0, size, planks + 1)]
    for top, bottom in itertools.pairwise(edges):
        shape = (bottom - top, size)
        bend = _smooth_noise(shape, (2.0, 3.0), rng)
        rings = np.sin(
            2 * np.pi * (4.0 * np.linspace(0, 1, shape[0])[:, None] + 1.4 * bend)
            + rng.uniform(0, 6.28)
        )
        fine = _smooth_noise(shape, (shape[0] / 2, 10.0), rng)
        finer = _smooth_noise(shape, (shape[0] / 1.5, 60.0), rng)
        tone = 0.5 * rng.uniform(-1, 1)
        image[top:bottom] = 0.45 * rings + 0.7 * fine + 0.35 * finer + tone
        image[top : top + 2] -= 1.6
    shade = 1 + room.grain * image[..., None] * np.array([0.9, 1.0, 1.1])
    return _pixels(np.array(room.wood) * shade)


def _printed(thing: Thing, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Return the atlas of a thing: 3 x 2 tiles for a box; side above, caps below for a cylinder."""
    tile = 192
    if thing.shape == "box":
        tiles = [_tile(thing, (tile, tile), rng) for _ in range(6)]
        return np.concatenate([np.concatenate(tiles[:3], 1), np.concatenate(tiles[3:], 1)])
    side = _tile(thing, (tile, 3 * tile), rng)
    metal = _noise_texture((0.74, 0.74, 0.76), 0.06, 3, rng)[:tile, :tile]
    rest = np.broadcast_to(metal[:1, :1], (tile, 2 * tile, 3))
    return np.concatenate([side, np.concatenate([metal, rest], 1)])


def _tile(
    thing: Thing, shape: tuple[int, int], rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    h, w = shape
    base, accent = np.array(thing.base), np.array(thing.accent)
    y, x = np.mgrid[0:h, 0:w] / float(h)
    printed = np.zeros((h, w), bool)
    if thing.print == "stripes":
        printed = ((y + 0.25 * x) * 3 % 1) < 0.30
    elif thing.print == "checker":
        printed = ((y * 5).astype(int) + (x * 5).astype(int)) % 2 == 0
    elif thing.print == "speckle":
        printed = _smooth_noise((h, w), (14.0, 14 * w / h), rng) > 0.45
    else:
        printed |= (np.abs(y - 0.5) < 0.17) & (x > 0.1) & (x < w / h - 0.1)
        printed |= np.abs(y - 0.9) < 0.025
        printed |= np.abs(y - 0.1) < 0.025
        # lines that could be words on the label
        for row in (0.42, 0.5, 0.58):
            for start in np.arange(0.18, w / h - 0.3, 0.33):
                length = rng.uniform(0.12, 0.26)
                printed &= ~((np.abs(y - row) < 0.014) & (x > start) & (x < start + length))
    image = np.where(printed[..., None], accent, base)
    wear = 0.05 * _smooth_noise((h, w), (5.0, 5.0), rng) + 0.04 * _smooth_noise(
        (h, w), (60.0, 60.0), rng
    )
    edge = np.minimum(np.minimum(y, 1 - y), np.minimum(x, w / h - x)) < 0.012
    image = image * (1 + wear[..., None]) * np.where(edge, 0.72, 1.0)[..., None]
    return _pixels(image)


_Mesh = tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 2"], np.ndarray]
"""Vertices, texture coordinates, faces."""


def _box_mesh(thing: Thing) -> _Mesh:
    half = np.array(thing.size_m) / 2
    vertices, uv, faces = [], [], []
    for face, (axis, sign) in enumerate([(0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1)]):
        normal = np.zeros(3)
        normal[axis] = sign
        up = np.array([0, 0, 1.0]) if axis < 2 else np.array([1.0, 0, 0])
        right = np.cross(up, normal)
        column, row = face % 3, face // 3
        first = len(vertices)
        for u, v in [(0, 0), (1, 0), (1, 1), (0, 1)]:
            vertices.append((normal + (2 * u - 1) * right + (2 * v - 1) * up) * half)
            # 1 - v: texture rows count downwards
            uv.append([(column + 0.01 + 0.98 * u) / 3, (row + 0.01 + 0.98 * (1 - v)) / 2])
        faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return np.array(vertices), np.array(uv), np.array(faces)


def _cylinder_mesh(thing: Thing, sides: int = 48) -> _Mesh:
    radius, half = thing.size_m[0] / 2, thing.size_m[2] / 2
    vertices, uv, faces = [], [], []
    for k in range(sides + 1):
        angle = 2 * np.pi * k / sides
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        vertices += [[x, y, -half], [x, y, half]]
        uv += [[k / sides, 0.495], [k / sides, 0.005]]
    for k in range(sides):
        a = 2 * k
        faces += [[a, a + 2, a + 3], [a, a + 3, a + 1]]
    for sign in (-1, 1):
        centre = len(vertices)
        vertices.append([0, 0, sign * half])
        uv.append([1 / 6, 0.75])
        for k in range(sides + 1):
            angle = 2 * np.pi * k / sides
            c, s = np.cos(angle), np.sin(angle)
            vertices.append([radius * c, radius * s, sign * half])
            uv.append([1 / 6 + 0.15 * c, 0.75 + 0.23 * s])
        for k in range(sides):
            a, b = centre + 1 + k, centre + 2 + k
            faces.append([centre, a, b] if sign > 0 else [centre, b, a])
    return np.array(vertices), np.array(uv), np.array(faces)
