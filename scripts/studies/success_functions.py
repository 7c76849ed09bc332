"""Recorded episodes of scripted programs, and what success functions say of their last moments."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from v2p_data.experts.teacher import Teacher
from v2p_data.sim.env import task_code
from v2p_data.sim.env.batch_env import HELD_STEPS, BatchEnv
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.task import TaskBundle

QUIET_STEPS = 20
"""Control steps (1 s) without noise at the end, so that stillness alone does not decide."""
Moments = list[dict[str, torch.Tensor]]


def play_programs(
    env: BatchEnv,
    program: Int[np.ndarray, "env"],
    noise: Float[np.ndarray, "env"],
    stop: Float[np.ndarray, "env"],
    rng: np.random.Generator,
) -> tuple[Moments, Bool[np.ndarray, "env"]]:
    """Play one episode in every world; return the last moments, and what the referee says.

    Args:
        env: the worlds.
        program: of each world, by its place among the programs of the scene.
        noise: standard deviation on actions in [-1, 1].
        stop: control step from which on the robot does nothing.
        rng: of the noise.
    """
    n, horizon = env.num_envs, env.horizon
    teacher, referee = Teacher(env), RefereeRecord(env)
    env.reset(np.arange(n))
    referee.restart()
    last: Moments = []
    for step in range(horizon):
        moment = teacher.moment()
        wanted: Float[np.ndarray, "program env 7"] = np.stack(
            [act(moment) for act in teacher.programs.values()]
        )
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
    bundle: TaskBundle = env.bundle
    try:
        task = task_code.load(replace(bundle, code=code, class_name=class_name(code)), env, None)
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
