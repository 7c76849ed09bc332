"""How often an expert succeeds in fresh episodes that decided nothing during training."""

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from policies.evaluation.rate import Rate, wilson


@torch.no_grad()
def evaluate(
    env: EnvBase,
    act: Callable[[np.ndarray], np.ndarray],
    *,
    num_episodes: int,
    max_steps: int = 10_000,
) -> Rate:
    """Return successes among `num_episodes` whole episodes, the same number per world up to one.

    An episode is judged by `outcome` at the step that ends it. Counting episodes in the order in which they
    finish would favour short ones; here every world plays its episodes to the end.

    Args:
        env: its batch of worlds plays as many rounds as are needed.
        act: observations (env, obs) to actions (env, act), e.g. `Expert.act`.
        num_episodes: how many are counted.
        max_steps: an episode that does not end by then is an error.
    """
    num_envs = env.batch_size[0]
    successes, counted = 0, 0
    while counted < num_episodes:
        is_counted = torch.arange(num_envs) < num_episodes - counted
        successes += int((_one_round(env, act, max_steps) & is_counted).sum())
        counted += int(is_counted.sum())
    return wilson(successes, num_episodes)


def outcome(after: TensorDictBase) -> torch.Tensor:
    """Return whether each world counts as a success if its episode ends here: `held`, else `success`."""
    held = after.get("held", None)
    return after.get("success") if held is None else held


def _one_round(
    env: EnvBase, act: Callable[[np.ndarray], np.ndarray], max_steps: int
) -> torch.Tensor:
    """Return a bool per world: whether its episode, played from a reset to its end, was a success."""
    now = env.reset()
    is_over = torch.zeros(env.batch_size[0], dtype=torch.bool)
    succeeded = is_over.clone()
    for _ in range(max_steps):
        action = torch.from_numpy(act(now["observation"].numpy()))
        now = env.step(TensorDict({"action": action}, env.batch_size))["next"]
        ends = now["done"].flatten() & ~is_over
        succeeded |= ends & outcome(now).flatten()
        is_over |= ends
        if is_over.all():
            return succeeded
    raise RuntimeError(
        f"{int((~is_over).sum())} worlds had not ended their episode after {max_steps} steps"
    )
