"""The expert: an actor-critic trained with PPO on simulator states.

In: a batched TorchRL environment with `observation` (env, obs), actions in [-1, 1], and in its step output
`held` (success that has lasted) or `success`, a bool per world that is read when an episode ends;
optionally `components`, a nested dict of the parts of the reward, and a method `stagger(first)` that puts the
worlds at random moments of their episodes. Out, in one folder: the best expert
(`weights.safetensors` + `expert.json`), `last/` (the same, at the end), `checkpoint.pt` to go on from,
`curve.csv` and `curve.png`.
"""
