"""Settings of the robot type `v2p_franka`. LeRobot parses this config, hence it is not frozen."""

from dataclasses import dataclass
from typing import Literal

from lerobot.robots import RobotConfig

from lerobot_policy_v2p.robot.config_arm import ArmRobotConfig

Backend = Literal["sim", "network", "franky"]


@RobotConfig.register_subclass("v2p_franka")
@dataclass(kw_only=True)
class V2PFrankaConfig(ArmRobotConfig):
    """A Franka arm with a parallel gripper, real or simulated."""

    backend: Backend = "sim"
    """`sim` simulates a task; `network` talks to a driver of yours by the protocol of
    docs/deploy.md; `franky` drives a real arm through the library franky and has never been run by
    us. `network` needs `clicks`, or `pictures` to be `rgb`."""

    task_folder: str = ""
    """`sim`: the task to simulate, as `v2p task` writes it."""
    seed: int = 0
    """`sim`: which episode starts."""

    address: str = ""
    """`network`: HOST:PORT of the driver."""
    timeout_s: float = 0.5
    """`network`: a driver that does not answer for so long counts as gone."""

    ip: str = ""
    """`franky`: address of the robot's control interface."""
    masks: str = ""
    """`franky`: `package.module:name` of a function without arguments that returns the current label image, 256 x 256
    uint8 (0 background, 1 robot, 2 manipulated object, 3.. others): camera and segmentation are yours."""
    relative_dynamics: float = 0.1
    """`franky`: share of the arm's speed, acceleration and jerk limits that it may use."""
    gripper_speed_m_s: float = 0.08
    grip_force_n: float = 20.0
    tool_offset_m: float = 0.0
    """`franky`: how far below the arm's own end-effector frame, along its z axis, the fingers' pads meet."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.backend == "sim" and not self.task_folder:
            raise ValueError("the simulated robot needs a task: --robot.task_folder=FOLDER")
        if self.backend == "network" and not self.address:
            raise ValueError("the network driver needs --robot.address=HOST:PORT")
        if self.backend == "network" and self.pictures == "mask" and not self.clicks:
            raise ValueError(
                "the network driver gives colour pictures; say what to track with --robot.clicks='120,80', the"
                " object's pixel, or use 'v2p deploy', which asks for the click"
            )
        if self.backend == "franky" and not (self.ip and self.masks):
            raise ValueError(
                "the real robot needs --robot.ip=ADDRESS and --robot.masks=package.module:name, because the policy"
                " sees masks and not pictures"
            )
        if self.backend == "franky" and (self.pictures == "rgb" or self.clicks):
            raise ValueError(
                "the backend 'franky' gives masks only; leave --robot.pictures and --robot.clicks away, or put the arm"
                " behind the network protocol of docs/deploy.md"
            )
        if not self.timeout_s > 0:
            raise ValueError(f"timeout_s is {self.timeout_s}; it must be above 0")
        if not 0 < self.relative_dynamics <= 1:
            raise ValueError(
                f"relative_dynamics is {self.relative_dynamics}; it lies between 0 and 1"
            )
