"""Worlds of several tasks as one batch, so that one policy learns them all.

It sees the base observation alone, which is the same for all tasks; terms that a task's own code adds are left out.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import ACT_DIM, BatchEnv, StepResult
from v2p_data.task.task import BASE_OBSERVATION_DIM


class JoinedWorlds:
    """Environments of as many worlds each, in turn: world `k` is world `k // p` of environment `k % p` of `p`.

    Args:
        parts: environments, each of one task.

    Raises:
        V2PError: episodes of the tasks differ in length.
    """

    act_dim, obs_dim = ACT_DIM, BASE_OBSERVATION_DIM

    def __init__(self, parts: Sequence[BatchEnv]) -> None:
        self.parts = tuple(parts)
        first = self.parts[0]
        self.horizon = first.horizon
        for part in self.parts:
            if part.horizon != self.horizon:
                raise V2PError(
                    f"an episode of task '{part.bundle.title}' has {part.horizon} steps, and of '{first.bundle.title}'"
                    f" {self.horizon}: one policy learns tasks of one length"
                )
        self.num_envs = len(self.parts) * first.num_envs
        self.device = first.device
        self.component_names = tuple(
            name
            for name in first.component_names
            if all(name in part.component_names for part in self.parts)
        )

    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        """Start new episodes in the worlds `ids`."""
        count = len(self.parts)
        for k, part in enumerate(self.parts):
            part.reset(ids[ids % count == k] // count)

    def observe(self) -> Float32[np.ndarray, "env obs"]:
        """Return the base observation of all worlds."""
        return self.joined([part.observe()[:, : self.obs_dim] for part in self.parts])

    def step(self, action: Float[np.ndarray, "env 7"]) -> StepResult:
        """Carry out one action in every world."""
        count = len(self.parts)
        results = [part.step(action[k::count]) for k, part in enumerate(self.parts)]
        columns = {
            name: self.joined([getattr(r, name) for r in results])
            for name in ("reward", "success", "held", "terminated", "truncated", "task_reward")
        }
        return StepResult(
            obs=self.joined([r.obs[:, : self.obs_dim] for r in results]),
            components={
                name: self.joined([r.components[name] for r in results])
                for name in self.component_names
            },
            **columns,
        )

    @staticmethod
    def joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return rows of all parts in the order of the worlds."""
        stacked = np.stack(arrays, axis=1)
        return stacked.reshape(-1, *stacked.shape[2:])

    def stagger(self, first: int = 0) -> None:
        """See `BatchEnv.stagger`; worlds before `first` are left as they are in whole rounds of the parts."""
        for part in self.parts:
            part.stagger(-(-first // len(self.parts)))

    def seed(self, seed: int) -> None:
        """Restart the stream of everything drawn, in each part with a seed of its own."""
        for k, part in enumerate(self.parts):
            part.seed(seed + k)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of all parts."""
        return {str(k): part.state_dict() for k, part in enumerate(self.parts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` returned."""
        for k, part in enumerate(self.parts):
            part.load_state_dict(state[str(k)])
