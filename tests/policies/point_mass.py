"""A toy to learn on: a point that has to be at its goal when time is up."""

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

HORIZON = 20
REACH = 0.15


class PointMass(EnvBase):
    """Position in the plane, action = velocity; success = near the goal at the end.

    Observations are off-centre and badly scaled on purpose: normalisation has something to do.
    """

    def __init__(
        self,
        num_envs: int,
        seed: int = 0,
        *,
        nan_at: int | None = None,
        device: str = "cpu",
    ):
        super().__init__(device=device, batch_size=[num_envs])
        n = num_envs
        self.nan_at, self.num_calls = nan_at, 0
        self.stream = torch.Generator().manual_seed(seed)
        self.pos, self.goal = (torch.zeros(n, 2, device=device) for _ in range(2))
        self.t = torch.zeros(n, dtype=torch.long, device=device)
        self.observation_spec = Composite(
            observation=Unbounded((n, 4), device=device),
            success=Binary(1, (n, 1), dtype=torch.bool, device=device),
            components=Composite(near=Unbounded((n, 1), device=device), batch_size=[n]),
            batch_size=[n],
        )
        self.action_spec = Bounded(-1, 1, (n, 2), device=device)
        self.reward_spec = Unbounded((n, 1), device=device)
        flag = Binary(1, (n, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), batch_size=[n]
        )

    def _observe(self) -> torch.Tensor:
        return torch.cat([1000 + 50 * self.pos, self.goal - self.pos], 1)

    def _out(self, ends: torch.Tensor) -> dict:
        near = (self.goal - self.pos).norm(dim=1, keepdim=True)
        no = torch.zeros_like(ends)
        return {
            "observation": self._observe(),
            "success": near < REACH,
            "components": TensorDict({"near": -near}, self.batch_size),
            "done": ends,
            "terminated": no,
            "truncated": ends.clone(),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDict:
        everyone = torch.ones(self.batch_size[0], dtype=torch.bool, device=self.device)
        mask = everyone if tensordict is None else tensordict.get("_reset", everyone).flatten()
        n = int(mask.sum())
        for place in (self.pos, self.goal):
            place[mask] = (torch.rand(n, 2, generator=self.stream) * 2 - 1).to(place)
        self.t[mask] = 0
        return TensorDict(
            self._out(torch.zeros_like(self.t, dtype=torch.bool)[:, None]), self.batch_size
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.pos = self.pos + 0.2 * tensordict["action"].clamp(-1, 1)
        self.t = self.t + 1
        out = self._out((self.t >= HORIZON)[:, None])
        self.num_calls += 1
        if self.nan_at is not None and self.num_calls == self.nan_at:
            out["observation"][5, 1] = torch.nan
        return TensorDict({**out, "reward": out["components"]["near"].clone()}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.stream.manual_seed(seed or 0)

    def get_extra_state(self):
        return {"pos": self.pos, "goal": self.goal, "t": self.t, "stream": self.stream.get_state()}

    def set_extra_state(self, state):
        self.pos, self.goal, self.t = (state[k].clone() for k in ("pos", "goal", "t"))
        self.stream.set_state(state["stream"])


def success_rate(act: Callable[[np.ndarray], np.ndarray], *, seed: int = 2) -> float:
    """Return the share of 200 fresh episodes that a policy ends near the goal."""
    env = PointMass(200, seed)
    now = env.reset()
    for _ in range(HORIZON):
        action = torch.from_numpy(act(now["observation"].numpy()))
        now = env.step(TensorDict({"action": action}, env.batch_size))["next"]
    return float(now["success"].float().mean())
