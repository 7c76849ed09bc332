"""One expert for many random tasks of one kind: a program is imitated on all of them, PPO goes on from there.

With `alone` there is no program in the learning: PPO learns from the reward, as in the paper, on all tasks at once.
"""

import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from policies.ppo.config import ActorConfig, ImitationConfig, PPOConfig
from policies.ppo.imitate import imitate
from policies.ppo.policy import Expert
from policies.ppo.train import LAST_FOLDER, train_expert
from v2p_data.errors import ItemRejectedError
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.labeller import network_actor
from v2p_data.experts.teacher import Teacher, try_out
from v2p_data.kinds import KINDS, Kind
from v2p_data.play import Actor, StateActor
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.task import TaskBundle

from .joined_worlds import JoinedWorlds
from .toys import random_task

HIDDEN = (256, 256)
LAST_EPOCHS = 15
LEAST_PROGRAM = 0.6
"""A task that no preferred program solves this often teaches by imitation what is wrong."""
TRIAL_WORLDS = 12
CHOICE, JUDGED = 10_000, 20_000
"""First numbers of the tasks that choose what ships, and of those that judge it once."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Taught:
    """A task and the program that does it best."""

    bundle: TaskBundle
    program: str
    rate: float


def solvable_tasks(kind: Kind, first: int, count: int, seed: int, folder: Path) -> list[Taught]:
    """Return random tasks that a program solves, from number `first` on."""
    found: list[Taught] = []
    for number in range(first, first + 4 * count):
        if len(found) == count:
            break
        try:
            bundle = random_task(kind, number, seed, folder)
            env = BatchEnv(bundle, SimConfig(), num_envs=TRIAL_WORLDS, seed=number, num_threads=1)
            teacher, rates = Teacher(env), {}
            for name in teacher.programs:
                if name.startswith(
                    KINDS[kind].programs[0]
                ):  # two programs are averaged into neither
                    teacher.name = name
                    rates[name] = float(_at_end(env, teacher).mean())
        except ItemRejectedError:
            continue
        ((program, rate),) = rates.items()
        if rate >= LEAST_PROGRAM:
            found.append(Taught(bundle=bundle, program=program, rate=rate))
    return found


def _at_end(env: BatchEnv, teacher: Teacher) -> Bool[np.ndarray, "env"]:
    return try_out(env, StateActor(lambda _: teacher.act())).at_end


def worlds_of(
    tasks: Sequence[Taught], purpose: str, count: int, sim: SimConfig, seed: int
) -> list[BatchEnv]:
    """Return worlds of each task, seeded by the purpose."""
    return [
        BatchEnv(
            t.bundle,
            sim,
            num_envs=count,
            seed=seed_for(seed, purpose, t.bundle.title),
            num_threads=1,
        )
        for t in tasks
    ]


def rates_of(parts: Sequence[BatchEnv], actor: Actor, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return per task the share of episodes that succeed at some time, and at their end."""
    played = [try_out(part, actor, seed) for part in parts]
    return np.array([p.once.mean() for p in played]), np.array([p.at_end.mean() for p in played])


def teach(
    tasks: Sequence[Taught], each: int, cfg: ImitationConfig, out: Path, seed: int
) -> dict[str, Any]:
    """Imitate each task's program in worlds of all tasks at once."""
    parts = worlds_of(tasks, "taught", each, SimConfig(), seed)
    joined, teachers = JoinedWorlds(parts), [Teacher(part) for part in parts]
    for teacher, task in zip(teachers, tasks, strict=True):
        teacher.name = task.program
    result = imitate(
        TorchRLEnv(joined),  # type: ignore[arg-type]
        lambda: joined.joined([t.act() for t in teachers]),
        cfg,
        out,
        seed=seed,
    )
    return {"steps": result.steps, "seconds": round(result.seconds, 1), "loss": result.loss}


def improve(
    tasks: Sequence[Taught], each: int, cfg: PPOConfig, out: Path, seed: int, start: Path | None
) -> dict[str, Any]:
    """Train by PPO in worlds of all tasks at once, from a taught policy or from nothing."""
    fine = start is not None
    bonus = SimConfig().bonus_ratio * (ExpertConfig().taught_bonus_factor if fine else 1.0)
    parts = worlds_of(tasks, "ppo", each, SimConfig(fine=fine, bonus_ratio=bonus), seed)
    begun = [time.monotonic()]

    def tell(done: int, total: int, success: float) -> None:
        if time.monotonic() - begun[0] > 20:
            begun[0] = time.monotonic()
            print(f"  PPO {done} of {total}: {success:.3f}", flush=True)

    result = train_expert(
        TorchRLEnv(JoinedWorlds(parts)),
        cfg,
        out,
        seed=seed,
        warm_start=start,
        on_progress=tell,  # type: ignore[arg-type]
    )
    return {
        "steps": result.steps,
        "seconds": round(result.seconds, 1),
        "stopped_by": result.stopped_by,
        "actor_updates": result.actor_updates,
        "last_actor_updates": result.last_actor_updates,
    }


def learn_kind(
    kind: Kind, out: Path, *, num_tasks: int, each: int, steps: int, alone: bool, seed: int
) -> dict[str, Any]:
    """Learn one kind; write experts and a record into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    tasks = solvable_tasks(kind, 0, num_tasks, seed, out / "tasks")
    print(
        kind,
        len(tasks),
        "tasks, program",
        round(float(np.mean([t.rate for t in tasks])), 3),
        round(time.monotonic() - started),
        "s",
        flush=True,
    )
    record: dict[str, Any] = {"kind": kind, "tasks": len(tasks), "seed": seed, "alone": alone}
    folders = {}
    train_seed = seed_for(seed, "pretraining", kind) % 2**63
    actor = ActorConfig(hidden=HIDDEN)
    if not alone:
        imitation = ImitationConfig(last_epochs=LAST_EPOCHS)
        imitation = replace(imitation, actor=replace(imitation.actor, hidden=HIDDEN))
        record["taught"] = teach(tasks, each, imitation, out / "taught", train_seed)
        folders["taught"] = out / "taught"
        print(" ", record["taught"], flush=True)
    if steps:
        ppo = PPOConfig(
            total_steps=steps,
            max_seconds=1e9,
            target_success=1.0,
            plateau_steps=10 * steps,
            num_deterministic=each * num_tasks // 4,
            window_episodes=240,
            min_window_episodes=120,
            actor=actor,
        )
        start = None if alone else out / "taught"
        record["ppo"] = improve(tasks, each, ppo, out / "ppo", train_seed, start)
        folders |= {"best": out / "ppo", "last": out / "ppo" / LAST_FOLDER}
        print(" ", record["ppo"], flush=True)
    held_out = solvable_tasks(kind, CHOICE, 20, seed, out / "tasks")
    parts = worlds_of(held_out, "choice", 24, SimConfig(fine=True), seed)
    record["program"] = round(float(np.mean([t.rate for t in held_out])), 4)
    for name, folder in folders.items():
        once, end = rates_of(parts, network_actor(Expert.load(folder)), train_seed % 2**31)
        record[f"choice_{name}"] = {"once": once.round(3).tolist(), "end": end.round(3).tolist()}
        print(
            " ",
            kind,
            name,
            f"once {once.mean():.3f} end {end.mean():.3f} least",
            np.sort(once)[:4].round(2).tolist(),
            flush=True,
        )
    record["seconds"] = round(time.monotonic() - started)
    (out / "record.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    return record
