"""What LeRobot imports to find us: policy `v2p_bc`, environment `v2p`, robots `v2p_franka` and `v2p_twin`.

LeRobot looks for installed distributions whose name starts with `lerobot_policy_` and imports the module of
that name; importing the modules below registers what they hold.
"""

from lerobot_policy_v2p.robot import config_v2p_franka as _robot
from lerobot_policy_v2p.robot import config_v2p_twin as _twin
from policies.bc import configuration_v2p_bc as _policy
from v2p_data.sim.wrappers import lerobot_env as _environment

_registered = (_policy, _environment, _robot, _twin)
