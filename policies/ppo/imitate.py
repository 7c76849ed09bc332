"""Learn from a teacher who says what to do anywhere: DAgger (Ross, Gordon, Bagnell 2011) over a batch of worlds.

At first the teacher moves all worlds, later more and more of them follow the learner; the teacher only says
what it would do there. So the learner is corrected in the states into which its own mistakes lead. What comes
out is an expert's folder, from which PPO goes on.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

from policies.ppo.config import ImitationConfig
from policies.ppo.policy import ActorCritic, Expert, load_weights, weights_of
from policies.threads import torch_threads

log = logging.getLogger(__name__)

Teacher = Callable[[], Float[np.ndarray, "env act"]]
"""What to do in the worlds as they are now."""


@dataclass(frozen=True, kw_only=True)
class ImitationResult:
    """What came of it."""

    folder: Path
    steps: int
    seconds: float
    loss: float
    """Error of the actions at the end, smooth L1."""


def imitate(
    env: EnvBase,
    teacher: Teacher,
    cfg: ImitationConfig,
    out: Path,
    *,
    seed: int,
    check: Callable[[Expert], float] | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> ImitationResult:
    """Write an expert that does as the teacher does into `out`.

    Args:
        env: a batch of worlds, seeded by the caller.
        teacher: looks at the same worlds.
        cfg: the recipe.
        out: folder of the expert.
        seed: of weights, noise and minibatches.
        check: how often an expert succeeds in worlds of its own; imitation ends once that is `target_success`.
        on_progress: told the share that is done.
    """
    with torch_threads(cfg.num_threads):
        return _imitate(env, teacher, cfg, out, seed, check, on_progress)


def _imitate(
    env: EnvBase,
    teacher: Teacher,
    cfg: ImitationConfig,
    out: Path,
    seed: int,
    check: Callable[[Expert], float] | None,
    on_progress: Callable[[float], None],
) -> ImitationResult:
    started = time.monotonic()
    generator = torch.Generator().manual_seed(seed)
    num_envs = env.batch_size[0]
    obs_dim = env.observation_spec["observation"].shape[-1]  # type: ignore[union-attr]
    model = ActorCritic(obs_dim, env.action_spec.shape[-1], cfg.actor, generator)
    optimiser = torch.optim.Adam(model.actor.parameters(), lr=cfg.learning_rate, fused=True)
    seen: list[torch.Tensor] = []
    said: list[torch.Tensor] = []
    now = env.reset()
    if (stagger := getattr(env, "stagger", None)) is not None:
        stagger()
    loss, rounds = float("nan"), 0
    best_rate, best = -1.0, None
    for k in range(cfg.rounds):
        share = max(1 - k / cfg.teacher_rounds, cfg.least_teacher)
        follows = torch.rand(num_envs, generator=generator) >= share
        start = len(seen)
        for _ in range(cfg.round_steps):
            seen.append(now["observation"].clone())
            said.append(torch.from_numpy(teacher()).float())
            action = _mixed(model, seen[-1], said[-1], follows)
            noise = cfg.noise * torch.randn(action.shape, generator=generator)
            _, now = env.step_and_maybe_reset(
                TensorDict({"action": action + noise}, env.batch_size)
            )
        model.normaliser.update(torch.cat(seen[start:]))
        loss = _fit(model, optimiser, torch.cat(seen), torch.cat(said), cfg, generator)
        rounds = k + 1
        on_progress(rounds / cfg.rounds)
        log.info("round %d: loss %.4f", k, loss)
        if check is not None and rounds >= cfg.least_rounds:
            rate = check(Expert(model))
            log.info("the learner succeeds in %.0f %%", 100 * rate)
            if rate > best_rate:
                best_rate, best = rate, weights_of(model)
            if rate >= cfg.target_success:
                break
    for k in range(cfg.last_epochs):
        for group in optimiser.param_groups:
            group["lr"] = cfg.learning_rate * 0.1 ** ((k + 1) / cfg.last_epochs)
        data = torch.cat(seen), torch.cat(said)
        loss = _fit(model, optimiser, *data, replace(cfg, epochs=1), generator)
    if best is not None:
        load_weights(model, best)
    Expert(model).save(out)
    return ImitationResult(
        folder=out,
        steps=rounds * cfg.round_steps * num_envs,
        seconds=time.monotonic() - started,
        loss=loss,
    )


def _mixed(
    model: ActorCritic, obs: torch.Tensor, advice: torch.Tensor, follows: torch.Tensor
) -> torch.Tensor:
    """Return the learner's actions in the worlds where it is followed, the teacher's elsewhere."""
    if not bool(follows.any()):
        return advice
    with torch.no_grad():
        mean, _ = model.actor(obs)
    return torch.where(follows[:, None], mean, advice)


def _fit(
    model: ActorCritic,
    optimiser: torch.optim.Optimizer,
    obs: torch.Tensor,
    advice: torch.Tensor,
    cfg: ImitationConfig,
    generator: torch.Generator,
) -> float:
    """Descend on the error for some passes and return the last one's mean."""
    bound = model.actor.bound
    wanted = torch.minimum(torch.maximum(advice, -0.95 * bound), 0.95 * bound)
    total = 0.0
    for _ in range(cfg.epochs):
        order = torch.randperm(len(obs), generator=generator)
        chunks = order.chunk(max(1, len(obs) // cfg.minibatch))
        total = 0.0
        for idx in chunks:
            mean, _ = model.actor(obs[idx])
            loss = nn.functional.smooth_l1_loss(mean, wanted[idx], beta=0.2)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            total += float(loss.detach()) / len(chunks)
    return total
