"""Settings of the robot type `v2p_twin`. LeRobot parses this config, hence it is not frozen."""

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig

from lerobot_policy_v2p.robot.config_arm import ArmRobotConfig


@RobotConfig.register_subclass("v2p_twin")
@dataclass(kw_only=True)
class V2PTwinConfig(ArmRobotConfig):
    """The twin of a Franka arm with a parallel gripper and a camera: another simulator."""

    task_folder: str = ""
    """The task that stands on the twin's table, as `v2p task` writes it."""
    seed: int = 0
    """Which episode starts."""
    change: dict[str, float] = field(default_factory=dict[str, float])
    """Other values than the nominal twin's, by name, as `{command_latency_s: 0.3}`; see `v2p_data.twin.parameters`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.task_folder:
            raise ValueError("the twin needs a task: --robot.task_folder=FOLDER")
