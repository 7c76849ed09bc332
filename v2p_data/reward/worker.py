"""The process in which candidate rewards train: it loads the libraries once and forks for each job.

It reads lines of JSON from its input ({"job": folder, "number": n} or {"kill": n}) and answers with lines of JSON. A job's
process gives up the network, starting programs and writing outside its own folder, and gets a limit on its memory,
before it loads any generated code; time limits are the parent's business. What it does:

* `train`: PPO on one candidate's reward up to a mark, with an evaluation at every mark on the way; it goes on from
  its checkpoint, so that stopping and going on changes no result;
* `teach`: the policy from which candidates start, imitated from a scripted program.
"""

import csv
import json
import os
import re
import select
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict

from policies.ppo.config import ImitationConfig, PPOConfig
from policies.ppo.policy import Expert
from policies.ppo.train import NotFiniteError, train_expert
from v2p_data.errors import V2PError
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.learning import Worlds, success_of
from v2p_data.experts.learning import teach as teach_policy
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.play import StateActor
from v2p_data.processes import end_with_parent
from v2p_data.reward.candidate import (
    DONE_FILE,
    EVALUATIONS_FILE,
    FAULT_FILE,
    FEEDBACK_FILE,
    LAST_POLICY,
    TRAIN_FOLDER,
    TRAJECTORIES_FILE,
    Fault,
    Kind,
)
from v2p_data.reward.feedback import feedback_of, reward_ranks
from v2p_data.reward.jobs import HEARTBEAT_FILE, LOG_FILE, REQUEST_FILE
from v2p_data.reward.methods import load_candidate
from v2p_data.reward.record import record_trajectories
from v2p_data.reward.trajectories import Trajectories
from v2p_data.scene.scene import SceneObject
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.sandbox.confine import Rights, confine, leave_the_network

POLL_S = 0.05
FILE_BYTES = 2 * 1024**3
OPEN_FILES = 256
THREADS = 64
ANY_SUCCESS = 1e-6
"""A program that succeeds in any world is imitated: candidates start from it, however poor it is."""
LEAST_WAY_M = 0.01
"""The video's displacement says nothing below this."""


# --- the process that forks ----------------------------------------------------------------------------------


def main() -> None:
    """Answer requests until the input ends or the parent does."""
    leave_the_network()
    torch.set_num_threads(1)
    # Loads what tensordict loads late, once for all jobs: three seconds.
    TensorDict.from_any({"a": torch.zeros(1)})
    _say({"ready": True})
    children: dict[int, int] = {}
    pending = b""
    while True:
        ready, _, _ = select.select([0], [], [], POLL_S)
        if ready:
            read = os.read(0, 65536)
            if not read:
                break
            *lines, pending = (pending + read).split(b"\n")
            for line in lines:
                _obey(json.loads(line), children)
        for pid, number in list(children.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                del children[pid]
                _say({"number": number, "status": os.waitstatus_to_exitcode(status)})
    for pid in children:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    os._exit(0)  # taking torch down in order lasts seconds


def _obey(message: dict[str, Any], children: dict[int, int]) -> None:
    if "kill" in message:
        for pid, number in children.items():
            if number == message["kill"]:
                os.kill(pid, signal.SIGKILL)
        return
    parent_pid, pid = os.getpid(), os.fork()
    if pid == 0:
        code = 1
        try:
            code = _in_child(Path(message["job"]), parent_pid)
        finally:
            os._exit(code)
    children[pid] = message["number"]


def _in_child(folder: Path, parent_pid: int) -> int:
    end_with_parent(parent_pid)
    with (folder / LOG_FILE).open("a") as log, Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    request = json.loads((folder / REQUEST_FILE).read_text())
    confine(
        Rights(
            seconds=None,
            memory_bytes=int(request["memory_mb"]) * 1024**2,
            file_bytes=FILE_BYTES,
            open_files=OPEN_FILES,
            processes=THREADS,
            folder=folder,
        ),
        parent_pid=parent_pid,
        give_up_root=False,
    )
    return run_job(request, folder)


def run_job(request: dict[str, Any], folder: Path) -> int:
    """Do what a request asks for; an exception becomes `fault.json`. Return the exit code."""
    try:
        {"train": train, "teach": teach}[request["job"]](request, folder)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is this candidate's result
        traceback.print_exc()
        write_json_atomically(folder / FAULT_FILE, fault_of(error).as_dict())
        return 1
    return 0


def fault_of(error: Exception) -> Fault:
    """Return which kind of failure an exception is."""
    words = " ".join(str(error).split())[:500]
    kind: Kind = "error"
    if isinstance(error, NotFiniteError) or re.search(r"\bis (nan|-?inf)\b", words):
        kind = "not_finite"
    elif "rewards lie within" in words:
        kind = "unbounded"
    elif isinstance(error, MemoryError) or re.search(r"alloc|out of memory", words, re.I):
        kind = "out_of_memory"
    return Fault(
        kind=kind,
        reason=words if isinstance(error, V2PError) else f"{type(error).__name__}: {words}",
    )


def _say(message: dict[str, Any]) -> None:
    os.write(1, json.dumps(message).encode() + b"\n")


# --- what a job does -----------------------------------------------------------------------------------------


def train(request: dict[str, Any], folder: Path) -> None:
    """Train one candidate up to a mark, or until its evaluations reach the target."""
    bundle = load_candidate(Path(request["bundle"]), Path(request["code"]))
    sim = SimConfig(bonus_ratio=float(request["bonus_ratio"]))
    seed, every = int(request["seed"]), int(request["steps_per_mark"])
    num_envs, threads = int(request["num_envs"]), int(request["num_threads"])
    env = BatchEnv(
        bundle, sim, num_envs=num_envs, seed=seed_for(seed, "worlds"), num_threads=threads
    )
    judge = BatchEnv(
        bundle,
        sim,
        num_envs=int(request["eval_worlds"]),
        seed=int(request["eval_seed"]),
        num_threads=threads,
    )
    warm_start = Path(request["warm_start"]) if request["warm_start"] else None
    evaluations: list[dict[str, Any]] = json_or_none(folder / EVALUATIONS_FILE) or []
    done: dict[str, Any] = json_or_none(folder / DONE_FILE) or {}
    began, before = time.monotonic(), float(done.get("seconds", 0.0))
    mark, target = len(evaluations), int(request["mark"])
    reached, trajectories = False, None
    if evaluations and (mark >= target or is_enough(evaluations, request)):
        mark -= 1  # a kill came before the feedback: the last evaluation is made again, without training
    while not reached and mark < target:
        mark += 1
        train_expert(
            TorchRLEnv(env),
            ppo_config(num_envs, mark * every, num_threads=threads),
            folder / TRAIN_FOLDER,
            seed=seed_for(seed, "ppo") % 2**63,
            warm_start=warm_start,
            on_progress=lambda *_: _beat(folder),
            draws=False,
        )
        expert = Expert.load(folder / TRAIN_FOLDER / LAST_POLICY)
        judge.seed(seed_for(int(request["eval_seed"]), "mark", mark))
        trajectories = record_trajectories(judge, StateActor(expert.act))
        _beat(folder)
        evaluations = [
            *evaluations[: mark - 1],
            evaluation_of(trajectories, bundle.scene.manipulated, bool(request["sees_video"])),
        ]
        write_json_atomically(folder / EVALUATIONS_FILE, evaluations)
        reached = is_enough(evaluations, request)
    assert trajectories is not None
    feedback = feedback_of(
        trajectories,
        judge.physics.control_dt_s,
        curves=curves_of(folder / TRAIN_FOLDER / "curve.csv", evaluations),
    )
    trajectories.save(folder / TRAJECTORIES_FILE)
    write_json_atomically(folder / FEEDBACK_FILE, feedback.as_dict())
    write_json_atomically(
        folder / DONE_FILE,
        {"mark": mark, "reached": reached, "seconds": before + time.monotonic() - began},
    )


def is_enough(evaluations: list[dict[str, Any]], request: dict[str, Any]) -> bool:
    """Tell whether the last evaluations reach the target."""
    count = int(request["evaluations"])
    last = [float(e["success"]) for e in evaluations[-count:]]
    return len(last) == count and float(np.mean(last)) >= float(request["target_success"])


def ppo_config(num_envs: int, total_steps: int, *, num_threads: int = 1) -> PPOConfig:
    """Return the recipe of all candidates: only steps end it, never what training itself believes."""
    return PPOConfig(
        total_steps=total_steps,
        max_seconds=float("inf"),
        target_success=2.0,
        decline=2.0,
        plateau_steps=total_steps,
        num_deterministic=max(1, num_envs // 8),
        window_episodes=max(64, num_envs // 4),
        min_window_episodes=max(1, num_envs // 8),
        minibatch=min(1024, num_envs * 4),
        warm_start_critic_batches=2,
        num_threads=num_threads,
    )


def evaluation_of(t: Trajectories, obj: SceneObject, sees_video: bool) -> dict[str, Any]:
    """Return one entry of `evaluations.json`; methods that know no video have no use for its motion."""
    moved = t.states[f"{obj.name}_pos"][-1] - t.states[f"{obj.name}_start_pos"][-1]
    return {
        "success": float(t.succeeded.mean()),
        "ever": float(t.success.any(0).mean()),
        "closeness": float(closeness(moved, obj).mean()) if sees_video else 0.0,
        "touched": float((t.states[f"{obj.name}_touched"] > 0.5).mean()),
        "control_steps": int(t.success.size),
        "ranking": reward_ranks(t),
    }


def closeness(moved_m: Float[np.ndarray, "env 3"], obj: SceneObject) -> Float[np.ndarray, "env"]:
    """Return how much of the video's displacement happened: 0 for none, 1 for all of it."""
    way = np.zeros(3)
    if obj.poses_world:
        way = np.asarray(obj.first_to_last.translation_m, float)
    length = float(np.linalg.norm(way))
    if length < LEAST_WAY_M:
        return np.zeros(len(moved_m))
    return np.clip(1 - np.linalg.norm(moved_m - way, axis=1) / length, 0.0, 1.0)


def curves_of(curve: Path, evaluations: list[dict[str, Any]]) -> dict[str, list[float]]:
    """Return per component its mean in the course of training, and the success of the evaluations."""
    with curve.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    names = [k for k in (rows[0] if rows else {}) if k.startswith("reward_")]
    curves = {n.removeprefix("reward_"): [float(row[n] or "nan") for row in rows] for n in names}
    return curves | {"success": [float(e["success"]) for e in evaluations]}


def teach(request: dict[str, Any], folder: Path) -> None:
    """Imitate the program that does best; without one that succeeds at all there is no policy to start from."""
    bundle = load_candidate(Path(request["bundle"]), Path(request["code"]))
    seed, threads = int(request["seed"]), int(request["num_threads"])

    worlds = Worlds(bundle=bundle, seed=seed, num_threads=threads)
    num_trials, num_envs = int(request["eval_worlds"]), int(request["num_envs"])
    cfg = ExpertConfig(
        trial_worlds=num_trials,
        num_envs=num_envs,
        least_teacher_success=ANY_SUCCESS,
        imitation=ImitationConfig(rounds=int(request["rounds"]), num_threads=threads),
    )
    began = time.monotonic()
    taught = teach_policy(
        worlds,
        worlds.make(num_trials, "trials"),
        cfg,
        folder / TRAIN_FOLDER,
        has_exams=False,
        on_progress=lambda *_: _beat(folder),
    )
    steps, success = taught.steps, 0.0
    if taught.folder is not None:
        exam = worlds.make(num_trials, "exam", fine=True)
        success = success_of(exam, Expert.load(taught.folder))
        steps += exam.num_envs * bundle.horizon_steps
    write_json_atomically(
        folder / DONE_FILE,
        {
            "mark": 0,
            "teacher": taught.program if taught.folder is not None else "",
            "program_success": taught.program_success,
            "taught_success": success,
            "control_steps": steps,
            "seconds": time.monotonic() - began,
        },
    )


def _beat(folder: Path) -> None:
    os.utime(folder / HEARTBEAT_FILE)


if __name__ == "__main__":
    sys.exit(main())
