"""Tasks as environments that others know: Gymnasium, its vector environments, TorchRL, LeRobot.

`import v2p_data.sim.wrappers` lets `gymnasium.make` know `v2p/Task-v0`, what a policy sees, and
`v2p/States-v0`, what an expert sees.
"""

from gymnasium import register

ENV_ID, STATES_ID = "v2p/Task-v0", "v2p/States-v0"
_MADE_BY = "v2p_data.sim.wrappers.gym_env:V2PEnv"

register(ENV_ID, _MADE_BY)
register(STATES_ID, _MADE_BY, kwargs={"observation": "states"})
