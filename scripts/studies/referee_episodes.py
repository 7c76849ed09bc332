"""Episodes of mixed success in a benchmark task, with the referee's word, for judging success functions."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool

from v2p_data.experts.teacher import Teacher
from v2p_data.kinds import KINDS
from v2p_data.sim.env import task_code
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.task_code import HELD_STEPS
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.task.sandbox.sandbox import class_name

NOISES = (0.0, 0.3, 0.6, 1.0)
"""Standard deviations of the noise on actions in [-1, 1]."""
IDLE_SHARE, STOPPED_SHARE, MEANT_SHARE = 0.1, 0.3, 0.5
"""Of the worlds: nobody acts; the robot stops half-way; the program is the one that the task's words mean."""
QUIET_STEPS = 20
"""Control steps (1 s) without noise at the end, so that stillness alone does not decide."""
Moments = list[dict[str, torch.Tensor]]


def played(env: BatchEnv, rng: np.random.Generator) -> tuple[Moments, Bool[np.ndarray, "env"]]:
    """Play one episode in every world; return the last moments, and what the referee says."""
    n, horizon = env.num_envs, env.horizon
    teacher, referee = Teacher(env), RefereeRecord(env)
    names = list(teacher.programs)
    meant = [k for k, name in enumerate(names) if name.startswith(KINDS[env.bundle.kind].programs)]
    program = np.where(
        rng.random(n) < MEANT_SHARE, rng.choice(meant, n), rng.integers(len(names), size=n)
    )
    noise = rng.choice(NOISES, n)
    is_idle = rng.random(n) < IDLE_SHARE
    stop = np.where(rng.random(n) < STOPPED_SHARE, rng.uniform(0.3, 1.0, n), np.inf) * horizon
    stop = np.where(is_idle, -1, stop)
    env.reset(np.arange(n))
    referee.restart()
    last: Moments = []
    for step in range(horizon):
        moment = teacher.moment()
        wanted = np.stack([act(moment) for act in teacher.programs.values()])
        action = wanted[program, np.arange(n)]
        if step < horizon - QUIET_STEPS:
            action = action + noise[:, None] * rng.normal(size=action.shape)
        action[step > stop] = 0.0
        env.step(action)
        referee.note()
        if step >= horizon - HELD_STEPS:
            last.append({key: value.clone() for key, value in env.states().items()})
    return last, referee.verdict()


def held(env: BatchEnv, code: str, last: Moments) -> Bool[np.ndarray, "env"] | None:
    """Return where a code's success is true at all of the last moments, None where it does not run."""
    try:
        task = task_code.load(
            replace(env.bundle, code=code, class_name=class_name(code)), env, None
        )
        answers = [
            task.succeeds(lambda moment=moment: {k: v.clone() for k, v in moment.items()})
            for moment in last
        ]
    except Exception:  # noqa: BLE001 - whatever the code raises, it does not run
        return None
    return torch.stack(answers).all(dim=0).numpy()


def balanced_accuracy(said: Bool[np.ndarray, "env"], right: Bool[np.ndarray, "env"]) -> float:
    """Return the mean of the shares of true and of false cases that are told right; of one kind, where there is one only."""
    shares = [
        np.mean(said[right == value] == value) for value in (True, False) if (right == value).any()
    ]
    return float(np.mean(shares))
