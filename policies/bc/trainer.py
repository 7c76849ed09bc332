"""Train a `v2p_bc` policy on frames in memory.

LeRobot's policy, optimiser, schedule and processors, without its loader.

The result is a checkpoint folder as `lerobot-train` writes it. The weights in it are a running mean of the training's
(EMA). A training that was killed goes on from its last state and ends in the same weights.
"""

import contextlib
import copy
import csv
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Int64
from lerobot.configs.types import NormalizationMode
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import ACTION, DatasetError, FrameTable, moved
from policies.bc.modeling_v2p_bc import V2PBCPolicy

logger = logging.getLogger(__name__)

STATE_FILE = "training_state.pt"
BEST_FILE = "best.safetensors"
CURVE_FILE = "curve.csv"
STATISTICS = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
}
"""Per way to normalise what it needs to know of a feature."""
CURVE_FIELDS = ("step", "loss", "lr", "samples_per_s", "loader_share")
GPU_SHARE_FOR_FRAMES = 0.5
"""Share of a GPU's free memory that frames may take; larger datasets stay in the computer's memory."""
Precision = Literal["auto", "float32", "bfloat16"]
Judge = Callable[[V2PBCPolicy], float]
"""Returns the success rate of a policy in simulation."""
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """How a policy is trained on a table of frames."""

    steps: int = 20_000
    """Gradient steps."""
    batch_size: int = 64
    """Samples a step."""
    ema_decay: float = 0.995
    """Decay of the running mean of the weights, which is kept; it rises to this over the first steps. 0: none."""
    precision: Precision = "auto"
    """Number format of the network. `auto`: bfloat16 where the device computes with it, else float32."""
    checkpoints: int = 1
    """Moments in the second half, the end included, at which the policy is judged in simulation if it can be; the one
    that succeeds most is kept. 1: the end."""
    save_every_s: float = 60.0
    """Seconds between saved states; part of no result."""
    log_points: int = 50
    """Rows of the loss curve."""

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch_size < 1 or self.checkpoints < 1 or self.log_points < 1:
            raise ValueError("steps, batch_size, checkpoints and log_points must be at least 1")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"ema_decay is {self.ema_decay}; it lies between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What a training ended with."""

    final_loss: float
    """Mean over the last part of the curve."""
    seconds: float
    samples_per_s: float
    loader_share: float
    """Share of the time that drawing batches takes."""
    judged: tuple[tuple[int, float], ...] = ()
    """Steps at which the policy was judged, and its success rates."""


@dataclass(frozen=True, kw_only=True)
class Processors:
    """LeRobot's pipelines around a policy."""

    before: Any
    after: Any


def make_policy(
    cfg: V2PBCConfig, stats: dict[str, dict[str, Any]], *, seed: int, device: str = "cpu"
) -> tuple[V2PBCPolicy, Processors]:
    """Return a fresh policy and its processors.

    Args:
        cfg: with `input_features` and `output_features` filled in.
        stats: of the dataset, by feature.
        seed: of the weights.
        device: cpu, cuda or mps.

    Raises:
        DatasetError: there are no cameras or no actions, or the statistics lack what is normalised by.
    """
    from policies.bc.processor_v2p_bc import make_v2p_bc_pre_post_processors

    cfg.device = device
    check_features(cfg, stats)
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(seed)
        policy = V2PBCPolicy(cfg).to(device)
    before, after = make_v2p_bc_pre_post_processors(cfg, stats)
    return policy, Processors(before=before, after=after)


def check_features(cfg: V2PBCConfig, stats: dict[str, dict[str, Any]]) -> None:
    """Refuse features that no policy can be made for, and statistics that cannot normalise them.

    Raises:
        DatasetError: says what is missing.
    """
    try:
        cfg.validate_features()
    except ValueError as error:
        raise DatasetError(str(error)) from error
    for key, feature in {**(cfg.input_features or {}), **(cfg.output_features or {})}.items():
        known = stats.get(key, {})
        for name in STATISTICS.get(cfg.normalization_mapping[feature.type.value], ()):
            if name not in known:
                raise DatasetError(
                    f"meta/stats.json has no '{name}' of '{key}'; it has {', '.join(known) or 'nothing of it'}"
                )


def save_policy(folder: Path, policy: V2PBCPolicy, processors: Processors) -> None:
    """Write what `lerobot-eval` and `lerobot-rollout` load."""
    policy.save_pretrained(folder)
    processors.before.save_pretrained(folder)
    processors.after.save_pretrained(folder)


def write_train_config(
    folder: Path, policy: V2PBCPolicy, dataset: Path, repo_id: str, cfg: TrainerConfig, seed: int
) -> None:
    """Write `train_config.json` beside a saved policy, from which `lerobot-train --config_path` trains the same one."""
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig

    TrainPipelineConfig(
        dataset=DatasetConfig(repo_id=repo_id, root=str(dataset), use_imagenet_stats=False),
        policy=policy.config,
        steps=cfg.steps,
        batch_size=cfg.batch_size,
        seed=seed % 2**31,
        env_eval_freq=0,
    ).save_pretrained(folder)


def load_policy(folder: Path, *, device: str = "cpu") -> tuple[V2PBCPolicy, Processors]:
    """Read what `save_policy` wrote."""
    from lerobot.policies.factory import make_pre_post_processors

    policy = V2PBCPolicy.from_pretrained(folder).to(device)
    policy.config.device = device
    before, after = make_pre_post_processors(
        policy_cfg=policy.config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": device}},
    )
    return policy, Processors(before=before, after=after)


def normalised(table: FrameTable, processors: Processors) -> FrameTable:
    """Return the table with states and actions as the network takes them."""
    batch = processors.before({**table.vectors, ACTION: table.action})
    return replace(
        table,
        vectors={key: batch[key].cpu() for key in table.vectors},
        action=batch[ACTION].cpu(),
    )


def train(
    policy: V2PBCPolicy,
    table: FrameTable,
    cfg: TrainerConfig,
    out: Path,
    *,
    seed: int,
    judge: Judge | None = None,
    on_progress: Progress = lambda share, words: None,
) -> Trained:
    """Train the policy in place, on its own device, and leave its curve in `out`.

    Args:
        policy: starts as it is; ends with the mean weights of the best checkpoint.
        table: frames prepared by this policy's encoders and `normalised` by its processors.
        cfg: the recipe.
        out: folder of the state; a half-finished training in it is continued.
        seed: of the order of samples and of augmentation.
        judge: success rate of a policy in simulation.
        on_progress: told the share that is done and a few words.

    Raises:
        DatasetError: the loss is not finite, or the saved state cannot be read.
    """
    out.mkdir(parents=True, exist_ok=True)
    with torch.random.fork_rng():
        return _Run(policy, table, cfg, out, seed, judge, on_progress).to_the_end()


class _Run:
    """One training: weights, their mean, optimiser, curve."""

    def __init__(
        self,
        policy: V2PBCPolicy,
        table: FrameTable,
        cfg: TrainerConfig,
        out: Path,
        seed: int,
        judge: Judge | None,
        on_progress: Progress,
    ) -> None:
        self.policy, self.cfg, self.out = policy, cfg, out
        self.seed, self.judge, self.on_progress = seed, judge, on_progress
        self.mean = copy.deepcopy(policy)
        self.optimizer = _optimizer(policy)
        preset = policy.config.get_scheduler_preset()
        self.schedule = preset.build(self.optimizer, cfg.steps) if preset else None
        self.device = next(policy.parameters()).device
        self.table = table.on(self.device) if _fits(table, self.device) else table
        self.autocast = autocast_for(self.device, cfg.precision)
        self.observed = list(policy.config.observation_delta_indices)
        self.acted = list(policy.config.action_delta_indices)
        self.step = 0
        self.rows: list[tuple[float, ...]] = []
        self.judged: list[tuple[int, float]] = []
        self.order: tuple[int, Tensor] = (-1, torch.zeros(0, dtype=torch.int64))
        self._resume()

    def to_the_end(self) -> Trained:
        cfg = self.cfg
        log_every = max(1, cfg.steps // cfg.log_points)
        moments = {
            cfg.steps - k * (cfg.steps // (2 * cfg.checkpoints)) for k in range(cfg.checkpoints)
        }
        started = saved = time.monotonic()
        loader_s = part_s = part_loader_s = 0.0
        losses: list[Tensor] = []
        first = self.step
        self.policy.train()
        while self.step < cfg.steps:
            begun = time.perf_counter()
            batch = self._batch(self.step)
            loaded = time.perf_counter()
            losses.append(self._descend(batch))
            ended = time.perf_counter()
            part_s += ended - begun
            part_loader_s += loaded - begun
            self.step += 1
            if self.step % log_every == 0 or self.step == cfg.steps:
                rate = len(losses) * cfg.batch_size / part_s
                loss = self._note(losses, rate, part_loader_s / part_s)
                loader_s += part_loader_s
                self.on_progress(self.step / cfg.steps, f"loss {loss:.3f}, {rate:.0f} samples/s")
                losses, part_s, part_loader_s = [], 0.0, 0.0
            if self.judge is not None and cfg.checkpoints > 1 and self.step in moments:
                self._judge()
            if time.monotonic() - saved > cfg.save_every_s and self.step < cfg.steps:
                self._save()
                saved = time.monotonic()
        seconds = time.monotonic() - started
        self._write_curve()
        self._keep_best()
        # In this order: a state without the best checkpoint would end in other weights.
        (self.out / STATE_FILE).unlink(missing_ok=True)
        (self.out / BEST_FILE).unlink(missing_ok=True)
        return Trained(
            final_loss=self.rows[-1][1],
            seconds=seconds,
            samples_per_s=(cfg.steps - first) * cfg.batch_size / max(seconds, 1e-9),
            loader_share=loader_s / max(seconds, 1e-9),
            judged=tuple(self.judged),
        )

    def _note(self, losses: list[Tensor], rate: float, loader_share: float) -> float:
        """Add a row to the curve; return the mean loss since the last one.

        Raises:
            DatasetError: it is no number.
        """
        loss = float(torch.stack(losses).mean())
        if not loss == loss or loss in (float("inf"), float("-inf")):
            raise DatasetError(
                f"the loss is {loss} at step {self.step} of {self.cfg.steps}; columns were finite, so lower"
                " optimizer_lr"
            )
        row = (self.step, loss, self.optimizer.param_groups[0]["lr"], rate, loader_share)
        self.rows.append(row)
        return loss

    def _batch(self, step: int) -> dict[str, Any]:
        batch = self.table.batch(self._rows_of(step), self.observed, self.acted)
        if self.device.type == "cpu":
            return batch
        return {key: moved(value, self.device) for key, value in batch.items()}

    def _rows_of(self, step: int) -> Int64[Tensor, "n"]:
        """Return the samples of a step: the frames in a new random order every time round."""
        n, size = len(self.table), self.cfg.batch_size
        rows: list[Tensor] = []
        begin, end = step * size, (step + 1) * size
        while begin < end:
            turn, place = divmod(begin, n)
            if self.order[0] != turn:
                rng = torch.Generator().manual_seed((self.seed + turn) % 2**63)
                self.order = (turn, torch.randperm(n, generator=rng))
            part = self.order[1][place : place + end - begin]
            rows.append(part)
            begin += len(part)
        return torch.cat(rows)

    def _descend(self, batch: dict[str, Any]) -> Tensor:
        with self.autocast():
            loss, _ = self.policy(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = self.policy.config.grad_clip_norm
        if norm > 0:
            nn.utils.clip_grad_norm_(self.policy.parameters(), norm)
        self.optimizer.step()
        if self.schedule is not None:
            self.schedule.step()
        self._follow()
        return loss.detach()

    @torch.no_grad()
    def _follow(self) -> None:
        """Move the mean weights towards the present ones."""
        decay = min(self.cfg.ema_decay, (1 + self.step) / (10 + self.step))
        if not self.cfg.ema_decay:
            decay = 0.0
        torch._foreach_lerp_(
            list(self.mean.parameters()), list(self.policy.parameters()), 1 - decay
        )
        for mean, now in zip(self.mean.buffers(), self.policy.buffers(), strict=True):
            mean.copy_(now)

    def _judge(self) -> None:
        assert self.judge is not None
        rate = self.judge(self.mean)
        if not self.judged or rate >= max(r for _, r in self.judged):
            save_file(self.mean.state_dict(), self.out / BEST_FILE)
        self.judged.append((self.step, rate))
        logger.info("step %d: success %.3f", self.step, rate)
        self.policy.train()

    def _keep_best(self) -> None:
        best = self.out / BEST_FILE
        weights = load_file(best) if best.is_file() else self.mean.state_dict()
        self.policy.load_state_dict(weights)
        self.policy.eval()

    def _save(self) -> None:
        temporary = self.out / f"{STATE_FILE}.tmp"
        torch.save(
            {
                "step": self.step,
                "policy": self.policy.state_dict(),
                "mean": self.mean.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "schedule": self.schedule.state_dict() if self.schedule else {},
                "rows": self.rows,
                "judged": self.judged,
            },
            temporary,
        )
        temporary.replace(self.out / STATE_FILE)

    def _resume(self) -> None:
        path = self.out / STATE_FILE
        if not path.is_file():
            return
        try:
            state = torch.load(path, map_location=self.device, weights_only=True)
            self.policy.load_state_dict(state["policy"])
            self.mean.load_state_dict(state["mean"])
            self.optimizer.load_state_dict(state["optimizer"])
            if self.schedule is not None:
                self.schedule.load_state_dict(state["schedule"])
            self.step = int(state["step"])
            self.rows = [tuple(row) for row in state["rows"]]
            self.judged = [(int(step), float(rate)) for step, rate in state["judged"]]
        except Exception as error:
            raise DatasetError(
                f"the training state {path} cannot be read ({type(error).__name__}); delete it to train from the"
                " beginning"
            ) from error

    def _write_curve(self) -> None:
        with (self.out / CURVE_FILE).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(CURVE_FIELDS)
            writer.writerows(self.rows)


def autocast_for(
    device: torch.device, precision: Precision
) -> Callable[[], contextlib.AbstractContextManager[Any]]:
    """Return what the forward pass runs in."""
    lower = precision == "bfloat16" or (precision == "auto" and computes_bfloat16(device))
    if not lower:
        return contextlib.nullcontext
    return lambda: torch.autocast(device.type, torch.bfloat16)


def computes_bfloat16(device: torch.device) -> bool:
    """Tell whether the device has instructions for bfloat16; elsewhere it is emulated and slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        found = torch.backends.cpu.get_cpu_capability()
        return "AVX512" in found and torch.cpu._is_avx512_bf16_supported()
    return False


def _fits(table: FrameTable, device: torch.device) -> bool:
    """Tell whether a GPU holds all frames and keeps room to train: then no batch crosses the bus."""
    if device.type != "cuda":
        return False
    free, _ = torch.cuda.mem_get_info(device)
    return table.num_bytes < GPU_SHARE_FOR_FRAMES * free


def _optimizer(policy: V2PBCPolicy) -> torch.optim.Optimizer:
    """Return LeRobot's optimiser with the fused step, which takes a fifth less time on a CPU."""
    preset = policy.config.get_optimizer_preset()
    return torch.optim.AdamW(
        policy.get_optim_params(),
        lr=preset.lr,
        betas=preset.betas,
        eps=preset.eps,
        weight_decay=preset.weight_decay,
        fused=True,
    )
