"""A scene becomes one MuJoCo model: table, robot, a camera `view`, and every object on a free joint.

Boxes, cylinders and spheres stay primitives; a mesh collides (and is drawn) as its convex hull or,
where it is concave, as a few convex parts (`solids`); a hollow object becomes a solid floor with
walls, so that things can go in. Body `<object>`, geoms `<object>_<k>`, free joint `<object>`; the
body's origin is the centre of the object's bounding box. Inertias are those of uniform density.
The manipulated object comes first, as in the scene.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import look_at, mujoco_xyaxes
from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene, SceneObject, friction_attribute, hollow_floor_m
from v2p_data.sim.model.solids import solids_of
from v2p_data.sim.model.suitability import check_grasp, check_names, checked_size
from v2p_data.sim.robot.arms import Robot, RobotConfig, read_arm
from v2p_data.sim.robot.robot import PADS, PhysicsConfig, ServoConfig, option_xml, xml_row

type Size = tuple[float, float, float]
"""Extents along x, y, z [m]."""

MESH_SCALES = (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15)
"""Ready-made sizes of each mesh; a world picks one, because MuJoCo cannot scale a mesh per world."""
ROUND_WALLS = 10
WALL_MAX_M = 0.012
RESERVED_NAMES = (
    "table",
    "hand",
    "palm",
    "world",
    "base",
    "robot",
    "finger_left",
    "finger_right",
    *PADS,
)
CAMERA = "view"
CAMERA_POS = (0.0, -0.6, 0.78)
CAMERA_TARGET = (0.54, -0.02, 0.10)
CAMERA_FOVY_DEG = 47.0


@dataclass(frozen=True, kw_only=True)
class Part:
    """One geom of an object, in the object's frame."""

    kind: str
    """`box`, `cylinder`, `sphere` or `mesh`."""
    half_size: tuple[float, float, float]
    """Half extents; cylinders (radius, radius, half height)."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ObjectModel:
    """Where one object is in the model, and what its unscaled values are."""

    name: str
    role: str
    kind: str
    """`box`, `cylinder`, `sphere`, `mesh`, `box_hollow` or `round_hollow`."""
    opens_up: bool
    """A floor with walls; a cover's walls point down."""
    size_m: tuple[float, float, float]
    mass_kg: float
    friction: float
    body_id: int
    qpos_adr: int
    dof_adr: int
    geom_ids: tuple[int, ...]
    mesh_ids: tuple[tuple[int, ...], ...]
    """Meshes: per geom one for each entry of `MESH_SCALES`."""
    rest_quat: tuple[float, float, float, float]
    """Orientation in which it stands on the table, at zero yaw; from its first pose in the video."""
    hull: Float[np.ndarray, "h 3"]
    """Corner points of its hull, unscaled, from which its height and footprint follow."""

    @property
    def is_round(self) -> bool:
        """Whether x and y must be scaled alike."""
        return self.kind in {"cylinder", "round_hollow"}


@dataclass(frozen=True, kw_only=True)
class World:
    """The compiled model with the addresses of its objects."""

    spec: Any
    """What it was compiled from; change a copy."""
    model: mujoco.MjModel
    robot: Robot
    physics: PhysicsConfig
    objects: tuple[ObjectModel, ...]
    scene: Scene


def build_world(
    scene: Scene,
    physics: PhysicsConfig,
    servo: ServoConfig | None = None,
    robot: RobotConfig | None = None,
) -> World:
    """Return the scene as a model; the built-in arm's joints come first in it, another arm's last.

    Raises:
        V2PError: the robot's file is not what it should be.
        ItemRejectedError: an object is too large, too small, too heavy or too wide for this robot, or its mesh
            is no solid.
    """
    check_names(scene, RESERVED_NAMES)
    arm = read_arm(robot or RobotConfig(), physics, servo or ServoConfig())
    drafts = [_draft(o, scene, 2 * arm.finger_travel_m) for o in scene.objects]
    sensors = "".join(
        f'<contact name="{pad}_{o.name}" {end} body2="{o.name}" num="1" reduce="netforce" data="found"/>'
        for o in scene.objects
        for pad, end in zip(PADS, arm.sensor_ends, strict=True)
    )
    # Who reads contacts relies on this order: two pads per object, then the whole arm per object.
    sensors += "".join(
        f'<contact name="arm_{o.name}" {arm.any_part} body2="{o.name}" num="1" reduce="netforce" data="found" '
        f'nsample="{physics.substeps}"/>'
        for o in scene.objects
    )
    xml = (
        f'<mujoco model={quoteattr(scene.title)}><compiler angle="radian" autolimits="true"/>{option_xml(physics)}'
        '<visual><global offwidth="640" offheight="640"/><quality offsamples="0" shadowsize="1024"/>'
        '<headlight ambient="0.4 0.4 0.4" diffuse="0.5 0.5 0.5"/></visual>'
        f"<asset>{''.join(d.form.asset_xml for d in drafts)}</asset>"
        '<worldbody><site name="base" size="0.001" group="4"/>'
        f'<light pos="0.5 -0.5 2" dir="0 0.2 -1" castshadow="false"/>{_camera_xml()}'
        '<geom name="table" type="plane" size="1.5 1.5 0.1" contype="1" conaffinity="3" condim="4" '
        f'friction="{friction_attribute()}" solref="{physics.solref_s} 1" rgba="0.55 0.5 0.45 1"/>'
        f"{arm.bodies_xml}{''.join(d.body_xml(physics) for d in drafts)}</worldbody>"
        f"{arm.servos_xml}<sensor>{sensors}</sensor></mujoco>"
    )
    try:
        spec = mujoco.MjSpec.from_string(xml)
        arm.put_into(spec)
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ItemRejectedError(
            "model_not_compiled",
            f"MuJoCo makes no model of scene '{scene.title}': "
            f"{' '.join(str(error).split())[:300]}; are its sizes, masses "
            "and meshes those of real objects?",
        ) from error
    return World(
        robot=arm.robot(model),
        spec=spec,
        model=model,
        physics=physics,
        objects=tuple(d.located(model) for d in drafts),
        scene=scene,
    )


def cover_of(scene: Scene) -> int | None:
    """Return which object is a cover, open below: one with that role, else what a cover task manipulates."""
    for k, obj in enumerate(scene.objects):
        if obj.role == "cover":
            return k
    return 0 if KINDS[scene.kind].has_cover and len(scene.objects) > 1 else None


def hollow_wall_m(width_m: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return how thick the walls of a hollow object are simulated, given its narrower width [m]."""
    return np.clip(0.08 * width_m, 0.006, WALL_MAX_M)


def hollow_parts(
    size_m: tuple[float, float, float], *, is_round: bool, upside_down: bool = False
) -> list[Part]:
    """Return a container's floor and walls, filling a box of `size_m` about the origin.

    The walls stand on the floor and do not reach the table: each further contact costs time. The floor is
    at least 6 mm thick; through thin floors hard-pressed objects were pushed into the table.
    """
    half = np.asarray(size_m) / 2
    floor = float(hollow_floor_m(np.array([size_m[2]]))[0])
    wall = float(hollow_wall_m(np.array([min(size_m[:2])]))[0])
    flip = -1.0 if upside_down else 1.0
    wall_half_height = half[2] - floor / 2
    wall_z = flip * floor / 2
    floor_z = flip * (floor / 2 - half[2])
    if is_round:
        parts = [
            Part(kind="cylinder", half_size=(half[0], half[0], floor / 2), pos=(0.0, 0.0, floor_z))
        ]
        reach = float(half[0] * np.cos(np.pi / ROUND_WALLS) - wall / 2)
        width = float((reach + wall / 2) * np.tan(np.pi / ROUND_WALLS))
        for k in range(ROUND_WALLS):
            yaw = 2 * np.pi * k / ROUND_WALLS
            parts.append(
                Part(
                    kind="box",
                    half_size=(wall / 2, width, wall_half_height),
                    pos=(reach * float(np.cos(yaw)), reach * float(np.sin(yaw)), wall_z),
                    yaw_rad=yaw,
                )
            )
        return parts
    parts = [Part(kind="box", half_size=(half[0], half[1], floor / 2), pos=(0.0, 0.0, floor_z))]
    for side in (1.0, -1.0):
        parts.append(
            Part(
                kind="box",
                half_size=(wall / 2, half[1], wall_half_height),
                pos=(side * (half[0] - wall / 2), 0.0, wall_z),
            )
        )
        parts.append(
            Part(
                kind="box",
                half_size=(half[0] - wall, wall / 2, wall_half_height),
                pos=(0.0, side * (half[1] - wall / 2), wall_z),
            )
        )
    return parts


@dataclass(frozen=True, kw_only=True)
class _Form:
    """The shape of an object in the simulator."""

    kind: str
    size_m: tuple[float, float, float]
    parts: tuple[Part, ...]
    hull: np.ndarray
    corners: tuple[np.ndarray, ...]
    """Points on its surface, by convex part."""
    com: np.ndarray
    inertia: np.ndarray
    """Full 3 x 3, about the centre of mass."""
    asset_xml: str = ""


@dataclass(frozen=True, kw_only=True)
class _Draft:
    """An object before the model is compiled."""

    obj: SceneObject
    form: _Form
    opens_up: bool
    rest_quat: tuple[float, float, float, float]

    def body_xml(self, physics: PhysicsConfig) -> str:
        o = self.obj
        i = self.form.inertia
        if self.form.kind == "mesh":
            moments = (
                f'fullinertia="{i[0, 0]:.9g} {i[1, 1]:.9g} {i[2, 2]:.9g} {i[0, 1]:.9g} '
                f'{i[0, 2]:.9g} {i[1, 2]:.9g}"'
            )
        else:
            moments = f'diaginertia="{i[0, 0]:.9g} {i[1, 1]:.9g} {i[2, 2]:.9g}"'
        geoms = ""
        for k, part in enumerate(self.form.parts):
            h = part.half_size
            if part.kind == "mesh":
                form = f'type="mesh" mesh="{_mesh_name(o.name, k, MESH_SCALES.index(1.0))}"'
            else:
                size = {"box": h, "cylinder": (h[0], h[2]), "sphere": (h[0],)}[part.kind]
                form = (
                    f'type="{part.kind}" size="{xml_row(size)}" pos="{xml_row(part.pos)}" '
                    f'euler="0 0 {part.yaw_rad:.9g}"'
                )
            geoms += (
                f'<geom name="{o.name}_{k}" {form} contype="1" conaffinity="3" condim="4" '
                f'friction="{friction_attribute(o.friction)}" solref="{physics.solref_s} 1" rgba="{xml_row(o.rgba)}"/>'
            )
        return (
            f'<body name="{o.name}" pos="0.5 0 {self.form.size_m[2] / 2:.6g}"><freejoint name="{o.name}"/>'
            f'<inertial mass="{o.mass_kg:.9g}" pos="{xml_row(tuple(self.form.com))}" {moments}/>{geoms}</body>'
        )

    def located(self, model: mujoco.MjModel) -> ObjectModel:
        body = model.body(self.obj.name).id
        joint = model.body_jntadr[body]
        first = int(model.body_geomadr[body])
        is_mesh = self.form.kind == "mesh"
        return ObjectModel(
            name=self.obj.name,
            role=self.obj.role,
            kind=self.form.kind,
            opens_up=self.opens_up,
            size_m=self.form.size_m,
            mass_kg=self.obj.mass_kg,
            friction=self.obj.friction,
            body_id=int(body),
            qpos_adr=int(model.jnt_qposadr[joint]),
            dof_adr=int(model.jnt_dofadr[joint]),
            geom_ids=tuple(range(first, first + len(self.form.parts))),
            mesh_ids=tuple(
                tuple(
                    int(model.mesh(_mesh_name(self.obj.name, part, k)).id)
                    for k in range(len(MESH_SCALES))
                )
                for part in range(len(self.form.parts))
                if is_mesh
            ),
            rest_quat=self.rest_quat,
            hull=self.form.hull,
        )


def _draft(obj: SceneObject, scene: Scene, opening_m: float) -> _Draft:
    cover = cover_of(scene)
    is_cover = cover is not None and scene.objects[cover] is obj
    is_hollow = obj.hollow or is_cover
    size_m = checked_size(obj, scene)
    if is_hollow:
        form = _hollow_form(obj, size_m, upside_down=is_cover)
    elif obj.shape == "mesh":
        form = _mesh_form(obj, size_m, scene.folder)
    else:
        form = _primitive_form(obj, size_m)
    rest_quat = _rest_quat(obj, form.kind)
    if not is_hollow or is_cover:  # other hollow things are taken by the wall
        check_grasp(obj, scene, form.corners, rest_quat, opening_m)
    return _Draft(obj=obj, form=form, opens_up=is_hollow and not is_cover, rest_quat=rest_quat)


def _hollow_form(obj: SceneObject, size_m: Size, *, upside_down: bool) -> _Form:
    x, y, z = size_m
    is_round = obj.shape in {"cylinder", "sphere"} or (
        obj.shape == "mesh" and abs(x - y) < 0.12 * max(x, y)
    )
    hull = _box(size_m)
    if is_round:
        x = y = (x + y) / 2
        hull = _disc(x / 2, z / 2)
    parts = hollow_parts((x, y, z), is_round=is_round, upside_down=upside_down)
    com, inertia = _mass_properties(parts, obj.mass_kg)
    return _Form(
        kind="round_hollow" if is_round else "box_hollow",
        size_m=(x, y, z),
        parts=tuple(parts),
        hull=hull,
        corners=(hull,),
        com=com,
        inertia=inertia,
    )


def _mesh_form(obj: SceneObject, size_m: Size, folder: Path) -> _Form:
    ready = [folder / part for part in obj.parts]
    solids = solids_of(folder / obj.mesh, obj.name, size_m, ready=ready)
    com, inertia = solids.mass_properties(obj.mass_kg)
    return _Form(
        kind="mesh",
        size_m=size_m,
        parts=tuple(
            Part(kind="mesh", half_size=_half(np.ptp(p.vertices, axis=0))) for p in solids.parts
        ),
        hull=solids.hull,
        corners=tuple(np.asarray(p.vertices) for p in solids.parts),
        com=com,
        inertia=inertia,
        asset_xml="".join(
            f'<mesh name="{_mesh_name(obj.name, part, k)}" vertex="{xml_row((np.asarray(p.vertices) * s).ravel())}"/>'
            for part, p in enumerate(solids.parts)
            for k, s in enumerate(MESH_SCALES)
        ),
    )


def _primitive_form(obj: SceneObject, size_m: Size) -> _Form:
    kind, (x, y, z) = obj.shape, size_m
    hull = _box(size_m)
    if kind == "cylinder":
        x = y = (x + y) / 2
        hull = _disc(x / 2, z / 2)
    elif kind == "sphere":
        x = y = z = float(np.mean(size_m))
        hull = np.concatenate([np.eye(3), -np.eye(3)]) * x / 2
    parts = [Part(kind=kind, half_size=(x / 2, y / 2, z / 2))]
    com, inertia = _mass_properties(parts, obj.mass_kg)
    return _Form(
        kind=kind,
        size_m=(x, y, z),
        parts=tuple(parts),
        hull=hull,
        corners=(_outline(kind, hull, (x, y, z)),),
        com=com,
        inertia=inertia,
    )


def _rest_quat(obj: SceneObject, kind: str) -> tuple[float, float, float, float]:
    """Return the first pose's orientation without its yaw, snapped so that the nearest own axis is vertical.

    Hollow things stand on their floors (covers on their walls) whatever the estimate says. A mesh further
    than 30 degrees from an axis keeps the tilt it had.
    """
    if kind.endswith("_hollow") or kind == "sphere" or not obj.poses_world:
        return (1.0, 0.0, 0.0, 0.0)
    R = Rotation.from_quat(obj.laid_pose[3:], scalar_first=True).as_matrix()
    axis = int(np.argmax(np.abs(R[2])))
    sign = 1.0 if R[2, axis] > 0 else -1.0
    if kind == "mesh" and abs(R[2, axis]) < np.cos(np.radians(30)):
        yaw = np.arctan2(R[1, 0], R[0, 0])
        upright = Rotation.from_euler("z", -yaw).as_matrix() @ R
    else:
        upright = np.zeros((3, 3))  # rows: world axes in the object's frame
        upright[2, axis] = sign
        upright[0, (axis + 1) % 3] = 1.0
        upright[1] = np.cross(upright[2], upright[0])
    quat = Rotation.from_matrix(upright).as_quat(canonical=True, scalar_first=True)
    return (float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3]))


def _half(extents: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(e) / 2 for e in extents)
    return x, y, z


def _outline(kind: str, hull: np.ndarray, size_m: Size) -> np.ndarray:
    """Return points on the surface of a primitive, dense enough to be measured."""
    if kind == "sphere":
        return np.asarray(trimesh.creation.icosphere(2, size_m[0] / 2).vertices)
    return hull


def _box(size_m: Size) -> np.ndarray:
    x, y, z = size_m
    return np.array([[i, j, k] for i in (-x, x) for j in (-y, y) for k in (-z, z)]) / 2


def _disc(radius: float, half_height: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    return np.concatenate([np.c_[ring, np.full(16, z)] for z in (-half_height, half_height)])


def _mass_properties(parts: list[Part], mass_kg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return centre of mass and inertia about it of parts of one density."""
    volumes, moments = [], []
    for part in parts:
        a, b, c = part.half_size
        if part.kind == "box":
            volumes.append(8 * a * b * c)
            second = np.array([a * a, b * b, c * c]) / 3
        elif part.kind == "cylinder":
            volumes.append(2 * np.pi * a * a * c)
            second = np.array([a * a / 4, a * a / 4, c * c / 3])
        else:
            volumes.append(4 / 3 * np.pi * a**3)
            second = np.full(3, a * a / 5)
        R = Rotation.from_euler("z", part.yaw_rad).as_matrix()
        pos = np.asarray(part.pos)
        moments.append(R @ np.diag(second) @ R.T + np.outer(pos, pos))
    share = np.asarray(volumes) / np.sum(volumes)
    com = share @ np.asarray([p.pos for p in parts])
    second = mass_kg * (np.tensordot(share, moments, 1) - np.outer(com, com))
    return com, np.trace(second) * np.eye(3) - second


def _camera_xml() -> str:
    """Return the camera: on the robot's side, so that +y is on the image's left."""
    axes = mujoco_xyaxes(look_at(np.array(CAMERA_POS), np.array(CAMERA_TARGET)))
    return f'<camera name="{CAMERA}" pos="{xml_row(CAMERA_POS)}" xyaxes="{xml_row(axes)}" fovy="{CAMERA_FOVY_DEG}"/>'


def _mesh_name(name: str, part_idx: int, scale_idx: int) -> str:
    return f"{name}_mesh_{part_idx}_{scale_idx}"
