"""The robot: a Franka-Panda-like arm with a 2F-85-like gripper, as MJCF text and as closed-form kinematics.

The arm follows Cartesian targets by itself: three position servos and one quaternion servo act on the tool
centre point `tcp`, so nothing inverts kinematics while it runs. Controls are
`[x, y, z, qw, qx, qy, qz, finger]`: the wanted `tcp` pose in the world [m, wxyz] and the finger travel
[m], 0 closed and `FINGER_TRAVEL_M` open. Joint 3 carries a weak spring towards 0: every reachable pose has
a solution with joint 3 at 0, so the spring settles the arm's redundancy without moving the tool.

Kinematics, joint limits, link masses and inertias are Franka Emika's published values.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.rotation import conjugates, product

HOME_QPOS = (0.0, 0.1, 0.0, -2.15, 0.0, 2.25, 0.7853981633974483)
"""Joint angles [rad] with the gripper pointing down in front of the robot."""
NUM_ARM_JOINTS = 7
FINGER_TRAVEL_M = 0.0425
"""Travel of one finger; the gripper opens by twice as much."""
TCP_BELOW_FLANGE_M = 0.107 + 0.145
FINGER_THICKNESS_M = 0.012
FINGERTIP_BELOW_TCP_M = 0.015
QUAT_DOWN = (0.0, 1.0, 0.0, 0.0)
"""`quat_wxyz` of the gripper pointing straight down with zero yaw."""
BASE_SITE_XML = '<site name="base" size="0.001" group="4"/>'
"""The world's origin, in which the servos' targets are given."""
PADS = ("pad_left", "pad_right")
NUM_CONTROLS = 8

TARGET_LOW_M = (0.33, -0.32, 0.017)
TARGET_HIGH_M = (0.72, 0.32, 0.45)
"""Corners of the box in which `tcp` targets may lie; at its bottom the fingertips are 2 mm above the table."""


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Time step and contact stiffness; one control step is 50 ms whatever the time step."""

    timestep_s: float
    substeps: int
    """Time steps per control step."""
    solref_s: float
    """Time constant of contacts; at least twice the time step."""

    def __post_init__(self) -> None:
        if self.solref_s < 2 * self.timestep_s:
            raise ValueError(
                f"solref_s {self.solref_s} must be at least twice timestep_s {self.timestep_s}"
            )

    @property
    def control_dt_s(self) -> float:
        return self.timestep_s * self.substeps


COARSE = PhysicsConfig(timestep_s=0.0125, substeps=4, solref_s=0.025)
"""For training: 2.5 times faster; hard-pressed objects may sink into containers' floors."""
FINE = PhysicsConfig(timestep_s=0.005, substeps=10, solref_s=0.01)
"""For evaluation and recording: no such penetration was seen."""


@dataclass(frozen=True, kw_only=True)
class ServoConfig:
    """Gains of the Cartesian servos. The tool lags by about `kv / kp` seconds."""

    position_kp: float = 6000.0
    position_kv: float = 300.0
    rotation_kp: float = 300.0
    rotation_kv: float = 20.0
    force_limit_n: float = 200.0
    torque_limit_nm: float = 30.0
    finger_kp: float = 5000.0
    finger_kv: float = 80.0
    grip_force_n: float = 40.0
    finger_armature_kg: float = 0.4
    """Damps the fingers' contacts: at 0.05 a scripted grasp lost 5 % of its objects."""
    elbow_stiffness_nm: float = 20.0
    history_samples: int = 5
    """Past controls kept for delayed actuation; covers 20 ms at the fine time step."""


# Per link: position and x-rotation [degrees] in its parent, mass [kg], centre of mass [m], inertia
# [kg m2: xx yy zz xy xz yz], joint range [rad]; then visual capsules as (from, to, radius).
_LINKS = (
    ((0, 0, 0.333), 0, 4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169), (-2.8973, 2.8973),
     (((0, 0, -0.19), (0, 0, 0), 0.06),)),
    ((0, 0, 0), -90, 0.646926, (-0.003141, -0.02872, 0.003495),
     (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704), (-1.7628, 1.7628),
     (((0, 0, -0.05), (0, 0, 0.05), 0.06), ((0, -0.06, 0), (0, -0.19, 0), 0.06))),
    ((0, -0.316, 0), 90, 3.228604, (0.027518, 0.039252, -0.066502),
     (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805), (-2.8973, 2.8973),
     (((0, 0, -0.12), (0, 0, 0), 0.055), ((0.0825, 0, 0), (0.0825, 0.06, 0), 0.05))),
    ((0.0825, 0, 0), 90, 3.587895, (-0.05317, 0.104419, 0.027454),
     (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641), (-3.0718, -0.0698),
     (((0, 0, -0.05), (0, 0, 0.05), 0.055), ((-0.0825, 0.08, 0), (-0.0825, 0.14, 0), 0.05))),
    ((-0.0825, 0.384, 0), -90, 1.225946, (-0.011953, 0.041065, -0.038437),
     (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229), (-2.8973, 2.8973),
     (((0, 0, -0.24), (0, 0, -0.17), 0.055), ((0, 0.05, -0.2), (0, 0.07, -0.02), 0.035))),
    ((0, 0, 0), 90, 1.666555, (0.060149, -0.014117, -0.010517),
     (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341), (-0.0175, 3.7525),
     (((0, 0, -0.05), (0, 0, 0.03), 0.045), ((0.03, 0, 0), (0.088, 0, 0), 0.045))),
    ((0.088, 0, 0), 90, 0.735522, (0.010517, -0.004252, 0.061597),
     (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741), (-2.8973, 2.8973),
     (((0, 0, -0.02), (0, 0, 0.08), 0.042),)),
)  # fmt: skip
JOINT_RANGES_RAD = tuple(link[5] for link in _LINKS)


def option_xml(physics: PhysicsConfig) -> str:
    """Return `<option>`: the settings under which scripted grasps held 64 of 64 objects.

    The discrete integrator is a must: under a noisy policy implicitfast flung objects in 9-15 % of steps.
    Fewer than 50 line-search steps or 10 iterations made grasps explode.
    """
    return (
        f'<option timestep="{physics.timestep_s}" integrator="discrete" cone="elliptic" impratio="3" '
        'iterations="20" ls_iterations="50" tolerance="1e-5" jacobian="dense"/>'
    )


def robot_body_xml(physics: PhysicsConfig, servo: ServoConfig) -> str:
    """Return the arm's bodies, for `<worldbody>`. Only wrist and gripper collide, never with each other."""
    opening, closing = "", ""
    for i, (pos, angle, mass, com, inertia, limits, capsules) in enumerate(_LINKS):
        stiffness = f' stiffness="{servo.elbow_stiffness_nm}"' if i == 2 else ""
        collision = "2" if i >= 4 else "0"
        opening += (
            f'<body name="link{i + 1}" pos="{xml_row(pos)}" euler="{np.radians(angle)} 0 0" gravcomp="1">'
            f'<inertial mass="{mass}" pos="{xml_row(com)}" fullinertia="{xml_row(inertia)}"/>'
            f'<joint name="joint{i + 1}" axis="0 0 1" range="{xml_row(limits)}" armature="0.1" damping="1"{stiffness}/>'
        )
        for k, (start, end, radius) in enumerate(capsules):
            opening += (
                f'<geom name="link{i + 1}_{k}" type="capsule" fromto="{xml_row(start)} {xml_row(end)}" size="{radius}" '
                f'contype="{collision}" conaffinity="0" rgba="0.93 0.93 0.95 1"/>'
            )
        closing += "</body>"
    base = (
        f"{BASE_SITE_XML}"
        '<geom name="link0_0" type="cylinder" fromto="0 0 0 0 0 0.14" size="0.07" contype="0" conaffinity="0" '
        'rgba="0.93 0.93 0.95 1"/>'
    )
    return base + opening + _gripper_xml(physics, servo) + closing


def _gripper_xml(physics: PhysicsConfig, servo: ServoConfig) -> str:
    fingers = ""
    for pad, joint, side in (("pad_left", "finger_left", 1), ("pad_right", "finger_right", -1)):
        fingers += (
            f'<body name="{joint}" pos="0 0 0.12" gravcomp="1">'
            f'<inertial mass="0.03" pos="0 {0.006 * side} 0.01" diaginertia="1e-5 1e-5 1e-5"/>'
            f'<joint name="{joint}" type="slide" axis="0 {side} 0" range="0 {FINGER_TRAVEL_M}" '
            f'armature="{servo.finger_armature_kg}" damping="2"/>'
            f'<geom name="{pad}" type="box" pos="0 {0.006 * side} 0.0075" size="0.011 0.006 0.0325" '
            f'contype="2" conaffinity="0" condim="4" friction="1 0.01 0.001" priority="1" '
            f'solref="{physics.solref_s} 1" solimp="0.95 0.99 0.001" rgba="0.3 0.3 0.32 1"/></body>'
        )
    return (
        '<body name="hand" pos="0 0 0.107" euler="0 0 -0.7853981633974483" gravcomp="1">'
        '<inertial mass="0.8" pos="0 0 0.045" diaginertia="9e-4 9e-4 5e-4"/>'
        '<geom name="palm" type="box" pos="0 0 0.045" size="0.035 0.05 0.045" contype="2" conaffinity="0" '
        'rgba="0.15 0.15 0.17 1"/>'
        f'<site name="tcp" pos="0 0 0.145" size="0.005" group="4"/>{fingers}</body>'
    )


def robot_rest_xml(servo: ServoConfig) -> str:
    """Return contact exclusions, the finger coupling and the servos, for the root of the model."""
    exclusion = '<contact><exclude body1="link7" body2="hand"/></contact>'
    return exclusion + servo_xml(servo, "tcp", ("finger_left", "finger_right"), FINGER_TRAVEL_M)


def servo_xml(servo: ServoConfig, site: str, fingers: tuple[str, str], travel_m: float) -> str:
    """Return the finger coupling and the servos of any arm with a tool site and two sliding fingers."""
    history = f'nsample="{servo.history_samples}" delay="0"'
    force = f'forcerange="-{servo.force_limit_n} {servo.force_limit_n}"'
    left, right = fingers
    axes = "".join(
        f'<position name="servo_{name}" site="{site}" refsite="base" gear="{gear} 0 0 0" '
        f'kp="{servo.position_kp}" kv="{servo.position_kv}" {force} {history}/>'
        for name, gear in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    return (
        f'<tendon><fixed name="opening"><joint joint="{left}" coef="0.5"/>'
        f'<joint joint="{right}" coef="0.5"/></fixed></tendon>'
        f'<equality><joint joint1="{left}" joint2="{right}" polycoef="0 1 0 0 0" '
        'solimp="0.95 0.99 0.001" solref="0.01 1"/></equality>'
        f"<actuator>{axes}"
        f'<orientation name="servo_rotation" site="{site}" refsite="base" input="quat" kp="{servo.rotation_kp}" '
        f'kv="{servo.rotation_kv}" forcerange="0 {servo.torque_limit_nm}" {history}/>'
        f'<position name="servo_gripper" tendon="opening" kp="{servo.finger_kp}" kv="{servo.finger_kv}" '
        f'forcerange="-{servo.grip_force_n} {servo.grip_force_n}" ctrlrange="0 {travel_m}" {history}/>'
        "</actuator>"
    )


@dataclass(frozen=True, kw_only=True)
class ToolState:
    """Pose and velocity of `tcp` in the world frame, for a batch of arms."""

    pos: Float[np.ndarray, "env 3"]
    rotation: Float[np.ndarray, "env 3 3"]
    quat_wxyz: Float[np.ndarray, "env 4"]
    vel_linear: Float[np.ndarray, "env 3"]
    vel_angular: Float[np.ndarray, "env 3"]


def tool_state(qpos: Float[np.ndarray, "env 7"], qvel: Float[np.ndarray, "env 7"]) -> ToolState:
    """Return the tool's state from joint angles and speeds.

    MuJoCo's own output lags the state by one time step; this one does not.
    """
    chain = _chain(qpos)
    turning = chain.axes * np.ascontiguousarray(qvel.T)[:, None]
    # Joints with the same lever turn the tool together.
    groups = np.stack([turning[:3].sum(0), turning[3], turning[4] + turning[5]])
    lever, next_, last = chain.levers, [1, 2, 0], [2, 0, 1]
    swept = groups[:, next_] * lever[:, last] - groups[:, last] * lever[:, next_]
    return ToolState(
        pos=chain.pos.T,
        rotation=chain.tool_axes.transpose(2, 1, 0),
        quat_wxyz=chain.quat_wxyz.T,
        vel_linear=swept.sum(0).T,
        vel_angular=(groups.sum(0) + turning[6]).T,
    )


def arm_qpos_for(
    pos: Float[np.ndarray, "n 3"], yaw_rad: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 7"]:
    """Return joint angles, joint 3 at 0, that hold `tcp` at `pos` with the gripper down and turned by `yaw_rad`.

    Damped Newton steps from the home pose; used once, to fill a bank of start poses.

    Raises:
        ValueError: a pose is out of reach.
    """
    n = len(pos)
    qpos = np.tile(np.asarray(HOME_QPOS), (n, 1))
    half = yaw_rad / 2
    wanted = np.stack([np.zeros(n), np.cos(half), np.sin(half), np.zeros(n)])
    free = [0, 1, 3, 4, 5, 6]
    error = np.full((n, 6), np.inf)
    for _ in range(60):
        chain = _chain(qpos)
        turn = _rotation_error(wanted, chain.quat_wxyz)
        error = np.concatenate([pos - chain.pos.T, turn.T], axis=1)
        if np.abs(error).max() < 1e-10:
            break
        jacobian = np.zeros((n, 6, 6))
        for k, i in enumerate(free):
            if i < len(_LEVER_OF_JOINT):
                jacobian[:, :3, k] = np.cross(chain.axes[i].T, chain.levers[_LEVER_OF_JOINT[i]].T)
            jacobian[:, 3:, k] = chain.axes[i].T
        step = np.linalg.solve(jacobian + 1e-9 * np.eye(6), error[..., None])[..., 0]
        qpos[:, free] += np.clip(step, -0.3, 0.3)
    low, high = np.array(JOINT_RANGES_RAD).T
    bad = (np.abs(error).max(1) > 1e-6) | ((qpos < low) | (qpos > high)).any(1)
    if bad.any():
        raise ValueError(
            f"tool position {pos[bad][0]} with yaw {yaw_rad[bad][0]:.2f} is out of the arm's reach"
        )
    return qpos


# What the links' places in their parents mean for the tool: all of them lie along axes that `_chain` goes through.
_SHOULDER_HEIGHT, _UPPER_ARM = _LINKS[0][0][2], -_LINKS[2][0][1]
_ELBOW_OFFSET, _FOREARM, _WRIST_OFFSET = _LINKS[3][0][0], _LINKS[4][0][1], _LINKS[6][0][0]
_LEVER_OF_JOINT = (0, 0, 0, 1, 2, 2)
"""Joints 1 to 3 meet in the shoulder and 5 and 6 in the wrist; joint 7 has none, it points at the tool."""


@dataclass(frozen=True, kw_only=True)
class _Chain:
    """Joints and tool in the world frame. Worlds come last here: numpy is fastest along the last axis."""

    axes: Float[np.ndarray, "7 3 n"]
    levers: Float[np.ndarray, "3 3 n"]
    """From shoulder, elbow and wrist to the tool."""
    tool_axes: Float[np.ndarray, "3 3 n"]
    """The tool's x, y and z."""
    quat_wxyz: Float[np.ndarray, "4 n"]
    pos: Float[np.ndarray, "3 n"]


def _chain(qpos: Float[np.ndarray, "n 7"]) -> _Chain:
    """Return where joint angles put the arm.

    A turn about a joint multiplies `x + iy` of its frame by `exp(-i angle)`, and `w + iz` and `x + iy` of the
    quaternion by `exp(i angle / 2)` and `exp(-i angle / 2)`. Each next frame is turned about x by 90 degrees.
    """
    angle = qpos.T.copy()
    angle[6] -= np.pi / 4  # the hand is turned by -45 degrees
    n = angle.shape[1]
    # numpy's tangent takes a tenth of the time of its sine and cosine.
    tangent = np.tan(0.25 * angle)
    square = tangent * tangent
    scale = 1.0 / (1.0 + square)
    half = (1.0 - square) * scale + 1j * (2.0 * tangent * scale)
    back = half.conj()
    turn = back * back
    frames = np.empty((NUM_ARM_JOINTS, 3, n), np.complex128)
    axes = np.zeros((NUM_ARM_JOINTS, 3, n))
    axes[0, 2] = 1.0
    frames[0, 0], frames[0, 1], frames[0, 2] = turn[0], 1j * turn[0], 0.0
    wz, xy = half[0], np.zeros(n, np.complex128)
    for i in range(1, NUM_ARM_JOINTS):
        before, frame = frames[i - 1], frames[i]
        frame.real = before.real
        if _LINKS[i][1] > 0:
            frame.imag = axes[i - 1]
            np.negative(before.imag, out=axes[i])
            wz, xy = wz - xy, xy + wz
        else:
            np.negative(axes[i - 1], out=frame.imag)
            axes[i] = before.imag
            wz, xy = wz + xy, xy - wz
        frame *= turn[i]
        wz *= half[i]
        xy *= back[i]
    levers = np.empty((3, 3, n))
    x = np.real(frames)
    np.add(_WRIST_OFFSET * x[5], TCP_BELOW_FLANGE_M * axes[6], out=levers[2])
    np.add(levers[2], _FOREARM * axes[4] - _ELBOW_OFFSET * x[3], out=levers[1])
    np.add(levers[1], _UPPER_ARM * axes[2] + _ELBOW_OFFSET * x[2], out=levers[0])
    pos = levers[0].copy()
    pos[2] += _SHOULDER_HEIGHT
    shrink = 0.5 ** ((NUM_ARM_JOINTS - 1) / 2)  # each turn by 90 degrees has left out a factor
    return _Chain(
        axes=axes,
        levers=levers,
        tool_axes=np.stack([x[6], np.imag(frames[6]), axes[6]]),
        quat_wxyz=np.stack([np.real(wz), np.real(xy), np.imag(xy), np.imag(wz)]) * shrink,
        pos=pos,
    )


def _rotation_error(wanted: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return twice the vector part of `wanted * conj(quat)`, `(3, n)`."""
    error = product(wanted, conjugates(quat))
    return 2 * np.where(error[0] < 0, -1.0, 1.0) * error[1:]


def xml_row(values: Iterable[float | int]) -> str:
    """Return numbers as the value of an XML attribute."""
    return " ".join(f"{v:.9g}" for v in values)
