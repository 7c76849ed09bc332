"""The robot's side of an episode in the twin: states and actions of the dataset, and what the referee makes of it.

The same `next_target` that drives a real arm moves the target; the state comes from joint readings. One action lasts
50 ms. A success is one where the task's own success has held for 0.25 s and the independent referee agrees.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, UInt8

from v2p_data.sim.env.batch_env import SimConfig, StepResult
from v2p_data.sim.env.targets import ToolPose, next_target
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M
from v2p_data.sim.wrappers.gym_env import CONTROL_HZ, within_bounds
from v2p_data.task.task import TaskBundle
from v2p_data.twin.control import tool_pose
from v2p_data.twin.interface import RGB_PX
from v2p_data.twin.parameters import TwinParameters
from v2p_data.twin.robot import TwinRobot


class TwinArm:
    """One episode of a task in the twin.

    Args:
        bundle: the task.
        parameters: of the twin; by default the nominal one.
        size_px: width and height of pictures and labels.

    Attributes:
        measured: the last report of the joints and the gripper; pictures are taken with `picture`.
    """

    def __init__(
        self, bundle: TaskBundle, parameters: TwinParameters | None = None, size_px: int = RGB_PX
    ) -> None:
        self.robot = TwinRobot(bundle, parameters, size_px)
        self.mirror = self.robot.mirror
        cfg = self.mirror.cfg
        self.cfg: SimConfig = replace(
            cfg,
            position_step_m=cfg.position_step_m * bundle.motion_scale,
            position_leash_m=cfg.position_leash_m * bundle.motion_scale,
        )
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start the episode of a seed, with the gripper open and the target at the tool."""
        self.robot.reset(seed)
        self._measure()
        self.target = replace(self.tool, opening=1.0)
        self.robot.command(self.target)
        self.mirror.begin(self.robot.world, self.robot.truth(), self.target)

    def state(self) -> Float32[np.ndarray, "11"]:
        """Return `observation.state`, within the bounds of the training environment's."""
        state = within_bounds(self.tool.state(self.target))
        return state.astype(np.float32)

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the rectified picture.

        Raises:
            V2PError: there is no OpenGL.
        """
        return self.robot.picture()

    def act(self, action: Float[np.ndarray, "7"]) -> StepResult:
        """Carry out one action in [-1, 1], then measure; return what the mirror says of it, for judges only."""
        self.target = next_target(self.target, self.tool, action, self.cfg, FINGER_TRAVEL_M)
        self.robot.command(self.target)
        self.robot.step(1 / CONTROL_HZ)
        self._measure()
        truth = self.robot.truth()
        result = self.mirror.follow(truth, self.target, np.asarray(action, float))
        broke = result.terminated | truth.is_broken
        return replace(result, held=result.held & ~broke, terminated=broke)

    def close(self) -> None:
        """Free the graphics memory."""
        self.robot.close()

    def _measure(self) -> None:
        self.measured = self.robot.measure()
        self.tool: ToolPose = tool_pose(self.measured.joints, self.measured.opening)
