"""The twin as its robot: joint angles, gripper opening and a picture come out, tool poses go in, all of them late.

Time passes in `step` only. Commands and readings go through delay lines of physics steps. The truth is for the referee,
for experts and for true masks; nothing that is measured depends on it but through sensors.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from collections import deque
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from v2p_data.geometry.camera import Camera
from v2p_data.sim.env.targets import ToolPose
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M, NUM_ARM_JOINTS
from v2p_data.task.task import TaskBundle
from v2p_data.twin.camera import Optics, TwinCamera
from v2p_data.twin.control import ArmController, Gripper, reported_opening
from v2p_data.twin.interface import RGB_PX
from v2p_data.twin.mirror import Mirror, Truth
from v2p_data.twin.parameters import TwinParameters, episode_rng, nominal
from v2p_data.twin.world import TIMESTEP_S, build_twin

ARM = slice(0, NUM_ARM_JOINTS)
FINGERS = slice(NUM_ARM_JOINTS, NUM_ARM_JOINTS + 2)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What the arm and the gripper report."""

    joints: Float[np.ndarray, "7"]
    """By the encoders [rad]."""
    opening: float
    """By the gripper's register, 0 closed, 1 open."""


@dataclass(frozen=True, kw_only=True)
class _Sample:
    """One physics step, kept for the delay lines."""

    joints: Float[np.ndarray, "7"]
    travel_m: float
    qpos: Float[np.ndarray, "q"]


class TwinRobot:
    """The twin of one task.

    Args:
        bundle: the task.
        parameters: of the twin; by default the nominal one.
        size_px: width and height of the rectified picture.

    Raises:
        V2PError: the task is made for another arm.
        ItemRejectedError: the task cannot be simulated.
    """

    def __init__(
        self, bundle: TaskBundle, parameters: TwinParameters | None = None, size_px: int = RGB_PX
    ) -> None:
        self.parameters = parameters or nominal()
        self.mirror = Mirror(bundle)
        self.optics = Optics(parameters=self.parameters, size_px=size_px)
        self.world = build_twin(bundle.scene, self.parameters, self.optics.pinhole)
        self.camera = TwinCamera(self.world.like, self.optics)
        self._data = mujoco.MjData(self.world.model)
        p = self.parameters
        longest = max(
            p.reading_latency_s + p.latency_jitter_s, p.camera_latency_s + p.camera_jitter_s
        )
        self._past: deque[_Sample] = deque(maxlen=2 + round(longest / TIMESTEP_S))
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start the episode that `V2PEnv.reset(seed=seed)` starts in the training simulator."""
        start = self.mirror.start(seed, self.world)
        data, model = self._data, self.world.model
        mujoco.mj_resetData(model, data)
        data.qpos[ARM] = start.joints
        data.qpos[FINGERS] = FINGER_TRAVEL_M
        data.qpos[self.world.object_qpos] = start.object_poses
        mujoco.mj_forward(model, data)
        self._rng = episode_rng(seed, "latency")
        self.camera.begin(seed)
        self._steps = 0
        self._play = start.joints.copy()
        self._control = ArmController(self.parameters, self._encoders())
        self._gripper = Gripper(self.parameters, 1.0)
        self._due: deque[tuple[int, ToolPose]] = deque()
        self._arm_touched = np.zeros(len(self.world.objects))
        self._past.clear()
        self._keep()

    def measure(self) -> Measured:
        """Return what the arm and the gripper report now, without a picture."""
        p = self.parameters
        seen = self._late(p.reading_latency_s, p.latency_jitter_s)
        return Measured(joints=seen.joints.copy(), opening=reported_opening(seen.travel_m))

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the latest picture that has arrived, rectified.

        Raises:
            V2PError: there is no OpenGL.
        """
        p = self.parameters
        return self.camera.picture(self._late(p.camera_latency_s, p.camera_jitter_s).qpos)

    def command(self, target: ToolPose) -> None:
        """Send a tool pose and an opening; they reach the controllers after the command latency."""
        p = self.parameters
        delay_s = p.command_latency_s + p.latency_jitter_s * float(self._rng.uniform())
        arrival = self._steps + round(delay_s / TIMESTEP_S)
        if self._due:
            arrival = max(arrival, self._due[-1][0])
        self._due.append((arrival, target))

    def step(self, seconds: float) -> None:
        """Let time pass."""
        data, model = self._data, self.world.model
        self._arm_touched[:] = 0
        for _ in range(round(seconds / TIMESTEP_S)):
            while self._due and self._due[0][0] <= self._steps:
                _, target = self._due.popleft()
                self._control.aim(target.pos, target.rotation)
                self._gripper.command(target.opening)
            data.ctrl[ARM] = self._control.torque(self._encoders(), data.qvel[ARM])
            data.ctrl[NUM_ARM_JOINTS] = self._gripper.control(self._travel_m())
            mujoco.mj_step(model, data)
            self._arm_touched = np.maximum(self._arm_touched, self._touches()[:, 2])
            self._steps += 1
            self._keep()

    def calibration(self) -> Camera:
        """Return the camera of the rectified picture, as calibrated."""
        return self.optics.rectified

    def true_labels(self) -> UInt8[np.ndarray, "h w"]:
        """Return the true labels of what `picture` shows now but for its jitter; see `sim.masks`."""
        p = self.parameters
        return self.camera.labels(self._sample_before(p.camera_latency_s).qpos)

    def truth(self) -> Truth:
        """Return what only the simulator knows, for the referee and for experts."""
        data, world = self._data, self.world
        mujoco.mj_forward(world.model, data)  # contacts of this state, not of the one before
        touches = self._touches()
        touches[:, 2] = np.maximum(touches[:, 2], self._arm_touched)
        return Truth(
            joints=data.qpos[ARM].copy(),
            joint_speeds=data.qvel[ARM].copy(),
            fingers=data.qpos[FINGERS].copy(),
            object_poses=data.qpos[world.object_qpos],
            object_speeds=data.qvel[world.object_dofs],
            touches=touches,
            deepest_m=float(-data.contact.dist.min(initial=0.0)),
            is_broken=not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()),
        )

    def close(self) -> None:
        """Free the graphics memory."""
        self.camera.close()

    def _touches(self) -> Float[np.ndarray, "object 3"]:
        """Return 1 where the left pad, the right pad, any part of the arm touches each object."""
        world, touches = self.world, np.zeros((len(self.world.objects), 3))
        for geoms in self._data.contact.geom.tolist():
            for part, other in (geoms, geoms[::-1]):
                is_arm = part not in world.object_of_geom and world.model.geom_bodyid[part] > 0
                if is_arm and other in world.object_of_geom:
                    row = touches[world.object_of_geom[other]]
                    row[2] = 1.0
                    if part in world.pad_geoms:
                        row[world.pad_geoms.index(part)] = 1.0
        return touches

    def _travel_m(self) -> float:
        return float(self._data.qpos[FINGERS].mean())

    def _encoders(self) -> Float[np.ndarray, "7"]:
        """Return the motors' angles: within the play of the links', plus each encoder's zero error."""
        half = self.parameters.backlash_rad / 2
        link = self._data.qpos[ARM]
        self._play = np.minimum(np.maximum(self._play, link - half), link + half)
        return self._play + self.parameters.joint_offset_rad

    def _keep(self) -> None:
        self._past.append(
            _Sample(
                joints=self._encoders(), travel_m=self._travel_m(), qpos=self._data.qpos.copy()
            )
        )

    def _late(self, latency_s: float, jitter_s: float) -> _Sample:
        return self._sample_before(latency_s + jitter_s * float(self._rng.uniform()))

    def _sample_before(self, delay_s: float) -> _Sample:
        """Return the sample of some time ago, or the episode's first one."""
        back = round(delay_s / TIMESTEP_S)
        return self._past[max(len(self._past) - 1 - back, 0)]
