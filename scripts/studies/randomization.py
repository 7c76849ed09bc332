"""What each randomisation of recorded episodes is worth: one policy without each of them, judged in both simulators.

A setting changes what demonstrations and handovers are recorded under, and nothing else: task, expert, seeds and training
are the same. All policies are judged from the same starts, so episodes are paired. Everything but the judgement is stages
in `<out>/run`, so a stopped study goes on.
"""

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import Record, provenance, read_record
from v2p_data.pipeline.fingerprint import fingerprint
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.policy.training import POLICY_FOLDER, sources_of
from v2p_data.sim.env import ranges
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.stages import EngineConfig, dataset_stage, episodes_stage, policy_stage
from v2p_data.twin.parameters import nominal

from .places import in_training, in_twin
from .results import Row
from .stages import run_shown

ALL, NONE, NOISE = "all", "none", "noise"
"""Settings: every randomisation as configured; none but the noise, without which episodes would repeat each other."""
GROUPS: dict[str, tuple[str, ...]] = {
    NOISE: ("action_noise",),
    "delay": ("delay_s",),
    "size": ("size_scale",),
    "mass_friction": ("mass_scale", "friction_scale"),
    "placement": ("object_pos_m", "layout_distance_scale", "layout_angle_rad", "yaw_rad"),
    "camera": ("camera_pos_m", "camera_angle_rad", "camera_fovy_deg"),
    "servo": ("servo_gain_scale",),
    "arm_start": ("arm_pos_m", "arm_yaw_rad"),
}
"""Fields of `RandomizationConfig` that are switched off together, by the setting without them."""
SETTINGS = (ALL, NONE, *GROUPS)
PLACES = ("training", "twin")
"""The training simulator with its ordinary randomisation; the twin with true masks, through all of `v2p deploy`."""
Key = tuple[str, int, str]


@dataclass(frozen=True, kw_only=True)
class RandomizationStudyConfig:
    """The whole study."""

    settings: tuple[str, ...] = SETTINGS
    """What is switched off: `all` is the reference, `none` leaves the action noise only."""
    seeds: tuple[int, ...] = (0,)
    """Of recording, distillation and weights; each makes a policy a setting."""
    first_start: int = 1_000_000
    """Seed of the first judged episode, in both simulators; no training uses seeds from here on."""
    training_episodes: int = 100
    """Judged in the training simulator, a policy."""
    twin_episodes: int = 60
    """Judged in the twin, a policy."""
    engine: EngineConfig = field(default_factory=EngineConfig)
    """Demonstrations (`episodes.randomization` is the setting `all`), distillation and policy of every setting."""

    def __post_init__(self) -> None:
        unknown = [s for s in self.settings if s not in SETTINGS]
        if unknown or not self.settings or not self.seeds:
            raise ValueError(
                f"settings must name some of {', '.join(SETTINGS)}, and seeds at least one;"
                f" got {list(self.settings)} and {list(self.seeds)}"
            )
        if min(self.training_episodes, self.twin_episodes) < 1:
            raise ValueError("training_episodes and twin_episodes must be at least 1")

    @property
    def cells(self) -> list[Key]:
        """Setting, seed and place of every result, in the order in which they are made."""
        return [(s, seed, p) for seed in self.seeds for s in self.settings for p in PLACES]


def randomization_of(setting: str, every: RandomizationConfig) -> RandomizationConfig:
    """Return what a setting records under.

    Args:
        setting: of `SETTINGS`.
        every: all randomisations on.
    """
    if setting == ALL:
        return every
    off = ranges.none()
    groups = [g for g in GROUPS if g != NOISE] if setting == NONE else [setting]
    return replace(every, **{name: getattr(off, name) for g in groups for name in GROUPS[g]})


def key_of(row: Row) -> Key:
    return row["setting"], row["seed"], row["place"]


@dataclass(frozen=True, kw_only=True)
class RandomizationStudy:
    """A study's folders and settings.

    Args:
        cfg: the settings.
        out: where stages and results go.
        run: run folder with the task and its expert; it is only read.
        item: name of the task.
        runtime: device and threads; its root is set here.
        tell: shown a line per finished stage.
    """

    cfg: RandomizationStudyConfig
    out: Path
    run: Path
    item: str
    runtime: Runtime
    tell: Callable[[str], None] = lambda words: None

    @property
    def root(self) -> Path:
        return self.out / "run"

    def taught(self) -> tuple[Stage, Stage]:
        """Return the stages of the task and of its expert, copied from the run folder.

        Raises:
            V2PError: the run folder holds none, or several.
        """
        found = [f for f in (self.run / "expert").glob(f"{self.item}-*") if read_record(f)]
        if len(found) != 1:
            known = sorted(f.name for f in (self.run / "expert").glob("*"))
            raise V2PError(
                f"{self.run} must hold one finished expert of task '{self.item}' and holds {len(found)};"
                f" its experts: {', '.join(known) or 'none'}"
            )
        expert = copied_stage(found[0], self.run, self.root)
        return expert.inputs["task"], expert

    @property
    def identity(self) -> str:
        """A digest of what all results of a study must have in common."""
        _, expert = self.taught()
        return fingerprint(
            {
                "engine": replace(self.cfg.engine, seed=0),
                "first_start": self.cfg.first_start,
                "episodes": [self.cfg.training_episodes, self.cfg.twin_episodes],
                "expert": expert.folder_name,
                "twin": nominal().digest(),
            }
        )

    def policy(self, setting: str, seed: int) -> tuple[Path, Row]:
        """Make a setting's policy; return its folder and what it took.

        Raises:
            V2PError: a stage failed.
        """
        task, expert = self.taught()
        every = self.cfg.engine.episodes
        engine = replace(
            self.cfg.engine,
            seed=seed,
            episodes=replace(every, randomization=randomization_of(setting, every.randomization)),
        )
        demonstrations = episodes_stage(task, expert, engine)
        dataset = dataset_stage([demonstrations], f"study/{setting}_s{seed}")
        of_dataset = self._made(dataset)
        folder = dataset.folder(self.root)
        policy = policy_stage(folder, of_dataset, engine, sources_of(folder, self.root))
        of_policy = self._made(policy)
        return policy.folder(self.root) / POLICY_FOLDER, {
            "demonstrated_frames": of_dataset.counts["frames"],
            "frames": of_policy.counts["frames"],
            "steps": of_policy.counts["steps"],
        }

    def result(self, setting: str, seed: int, place: str) -> Row:
        """Make and judge one policy in one place; return its line.

        Raises:
            V2PError: a stage failed.
        """
        folder, about = self.policy(setting, seed)
        began = time.monotonic()
        task, first, cfg = self.taught()[0].folder(self.root), self.cfg.first_start, self.cfg
        device = self.runtime.device
        if place == "training":
            seeds = range(first, first + cfg.training_episodes)
            judged = in_training(
                folder,
                task,
                seeds,
                at_end=False,
                device=device,
                num_threads=self.runtime.num_threads,
            )
        else:
            seeds = range(first, first + cfg.twin_episodes)
            judged = in_twin(folder, task, seeds, at_end=False, device=device)
        return {
            "setting": setting, "seed": seed, "place": place, "task": self.item, "study": self.identity,
            "first_start": first, **judged, **about,
            "judging_s": round(time.monotonic() - began, 1), "commit": provenance()["commit"][:12],
        }  # fmt: skip

    def _made(self, stage: Stage) -> Record:
        outcomes = run_shown([stage], replace(self.runtime, root=self.root), self.tell)
        bad = next((o for o in outcomes.values() if not o.is_usable), None)
        if bad is not None:
            raise V2PError(f"{bad.stage} of {bad.item}: {bad.detail}")
        record = read_record(stage.folder(self.root))
        assert record is not None
        return record


def copied_stage(folder: Path, run: Path, root: Path) -> Stage:
    """Return the stage that made a finished folder; the folder and all that it was made from are copied.

    Args:
        folder: of a result in `run`.
        run: the run folder that it lies in.
        root: the run folder that it is copied to.

    Raises:
        V2PError: the folder, or one that it was made from, is not finished.
    """
    record = read_record(folder)
    if record is None:
        raise V2PError(f"{folder} holds no finished result; copy the run folder anew")
    inputs: dict[str, Stage] = {}
    for name, needed in record.inputs.items():
        places = list(run.glob(f"*/{needed}"))
        if not places:
            raise V2PError(f"{folder} was made from {needed}, which is not in {run}")
        inputs[name] = copied_stage(places[0], run, root)
    stage = Stage(
        name=record.stage, item=record.item, config=record.recipe["config"], inputs=inputs,
        sources=record.recipe["sources"], version=record.version, make=_not_here,
    )  # fmt: skip
    copy = stage.folder(root)
    if not copy.is_dir():
        partial = copy.with_name(copy.name + ".partial")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(folder, partial)
        partial.rename(copy)
    return stage


def _not_here(cfg: Any, inputs: Mapping[str, Path], out: Path, runtime: Runtime) -> None:
    raise V2PError(f"{out.name} is copied from another run and is not made here; delete {out.parent.parent} and try again")  # fmt: skip
