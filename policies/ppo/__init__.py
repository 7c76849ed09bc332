"""The expert: an actor-critic trained with PPO on simulator states.

In: a batched TorchRL environment with `observation` (env, obs), actions in [-1, 1], and in its step output
`("next", "success")`, a bool per world that is read when an episode ends; optionally
`("next", "components", <name>)`, the parts of the reward. Out, in one folder: `best/` and `last/` (an
`Expert` each: `weights.safetensors` + `expert.json`), `checkpoint.pt` to go on from, `curve.csv` and `curve.png`.
"""
