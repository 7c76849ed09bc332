"""The robot type `v2p_franka`: the dataset's state and action names on a simulated or a real Franka arm.

The simulated arm runs the very environment that policies are evaluated in. A real one stands
behind a driver that speaks the protocol of docs/deploy.md (`network`), or is driven by the library
`franky` (pip install franky-control); the code for `franky` follows its documentation and HAS
NEVER BEEN RUN: no arm was at hand. Try it slowly, with the stop button in your hand. Run with `v2p
deploy`, or with `lerobot-rollout`, always with `--return_to_initial_position=false`: actions are
displacements, so positions must not be played back as actions.
"""

from collections.abc import Callable

from lerobot_policy_v2p.robot.arm_robot import Arm, ArmRobot
from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from lerobot_policy_v2p.robot.franky import FrankyArm
from lerobot_policy_v2p.robot.network import NetworkArm
from lerobot_policy_v2p.robot.simulated import SimulatedArm

ARMS: dict[str, Callable[[V2PFrankaConfig], Arm]] = {
    "sim": SimulatedArm,
    "network": NetworkArm,
    "franky": FrankyArm,
}


class V2PFranka(ArmRobot[Arm, V2PFrankaConfig]):
    """A Franka arm."""

    config_class = V2PFrankaConfig
    name = "v2p_franka"

    def make_arm(self) -> Arm:
        return ARMS[self.config.backend](self.config)
