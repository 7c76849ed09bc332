"""What runs inside the twin's arm and gripper: from a wanted tool pose to torques, and from an opening to a stroke.

The arm follows its own reference by joint impedance; damped least squares turn the Cartesian error into speeds of the
reference, within Franka's limits of joint speed, acceleration and torque. It knows the nominal arm only: its errors
of zero, mount and mass model are the twin's. The gripper moves at a finite speed and has no servo on its target.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.sim.env.targets import ToolPose
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M, JOINT_RANGES_RAD, NUM_ARM_JOINTS, tool_state
from v2p_data.twin.parameters import TwinParameters
from v2p_data.twin.world import TIMESTEP_S, TORQUE_LIMIT_NM, nominal_arm

SPEED_LIMIT_RAD_S = np.array([2.175] * 4 + [2.61] * 3)
"""Franka Emika's data sheet, as the next two."""
ACCELERATION_LIMIT_RAD_S2 = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
TORQUE_RATE_LIMIT_NM_S = 1000.0
SPEEDING_UP = (4.0, 25.0)
"""Largest acceleration of the reference [m/s2, rad/s2]; Franka's limits are 13 and 25."""
BRAKING = (3.0, 15.0)
"""The reference slows down in time to stop with these [m/s2, rad/s2], so that it does not overshoot."""
STIFFNESS_NM_RAD = np.array([600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0])
DAMPING_NM_S_RAD = np.array([50.0, 50.0, 50.0, 50.0, 30.0, 25.0, 15.0])
"""Damping of libfranka's joint impedance example."""
IK_DAMPING = 0.02
ELBOW_RETURN_HZ = 2.0
"""Joint 3 goes back to 0 at this rate where that moves no tool."""
REGISTER_COUNTS = 255
"""The gripper reports its opening in 8 bits, as the 2F-85 does."""
LEAD_M = 0.006
"""How far the gripper's reference may run ahead of a blocked finger."""


_TWIST_PARTS = (slice(0, 3), slice(3, 6))


class ArmController:
    """Follows a tool pose; called once per time step of the physics.

    Args:
        parameters: gains and limits.
        qpos: joint angles at the start, by the encoders.
    """

    def __init__(self, parameters: TwinParameters, qpos: Float[np.ndarray, "7"]) -> None:
        p = parameters
        self.parameters = p
        self.model = nominal_arm()
        self.data = mujoco.MjData(self.model)
        self.site = int(self.model.site("tcp").id)
        self.stiffness = STIFFNESS_NM_RAD * p.stiffness_scale
        self.damping = DAMPING_NM_S_RAD * p.damping_scale * np.sqrt(p.stiffness_scale)
        low, high = np.array(JOINT_RANGES_RAD).T
        self.low, self.high = low + 0.01, high - 0.01
        self.limit = np.array(TORQUE_LIMIT_NM)
        self.reference = qpos.copy()
        self.speed = np.zeros(NUM_ARM_JOINTS)
        self.acceleration = np.zeros(NUM_ARM_JOINTS)
        self.twist = np.zeros(6)
        self.commanded = np.zeros(NUM_ARM_JOINTS)
        self.applied = np.zeros(NUM_ARM_JOINTS)
        self._jacobian = np.zeros((6, self.model.nv))
        self._mass = np.zeros((self.model.nv, self.model.nv))
        self._place()
        self._wanted_pos = self.data.site_xpos[self.site].copy()
        self._wanted_quat = np.zeros(4)
        mujoco.mju_mat2Quat(self._wanted_quat, self.data.site_xmat[self.site])

    def aim(self, pos: Float[np.ndarray, "3"], rotation: Rotation) -> None:
        """Take a new tool pose to follow, in the base frame."""
        self._wanted_pos = pos
        self._wanted_quat = rotation.as_quat(scalar_first=True)

    def torque(
        self, qpos: Float[np.ndarray, "7"], qvel: Float[np.ndarray, "7"]
    ) -> Float[np.ndarray, "7"]:
        """Return the torques that the motors apply during the next time step [N m].

        Args:
            qpos: joint angles by the encoders.
            qvel: joint speeds by the encoders.
        """
        self._move_reference()
        wanted = self.stiffness * (self.reference - qpos) + self.damping * (self.speed - qvel)
        wanted += self._inertia() @ self.acceleration
        step = TORQUE_RATE_LIMIT_NM_S * TIMESTEP_S
        wanted = np.minimum(np.maximum(wanted, self.commanded - step), self.commanded + step)
        self.commanded = np.minimum(np.maximum(wanted, -self.limit), self.limit)
        lag = self.parameters.motor_lag_s
        self.applied = self.applied + (self.commanded - self.applied) * (
            TIMESTEP_S / (lag + TIMESTEP_S)
        )
        return self.applied

    def _place(self) -> None:
        self.data.qpos[:NUM_ARM_JOINTS] = self.reference
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def _inertia(self) -> Float[np.ndarray, "7 7"]:
        """Return the nominal arm's mass matrix at the reference."""
        mujoco.mj_crb(self.model, self.data)
        mujoco.mj_fullM(self.model, self.data, self._mass)
        return self._mass[:NUM_ARM_JOINTS, :NUM_ARM_JOINTS]

    def _move_reference(self) -> None:
        self._place()
        share = self.parameters.speed_share
        error = np.empty(6)
        error[:3] = self._wanted_pos - self.data.site_xpos[self.site]
        own, turn = np.zeros(4), np.zeros(4)
        mujoco.mju_mat2Quat(own, self.data.site_xmat[self.site])
        mujoco.mju_negQuat(own, own)
        mujoco.mju_mulQuat(turn, self._wanted_quat, own)
        mujoco.mju_quat2Vel(error[3:], turn, 1.0)
        mujoco.mj_jacSite(self.model, self.data, self._jacobian[:3], self._jacobian[3:], self.site)
        J = self._jacobian[:, :NUM_ARM_JOINTS]
        inverse = J.T @ np.linalg.inv(J @ J.T + IK_DAMPING**2 * np.eye(6))
        free = np.zeros(NUM_ARM_JOINTS)
        free[2] = -ELBOW_RETURN_HZ * self.reference[2]
        gain = self.parameters.reference_gain_hz
        for part, braking, speeding in zip(_TWIST_PARTS, BRAKING, SPEEDING_UP, strict=True):
            change = _braked(error[part], gain, braking) - self.twist[part]
            size = float(np.sqrt(change @ change))
            self.twist[part] += change * min(1.0, speeding * TIMESTEP_S / max(size, 1e-12))
        speed = inverse @ (self.twist - J @ free) + free
        over = float(np.max(np.abs(speed) / (share * SPEED_LIMIT_RAD_S)))
        speed = speed / max(over, 1.0)
        change = ACCELERATION_LIMIT_RAD_S2 * TIMESTEP_S
        step = np.minimum(np.maximum(speed - self.speed, -change), change)
        self.speed = self.speed + step
        self.acceleration = step / TIMESTEP_S
        reference = self.reference + TIMESTEP_S * self.speed
        self.reference = np.minimum(np.maximum(reference, self.low), self.high)


class Gripper:
    """Moves its reference towards the accepted opening at a finite speed.

    Args:
        parameters: speed and deadband.
        opening: at the start, 0 closed, 1 open.
    """

    def __init__(self, parameters: TwinParameters, opening: float) -> None:
        self.parameters = parameters
        self.accepted = opening
        self.reference_m = opening * FINGER_TRAVEL_M

    def command(self, opening: float) -> None:
        """Take a new opening, unless it is within the deadband of the last one taken."""
        if abs(opening - self.accepted) >= self.parameters.gripper_deadband:
            self.accepted = opening

    def control(self, travel_m: float) -> float:
        """Return the finger travel that the drive aims at during the next time step [m].

        Args:
            travel_m: of each finger, now.
        """
        step = self.parameters.gripper_speed_m_s / 2 * TIMESTEP_S
        goal = self.accepted * FINGER_TRAVEL_M
        moved = self.reference_m + min(max(goal - self.reference_m, -step), step)
        self.reference_m = min(max(moved, travel_m - LEAD_M), travel_m + LEAD_M)
        return self.reference_m


def _braked(
    error: Float[np.ndarray, "3"], gain_hz: float, braking: float
) -> Float[np.ndarray, "3"]:
    """Return the speed towards a goal: proportional when near, slow enough to stop when far."""
    distance = float(np.sqrt(error @ error))
    if distance * gain_hz**2 <= 2 * braking:
        return gain_hz * error
    return error * float(np.sqrt(2 * braking / distance))


def reported_opening(travel_m: float) -> float:
    """Return the opening as the gripper's register has it, 0 closed, 1 open."""
    share = min(max(travel_m / FINGER_TRAVEL_M, 0.0), 1.0)
    return round(share * REGISTER_COUNTS) / REGISTER_COUNTS


def tool_pose(joints: Float[np.ndarray, "7"], opening: float) -> ToolPose:
    """Return the tool's pose by the nominal kinematics.

    Args:
        joints: angles as reported [rad].
        opening: as reported.
    """
    tool = tool_state(joints[None], np.zeros((1, NUM_ARM_JOINTS)))
    return ToolPose(
        pos=tool.pos[0].copy(),
        rotation=Rotation.from_quat(tool.quat_wxyz[0], scalar_first=True),
        opening=opening,
    )
