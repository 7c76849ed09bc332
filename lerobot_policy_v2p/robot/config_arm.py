"""Settings that both robot types share.

LeRobot parses these configs, hence they are not frozen and one class extends another.
"""

from dataclasses import dataclass, field
from typing import Literal

from lerobot.robots import RobotConfig

from v2p_data.deployment.limits import LimitsConfig
from v2p_data.sim.robot.action_names import Actions
from v2p_data.sim.robot.interface import ArmInterface

Pictures = Literal["mask", "rgb"]


@dataclass(kw_only=True)
class ArmRobotConfig(RobotConfig):
    """What a robot does by itself under LeRobot's own tools, where `v2p deploy` does it otherwise."""

    pictures: Pictures = "mask"
    """What an observation holds: `mask` for policies, `rgb` for `v2p deploy`, which makes the masks itself."""
    clicks: str = ""
    """`mask` only: pixels of the objects in order, `120,80 60,200`. The masks are then tracked in
    the colour pictures from these pixels on. Without clicks simulated arms give true masks, and
    `franky` those of `masks`."""
    training_view: bool = True
    """`mask` only: masks are carried over from the robot's camera to that of the training. Off
    only for a policy that was trained with the robot's camera."""
    actions: Actions = "delta_tool"
    """`mask` only: what the policy says, as its dataset's `--episodes.actions`. `v2p deploy` knows
    it from the policy."""
    joint_state: bool = False
    """`mask` only: the angles of the arm's joints follow in the state, as with `--episodes.joint-state`."""
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    """`mask` only: what `send_action` lets through, waiting for the gripper included; not on the
    simulated arm, whose gripper is that of the training. `v2p deploy` has limits of its own
    instead."""
    policy_path: str = ""
    """Folder of the policy that will act. Its palette, names, rate and action scale are compared
    with the robot's when it connects. By default the `--policy.path` of the LeRobot tool that
    connects it."""
    check_policy: bool = True
    """Off connects whatever the policy was trained for."""

    @property
    def interface(self) -> ArmInterface:
        """What the policy sees of the arm and tells it."""
        return ArmInterface(actions=self.actions, joint_state=self.joint_state)
