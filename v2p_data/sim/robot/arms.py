"""Arms as MJCF, the built-in one (`franka`) or any other: text, names of tool and fingers, limits.

The text gives bodies, joints and geoms. Its actuators, tendons, sensors, keyframes and contact
excludes are left out, and constraints that hold the arm are refused: every arm is driven by the
same Cartesian servos, on a site at its tool centre point. Gravity is compensated, and only the
last three links and the gripper collide, with objects and the table. In the model the names of
another arm than the built-in one begin with `robot/`.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.geometry.pose import matrix_from_quat
from v2p_data.sim.robot.franka import FRANKA_BODIES
from v2p_data.sim.robot.robot import (
    HOME_QPOS,
    PADS,
    PhysicsConfig,
    ServoConfig,
    ToolState,
    arm_qpos_for,
    servo_xml,
    tool_state,
)
from v2p_data.task.robot_files import robot_files

PREFIX = "robot/"
TCP_SITE = "v2p_tcp"
MIN_JOINTS = 6
COLLIDING_LINKS = 3
REDUNDANT_JOINT = 2
"""Of an arm with more than six joints, the one that a weak spring holds at its home angle."""
IK_STEPS = 150
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """Which arm; without a path, the built-in one."""

    path: Path | None = None
    """MJCF file of another arm with a parallel gripper."""
    eef_site: str = ""
    """Its tool centre point, 15 mm above the fingertips: a site, or a body from which `eef_offset_m` leads there."""
    eef_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From that site to the tool centre point, along the site's axes."""
    eef_turn_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Turns the site's axes so that z points out of the gripper and y along its opening."""
    fingers: tuple[str, str] = ("", "")
    """Its two finger joints: slides, 0 closed and open at their upper limit."""
    pads: tuple[str, str] = ("", "")
    """Geoms (or bodies) that touch what is grasped, one per finger."""
    home_qpos: tuple[float, ...] = ()
    """Joint angles [rad] from base to wrist with the gripper pointing down, about 0.5 m in front of the base."""
    base_pos_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the file's origin stands; the tool works at x 0.33 to 0.72, y -0.32 to 0.32, z 0.017 to 0.45."""
    base_yaw_rad: float = 0.0


def robot_to_json(cfg: RobotConfig) -> dict[str, Any]:
    """Return the config for a task bundle; nothing for the built-in arm."""
    if cfg.path is None:
        return {}
    return {**asdict(cfg), "path": str(cfg.path.resolve())}


def robot_from_json(data: dict[str, Any]) -> RobotConfig:
    """Return what `robot_to_json` wrote down."""
    fields = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
    return RobotConfig(**{**fields, "path": Path(data["path"])}) if data else RobotConfig()


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Where an arm is in the model's state, and its kinematics."""

    arm: slice
    """Its joints in `qpos`."""
    arm_dofs: slice
    """Its joints in `qvel`."""
    fingers: slice
    """The two fingers' travel in `qpos`."""
    finger_travel_m: float
    """Travel of one finger; the gripper opens by twice as much."""
    tool_state: Callable[[np.ndarray, np.ndarray], ToolState]
    """From joint angles and speeds, without the lag of one time step that MuJoCo's own output has."""
    qpos_for: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """Joint angles for tool positions and yaws, gripper down."""

    @property
    def num_joints(self) -> int:
        return self.arm.stop - self.arm.start


FRANKA_MJCF = f'<mujoco><compiler angle="radian"/><worldbody>{FRANKA_BODIES}</worldbody></mujoco>'
FRANKA = RobotConfig(
    eef_site="tcp", fingers=("finger_left", "finger_right"), pads=PADS, home_qpos=HOME_QPOS
)
"""The built-in arm's names."""


@dataclass(frozen=True, kw_only=True)
class ArmFile:
    """An arm that was read and made ready to be put into a world."""

    cfg: RobotConfig
    spec: Any
    servo: ServoConfig
    physics: PhysicsConfig
    chain: tuple[str, ...]
    """Its bodies from base to tool."""
    tcp: str
    """Site at its tool centre point."""
    tool_state: Callable[[np.ndarray, np.ndarray], ToolState]
    qpos_for: Callable[[np.ndarray, np.ndarray], np.ndarray]
    joints: tuple[str, ...]
    finger_travel_m: float
    pad_kind: str
    """`geom` or `body`."""

    @property
    def prefix(self) -> str:
        """Begins its names in the model."""
        return PREFIX if self.cfg.path else ""

    @property
    def servos_xml(self) -> str:
        """What drives it, for the root of a model."""
        left, right = (self.prefix + name for name in self.cfg.fingers)
        return servo_xml(self.servo, self.prefix + self.tcp, (left, right), self.finger_travel_m)

    @property
    def sensor_ends(self) -> tuple[str, ...]:
        """For each pad the XML attribute of a contact sensor that refers to it."""
        return tuple(f'{self.pad_kind}1="{self.prefix}{pad}"' for pad in self.cfg.pads)

    @property
    def any_part(self) -> str:
        """The XML attribute of a contact sensor that refers to the whole arm."""
        return f'subtree1="{self.prefix}{self.chain[0]}"'

    @property
    def bodies_xml(self) -> str:
        """What stands in the `<worldbody>` of a world's text: the built-in arm. Others follow with `put_into`."""
        return "" if self.cfg.path else FRANKA_BODIES

    def put_into(self, world: Any) -> None:
        """Add the arm to the spec of a world, or make it ready there."""
        if self.cfg.path is None:
            names = {body.name for body in self.spec.bodies[1:]}
            self.make_ready(world, [body for body in world.bodies if body.name in names])
            return
        turn = Rotation.from_euler("z", self.cfg.base_yaw_rad).as_quat(scalar_first=True)
        frame = world.worldbody.add_frame(pos=list(self.cfg.base_pos_m), quat=turn.tolist())
        world.attach(self.spec, prefix=PREFIX, frame=frame)

    def make_ready(self, spec: Any, bodies: Sequence[Any]) -> None:
        """Give bodies and joints in a spec what the servos need, and let wrist and gripper alone collide."""
        cfg, servo = self.cfg, self.servo
        for name in (*self.joints, *cfg.fingers):
            joint = spec.joint(name)
            is_finger = name in cfg.fingers
            # Without inertia and friction stiff servos shake.
            joint.armature = max(joint.armature, servo.finger_armature_kg if is_finger else 0.1)
            joint.damping = np.maximum(joint.damping, [2.0 if is_finger else 1.0, 0, 0])
            joint.frictionloss = 0.0
        if len(self.joints) > MIN_JOINTS:
            elbow, home = spec.joint(self.joints[REDUNDANT_JOINT]), cfg.home_qpos[REDUNDANT_JOINT]
            elbow.stiffness = [servo.elbow_stiffness_nm, 0, 0]
            elbow.springref = np.degrees(home) if spec.compiler.degree else home
        moving = [name for name in self.chain if spec.body(name).joints]
        wrist = moving[-COLLIDING_LINKS]
        near = {b.name for b in spec.body(wrist).find_all(mujoco.mjtObj.mjOBJ_BODY)} | {wrist}
        for body in bodies:
            if body.name != "world":
                body.gravcomp = 1
            for geom in body.geoms:
                collides = body.name in near and (geom.contype or geom.conaffinity)
                geom.contype, geom.conaffinity = (2 if collides else 0), 0
                if collides and (geom.name if self.pad_kind == "geom" else body.name) in cfg.pads:
                    geom.condim, geom.priority = 4, 1
                    geom.friction = [1.0, 0.01, 0.001]
                    geom.solref = [self.physics.solref_s, 1.0]
                    geom.solimp = [0.95, 0.99, 0.001, 0.5, 2.0]

    def robot(self, model: mujoco.MjModel) -> Robot:
        """Return where the arm is in the compiled model."""
        joints = [model.joint(self.prefix + j) for j in self.joints]
        fingers = [model.joint(self.prefix + j) for j in self.cfg.fingers]
        where = self.cfg.path
        return Robot(
            arm=_span([int(j.qposadr[0]) for j in joints], f"the arm joints of {where}"),
            arm_dofs=_span([int(j.dofadr[0]) for j in joints], f"the arm joints of {where}"),
            fingers=_span([int(j.qposadr[0]) for j in fingers], f"the finger joints of {where}"),
            finger_travel_m=self.finger_travel_m,
            tool_state=self.tool_state,
            qpos_for=self.qpos_for,
        )


def read_arm(cfg: RobotConfig, physics: PhysicsConfig, servo: ServoConfig) -> ArmFile:
    """Return the arm in `cfg.path`, or the built-in one, stripped of what drives it there.

    Raises:
        V2PError: there is no such file, it is no MJCF, or it lacks what `cfg` names.
    """
    if cfg.path is None:
        cfg, spec = FRANKA, mujoco.MjSpec.from_string(FRANKA_MJCF)
        model = spec.compile()
    else:
        spec, model = _loaded(cfg.path)
    body, place = _tool(cfg, model)
    chain = _chain_to(model, body)
    fingers = [_named(model, "joint", name, cfg, "fingers") for name in cfg.fingers]
    joints = [int(j) for b in chain for j in _joints_of(model, b)]
    names = tuple(model.joint(j).name for j in joints)
    _check_joints(cfg, model, joints, fingers)
    _check_free(cfg, model, chain, joints, fingers)
    travel = float(min(model.jnt_range[j, 1] for j in fingers))
    kind = "geom" if cfg.pads[0] in _names(model, "geom") else "body"
    for pad in cfg.pads:
        _named(model, kind, pad, cfg, "pads")
    _strip(spec, cfg)
    arm = ArmFile(
        cfg=cfg,
        spec=spec,
        servo=servo,
        physics=physics,
        chain=tuple(model.body(b).name for b in chain),
        tcp=cfg.eef_site,
        tool_state=tool_state,
        qpos_for=arm_qpos_for,
        joints=names,
        finger_travel_m=travel,
        pad_kind=kind,
    )
    arm.make_ready(spec, spec.bodies)
    if cfg.path is None:
        return arm
    spec.body(model.body(body).name).add_site(
        name=TCP_SITE, pos=place[:3, 3].tolist(), quat=_quat(place[:3, :3]).tolist(), group=4
    )
    base = np.eye(4)
    base[:3, :3] = Rotation.from_euler("z", cfg.base_yaw_rad).as_matrix()
    base[:3, 3] = cfg.base_pos_m
    found = Kinematics(model, chain, base, place, cfg)
    return replace(arm, tcp=TCP_SITE, tool_state=found.tool_state, qpos_for=found.qpos_for)


def _loaded(path: Path) -> tuple[Any, mujoco.MjModel]:
    """Return what a robot's file holds, as it is and compiled."""
    if not path.is_file():
        raise V2PError(f"there is no robot file {path}; --sim.robot.path names an MJCF file")
    robot_files(path)  # nothing is compiled that is more than an arm
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        return spec, spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        words = " ".join(str(error).split())
        raise V2PError(f"robot file {path} is no MJCF that MuJoCo reads: {words}") from error


class Kinematics:
    """A chain of hinges and slides from the world to the tool, for a batch of arms.

    Args:
        model: the arm alone.
        chain: its bodies, from base to tool.
        base: 4 x 4, of the arm's origin in the world.
        place: 4 x 4, of the tool in the last body.
        cfg: home angles, and the file's name for messages.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        chain: list[int],
        base: Float[np.ndarray, "4 4"],
        place: Float[np.ndarray, "4 4"],
        cfg: RobotConfig,
    ) -> None:
        self._base, self._place, self._cfg = base, place, cfg
        self._bodies = [
            (model.body_pos[b].copy(), matrix_from_quat(model.body_quat[b]), _joints_of(model, b))
            for b in chain
        ]
        ids = [j for _, _, js in self._bodies for j in js]
        self._axis = {j: model.jnt_axis[j].copy() for j in ids}
        self._anchor = {j: model.jnt_pos[j].copy() for j in ids}
        self._zero = {j: float(model.qpos0[model.jnt_qposadr[j]]) for j in ids}
        self._is_hinge = {j: int(model.jnt_type[j]) == HINGE for j in ids}
        limited = np.asarray(model.jnt_limited)[ids].astype(bool)[:, None]
        self._range = np.where(limited, model.jnt_range[ids], [[-np.inf, np.inf]])

    def tool_state(
        self, qpos: Float[np.ndarray, "env joint"], qvel: Float[np.ndarray, "env joint"]
    ) -> ToolState:
        """Return the tool's state from joint angles and speeds."""
        R, pos, jacobian = self._forward(qpos)
        twist = np.einsum("njk,nk->nj", jacobian, qvel)
        quat = Rotation.from_matrix(np.nan_to_num(R)).as_quat(scalar_first=True)
        return ToolState(
            pos=pos,
            rotation=R,
            quat_wxyz=quat,
            vel_linear=twist[:, :3],
            vel_angular=twist[:, 3:],
        )

    def qpos_for(
        self, pos: Float[np.ndarray, "n 3"], yaw_rad: Float[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n joint"]:
        """Return joint angles near the home pose that hold the tool at `pos`, down and turned by `yaw_rad`.

        Raises:
            V2PError: a pose is out of reach.
        """
        home = np.asarray(self._cfg.home_qpos)
        qpos = np.tile(home, (len(pos), 1))
        half = np.asarray(yaw_rad) / 2
        zero = np.zeros(len(pos))
        wanted = Rotation.from_quat(
            np.stack([zero, np.cos(half), np.sin(half), zero], axis=1), scalar_first=True
        )
        error = np.full((len(pos), 6), np.inf)
        for _ in range(IK_STEPS):
            R, at, jacobian = self._forward(qpos)
            turn = (wanted * Rotation.from_matrix(R).inv()).as_rotvec()
            error = np.concatenate([pos - at, turn], axis=1)
            if np.abs(error).max() < 1e-9:
                break
            across = jacobian.transpose(0, 2, 1)
            back = across @ np.linalg.inv(jacobian @ across + 1e-8 * np.eye(6))
            step = (back @ error[..., None])[..., 0]
            rest = 0.1 * (home - qpos)  # what the tool does not feel leads home
            step += rest - (back @ (jacobian @ rest[..., None]))[..., 0]
            qpos += np.clip(step, -0.3, 0.3)
        low, high = self._range.T
        bad = (np.abs(error).max(1) > 1e-6) | ((qpos < low) | (qpos > high)).any(1)
        if bad.any():
            raise V2PError(
                f"robot {self._cfg.path} cannot hold its tool at {np.round(pos[bad][0], 3)} m with yaw "
                f"{yaw_rad[bad][0]:.2f} rad, gripper down; set base_pos_m nearer to the workspace, or home_qpos"
            )
        return qpos

    def _forward(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the tool's rotations `(n, 3, 3)`, positions `(n, 3)` and Jacobians `(n, 6, joint)`."""
        n = len(qpos)
        R = np.tile(self._base[:3, :3], (n, 1, 1))
        pos = np.tile(self._base[:3, 3], (n, 1))
        axes, anchors, hinges = [], [], []
        for offset, turn, joints in self._bodies:
            pos = pos + R @ offset
            R = R @ turn
            for j in joints:
                value = qpos[:, len(axes)] - self._zero[j]
                axis, anchor = R @ self._axis[j], pos + R @ self._anchor[j]
                axes.append(axis)
                anchors.append(anchor)
                hinges.append(self._is_hinge[j])
                if self._is_hinge[j]:
                    R = R @ _turns(self._axis[j], value)
                    pos = anchor - R @ self._anchor[j]
                else:
                    pos = pos + axis * value[:, None]
        pos = pos + R @ self._place[:3, 3]
        R = R @ self._place[:3, :3]
        jacobian = np.zeros((n, 6, len(axes)))
        for k, (axis, anchor, is_hinge) in enumerate(zip(axes, anchors, hinges, strict=True)):
            jacobian[:, :3, k] = np.cross(axis, pos - anchor) if is_hinge else axis
            if is_hinge:
                jacobian[:, 3:, k] = axis
        return R, pos, jacobian


# --- reading -----------------------------------------------------------------------------------------------------


def _tool(cfg: RobotConfig, model: mujoco.MjModel) -> tuple[int, np.ndarray]:
    """Return the body that carries the tool, and the tool's place in it, 4 x 4."""
    offset = np.eye(4)
    offset[:3, :3] = matrix_from_quat(np.asarray(cfg.eef_turn_wxyz))
    offset[:3, 3] = cfg.eef_offset_m
    if cfg.eef_site in _names(model, "body")[1:]:
        return int(model.body(cfg.eef_site).id), offset
    site = _named(model, "site", cfg.eef_site, cfg, "eef_site")
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = matrix_from_quat(model.site_quat[site]), model.site_pos[site]
    return int(model.site_bodyid[site]), place @ offset


def _chain_to(model: mujoco.MjModel, body: int) -> list[int]:
    chain = []
    while body:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain[::-1]


def _joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    first = int(model.body_jntadr[body])
    return list(range(first, first + int(model.body_jntnum[body])))


def _check_joints(
    cfg: RobotConfig, model: mujoco.MjModel, joints: list[int], fingers: list[int]
) -> None:
    simple = (HINGE, SLIDE)
    for j in joints:
        if model.jnt_type[j] not in simple:
            raise V2PError(
                f"joint '{model.joint(j).name}' of robot {cfg.path} is neither hinge nor slide; an arm on a fixed "
                "base is wanted"
            )
    if len(joints) < MIN_JOINTS:
        raise V2PError(
            f"robot {cfg.path} has {len(joints)} joints from its base to '{cfg.eef_site}'; at least {MIN_JOINTS} are "
            "needed to place and turn the tool"
        )
    if len(cfg.home_qpos) != len(joints):
        known = ", ".join(model.joint(j).name for j in joints)
        raise V2PError(
            f"home_qpos of robot {cfg.path} has {len(cfg.home_qpos)} angles; it needs one for each of {known}"
        )
    for j in fingers:
        low, high = model.jnt_range[j]
        if model.jnt_type[j] != SLIDE or abs(low) > 2e-3 or high < 0.01:
            raise V2PError(
                f"finger joint '{model.joint(j).name}' of robot {cfg.path} moves from {low:.3g} to {high:.3g}; slides "
                "are wanted that are 0 closed and at least 0.01 m at their upper limit"
            )


def _check_free(
    cfg: RobotConfig,
    model: mujoco.MjModel,
    chain: list[int],
    joints: list[int],
    fingers: list[int],
) -> None:
    """Refuse equality constraints that hold arm or fingers.

    `_strip` leaves out those that couple the fingers' joints.
    """
    bodies = {*chain, *(int(model.jnt_bodyid[j]) for j in fingers)}
    for k in np.flatnonzero(model.eq_active0):
        ends = {int(e) for e in (model.eq_obj1id[k], model.eq_obj2id[k]) if e >= 0}
        kind = mujoco.mjtEq(model.eq_type[k]).name.removeprefix("mjEQ_").lower()
        if kind == "joint":
            held = [model.joint(j).name for j in ends & set(joints) if not ends & set(fingers)]
        elif kind in ("weld", "connect"):
            if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
                ends = {int(model.site_bodyid[site]) for site in ends}
            held = [model.body(b).name for b in ends & bodies]
        else:
            held = ["a tendon"]
        if held:
            raise V2PError(
                f"robot file {cfg.path} holds '{held[0]}' by an equality constraint (<{kind}>); "
                "arm and fingers must be free "
                "to move: take it out, or make one body of what never comes apart"
            )


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = {"site": model.nsite, "body": model.nbody, "joint": model.njnt, "geom": model.ngeom}
    return [getattr(model, kind)(i).name for i in range(count[kind])]


def _named(model: mujoco.MjModel, kind: str, name: str, cfg: RobotConfig, option: str) -> int:
    names = _names(model, kind)
    if not name or name not in names:
        raise V2PError(
            f"robot {cfg.path} has no {kind} '{name}', which {option} names."
            f"{did_you_mean(name, [n for n in names if n and n != 'world'])}"
        )
    return int(getattr(model, kind)(name).id)


def _span(addresses: list[int], what: str) -> slice:
    if addresses != list(range(addresses[0], addresses[0] + len(addresses))):
        raise V2PError(f"{what} do not follow one another in the model; reorder its bodies")
    return slice(addresses[0], addresses[-1] + 1)


# --- making ready ------------------------------------------------------------------------------------------------


def _strip(spec: Any, cfg: RobotConfig) -> None:
    """Remove what drives, measures, pairs for contact or not, or couples the fingers; the world brings its own."""
    for equality in list(spec.equalities):
        if not equality.active or {equality.name1, equality.name2} & set(cfg.fingers):
            spec.delete(equality)
    for elements in (
        spec.actuators,
        spec.sensors,
        spec.keys,
        spec.pairs,
        spec.excludes,
        spec.tendons,
    ):
        for element in list(elements):
            spec.delete(element)


def _turns(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the rotations about one axis, `(n, 3, 3)` (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sin, cos = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sin * K + (1 - cos) * (K @ K)


def _quat(R: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(R).as_quat(scalar_first=True)
