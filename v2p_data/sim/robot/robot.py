"""What drives an arm, and the built-in arm's closed-form kinematics; `franka` has its bodies.

An arm follows Cartesian targets by itself: three position servos and one quaternion servo act on the tool
centre point `tcp`, so nothing inverts kinematics while it runs. Controls are
`[x, y, z, qw, qx, qy, qz, finger]`: the wanted `tcp` pose in the world [m, wxyz] and the finger travel
[m], 0 closed and `FINGER_TRAVEL_M` open. Joint 3 carries a weak spring towards 0: every reachable pose has
a solution with joint 3 at 0, so the spring settles the arm's redundancy without moving the tool.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import conjugates, product

HOME_QPOS = (0.0, 0.1, 0.0, -2.15, 0.0, 2.25, 0.7853981633974483)
"""Joint angles [rad] with the gripper pointing down in front of the robot."""
NUM_ARM_JOINTS = 7
FINGER_TRAVEL_M = 0.0425
"""Travel of one finger; the gripper opens by twice as much."""
TCP_BELOW_FLANGE_M = 0.107 + 0.145
FINGERTIP_BELOW_TCP_M = 0.015
QUAT_DOWN = (0.0, 1.0, 0.0, 0.0)
"""`quat_wxyz` of the gripper pointing straight down with zero yaw."""
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


JOINT_RANGES_RAD = (
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (-0.0175, 3.7525),
    (-2.8973, 2.8973),
)


def option_xml(physics: PhysicsConfig) -> str:
    """Return `<option>`: the settings under which scripted grasps held 64 of 64 objects.

    The discrete integrator is a must: under a noisy policy implicitfast flung objects in 9-15 % of steps.
    Fewer than 50 line-search steps or 10 iterations made grasps explode.
    """
    return (
        f'<option timestep="{physics.timestep_s}" integrator="discrete" cone="elliptic" impratio="3" '
        'iterations="20" ls_iterations="50" tolerance="1e-5" jacobian="dense"/>'
    )


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
        raise V2PError(
            f"tool position {pos[bad][0]} with yaw {yaw_rad[bad][0]:.2f} is out of the arm's reach; if it was drawn,"
            " lower randomization.arm_pos_m"
        )
    return qpos


_SHOULDER_HEIGHT, _UPPER_ARM, _ELBOW_OFFSET, _FOREARM, _WRIST_OFFSET = (
    0.333,
    0.316,
    0.0825,
    0.384,
    0.088,
)
"""Between the joints, as in `franka`."""
_TURNS_BACK = (False, True, False, False, True, False, False)
"""Each next frame is turned about x by 90 degrees, forth or back."""
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
        if _TURNS_BACK[i]:
            np.negative(axes[i - 1], out=frame.imag)
            axes[i] = before.imag
            wz, xy = wz + xy, xy - wz
        else:
            frame.imag = axes[i - 1]
            np.negative(before.imag, out=axes[i])
            wz, xy = wz - xy, xy + wz
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
