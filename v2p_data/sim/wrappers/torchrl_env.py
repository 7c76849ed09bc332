"""The batched worlds as a TorchRL environment, for its collectors and losses.

Keys: `observation` and, after a step, `reward`, its `components`, `success` and `held` (see
`task_code.StepResult`), `terminated` (the simulation broke down), `truncated` (time is up) and `done`. Its
`state_dict` holds the worlds' whole state, so a training can go on exactly. Partial resets follow TorchRL's
`_reset` mask. Actions are not bounded by the specification; the environment clips them.
"""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch.nn.modules.module import _IncompatibleKeys
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from v2p_data.sim.env.batch_env import BatchEnv

FLAGS = ("success", "held", "done", "terminated", "truncated")


class TorchRLEnv(EnvBase):
    """TorchRL's view of a `BatchEnv`; its tensors are on the worlds' device.

    Args:
        env: the worlds; `batch_size` is their number.
    """

    def __init__(self, env: BatchEnv) -> None:
        n = env.num_envs
        super().__init__(device=env.device, batch_size=torch.Size([n]))
        self.worlds = env
        flag = Binary(1, torch.Size([n, 1]), dtype=torch.bool)
        self.observation_spec = Composite(
            observation=Unbounded(torch.Size([n, env.obs_dim])),
            success=flag.clone(),
            held=flag.clone(),
            components=Composite(
                {name: Unbounded(torch.Size([n])) for name in env.component_names},
                shape=torch.Size([n]),
            ),
            shape=torch.Size([n]),
        )
        self.action_spec = Unbounded(torch.Size([n, env.act_dim]))
        self.reward_spec = Unbounded(torch.Size([n, 1]))
        self.done_spec = Composite(
            done=flag.clone(),
            terminated=flag.clone(),
            truncated=flag.clone(),
            shape=torch.Size([n]),
        )

    @property
    def horizon(self) -> int:
        """Control steps per episode."""
        return self.worlds.horizon

    def stagger(self, first: int = 0) -> None:
        """See `BatchEnv.stagger`; training calls it once, after the first reset."""
        self.worlds.stagger(first)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        del kwargs
        n = self.worlds.num_envs
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ids = torch.arange(n) if mask is None else mask.reshape(n, -1).any(1).nonzero()[:, 0]
        self.worlds.reset(ids.cpu().numpy())
        no = torch.zeros(n, 1, dtype=torch.bool)
        parts = {name: torch.zeros(n) for name in self.worlds.component_names}
        return TensorDict(
            {
                "observation": torch.from_numpy(self.worlds.observe()),
                "components": TensorDict(parts, [n]),
                **{flag: no.clone() for flag in FLAGS},
            },
            [n],
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        result = self.worlds.step(tensordict.get("action").detach().cpu().numpy())
        columns = {
            "reward": result.reward,
            "success": result.success,
            "held": result.held,
            "terminated": result.terminated,
            "truncated": result.truncated,
            "done": result.terminated | result.truncated,
        }
        parts = {name: torch.from_numpy(value) for name, value in result.components.items()}
        n = self.worlds.num_envs
        return TensorDict(
            {
                "observation": torch.from_numpy(result.obs),
                "components": TensorDict(parts, [n]),
                **{key: torch.from_numpy(value)[:, None] for key, value in columns.items()},
            },
            [n],
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.worlds.seed(seed)

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        del args, kwargs
        return self.worlds.state_dict()

    def load_state_dict(
        self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any
    ) -> _IncompatibleKeys:
        del args, kwargs
        self.worlds.load_state_dict(dict(state_dict))
        return _IncompatibleKeys([], [])
