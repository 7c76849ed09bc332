"""What a dataset or a policy sees of the arm and tells it."""

from dataclasses import dataclass

from v2p_data.sim.robot.action_names import Actions


@dataclass(frozen=True, kw_only=True)
class ArmInterface:
    """The numbers of `observation.state` and `action`."""

    actions: Actions = "delta_tool"
    """What `action` says."""
    joint_state: bool = False
    """Whether the angles of the arm's joints follow in `observation.state`."""


STEPS = ArmInterface()
"""What robots and the twin have, and datasets by default: steps of the tool, and no angles of joints."""
