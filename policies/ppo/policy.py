"""The actor-critic, its observation normalisation, and the expert on disk (no pickle)."""

import json
import math
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import nn

from policies.ppo.config import ActorConfig

WEIGHTS_FILE = "weights.safetensors"
EXPERT_FILE = "expert.json"
SCHEMA = 1


class Normaliser(nn.Module):
    """Running mean and variance of the observations."""

    mean: torch.Tensor
    var: torch.Tensor
    count: torch.Tensor

    MIN_STD = 0.05
    """A feature that has hardly moved so far must not blow up once it does."""

    def __init__(self, obs_dim: int, clip: float) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(obs_dim))
        self.register_buffer("var", torch.ones(obs_dim))
        self.register_buffer("count", torch.zeros(1, dtype=torch.float64))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        std = self.var.sqrt().clamp_min(self.MIN_STD)
        return ((obs - self.mean) / std).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Float[torch.Tensor, "n obs"]) -> None:
        """Take a batch into account.

        Source: Chan, Golub, LeVeque 1979, eq. 2.1.
        """
        n, old = obs.shape[0], float(self.count)
        share = n / (old + n)
        delta = obs.mean(0) - self.mean
        var = (
            (1 - share) * self.var
            + share * obs.var(0, correction=0)
            + share * (1 - share) * delta**2
        )
        self.mean.add_(share * delta)
        self.var.copy_(var)
        self.count.add_(n)


class Actor(nn.Module):
    """Observation to the mean and standard deviation of a Gaussian over actions."""

    bound: torch.Tensor
    min_log_std: torch.Tensor

    def __init__(
        self, normaliser: Normaliser, act_dim: int, cfg: ActorConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        obs_dim = normaliser.mean.shape[0]
        self.normaliser = normaliser
        self.net = _mlp((obs_dim, *cfg.hidden, act_dim), last_gain=0.01, generator=generator)
        bound = torch.full((act_dim,), cfg.mean_bound)
        bound[-1] = cfg.gripper_mean_bound
        floor = torch.full((act_dim,), math.log(cfg.min_std))
        floor[-1] = math.log(cfg.gripper_min_std)
        self.register_buffer("bound", bound)
        self.register_buffer("min_log_std", floor)
        self.log_std = nn.Parameter(
            torch.maximum(torch.full((act_dim,), math.log(cfg.init_std)), floor)
        )

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.bound * torch.tanh(self.net(self.normaliser(obs)) / self.bound)
        return mean, self.log_std.exp().expand_as(mean)

    @torch.no_grad()
    def clamp_std(self) -> None:
        """Lift standard deviations to their floor; called after every optimiser step."""
        self.log_std.copy_(torch.maximum(self.log_std, self.min_log_std))


class Critic(nn.Module):
    """Observation to the value, in units of the reward scale that training keeps."""

    def __init__(
        self, normaliser: Normaliser, cfg: ActorConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.normaliser = normaliser
        self.net = _mlp(
            (normaliser.mean.shape[0], *cfg.hidden, 1), last_gain=1.0, generator=generator
        )

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.net(self.normaliser(obs))


class ActorCritic(nn.Module):
    """Both networks over one normaliser."""

    def __init__(
        self, obs_dim: int, act_dim: int, cfg: ActorConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.obs_dim, self.act_dim, self.cfg = obs_dim, act_dim, cfg
        self.normaliser = Normaliser(obs_dim, cfg.obs_clip)
        self.actor = Actor(self.normaliser, act_dim, cfg, generator)
        self.critic = Critic(self.normaliser, cfg, generator)


class Expert:
    """A trained policy on simulator states."""

    def __init__(self, model: ActorCritic) -> None:
        self.model = model

    def act(
        self,
        obs: Float[np.ndarray, "env obs"],
        deterministic: bool = True,
        generator: torch.Generator | None = None,
    ) -> Float[np.ndarray, "env act"]:
        """Return actions in [-1, 1]; the mean, or a sample drawn with `generator`."""
        with torch.no_grad():
            mean, std = self.model.actor(torch.as_tensor(obs, dtype=torch.float32))
            if not deterministic:
                mean = mean + std * torch.randn(mean.shape, generator=generator)
            return mean.clamp(-1, 1).numpy()

    def save(self, folder: Path) -> None:
        """Write weights and shape; a reader at any moment finds the old expert or the new one."""
        folder.mkdir(parents=True, exist_ok=True)
        about = {
            "schema": SCHEMA,
            "obs_dim": self.model.obs_dim,
            "act_dim": self.model.act_dim,
            "actor": asdict(self.model.cfg),
        }
        weights = {
            k: v.detach().clone().contiguous() for k, v in _unique_state(self.model).items()
        }
        save_file(weights, folder / f"{WEIGHTS_FILE}.partial")
        (folder / f"{EXPERT_FILE}.partial").write_text(
            json.dumps(about, indent=1), encoding="utf-8"
        )
        for name in (WEIGHTS_FILE, EXPERT_FILE):
            (folder / f"{name}.partial").replace(folder / name)

    @staticmethod
    def load(folder: Path) -> "Expert":
        """Read an expert's folder.

        Raises:
            FileNotFoundError: the folder holds no expert.
            ValueError: it was written by another version.
        """
        path = folder / EXPERT_FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"{folder} holds no {EXPERT_FILE}: it is no expert; train one first"
            )
        about: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if about["schema"] != SCHEMA:
            raise ValueError(
                f"{path} has schema {about['schema']}, this version reads {SCHEMA}; train the expert anew"
            )
        cfg = ActorConfig(**{**about["actor"], "hidden": tuple(about["actor"]["hidden"])})
        model = ActorCritic(about["obs_dim"], about["act_dim"], cfg, torch.Generator())
        load_weights(model, load_file(folder / WEIGHTS_FILE))
        return Expert(model)


def weights_of(model: ActorCritic) -> dict[str, torch.Tensor]:
    """Return a copy of everything that makes up the model, normalisation included."""
    return {k: v.detach().clone() for k, v in _unique_state(model).items()}


def load_weights(model: ActorCritic, weights: dict[str, torch.Tensor]) -> None:
    """Copy `weights` into the model in place.

    Raises:
        ValueError: a tensor is missing or has another shape.
    """
    own = _unique_state(model)
    wrong = sorted(k for k in own.keys() | weights.keys() if k not in own or k not in weights)
    wrong += sorted(k for k in own.keys() & weights.keys() if own[k].shape != weights[k].shape)
    if wrong:
        raise ValueError(
            f"these weights do not fit a {model.obs_dim} -> {model.act_dim} expert: {', '.join(wrong)}"
        )
    with torch.no_grad():
        for key, value in own.items():
            value.copy_(weights[key])


def _unique_state(model: ActorCritic) -> dict[str, torch.Tensor]:
    """The normaliser hangs under both networks too; keep it once."""
    return {
        k: v
        for k, v in model.state_dict(keep_vars=True).items()
        if not k.startswith(("actor.normaliser.", "critic.normaliser."))
    }


def _mlp(sizes: tuple[int, ...], *, last_gain: float, generator: torch.Generator) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        is_last = i == len(sizes) - 2
        layer = nn.Linear(fan_in, fan_out)
        nn.init.orthogonal_(
            layer.weight, last_gain if is_last else math.sqrt(2), generator=generator
        )
        nn.init.zeros_(layer.bias)
        layers += [layer] if is_last else [layer, nn.Tanh()]
    return nn.Sequential(*layers)
