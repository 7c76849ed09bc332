"""PPO on TorchRL: collect, estimate advantages, improve; one loop that may be killed at any moment.

The first `num_deterministic` worlds act without exploration and are left out of the loss: their episodes
are the success rate of the deterministic policy, for free and on the spot. All randomness of the learner
comes from one generator that the checkpoint keeps. Where the environment's `state_dict` holds its state, a
resumed run repeats an undisturbed one bit for bit; otherwise its worlds start anew at the resumption.
"""

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torch.distributions import Independent, Normal
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from policies.evaluation.paired import score
from policies.ppo.config import PPOConfig
from policies.ppo.curve import (
    CURVE_FILE,
    PICTURE_FILE,
    Row,
    append_row,
    cut_after,
    plot_curve,
)
from policies.ppo.policy import ActorCritic, Expert, load_weights, weights_of
from policies.threads import torch_threads

log = logging.getLogger(__name__)

CHECKPOINT_FILE = "checkpoint.pt"
LAST_FOLDER = "last"
DUMP_FILE = "not_finite.pt"
FINITE_KEYS = (("next", "observation"), ("next", "reward"), "observation", "action")
COMPONENTS_KEY = ("next", "components")


LEAST_PLATEAU_BATCHES = 8
"""So many batches without a gain are no plateau yet, however many worlds a batch has."""
StoppedBy = Literal["plateau", "steps", "seconds", "decline"]


@dataclass(frozen=True, kw_only=True)
class ExpertResult:
    """What training ended with."""

    folder: Path
    """The best expert."""
    success: float
    """Highest success at the end of deterministic episodes over a window of training: flattering,
    as the best of many."""
    actor_updates: int
    """Gradient steps that the best expert's actor took; 0 for an actor that is still as it was at the start."""
    last_actor_updates: int
    """The same of the expert in `last/`."""
    steps: int
    seconds: float
    stopped_by: StoppedBy


class NotFiniteError(RuntimeError):
    """A NaN or an infinity, named by key, world and step; the batch is dumped beside the checkpoint."""


@dataclass(kw_only=True)
class _Progress:
    """Everything that changes while training, apart from weights, optimiser, generator and environment."""

    iteration: int = 0
    steps: int = 0
    seconds: float = 0.0
    learning_rate: float = 0.0
    mean_square_return: float = 0.0
    """Running mean square of the discounted return: rewards are divided by its root."""
    discounted: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    """Discounted reward so far, per world."""
    episode_return: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    """Plain sum of rewards so far, per world."""
    age: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    """Steps of the episode so far, per world."""
    waited: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    """Steps of the episode before success was first held, per world."""
    deterministic: list[float] = field(default_factory=list[float])
    scores: list[float] = field(default_factory=list[float])
    """Score of each of the same episodes, see `policies.evaluation.paired.score`."""
    exploring: list[float] = field(default_factory=list[float])
    returns: list[float] = field(default_factory=list[float])
    actor_updates: int = 0
    best_success: float = -1.0
    best_score: float = -1.0
    best_actor_updates: int = 0
    plateau_score: float = -1.0
    """The score that must be beaten by `plateau_gain`, and when it was reached."""
    plateau_since: int = 0

    def success(self, cfg: PPOConfig, *, deterministic: bool = True) -> float:
        """Return the rate over the window, or NaN while there are too few episodes."""
        outcomes = self.deterministic if deterministic else self.exploring
        return float(np.mean(outcomes)) if len(outcomes) >= cfg.min_window_episodes else math.nan

    def follow(self, batch: TensorDictBase, cfg: PPOConfig) -> None:
        """Take note of finished episodes and of the scale of the returns."""
        reward, done = batch["next", "reward"][..., 0], batch["next", "done"][..., 0]
        success = outcome(batch.get("next")).reshape(done.shape)
        squares = torch.zeros((), device=reward.device)
        for t in range(cfg.batch_time):
            self.discounted = cfg.gamma * self.discounted + reward[:, t]
            self.episode_return = self.episode_return + reward[:, t]
            self.age = self.age + 1
            is_first = (self.waited == 0) & success[:, t]
            self.waited = torch.where(is_first, self.age, self.waited)
            squares = squares + self.discounted.square().mean() / cfg.batch_time
            ended = done[:, t].nonzero()[:, 0]
            for world in ended.tolist():
                outcomes = self.deterministic if world < cfg.num_deterministic else self.exploring
                outcomes.append(float(success[world, t]))
                if world < cfg.num_deterministic:
                    waited = float(self.waited[world] / self.age[world])
                    self.scores.append(score(float(waited > 0), waited))
                self.returns.append(float(self.episode_return[world]))
            for name in ("discounted", "episode_return", "age", "waited"):
                getattr(self, name)[ended] = 0.0
        for outcomes in (
            self.deterministic,
            self.scores,
            self.exploring,
            self.returns,
        ):
            del outcomes[: -cfg.window_episodes]
        keep = 0.95 if self.iteration else 0.0
        self.mean_square_return = keep * self.mean_square_return + (1 - keep) * float(squares)


def train_expert(
    env: EnvBase,
    cfg: PPOConfig,
    out: Path,
    *,
    seed: int = 0,
    warm_start: Path | None = None,
    on_progress: Callable[[int, int, float], None] | None = None,
    draws: bool = True,
) -> ExpertResult:
    """Train until a plateau, a decline, the step budget or the time limit; go on from `out/checkpoint.pt` if it exists.

    Args:
        env: a batch of worlds (see the room's docstring) which the caller has seeded.
        cfg: the recipe.
        out: folder of checkpoint, curve and experts; `Expert.load(out)` gives the best.
        seed: of weights, exploration and minibatches; the environment has its own.
        warm_start: another expert's folder; its actor and normalisation are the starting point.
        on_progress: called after every batch with steps, total steps and deterministic success (NaN at first).
        draws: write the curve's picture too; a training that is stopped and gone on with many times would spend
            much of its time on it.

    Raises:
        ValueError: the checkpoint was made with another recipe, or there are too few worlds.
        NotFiniteError: a NaN came out of the environment or the update.
    """
    num_envs = env.batch_size[0]
    if num_envs <= cfg.num_deterministic:
        raise ValueError(
            f"{num_envs} worlds leave none to learn from: num_deterministic is {cfg.num_deterministic}"
        )
    out.mkdir(parents=True, exist_ok=True)
    with torch_threads(cfg.num_threads):
        learner = _Learner(env, cfg, out, seed, warm_start, draws)
        stopped_by = learner.run(on_progress)
    progress = learner.progress
    return ExpertResult(
        folder=out,
        success=max(progress.best_success, 0.0),
        actor_updates=(
            progress.best_actor_updates if progress.best_success >= 0 else progress.actor_updates
        ),
        last_actor_updates=progress.actor_updates,
        steps=progress.steps,
        seconds=progress.seconds,
        stopped_by=stopped_by,
    )


class _Learner:
    """The parts of one training run, so that the checkpoint can list them."""

    def __init__(
        self,
        env: EnvBase,
        cfg: PPOConfig,
        out: Path,
        seed: int,
        warm_start: Path | None,
        draws: bool,
    ) -> None:
        self.env, self.cfg, self.out, self.draws = env, cfg, out, draws
        self.num_envs = env.batch_size[0]
        self.recipe = _recipe(cfg, seed)
        self.generator = torch.Generator().manual_seed(seed)
        obs_dim = env.observation_spec["observation"].shape[-1]  # type: ignore[union-attr]
        self.model = ActorCritic(obs_dim, env.action_spec.shape[-1], cfg.actor, self.generator)
        # All randomness is drawn on the CPU, so that a checkpoint means the same on every device.
        device = env.device or torch.device("cpu")
        self.model.to(device)
        self.progress = _Progress(
            learning_rate=cfg.learning_rate,
            discounted=torch.zeros(self.num_envs, device=device),
            episode_return=torch.zeros(self.num_envs, device=device),
            age=torch.zeros(self.num_envs, device=device),
            waited=torch.zeros(self.num_envs, device=device),
        )
        self.is_warm = warm_start is not None
        self.critic_batches = 0
        if warm_start is not None:
            _start_from(self.model, Expert.load(warm_start), cfg)
            self.critic_batches = cfg.warm_start_critic_batches
            self.progress.learning_rate = cfg.warm_start_learning_rate
        explore = _Explorer(self.model.actor, cfg.num_deterministic, self.generator)
        self.loss, self.gae = _losses(self.model, cfg)
        self.optimiser = torch.optim.Adam(
            self.model.parameters(), lr=cfg.learning_rate, eps=1e-5, fused=True
        )
        self.collector = Collector(
            env,
            TensorDictModule(explore, ["observation"], ["action", "action_log_prob"]),
            frames_per_batch=self.num_envs * cfg.batch_time,
            total_frames=-1,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self.best_weights = weights_of(self.model)
        self._resume()

    def run(self, on_progress: Callable[[int, int, float], None] | None) -> StoppedBy:
        """Go on until something stops it, and leave everything on disk."""
        cfg, progress = self.cfg, self.progress
        before, started = progress.seconds, time.monotonic()
        last_save = started
        batches = iter(self.collector)
        while (reason := self._reason_to_stop()) is None:
            row = self._iterate(next(batches))
            progress.seconds = before + time.monotonic() - started
            row = {"steps": progress.steps, "seconds": progress.seconds} | row
            append_row(self.out / CURVE_FILE, row)
            if on_progress is not None:
                on_progress(progress.steps, cfg.total_steps, progress.success(cfg))
            if time.monotonic() - last_save > cfg.checkpoint_seconds:
                self._save()
                last_save = time.monotonic()
        self._save()
        self.collector.shutdown(close_env=False)
        if self.draws and (self.out / CURVE_FILE).is_file():
            plot_curve(self.out / CURVE_FILE, self.out / PICTURE_FILE)
        return reason

    def _reason_to_stop(self) -> StoppedBy | None:
        cfg, progress = self.cfg, self.progress
        if progress.steps >= cfg.total_steps:
            return "steps"
        if self.is_warm and progress.success(cfg) < progress.best_success - cfg.decline:
            return "decline"
        batch = self.num_envs * cfg.batch_time
        since = max(progress.plateau_since, self.critic_batches * batch)
        patience = max(cfg.plateau_steps, LEAST_PLATEAU_BATCHES * batch)
        if progress.best_success >= cfg.target_success and progress.steps - since >= patience:
            return "plateau"
        if progress.seconds >= cfg.max_seconds:
            return "seconds"
        return None

    def _iterate(self, batch: TensorDictBase) -> Row:
        """Learn from one batch (env, time) and return the numbers of its curve row."""
        cfg, progress = self.cfg, self.progress
        self._check_finite(batch)
        progress.follow(batch, cfg)
        success = progress.success(cfg)
        self._compare_with_best(success)
        learning = batch[cfg.num_deterministic :]
        kl = 0.0
        # An untouched normaliser: the first batch only shows what observations look like.
        is_first = float(self.model.normaliser.count) == 0
        if not is_first:
            kl = self._update(learning)
        if not self.is_warm:  # a policy that can do something already keeps the eyes it has
            self.model.normaliser.update(batch["observation"].flatten(0, 1))
        progress.iteration += 1
        progress.steps += batch.numel()
        components: Any = batch.get(COMPONENTS_KEY, None)
        means = (
            {}
            if components is None
            else {
                str(k): float(v[cfg.num_deterministic :].float().mean())
                for k, v in components.items()
            }
        )
        return {
            "iteration": progress.iteration,
            "success_deterministic": success,
            "success_stochastic": progress.success(cfg, deterministic=False),
            "return": float(np.mean(progress.returns)) if progress.returns else math.nan,
            "kl": kl,
            "learning_rate": progress.learning_rate,
            "std": float(self.model.actor.log_std.detach().exp().mean()),
            **{f"reward_{name}": mean for name, mean in sorted(means.items())},
        }

    def _compare_with_best(self, success: float) -> None:
        """Keep the weights whose deterministic episodes are the best so far, and note when they got clearly better."""
        progress = self.progress
        if math.isnan(success):
            return
        progress.best_success = max(progress.best_success, success)
        now = float(np.mean(progress.scores))
        if now >= max(progress.best_score, 0.0):
            progress.best_score = now
            progress.best_actor_updates = progress.actor_updates
            self.best_weights = weights_of(self.model)
        if now >= progress.plateau_score + self.cfg.plateau_gain:
            progress.plateau_score = now
            progress.plateau_since = progress.steps + self.num_envs * self.cfg.batch_time

    def _update(self, batch: TensorDictBase) -> float:
        """Run the epochs over one batch and return the KL divergence from the collecting policy."""
        cfg, progress = self.cfg, self.progress
        batch["next", "reward"] = batch["next", "reward"] / max(
            math.sqrt(progress.mean_square_return), 1e-6
        )
        with torch.no_grad():
            self.gae(batch)
        advantage = batch["advantage"]
        batch["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        flat = batch.select(
            "observation", "action", "action_log_prob", "advantage", "value_target"
        ).reshape(-1)
        num_chunks = max(1, round(flat.numel() / cfg.minibatch))
        if progress.iteration == self.critic_batches:  # the value alone learned at the full rate
            self._take_learning_rate()
        kl = 0.0
        for _ in range(cfg.epochs):
            order = torch.randperm(flat.numel(), generator=self.generator)
            order = order.to(flat["action"].device)
            kls: list[float] = []
            for idx in order.chunk(num_chunks):
                kls.append(self._descend(flat[idx]))
                if kls[-1] > 2 * cfg.kl_stop:
                    break
            kl = float(np.mean(kls))
            if kl > cfg.kl_stop:
                break
        if progress.iteration < self.critic_batches:
            return kl
        if kl > cfg.kl_high:
            progress.learning_rate = max(progress.learning_rate / 1.5, cfg.min_learning_rate)
        elif kl < cfg.kl_low:
            progress.learning_rate = min(progress.learning_rate * 1.5, cfg.max_learning_rate)
        self._take_learning_rate()
        return kl

    def _take_learning_rate(self) -> None:
        for group in self.optimiser.param_groups:
            group["lr"] = self.progress.learning_rate

    def _descend(self, minibatch: TensorDictBase) -> float:
        losses = self.loss(minibatch)
        self.optimiser.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"]).backward()
        # Apart, so that a large value error does not silence the actor.
        if self.progress.iteration < self.critic_batches:
            self.model.actor.zero_grad(set_to_none=True)
        else:
            self.progress.actor_updates += 1
        norms = [
            nn.utils.clip_grad_norm_(part.parameters(), self.cfg.max_grad_norm)
            for part in (self.model.actor, self.model.critic)
        ]
        if not all(bool(norm.isfinite()) for norm in norms):
            raise NotFiniteError(
                f"the gradient is not finite in iteration {self.progress.iteration}"
            )
        self.optimiser.step()
        self.model.actor.clamp_std()
        # mean(ratio - 1 - log ratio): unbiased and never negative (Schulman 2020, "k3").
        return float((losses["mean_ratio"] - 1 + losses["kl_approx"]).detach())

    def _stagger(self) -> None:
        """Have the worlds end at different times: a batch of 16 steps would else see one phase of the task only.

        Learning to lift took half the steps with it (57 % against 11 % after 0.33 million). Deterministic worlds
        start at the start: their first episodes count.
        """
        stagger = getattr(self.env, "stagger", None)
        if stagger is not None:
            stagger(self.cfg.num_deterministic)

    def _check_finite(self, batch: TensorDictBase) -> None:
        for key in FINITE_KEYS:
            bad = ~torch.isfinite(batch.get(key)).flatten(2).all(-1)
            if not bool(bad.any()):
                continue
            world, step = bad.nonzero()[0].tolist()
            dump = self.out / DUMP_FILE
            torch.save({str(k): batch.get(k)[world].clone() for k in FINITE_KEYS}, dump)
            name = key if isinstance(key, str) else "/".join(key)
            raise NotFiniteError(
                f"'{name}' of world {world} is not finite at step {step} of iteration {self.progress.iteration} "
                f"({int(bad.any(1).sum())} worlds affected); that world's batch is in {dump}"
            )

    def _save(self) -> None:
        """Write experts and checkpoint, each atomically."""
        Expert(self.model).save(self.out / LAST_FOLDER)
        best = ActorCritic(
            self.model.obs_dim, self.model.act_dim, self.cfg.actor, torch.Generator()
        )
        load_weights(
            best, self.best_weights if self.progress.best_success >= 0 else weights_of(self.model)
        )
        Expert(best).save(self.out)
        checkpoint = {
            "recipe": self.recipe,
            "progress": vars(self.progress),
            "weights": weights_of(self.model),
            "best_weights": self.best_weights,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "env": dict(self.env.state_dict()),
            # The observations and flags that the collector goes on from; it has no public way to hand them out.
            "carrier": self.collector._carrier.clone().to_dict(),
        }
        partial = self.out / f"{CHECKPOINT_FILE}.partial"
        torch.save(checkpoint, partial)
        partial.replace(self.out / CHECKPOINT_FILE)

    def _resume(self) -> None:
        path = self.out / CHECKPOINT_FILE
        if not path.is_file():
            (self.out / CURVE_FILE).unlink(missing_ok=True)
            self._stagger()
            return
        saved: dict[str, Any] = torch.load(path, weights_only=True)
        _check_recipe(saved["recipe"], self.recipe, path)
        for name, value in saved["progress"].items():
            setattr(self.progress, name, value)
        load_weights(self.model, saved["weights"])
        self.best_weights = saved["best_weights"]
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])
        cut_after(self.out / CURVE_FILE, self.progress.steps)
        self.env.load_state_dict(saved["env"])
        self.collector._carrier.update(TensorDict(saved["carrier"], self.env.batch_size))
        log.info("going on from step %d of %d", self.progress.steps, self.cfg.total_steps)


class _Explorer(nn.Module):
    """The actor as the collector calls it: noise from our generator, and none for the deterministic worlds."""

    def __init__(
        self, actor: nn.Module, num_deterministic: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.actor, self.num_deterministic, self.generator = actor, num_deterministic, generator

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, std = self.actor(obs)
        noise = torch.randn(mean.shape, generator=self.generator).to(mean.device)
        noise[: self.num_deterministic] = 0.0
        action = mean + std * noise
        return action, _Gaussian(mean, std).log_prob(action)


class _Gaussian(Independent):
    """Independent normals, one per action."""

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor) -> None:
        super().__init__(Normal(loc, scale, validate_args=False), 1, validate_args=False)


def _losses(model: ActorCritic, cfg: PPOConfig) -> tuple[ClipPPOLoss, GAE]:
    """Return TorchRL's loss and advantage over the model's two networks."""
    gaussian = TensorDictModule(model.actor, ["observation"], ["loc", "scale"])
    sample = ProbabilisticTensorDictModule(
        ["loc", "scale"], ["action"], distribution_class=_Gaussian, return_log_prob=True
    )
    # A dict: the type stubs know no positional modules.
    actor = ProbabilisticTensorDictSequential(OrderedDict(gaussian=gaussian, sample=sample))
    critic = TensorDictModule(model.critic, ["observation"], ["state_value"])
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=cfg.clip,
        entropy_bonus=False,
        critic_coeff=1.0,
        loss_critic_type="l2",
        functional=False,
    )
    return loss, advantage_estimator(critic, cfg)


def advantage_estimator(critic: TensorDictModule, cfg: PPOConfig) -> GAE:
    """Return GAE in which a time limit bootstraps from the next state's value and a termination does not."""
    return GAE(
        gamma=cfg.gamma,
        lmbda=cfg.gae_lambda,
        value_network=critic,
        shifted=False,
        deactivate_vmap=True,
        time_dim=1,
    )


def outcome(after: TensorDictBase) -> torch.Tensor:
    """Return whether each world counts as a success if its episode ends here: `held`, else `success`."""
    held = after.get("held", None)
    return after.get("success") if held is None else held


def _start_from(model: ActorCritic, expert: Expert, cfg: PPOConfig) -> None:
    """Take over actor and normalisation; the value starts at zero, for it belongs to another reward."""
    load_weights(model, weights_of(expert.model))
    with torch.no_grad():
        model.actor.log_std.fill_(math.log(cfg.warm_start_std))
        last = model.critic.net[-1]
        for parameter in last.parameters():
            parameter.zero_()
    model.actor.clamp_std()


def _recipe(cfg: PPOConfig, seed: int) -> dict[str, Any]:
    """The settings that must not change between a checkpoint and its continuation."""
    free = {
        "total_steps",
        "max_seconds",
        "target_success",
        "plateau_steps",
        "plateau_gain",
        "checkpoint_seconds",
        "num_threads",
    }
    recipe = {k: v for k, v in asdict(cfg).items() if k not in free}
    recipe["seed"] = seed
    recipe["actor"] = {
        k: list(v) if isinstance(v, tuple) else v for k, v in recipe["actor"].items()
    }
    return recipe


def _check_recipe(saved: dict[str, Any], asked: dict[str, Any], path: Path) -> None:
    changed = sorted(k for k in saved.keys() | asked.keys() if saved.get(k) != asked.get(k))
    if changed:
        what = ", ".join(f"{k} was {saved.get(k)}, is {asked.get(k)}" for k in changed)
        raise ValueError(
            f"{path} was made with another recipe ({what}); train in an empty folder instead"
        )
