"""A scene as the twin's MuJoCo model: convex meshes in contact, another integrator, motors at the joints.

All objects collide as convex meshes, also those that the training simulator has as primitives: boxes have bevelled
edges, cylinders and spheres have facets. The inertias follow from the meshes. Link data of the arm are shared with the
training simulator; its Cartesian servos are not there.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from dataclasses import dataclass, replace
from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera, mujoco_xyaxes
from v2p_data.scene.scene import Scene
from v2p_data.sim.model.world import CAMERA, ObjectModel, World, build_world
from v2p_data.sim.robot.arms import RobotConfig, read_arm
from v2p_data.sim.robot.robot import (
    FINE,
    FINGER_TRAVEL_M,
    NUM_ARM_JOINTS,
    PADS,
    ServoConfig,
    xml_row,
)
from v2p_data.twin.parameters import TwinParameters

TIMESTEP_S = 0.002
INTEGRATOR = "implicitfast"
CONE = "pyramidal"
BEVEL_M = 0.0015
"""Boxes' edges are cut off by this much, as cardboard's and moulded plastic's are."""
FACETS = 24
"""Sides of a cylinder."""
TORQUE_LIMIT_NM = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Franka Emika's data sheet."""
ARMATURE_KG_M2 = (0.4, 0.4, 0.4, 0.4, 0.15, 0.15, 0.15)
"""Reflected rotor inertia in the arm's own model. Without it joints 1 and 3, whose axes are nearly parallel, swing
against each other under libfranka's damping."""
FINGER_KP, FINGER_KV, FINGER_ARMATURE_KG = 10_000.0, 150.0, 0.15
GRAIN_PX = 256


@dataclass(frozen=True, kw_only=True)
class TwinWorld:
    """The compiled twin of a scene with its addresses."""

    model: mujoco.MjModel
    like: World
    """The training simulator's world with the twin's model and addresses in it, for drawing."""
    objects: tuple[ObjectModel, ...]
    size_m: Float[np.ndarray, "object 3"]
    rest_height_m: Float[np.ndarray, "object"]
    """Height of each object's centre at rest, above z = 0."""
    object_qpos: Int[np.ndarray, "object 7"]
    object_dofs: Int[np.ndarray, "object 6"]
    pad_geoms: tuple[int, int]
    object_of_geom: dict[int, int]


def build_twin(scene: Scene, parameters: TwinParameters, camera: Camera) -> TwinWorld:
    """Return the twin of a scene; the arm's joints come first, then the fingers', then the objects'.

    Args:
        scene: objects of which sizes, masses and friction are changed by the parameters.
        parameters: of the twin.
        camera: pinhole that pictures are drawn with, before the lens.

    Raises:
        ItemRejectedError: an object does not suit the robot, or its mesh is no solid.
    """
    base = build_world(scene, FINE)
    arm = read_arm(RobotConfig(), FINE, ServoConfig(finger_armature_kg=FINGER_ARMATURE_KG))
    assets, bodies = "", ""
    for obj in base.objects:
        asset, body = _object_xml(base, obj, parameters)
        assets, bodies = assets + asset, bodies + body
    p = parameters
    lamp = np.array([0.5, 0.0, 1.6]) + p.lamp_pos_m
    xml = (
        f'<mujoco model={quoteattr("twin of " + scene.title)}><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{TIMESTEP_S}" integrator="{INTEGRATOR}" cone="{CONE}" solver="Newton" iterations="50" '
        'ls_iterations="50" tolerance="1e-8" jacobian="dense">'
        '<flag autoreset="disable"/></option>'
        f'<visual><global offwidth="{camera.width_px}" offheight="{camera.height_px}"/>'
        '<quality offsamples="0" shadowsize="1024"/>'
        '<headlight ambient="0.35 0.35 0.35" diffuse="0.15 0.15 0.15" specular="0 0 0"/></visual>'
        '<asset><texture type="skybox" builtin="gradient" rgb1="0.75 0.76 0.78" rgb2="0.45 0.44 0.43" '
        f'width="128" height="128"/>{assets}</asset><worldbody><site name="base" size="0.001" group="4"/>'
        f'<light pos="{xml_row(lamp)}" dir="{xml_row(np.array([0.5, 0, 0]) - lamp)}" '
        f'diffuse="{xml_row(np.full(3, 0.75 * p.lamp_scale))}" specular="0.2 0.2 0.2" castshadow="true"/>'
        f'<camera name="{CAMERA}" pos="{xml_row(camera.T_world_cam[:3, 3])}" '
        f'xyaxes="{xml_row(mujoco_xyaxes(camera.T_world_cam))}" fovy="{_fovy_deg(camera)}"/>'
        f'<geom name="table" type="plane" size="1.5 1.5 0.1" pos="0 0 {p.table_height_m}" contype="1" '
        f'conaffinity="3" condim="6" friction="{p.table_friction:.6g} 0.003 0.0005" '
        f'solref="{p.contact_time_s:.6g} 1"/>{arm.bodies_xml}{bodies}</worldbody>{_drives_xml(p)}</mujoco>'
    )
    spec = mujoco.MjSpec.from_string(xml)
    arm.put_into(spec)
    _change_robot(spec, p)
    _paint_table(spec, p)
    model = spec.compile()
    model.vis.map.znear = 0.02
    return _located(base, model, p)


def nominal_arm() -> mujoco.MjModel:
    """Return the arm as its maker's data and the calibrated mount say, for controllers: no objects, no errors."""
    spec = read_arm(RobotConfig(), FINE, ServoConfig()).spec
    for k, armature in enumerate(ARMATURE_KG_M2):
        spec.joint(f"joint{k + 1}").armature = armature
    return spec.compile()


def _located(base: World, model: mujoco.MjModel, p: TwinParameters) -> TwinWorld:
    objects, owner = [], {}
    for k, obj in enumerate(base.objects):
        body = model.body(obj.name).id
        joint = model.body_jntadr[body]
        first = int(model.body_geomadr[body])
        geoms = tuple(range(first, first + len(obj.geom_ids)))
        owner |= dict.fromkeys(geoms, k)
        objects.append(
            replace(
                obj,
                kind="mesh",
                size_m=tuple(float(s) * p.size_scale for s in obj.size_m),
                mass_kg=obj.mass_kg * p.mass_scale,
                friction=obj.friction * p.object_friction_scale,
                body_id=int(body),
                qpos_adr=int(model.jnt_qposadr[joint]),
                dof_adr=int(model.jnt_dofadr[joint]),
                geom_ids=geoms,
                mesh_ids=(),
                hull=obj.hull * p.size_scale,
            )
        )
    lowest = [
        (o.hull @ Rotation.from_quat(o.rest_quat, scalar_first=True).as_matrix().T)[:, 2].min()
        for o in objects
    ]
    return TwinWorld(
        model=model,
        like=replace(base, model=model, objects=tuple(objects)),
        objects=tuple(objects),
        size_m=np.array([o.size_m for o in objects]),
        rest_height_m=p.table_height_m - np.array(lowest),
        object_qpos=np.array([o.qpos_adr for o in objects])[:, None] + np.arange(7),
        object_dofs=np.array([o.dof_adr for o in objects])[:, None] + np.arange(6),
        pad_geoms=(int(model.geom(PADS[0]).id), int(model.geom(PADS[1]).id)),
        object_of_geom=owner,
    )


def _object_xml(base: World, obj: ObjectModel, p: TwinParameters) -> tuple[str, str]:
    """Return the meshes of an object's convex parts, and its body."""
    clouds = [_corners(base.model, geom) * p.size_scale for geom in obj.geom_ids]
    volume = np.array([float(trimesh.convex.convex_hull(c).volume) for c in clouds])
    mass = obj.mass_kg * p.mass_scale * volume / volume.sum()
    rgba = base.model.geom_rgba[obj.geom_ids[0]].tolist()
    asset, geoms = "", ""
    for k, cloud in enumerate(clouds):
        name = f"{obj.name}_{k}"
        asset += f'<mesh name="{name}" vertex="{xml_row(cloud.ravel())}"/>'
        geoms += (
            f'<geom name="{name}" type="mesh" mesh="{name}" mass="{mass[k]:.9g}" contype="1" conaffinity="3" '
            f'condim="6" friction="{obj.friction * p.object_friction_scale:.6g} 0.003 0.0005" '
            f'solref="{p.contact_time_s:.6g} 1" rgba="{xml_row(rgba)}"/>'
        )
    return asset, f'<body name="{obj.name}"><freejoint name="{obj.name}"/>{geoms}</body>'


def _corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "n 3"]:
    """Return corner points of a geom's convex mesh, in its body's frame."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        points = np.array(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], float)
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        points = _bevelled_box(size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        angle = 2 * np.pi * np.arange(FACETS) / FACETS
        ring = size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = np.concatenate([np.c_[ring, np.full(FACETS, z)] for z in (-size[1], size[1])])
    else:
        points = np.asarray(trimesh.creation.icosphere(3, float(size[0])).vertices)
    rotation = Rotation.from_quat(model.geom_quat[geom], scalar_first=True)
    return rotation.apply(points) + model.geom_pos[geom]


def _bevelled_box(half: Float[np.ndarray, "3"]) -> Float[np.ndarray, "24 3"]:
    cut = min(BEVEL_M, 0.2 * float(half.min()))
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    # Each corner becomes three: one in each of the faces that meet there.
    return np.concatenate([signs * (half - cut * (np.arange(3) != face)) for face in range(3)])


def _drives_xml(p: TwinParameters) -> str:
    """Return the fingers' coupling, a motor at each joint, and the gripper's own position control."""
    motors = "".join(
        f'<motor name="motor{k + 1}" joint="joint{k + 1}" ctrlrange="-{limit} {limit}"/>'
        for k, limit in enumerate(TORQUE_LIMIT_NM)
    )
    return (
        '<tendon><fixed name="opening"><joint joint="finger_left" coef="0.5"/>'
        '<joint joint="finger_right" coef="0.5"/></fixed></tendon>'
        '<equality><joint joint1="finger_left" joint2="finger_right" polycoef="0 1 0 0 0" solref="0.005 1"/>'
        f'</equality><actuator>{motors}<position name="gripper" tendon="opening" kp="{FINGER_KP}" '
        f'kv="{FINGER_KV}" forcerange="-{p.grip_force_n:.6g} {p.grip_force_n:.6g}" '
        f'ctrlrange="0 {FINGER_TRAVEL_M}"/></actuator>'
    )


def _change_robot(spec: Any, p: TwinParameters) -> None:
    """Give the arm its friction and errors, and the pads their rubber."""
    for k in range(NUM_ARM_JOINTS):
        joint = spec.joint(f"joint{k + 1}")
        joint.armature = ARMATURE_KG_M2[k] * p.armature_scale
        joint.frictionloss = p.joint_friction_nm
        joint.damping = [0.5, 0.0, 0.0]
        joint.stiffness = [0.0, 0.0, 0.0]
        spec.body(f"link{k + 1}").gravcomp = p.gravity_compensation
    hand = spec.body("hand")
    mount = Rotation.from_euler("z", -np.pi / 4) * Rotation.from_rotvec(p.mount_rad)
    hand.pos = np.asarray(hand.pos) + p.mount_pos_m
    hand.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    hand.quat = mount.as_quat(scalar_first=True)
    for pad in PADS:
        geom = spec.geom(pad)
        geom.condim = 6
        geom.friction = [p.pad_friction, 0.005, 0.0005]
        geom.solref = [p.contact_time_s, 1.0]
        geom.solimp = [0.9, 0.95, 0.001, 0.5, 2.0]


def _paint_table(spec: Any, p: TwinParameters) -> None:
    """Lay a wood-like grain on the table: streaks along x, of two octaves."""
    rng = np.random.default_rng(int(p.grain * 1e6))
    streaks = np.zeros((GRAIN_PX, GRAIN_PX))
    for rows in (32, 128):
        noise = rng.standard_normal((rows, 8))
        streaks += np.kron(noise, np.ones((GRAIN_PX // rows, GRAIN_PX // 8)))
    colour = p.table_grey * (1.0 + p.table_warmth * np.array([1.0, 0.2, -1.0]))
    pixels = colour * (1.0 + p.grain * streaks[..., None] / 3)
    spec.add_texture(
        name="grain",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=GRAIN_PX,
        height=GRAIN_PX,
        nchannel=3,
        data=(np.clip(pixels, 0, 1) * 255).astype(np.uint8).ravel().tolist(),
    )
    material = spec.add_material(name="grain", texrepeat=[3, 3], specular=0.1)
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "grain"
    spec.geom("table").material = "grain"


def _fovy_deg(camera: Camera) -> float:
    return float(2 * np.degrees(np.arctan(camera.height_px / 2 / camera.K[1, 1])))
