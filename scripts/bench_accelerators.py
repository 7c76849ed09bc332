"""Measure what shortens the way to an expert: the same tasks with and without each accelerator.

    python scripts/bench_accelerators.py                          # four tasks, two seeds; hours on two cores
    python scripts/bench_accelerators.py --quick                  # everything runs once; the figures mean nothing
    python scripts/bench_accelerators.py --tasks insert --ways scratch bank --seeds 0 1 2 --json out.json

Ways: `scratch`, PPO and nothing else; `bank`, with a share of its episodes begun from moments of the scripted
teacher's; `bank+reverse`, those moments in reverse order; `other`, PPO from the expert of the most similar other
task; `imitation` of the teacher alone; `imitation+ppo`; `imitation+ppo+bank`.

Every way has the same budget of control steps: trying programs, recording the bank and imitation are paid from it
and PPO gets the rest. Only `other` gets something for free, the finished expert of another task (here an imitated
one; its steps stand in its row as given). Training stops early at its target. Programs are tried, the bank is
recorded and the teacher is imitated once per task and seed, and each way that uses them is charged for them, in
steps and in seconds.

An expert is judged by episodes at the fine time step, by task and referee together, as the engine does. Intervals
are Wilson's over the episodes of all seeds together; they do not know how much seeds differ, so each seed's rate is
shown too. Seeds are the outer loop, so that ways take turns and a noise of the machine hits all of them.
"""

import json
import logging
import math
import statistics
import tempfile
import time
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import tyro

from policies.evaluation.rate import wilson
from policies.ppo.config import ImitationConfig, PPOConfig
from policies.ppo.imitate import imitate
from policies.ppo.policy import Expert
from policies.ppo.train import train_expert
from v2p_data.episodes.collect import judge_expert
from v2p_data.errors import V2PError
from v2p_data.experts.bank import Bank, BankConfig, record_bank, use_bank
from v2p_data.experts.learning import success_of
from v2p_data.experts.teacher import Teacher
from v2p_data.seeds import seed_for
from v2p_data.sim.batch_env import BatchEnv, SimConfig
from v2p_data.sim.torchrl_env import TorchRLEnv
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.likeness import Solved, rank_solved

Way = Literal[
    "scratch", "bank", "bank+reverse", "other", "imitation", "imitation+ppo", "imitation+ppo+bank"
]


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and with how much."""

    quick: bool = False
    """Prove that everything runs: one easy task, one seed, few worlds and steps."""
    tasks: tuple[str, ...] = ("insert", "drop_in_front_of", "uncover", "throw_into")
    """Benchmark tasks."""
    ways: tuple[Way, ...] = get_args(Way)
    seeds: tuple[int, ...] = (0, 1)
    """One training of each way per seed."""
    steps: int = 1_000_000
    """Control steps over all worlds that each way may spend."""
    num_envs: int = 512
    trial_worlds: int = 64
    """In which each program is tried."""
    bank_worlds: int = 128
    """In which one episode each is recorded."""
    episodes: int = 64
    """That judge each expert."""
    bank: BankConfig = field(default_factory=BankConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    threads: int = 1
    """Of the physics; torch has one."""
    json: Path | None = None
    """Where to write all figures."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What something took."""

    steps: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    """Of all threads; less disturbed by whatever else runs on the machine."""

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(
            steps=self.steps + other.steps,
            wall_s=self.wall_s + other.wall_s,
            cpu_s=self.cpu_s + other.cpu_s,
        )


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training and how its expert was judged."""

    task: str
    way: str
    seed: int
    successes: int
    episodes: int
    cost: Cost
    note: str = ""


class Watch:
    """What has passed since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def cost(self, steps: int) -> Cost:
        return Cost(
            steps=steps,
            wall_s=time.perf_counter() - self._wall,
            cpu_s=time.process_time() - self._cpu,
        )


class Lesson:
    """One task and seed: its worlds, and what several ways share, made when first asked for.

    Args:
        name: of the benchmark task.
        seed: of everything.
        cfg: how much.
        root: folder of its experts.
    """

    def __init__(self, name: str, seed: int, cfg: BenchConfig, root: Path) -> None:
        self.name, self.cfg, self.root = name, cfg, root
        self.bundle = load_benchmark(name)
        self.seed = seed_for(seed, "bench-accelerators", name)

    def worlds(self, count: int, what: str) -> BatchEnv:
        return BatchEnv(
            self.bundle,
            SimConfig(),
            num_envs=count,
            seed=seed_for(self.seed, what),
            num_threads=self.cfg.threads,
        )

    @cached_property
    def program(self) -> tuple[str, float, Cost]:
        """Name and success of the best program, and what trying all of them took."""
        watch = Watch()
        env = self.worlds(self.cfg.trial_worlds, "trials")
        teacher = Teacher(env)
        best = teacher.choose(env)
        steps = len(teacher.trials) * self.cfg.trial_worlds * env.horizon
        return best.name, best.success, watch.cost(steps)

    def teacher(self, env: BatchEnv) -> Teacher:
        teacher = Teacher(env)
        teacher.name = self.program[0]
        return teacher

    @cached_property
    def bank(self) -> tuple[Bank, Cost]:
        """Moments while the program plays, and what recording them took."""
        watch = Watch()
        env = self.worlds(self.cfg.bank_worlds, "bank")
        bank = record_bank(env, self.teacher(env).act)
        return bank, watch.cost(self.cfg.bank_worlds * env.horizon)

    @cached_property
    def imitated(self) -> tuple[Path, Cost]:
        """The program's pupil, and what teaching it took."""
        cfg = self.cfg.imitation
        affordable = (self.cfg.steps - self.program[2].steps) // (
            cfg.round_steps * self.cfg.num_envs
        )
        if affordable < 1:
            raise V2PError(
                f"--steps {self.cfg.steps} do not pay for trying programs and one round of imitation; "
                "give more steps or fewer worlds"
            )
        rounds = min(cfg.rounds, affordable)
        watch = Watch()
        env = self.worlds(self.cfg.num_envs, "taught")
        trial_env = self.worlds(self.cfg.trial_worlds, "trials")
        tried = 0

        def check(expert: Expert) -> float:
            nonlocal tried
            tried += self.cfg.trial_worlds * env.horizon
            return success_of(trial_env, expert)

        result = imitate(
            TorchRLEnv(env),
            self.teacher(env).act,
            replace(cfg, rounds=rounds),
            self.root / "taught",
            seed=seed_for(self.seed, "imitation") % 2**63,
            check=check,
        )
        return result.folder, watch.cost(result.steps + tried)

    def successes(self, folder: Path) -> int:
        """How many of the judging episodes an expert wins; the same ones for each."""
        judged = judge_expert(
            self.bundle,
            Expert.load(folder).act,
            episodes=self.cfg.episodes,
            seed=seed_for(self.seed, "judge"),
            num_threads=self.cfg.threads,
        )
        return int(judged.successes.sum())


class Course:
    """All lessons of one seed."""

    def __init__(self, seed: int, cfg: BenchConfig, root: Path) -> None:
        self.seed, self.cfg, self.root = seed, cfg, root
        self._lessons: dict[str, Lesson] = {}

    def lesson(self, name: str) -> Lesson:
        if name not in self._lessons:
            folder = self.root / f"{self.seed}" / name
            self._lessons[name] = Lesson(name, self.seed, self.cfg, folder)
        return self._lessons[name]

    def run(self, name: str, way: Way) -> Run:
        """Train and judge."""
        lesson, cfg = self.lesson(name), self.cfg
        folder, spent, notes = lesson.root / way, Cost(), list[str]()
        warm_start: Path | None = None
        bank: Bank | None = None
        if way == "other":
            warm_start, note = self._other(lesson)
            notes.append(note)
        elif way != "scratch":
            program, success, spent = lesson.program
            notes.append(f"'{program}' {success:.0%}")
        if way.startswith("imitation"):
            warm_start, cost = lesson.imitated
            spent = spent + cost
        if "bank" in way:
            bank, cost = lesson.bank
            spent = spent + cost
            kind = "moments" if bank.is_solved else "moments, none of a success"
            notes.append(f"{len(bank)} {kind}")
        if way == "imitation":
            folder = lesson.imitated[0]
        else:
            watch = Watch()
            worlds = lesson.worlds(cfg.num_envs, "worlds")
            starts = None
            if bank is not None and len(bank):
                settings = replace(
                    cfg.bank,
                    num_plain=cfg.ppo.num_deterministic,
                    reverse=cfg.bank.reverse or "reverse" in way,
                )
                starts = use_bank(worlds, bank, settings)
            result = train_expert(
                TorchRLEnv(worlds),
                replace(
                    cfg.ppo, total_steps=max(cfg.steps - spent.steps, 1), max_seconds=math.inf
                ),
                folder,
                seed=seed_for(lesson.seed, "ppo") % 2**63,
                warm_start=warm_start,
            )
            spent = spent + watch.cost(result.steps)
            notes.append(f"stopped by {result.stopped_by}, in training {result.success:.0%}")
            if starts is not None and "reverse" in way:
                notes.append(f"level {starts.level:.1f}")
        return Run(
            task=name,
            way=way,
            seed=self.seed,
            successes=lesson.successes(folder),
            episodes=cfg.episodes,
            cost=spent,
            note="; ".join(notes),
        )

    def _other(self, lesson: Lesson) -> tuple[Path, str]:
        """Return the expert of the most similar other task, imitated."""
        obs_dim = lesson.worlds(1, "shape").obs_dim
        others = [
            Solved(bundle=load_benchmark(name), folder=Path(name), obs_dim=obs_dim)
            for name in benchmark_names()
            if name != lesson.name
        ]
        ranked = rank_solved(lesson.bundle, obs_dim, others)
        if not ranked:
            raise V2PError(
                f"no other benchmark task's expert fits '{lesson.name}'; leave out its way 'other'"
            )
        source = self.lesson(ranked[0].folder.name)
        folder, cost = source.imitated
        steps = cost.steps + source.program[2].steps
        return folder, f"from '{source.name}', {steps} steps given"


def table(runs: list[Run]) -> str:
    """Return one row per task and way."""
    lines = [
        f"{'task':18}{'way':20}{'success':36}{'each seed':20}{'steps':>10}{'wall s':>9}{'CPU s':>9}  notes"
    ]
    for task, way in dict.fromkeys((r.task, r.way) for r in runs):
        rows = [r for r in runs if (r.task, r.way) == (task, way)]
        rate = wilson(sum(r.successes for r in rows), sum(r.episodes for r in rows))
        each = " ".join(f"{r.successes / r.episodes:.0%}" for r in rows)
        steps, wall, cpu = (
            statistics.median(getattr(r.cost, key) for r in rows)
            for key in ("steps", "wall_s", "cpu_s")
        )
        lines.append(
            f"{task:18}{way:20}{rate!s:36}{each:20}{steps:10.0f}{wall:9.1f}{cpu:9.1f}  {rows[-1].note}"
        )
    return "\n".join(lines)


def main(cfg: BenchConfig) -> None:
    """Run all of it and print the table after each training."""
    logging.basicConfig(level=logging.WARNING)
    if cfg.quick:
        cfg = replace(
            cfg,
            tasks=("lift_up",),
            seeds=(0,),
            steps=30_000,
            num_envs=96,
            trial_worlds=16,
            bank_worlds=16,
            episodes=8,
            imitation=replace(cfg.imitation, rounds=2, epochs=1),
        )
    runs: list[Run] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in cfg.seeds:
            course = Course(seed, cfg, Path(folder))
            for task in cfg.tasks:
                for way in cfg.ways:
                    run = course.run(task, way)
                    runs.append(run)
                    print(
                        f"{task} {way} seed {seed}: {wilson(run.successes, run.episodes)}, "
                        f"{run.cost.steps} steps, {run.cost.wall_s:.0f} s; {run.note}",
                        flush=True,
                    )
                    if cfg.json is not None:
                        cfg.json.write_text(json.dumps([asdict(r) for r in runs], indent=1))
    print()
    print(table(runs))


if __name__ == "__main__":
    main(tyro.cli(BenchConfig, description=__doc__))
