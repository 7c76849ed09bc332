"""The training simulator as a mirror of the twin: it draws the starts, and judges what really happened.

No physics runs in it. After each control step the twin's truth is written into one of its worlds, so that experts see
the states they know, the task's own success is asked, and the independent referee sees what happened.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig, StepResult, robot_of
from v2p_data.sim.env.targets import ToolPose
from v2p_data.sim.env.task_code import FRESH
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M
from v2p_data.sim.wrappers.gym_env import stream_seed
from v2p_data.task.task import TaskBundle
from v2p_data.twin.world import TwinWorld


@dataclass(frozen=True, kw_only=True)
class Start:
    """How an episode begins."""

    joints: Float[np.ndarray, "7"]
    object_poses: Float[np.ndarray, "object 7"]
    """Position [m] and `quat_wxyz` of each object."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """A moment of the twin as only its simulator knows it, world frame; for the referee and for experts."""

    joints: Float[np.ndarray, "7"]
    joint_speeds: Float[np.ndarray, "7"]
    fingers: Float[np.ndarray, "2"]
    """Travel of each finger [m]."""
    object_poses: Float[np.ndarray, "object 7"]
    object_speeds: Float[np.ndarray, "object 6"]
    """Linear in the world frame, angular in the object's frame."""
    touches: Float[np.ndarray, "object 3"]
    """1 where the left pad, the right pad touches the object, any part of the arm touched it in the last step."""
    deepest_m: float
    """Deepest penetration of any contact."""
    is_broken: bool
    """The simulation broke down."""


class Mirror(BatchEnv):
    """One world of the training simulator that follows the twin: no physics runs in it.

    Args:
        bundle: the task.

    Raises:
        V2PError: the task is made for another arm than the built-in one.
        ItemRejectedError: the task cannot be simulated.
    """

    def __init__(self, bundle: TaskBundle) -> None:
        sim = SimConfig(fine=True)
        robot = robot_of(bundle, sim)
        if robot.path:
            raise V2PError(
                f"task '{bundle.title}' is made for the arm in {robot.path}; the twin is a Franka arm with a parallel "
                "gripper, so make the task again without --robot.path"
            )
        super().__init__(bundle, sim, num_envs=1, seed=0, num_threads=1)
        self.referee = RefereeRecord(self)

    def start(self, seed: int, world: TwinWorld) -> Start:
        """Return how the episode of `V2PEnv.reset(seed=seed)` begins, at the heights of the twin's table."""
        self.reset_seeded(np.array([0]), [stream_seed(seed)])
        seen = self.snapshot(np.array([0])).qpos[0]
        robot, first = self.world.robot, self.world.objects[0].qpos_adr
        count = len(self.world.objects)
        poses = seen[first : first + 7 * count].reshape(count, 7).copy()
        above_table = self.randomizer.per_world_arrays()["height_above_table"][0]
        poses[:, 2] += world.rest_height_m - above_table
        return Start(joints=seen[robot.arm].copy(), object_poses=poses)

    def begin(self, world: TwinWorld, truth: Truth, target: ToolPose) -> None:
        """Take over the first moment of an episode."""
        self.randomizer.size_m[0] = world.size_m
        self._steps[:] = 0
        self._judgement.held[:] = FRESH
        self._last_action[:] = 0
        self._start_pose[:] = truth.object_poses
        self._take_over(truth, target)
        self.referee.restart()

    def follow(self, truth: Truth, target: ToolPose, action: Float[np.ndarray, "7"]) -> StepResult:
        """Take over the moment that an action led to, and say what the task's own success says of it."""
        clipped = np.clip(np.nan_to_num(action[None]), -1.0, 1.0)
        self._last_action[:] = clipped
        self._steps += 1
        self._take_over(truth, target)
        result = self._judged(torch.from_numpy(clipped.astype(np.float32)))
        self.referee.note()
        return result

    def _take_over(self, truth: Truth, target: ToolPose) -> None:
        sim, robot = self._sim, self.world.robot
        sim.qpos[:, robot.arm] = truth.joints
        sim.qvel[:, robot.arm_dofs] = truth.joint_speeds
        sim.qpos[:, robot.fingers] = truth.fingers
        sim.object_qpos[:], sim.object_qvel[:] = truth.object_poses, truth.object_speeds
        self._touches[:] = truth.touches
        sim.target_pos[:] = target.pos
        sim.target_quat[:] = target.rotation.as_quat(scalar_first=True)
        sim.target_finger[:] = target.opening * FINGER_TRAVEL_M
        self.broken_count += sim.look()
        self._fill(slice(None), sim.tool)
