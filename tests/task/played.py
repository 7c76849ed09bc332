"""Scripted arms in the real physics: what a careful or a cheating robot does in each kind of task.

A script is a list of phases, each a number of control steps and what the arm does in them. All worlds of a batch
follow it in step. Places are those of the object's centre, from where it started.
"""

from collections.abc import Callable, Sequence

import numpy as np

from v2p_data.experts.primitives import CLOSE, Actions, Moment, grasp, push, release
from v2p_data.experts.teacher import WITH_OTHER, Teacher
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.verdict import RefereeRecord

type Phase = tuple[int, Callable[[Moment], Actions]]
type Script = Sequence[Phase]

ASKED_EVERY = 4
LEFT, RIGHT, BACK, FORWARD = (0.0, 1.0), (0.0, -1.0), (-1.0, 0.0), (1.0, 0.0)


def idle(steps: int = 60) -> Phase:
    return steps, lambda m: np.zeros((len(m.tool), 7))


def take(of: int = 0, steps: int = 40) -> Phase:
    """Go to an object and close around it."""
    return steps, lambda m: np.where(
        m.holds(m.bodies[of])[:, None], m.go(m.tool, CLOSE), grasp(m, m.bodies[of])
    )


def bring(
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.002,
    *,
    of: int = 0,
    to: int | None = None,
    steps: int = 30,
) -> Phase:
    """Move what is held to a place: from its start, or from another object's centre, at a height above its start."""

    def act(m: Moment) -> Actions:
        body = m.bodies[of]
        goal = body.start.copy()
        if to is not None:
            goal[:, :2] = m.bodies[to].pos[:, :2]
        return m.go(m.tool + goal + [x, y, z] - body.pos, CLOSE, speed=0.7)

    return steps, act


def let_go(of: int = 0, steps: int = 16) -> Phase:
    return steps, lambda m: release(m, m.bodies[of])


def rise(z: float = 0.35, steps: int = 16, grip: float = CLOSE) -> Phase:
    """Go straight up."""

    def act(m: Moment) -> Actions:
        to = m.tool.copy()
        to[:, 2] = z
        return m.go(to, grip)

    return steps, act


def shove(
    direction: tuple[float, float] | None = None,
    way_m: float = 0.1,
    *,
    of: int = 0,
    towards: int | None = None,
    gap_m: float = 0.01,
    high: float | None = None,
    steps: int = 60,
) -> Phase:
    """Push an object from behind: so far from its start, or until a gap to another object is left."""

    def act(m: Moment) -> Actions:
        body = m.bodies[of]
        if towards is None:
            d = np.tile(np.asarray(direction), (len(m.tool), 1))
            left = way_m - ((body.pos - body.start)[:, :2] * d).sum(1)
        else:
            other = m.bodies[towards]
            off = (other.pos - body.pos)[:, :2]
            d = off / np.linalg.norm(off, axis=1, keepdims=True)
            left = np.linalg.norm(off, axis=1) - body.reach(d) - other.reach(d) - gap_m
        height = None if high is None else body.start[:, 2] * 2 * high
        return push(m, body, d, left, height_m=height)

    return steps, act


def program(name: str, steps: int = 90) -> Phase:
    """Do what the scripted policy of that name does with the second object."""
    return steps, lambda m: WITH_OTHER[name](m, 1)


def play(env: BatchEnv, script: Script, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the referee's verdicts at the end, and whether it said yes at any time."""
    env.seed(seed)
    env.reset(np.arange(env.num_envs))
    teacher, record = Teacher(env), RefereeRecord(env)
    ever = np.zeros(env.num_envs, bool)
    for steps, act in script:
        for _ in range(steps):
            env.step(act(teacher.moment()))
            record.note()
            if len(record) % ASKED_EVERY == 0:
                ever |= record.verdict()
    end = record.verdict()
    return end, ever | end
