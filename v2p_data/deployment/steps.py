"""From what a policy says to the step of the tool that a robot takes, along one run.

`sim.env.actions` does the same in worlds. A robot's state tells where its controller brings the
tool, but not how it is turned there: the turns that were sent are added up, within the
controller's leash. World frame.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.deployment.robot import ActionScale, Reading
from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.targets import DOWN, near
from v2p_data.sim.robot.interface import STEPS, ArmInterface
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M
from v2p_data.twin.control import tool_pose


class StepMaker:
    """Translates readings into a policy's states, and a policy's actions into steps of the tool.

    Args:
        interface: the policy's.
        scale: what a step of 1 means on the robot.
    """

    def __init__(self, interface: ArmInterface = STEPS, scale: ActionScale | None = None) -> None:
        self.interface, self.scale = interface, scale or ActionScale()
        self._target: Rotation | None = None

    def state(self, reading: Reading) -> Float[np.ndarray, " state"]:
        """Return `observation.state` as the policy knows it.

        Raises:
            V2PError: it knows the angles of joints, and the robot gives none.
        """
        if not self.interface.joint_state:
            return reading.state
        if reading.joints_rad is None:
            raise V2PError(
                "the policy sees the angles of the arm's joints, and the robot gives none"
            )
        return np.concatenate([reading.state, reading.joints_rad])

    def step(self, action: Float[np.ndarray, " act"], reading: Reading) -> Float[np.ndarray, "7"]:
        """Return the step, each entry in [-1, 1], that leads to what an action says, or as near as one step can.

        An action that is a step already is returned as it is. A target that is not finite gives a step of NaN.
        """
        if self.interface.actions == "delta_tool":
            return action
        if not np.isfinite(action).all():
            return np.full(7, np.nan)
        if self.interface.actions == "joints":
            wanted = tool_pose(action[:-1], float(action[-1]))
            pos, rotation = wanted.pos, wanted.rotation
        else:
            pos, rotation = action[:3], DOWN * Rotation.from_rotvec(action[3:6])
        turn = (rotation * self._turned(reading).inv()).as_rotvec()
        close = (reading.target_opening - action[-1]) * FINGER_TRAVEL_M
        step = [
            (pos - reading.target_pos) / self.scale.position_step_m,
            turn / self.scale.rotation_step_rad,
            [close / self.scale.finger_step_m],
        ]
        return np.clip(np.concatenate(step), -1.0, 1.0)

    def sent(self, step: Float[np.ndarray, "7"], reading: Reading) -> None:
        """Note the step that was sent after a reading."""
        if self.interface.actions == "delta_tool":
            return
        turn = Rotation.from_rotvec(step[3:6] * self.scale.rotation_step_rad)
        target = turn * self._turned(reading)
        self._target = near(target, reading.rotation, SimConfig.rotation_leash_rad)

    def _turned(self, reading: Reading) -> Rotation:
        """Return how the controller's target is turned; like the tool, at first."""
        return reading.rotation if self._target is None else self._target
