"""A teacher for a task that nobody has solved yet: programs of primitives, tried in simulation, the best one kept.

A program says what to do from any state: grasp what is manipulated and lift it, carry it somewhere and let go,
push it, push it with a tool, throw it. Which programs make sense follows from the scene's objects and from how
far they moved in the video, not from the kind of task; which one is right is found by trying all of them and
asking the task's own success function. Policies learn from the teacher's actions. It makes datasets itself only where
`ExpertConfig.start` is `as_program`.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from policies.evaluation.paired import score
from v2p_data.experts.primitives import (
    CLOSE,
    Actions,
    Body,
    Moment,
    carry,
    choose,
    grasp,
    push,
    raise_up,
    release,
    swing,
)
from v2p_data.kinds import KINDS
from v2p_data.play import Actor, StateActor, View, play
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.sandbox.probes import first_pose

logger = logging.getLogger(__name__)

Program = Callable[[Moment], Actions]

LIFT, PUSH_AS, CARRY_AS, TIP = "lift", "push as in the video", "carry as in the video", "tip over"
"""Names of the programs that need no second object."""
THROWN_OVER_M = 0.3
"""An object nearer than this needs no throw."""
GOOD_ENOUGH = 0.4
"""A program that is meant and succeeds this often is not compared with others."""


@dataclass(frozen=True, kw_only=True)
class ProgramScore:
    """How one program did."""

    name: str
    success: float
    """Share of episodes that the task's own success function held at their end."""


class Teacher:
    """The programs of one task's worlds.

    Args:
        env: the worlds.
    """

    def __init__(self, env: BatchEnv) -> None:
        self.env = env
        self.programs = programs_for(env)
        self.name = next(iter(self.programs))
        self.trials: tuple[ProgramScore, ...] = ()

    def act(self) -> Float[np.ndarray, "env 7"]:
        """Return the chosen program's actions for the worlds as they are."""
        return self.programs[self.name](self.moment())

    def moment(self) -> Moment:
        """Return the worlds as they are."""
        env = self.env
        return Moment.of(
            env.states(),
            env.world.objects,
            step_m=env.cfg.position_step_m * env.bundle.motion_scale,
            turn_rad=env.cfg.rotation_step_rad,
            opening_m=2 * env.world.robot.finger_travel_m,
        )

    def choose(self, env: BatchEnv) -> ProgramScore:
        """Play one episode of each program in every world of another environment and keep the best one.

        What the task's words name is tried first and kept if it succeeds well: the task's own success sees only
        how an episode ends, and an object may also have been carried to where it should be pushed.
        """
        meant = KINDS[self.env.bundle.kind].programs
        names = sorted(self.programs, key=lambda name: not name.startswith(meant))
        player = Teacher(env)
        trials: list[ProgramScore] = []
        for name in names:
            is_meant = name.startswith(meant)
            if not is_meant and any(t.success >= GOOD_ENOUGH for t in trials):
                break
            player.name = name
            trials.append(ProgramScore(name=name, success=player.play()))
            logger.info("program '%s': %.0f %%", name, 100 * trials[-1].success)
        self.trials = tuple(trials)
        best = max(trials, key=lambda t: t.success + 0.2 * t.name.startswith(meant))
        self.name = best.name
        return best

    def play(self) -> float:
        """Play one episode in every world and return the share whose success was held at the end."""
        return float(try_out(self.env, StateActor(lambda _: self.act())).at_end.mean())


@dataclass(frozen=True, kw_only=True)
class EpisodeOutcomes:
    """One episode in every world, judged by the task's own success."""

    at_end: Bool[np.ndarray, "env"]
    """Success was held at the end."""
    steps: Int[np.ndarray, "env"]
    """Control steps until success was first held; one more than the horizon where it never was."""
    horizon: int

    @property
    def once(self) -> Bool[np.ndarray, "env"]:
        """Success was held at some time, which is what episodes are recorded for."""
        return self.steps <= self.horizon

    @property
    def score(self) -> float:
        """Mean of `policies.evaluation.paired.score` over the worlds."""
        waited = self.steps / self.horizon
        return float(np.mean([score(*pair) for pair in zip(self.once * 1.0, waited, strict=True)]))


def try_out(env: BatchEnv, actor: Actor, seed: int | None = None) -> EpisodeOutcomes:
    """Play one episode in every world; who is given the same seed plays the same episodes."""
    if seed is not None:
        env.seed(seed)
    env.reset(np.arange(env.num_envs))
    steps = np.full(env.num_envs, env.horizon + 1)

    def note(view: View) -> None:
        np.minimum(steps, view.t, out=steps, where=view.result.held)

    view = View(env)
    play(view, actor, [note])
    return EpisodeOutcomes(at_end=view.result.held, steps=steps, horizon=env.horizon)


def programs_for(env: BatchEnv) -> dict[str, Program]:
    """Return the programs that make sense for a scene, by name."""
    scene = env.bundle.scene
    objects = scene.objects
    poses = np.array(objects[0].poses_world, float).reshape(-1, 7)
    move = poses[-1, :3] - poses[0, :3] if len(poses) else np.zeros(3)
    way = float(np.linalg.norm(move[:2]))
    lift = float(poses[:, 2].max() - poses[0, 2]) if len(poses) else 0.0
    programs: dict[str, Program] = {LIFT: lambda m: _lift(m, height_m=max(0.13, min(lift, 0.16)))}
    if way > 0.03:
        direction = move[:2] / way
        side = np.array([0.0, np.sign(move[1])]) if abs(move[1]) > abs(move[0]) else None
        programs[PUSH_AS] = lambda m: _push(
            m, side if side is not None else direction, np.clip(0.75 * way, 0.1, 0.16)
        )
        offset = np.array([*move[:2], 0.0])
        programs[CARRY_AS] = lambda m: _put(
            m, m.bodies[0].start + offset, over_m=np.full(len(m.tool), 0.05)
        )
    programs[TIP] = _tip
    for k in range(1, len(objects)):
        far = np.linalg.norm(first_pose(objects[k])[:2] - first_pose(objects[0])[:2])
        label = objects[k].name
        for words, program in WITH_OTHER.items():
            if program is not _throw or far > THROWN_OVER_M:
                programs[f"{words} {label}"] = lambda m, k=k, program=program: program(m, k)
    return programs


# --- programs ------------------------------------------------------------------------------------------------


def _lift(m: Moment, *, height_m: float) -> Actions:
    obj = m.bodies[0]
    return choose(m.holds(obj), raise_up(m, obj, height_m), grasp(m, obj))


def _push(m: Moment, direction: np.ndarray, way_m: float) -> Actions:
    obj = m.bodies[0]
    d = np.tile(direction, (len(m.tool), 1))
    moved = ((obj.pos - obj.start)[:, :2] * d).sum(1)
    # Back onto the line on which it started.
    drift = (obj.pos - obj.start)[:, :2] - moved[:, None] * d
    d = _unit(d - np.clip(4 * drift, -0.35, 0.35))
    return push(m, obj, d, way_m - moved)


def _tip(m: Moment) -> Actions:
    obj = m.bodies[0]
    side = np.zeros((len(m.tool), 2))
    side[:, 1] = np.where(obj.start[:, 1] > 0, -1.0, 1.0)
    upright = np.abs(obj.rotation[:, 2, 2])
    height = obj.start[:, 2] * 2 * 0.8
    return push(m, obj, side, np.where(upright > 0.4, 0.1, -1.0), height_m=height)


def _push_next_to(m: Moment, k: int) -> Actions:
    obj, ref = m.bodies[0], m.bodies[k]
    d = _unit((ref.pos - obj.pos)[:, :2])
    gap = np.linalg.norm((ref.pos - obj.pos)[:, :2], axis=1) - obj.reach(d) - ref.reach(d)
    return push(m, obj, d, gap - 0.009, avoid=ref)


def _drag_next_to(m: Moment, k: int) -> Actions:
    """Grasp the object, slide it with its end first, let go."""
    obj, ref = m.bodies[0], m.bodies[k]
    d = _unit((ref.pos - obj.pos)[:, :2])
    gap = np.linalg.norm((ref.pos - obj.pos)[:, :2], axis=1) - obj.reach(d) - ref.reach(d)
    turn = _turn_along(obj, d)
    to = m.tool.copy()
    pace = np.clip((gap - 0.008) / 0.03, 0.1, 1.0) * np.clip(1.2 - 2 * np.abs(turn), 0.1, 1.0)
    to[:, :2] += d * 0.03 * pace[:, None]
    to[:, 2] += obj.start[:, 2] + 0.001 - obj.pos[:, 2]
    carried = m.go(to, CLOSE, turn)
    return choose(gap < 0.012, release(m, obj), choose(m.holds(obj), carried, grasp(m, obj)))


def _turn_along(body: Body, direction: np.ndarray) -> np.ndarray:
    """Return by how much to turn an object [rad] so that its longer side points along a direction."""
    long = int(np.argmax(body.model.size_m[:2]))
    axis = body.rotation[:, :2, long]
    turn = np.arctan2(direction[:, 1], direction[:, 0]) - np.arctan2(axis[:, 1], axis[:, 0])
    return (turn + np.pi / 2) % np.pi - np.pi / 2


def _put(
    m: Moment,
    goal: np.ndarray,
    *,
    over_m: np.ndarray,
    near_m: float = 0.012,
    down_m: float = 0.006,
    turn: np.ndarray | float = 0.0,
) -> Actions:
    """Grasp the object, carry it to `goal` over `over_m`, let go there."""
    obj = m.bodies[0]
    off = np.linalg.norm((goal - obj.pos)[:, :2], axis=1)
    is_down = obj.pos[:, 2] < goal[:, 2] + down_m
    is_there = (off < 2 * near_m) & is_down
    lets_go = is_there & ((off < 1.4 * near_m) | ~m.holds(obj) | (m.width > 0.08))
    carried = carry(m, obj, goal, clearance_m=over_m, near_m=near_m, turn=turn)
    return choose(lets_go, release(m, obj), choose(m.holds(obj), carried, grasp(m, obj)))


def _put_into(m: Moment, k: int) -> Actions:
    """Let go above the rim, aligned with it."""
    obj, ref = m.bodies[0], m.bodies[k]
    goal = ref.pos.copy()
    goal[:, 2] = ref.top + obj.half[:, 2] + 0.008
    over = ref.top + 0.02
    inside = (
        np.linalg.norm((obj.pos - ref.pos)[:, :2], axis=1) < 0.5 * ref.size[:, :2].min(1)
    ) & (obj.pos[:, 2] < goal[:, 2])
    put = _put(m, goal, over_m=over, near_m=0.02, down_m=0.02)
    return choose(inside, release(m, obj), put)


def _put_onto(m: Moment, k: int) -> Actions:
    obj, ref = m.bodies[0], m.bodies[k]
    goal = ref.pos.copy()
    goal[:, 2] = ref.top + (obj.start[:, 2]) + 0.002
    return _put(m, goal, over_m=ref.top + 0.02)


def _put_over(m: Moment, k: int) -> Actions:
    obj, ref = m.bodies[0], m.bodies[k]
    goal = ref.pos.copy()
    goal[:, 2] = obj.start[:, 2] + 0.001
    return _put(m, goal, over_m=ref.top + 0.015, near_m=0.005)


def _put_in_front(m: Moment, k: int) -> Actions:
    obj, ref = m.bodies[0], m.bodies[k]
    goal = ref.pos.copy()
    room = obj.size[:, :2].max(1) / 2 + ref.size[:, :2].max(1) / 2
    goal[:, 0] -= room + 0.03
    goal[:, 2] = obj.start[:, 2] + 0.002
    # Let go a little above the table: beside something tall the palm cannot go lower.
    return _put(m, goal, over_m=np.full(len(m.tool), 0.06), down_m=0.02)


def _push_with(m: Moment, k: int) -> Actions:
    """Take the tool, turn its long side towards the object, bring it behind and push with its end."""
    obj, tool = m.bodies[0], m.bodies[k]
    d = _unit((obj.start - tool.start)[:, :2])
    moved = ((obj.pos - obj.start)[:, :2] * d).sum(1)
    long = np.argmax(tool.model.size_m[:2])
    half = tool.size[:, long] / 2
    turn = _turn_along(tool, d)
    low = tool.start[:, 2] + 0.006
    offset = (tool.pos - obj.pos)[:, :2]
    along = (offset * d).sum(1)
    across = offset - along[:, None] * d
    aside = np.linalg.norm(across, axis=1)
    behind = obj.reach(d) + half
    is_low = tool.pos[:, 2] < low + 0.015
    is_ready = (aside < 0.012) & (np.abs(turn) < 0.12) & (along < -behind + 0.01)
    # High, behind, turned; then low; then forward.
    high = obj.top + tool.half[:, 2] + 0.03
    spot = obj.pos[:, :2] - d * (behind + 0.02)[:, None]
    off = spot - tool.pos[:, :2]
    free = np.clip((tool.pos[:, 2] - high + 0.03) / 0.02, 0, 1)[:, None]
    approach = m.tool.copy()
    approach[:, :2] += off * np.where(is_ready[:, None], 1.0, free)
    approach[:, 2] += np.where(is_ready, low, high) - tool.pos[:, 2]
    remaining = 0.11 - moved
    pace = np.clip(remaining / 0.06, 0.15, 1.0)[:, None]
    forward = m.tool.copy()
    forward[:, :2] += d * 0.05 * pace - across * 0.8
    forward[:, 2] += low - tool.pos[:, 2]
    pushes = is_ready & is_low
    to = np.where((pushes & (remaining > 0))[:, None], forward, approach)
    to = np.where((remaining <= 0)[:, None], m.target, to)
    return choose(m.holds(tool), m.go(to, CLOSE, turn), grasp(m, tool))


def _throw(m: Moment, k: int) -> Actions:
    obj, ref = m.bodies[0], m.bodies[k]
    return choose(
        m.holds(obj), swing(m, obj, ref.pos, elevation_rad=0.45, lead_s=0.05), grasp(m, obj)
    )


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)


WITH_OTHER: dict[str, Callable[[Moment, int], Actions]] = {
    "push next to": _push_next_to,
    "drag next to": _drag_next_to,
    "put into": _put_into,
    "put over": _put_over,
    "put in front of": _put_in_front,
    "put onto": _put_onto,
    "push with": _push_with,
    "throw into": _throw,
}
"""Programs that act on the manipulated object and another one; that one's name follows in the program's name."""


def _check_preferred_programs() -> None:
    """Demand that every kind prefers programs that there are.

    Raises:
        ValueError: one of them is no beginning of a program's name.
    """
    known = (LIFT, PUSH_AS, CARRY_AS, TIP, *WITH_OTHER)
    for kind in KINDS.values():
        for start in kind.programs:
            if not any(name.startswith(start) for name in known):
                raise ValueError(
                    f"task kind '{kind.name}' prefers the scripted policy '{start}'; add it to "
                    "v2p_data/experts/teacher.py "
                    f"or name one of: {', '.join(known)}"
                )


_check_preferred_programs()
