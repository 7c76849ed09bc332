"""Holds a success function against the video it was written for, and against moments that must not count.

The video's own tracked poses become states: success must be false at the first and should be true at the last.
Probes say what else must be false: the reset, a mere touch, an object flung by, carried where it should stand,
off the table. A search over the workspace says whether success can be reached at all. Tracked poses are
noisy, so a success that is false at the last one costs points; a success that is true at the start is vetoed.

Probes are built here and answered in the child process of `smoke`; nothing here runs task code.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene
from v2p_data.task.probes import (
    GRIPPER_OPENING_M,
    HAND_HEIGHT_M,
    WORKSPACE_M,
    ObjectProbe,
    Probe,
    States,
    at_rest,
    concatenated,
    first_pose,
    rest_height,
)
from v2p_data.task.smoke import SmokeResult

RESET_ROWS = 32
PATH_ROWS = 31
PATH_END = 1.5
"""The straight path from the first to the last pose is followed this far, in units of its length."""
AT_END = 20
"""The path row that is the last pose."""
REACH_ROWS = 600
MAX_TRACKED = 24
FLUNG_M_S = 2.0
SMALLEST_M = 0.02
"""A success after less displacement is within what tracking and contact jitter give."""
HANDS = ("held", "let go", "touching")
"""What the robot may be doing at a pose of the video, which shows a hand instead; any of them may count."""
ACCEPTABLE_SCORE = 0.5
VETO_WORDS = {
    "first_pose": "its success is true at the video's first pose already",
    "reset": "its success is true at a reset already",
    "reachable": "its success is true in none of the states that were tried all over the workspace",
}
ALWAYS_TRUE = "its success is always true"


@dataclass(frozen=True, kw_only=True)
class AuditProbes:
    """The moments, and which rows belong to which question."""

    states: States
    rows: dict[str, list[int]]
    path_m: tuple[float, ...]
    """Displacement of the manipulated object along the path rows [m]."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the audit table."""

    name: str
    asks: str
    passed: bool
    share: float
    """Share of its rows for which success was true; for `becomes_true` the displacement [m]."""
    weight: float
    is_veto: bool = False


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The table, and what follows from it."""

    checks: tuple[Check, ...] = ()
    score: float = 0.0
    """0 to 1."""
    vetoed: str = ""
    """The first failed veto, in words."""
    true_from_pose: int | None = None
    """The first tracked pose from which success is true to the end."""
    threshold_m: float | None = None
    """Displacement along the video's motion at which success becomes true."""
    notes: tuple[str, ...] = field(default=())

    @property
    def is_acceptable(self) -> bool:
        return not self.vetoed and self.score >= ACCEPTABLE_SCORE

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"acceptable": self.is_acceptable}


# --- probes --------------------------------------------------------------------------------------------------


def build_probes(scene: Scene, rng: np.random.Generator) -> AuditProbes:
    """Return every moment the audit asks about, as one batch."""
    path, path_m = _path(scene)
    builders: dict[str, Callable[[], list[Probe]]] = {
        "first": lambda: _hands(scene, _tracked(scene)[:1]),
        "last": lambda: _hands(scene, _tracked(scene)[-1:]),
        "tracked": lambda: _hands(scene, _tracked(scene)),
        "path": lambda: _hands(scene, path),
        "reset": lambda: [_resets(scene, rng)],
        "touched": lambda: [
            _at_pose(scene, _tracked(scene)[:1], hand) for hand in hands_of(scene)
        ],
        "flung": lambda: [_flung(scene, path[AT_END : AT_END + 1])],
        "in_the_air": lambda: [_in_the_air(scene)],
        "off_the_table": lambda: [_off_the_table(scene)],
        "reachable": lambda: [_anywhere(scene, rng, hand) for hand in hands_of(scene)],
    }
    batches: list[States] = []
    rows: dict[str, list[int]] = {}
    count = 0
    for name, build in builders.items():
        made = [p.states() for p in build()]
        size = sum(len(b["eef_pos"]) for b in made)
        rows[name] = list(range(count, count + size))
        count += size
        batches += made
    return AuditProbes(states=concatenated(batches), rows=rows, path_m=path_m)


Poses = dict[str, np.ndarray]
"""Object name -> (7,) pose, in the simulator's frame."""


def _tracked(scene: Scene) -> list[Poses]:
    """Return the video's poses, at most `MAX_TRACKED` of them, set on the table.

    Tracked heights and tilts are off by a centimetre or so; the first pose is made to rest on the table, and
    the others keep their height above the first.
    """
    main = scene.manipulated
    frames = main.frames or (0,)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(MAX_TRACKED, len(frames))).astype(int))
    centre = np.array([0.5, 0.0, 0.0])
    origin = np.array([*first_pose(main)[:2], 0.0])
    out: list[Poses] = []
    for index in chosen:
        poses: Poses = {}
        for obj in scene.objects:
            first = first_pose(obj)
            pose = first
            if obj.poses_world:
                k = int(np.argmin(np.abs(np.asarray(obj.frames or (0,)) - frames[index])))
                pose = np.asarray(obj.poses_world[k], float).copy()
            lifted = pose[2] - first[2]
            ground = rest_height(obj, first[3:])
            height = max(ground + lifted, rest_height(obj, pose[3:]))
            if abs(lifted) < 0.02 and _angle(first[3:], pose[3:]) < 0.35:
                height = ground
            poses[obj.name] = np.array([*(pose[:2] - origin[:2] + centre[:2]), height, *pose[3:]])
        out.append(poses)
    return out


def _path(scene: Scene) -> tuple[list[Poses], tuple[float, ...]]:
    """Return poses on the straight line from the first to the last, and beyond, with their displacement."""
    tracked = _tracked(scene)
    name = scene.manipulated.name
    first, last = tracked[0][name], tracked[-1][name]
    if KINDS[scene.kind].end == "in_air":  # hands often set things down again before the clip ends
        last = max((p[name] for p in tracked), key=lambda pose: float(pose[2]))
    turn = Slerp([0, 1], Rotation.from_quat(np.stack([first[3:], last[3:]]), scalar_first=True))
    out: list[Poses] = []
    for t in np.linspace(0, PATH_END, PATH_ROWS):
        quat = turn(min(t, 1.0)).as_quat(scalar_first=True)
        pos = first[:3] + t * (last[:3] - first[:3])
        pos[2] = max(pos[2], rest_height(scene.manipulated, quat))
        out.append({**tracked[0], name: np.concatenate([pos, quat])})
    length = float(np.linalg.norm(last[:3] - first[:3]))
    return out, tuple(float(t * length) for t in np.linspace(0, PATH_END, PATH_ROWS))


def hands_of(scene: Scene) -> tuple[str, ...]:
    """Return what the robot may be doing at a pose of the video: where there is a tool, also holding that."""
    return (*HANDS, "by tool") if any(o.role == "tool" for o in scene.others) else HANDS


def _hands(scene: Scene, moments: list[Poses]) -> list[Probe]:
    return [_at_pose(scene, moments, hand) for hand in hands_of(scene)]


def _at_pose(scene: Scene, moments: list[Poses], hand: str) -> Probe:
    """Return the moments with everything still and the robot doing what `hand` says."""
    first = _tracked(scene)[0]
    n = len(moments)
    probe = Probe(
        eef_pos=np.zeros((n, 3)), gripper_width=np.full(n, GRIPPER_OPENING_M), progress=0.8
    )
    for obj in scene.objects:
        pose = np.stack([m[obj.name] for m in moments])
        start = np.tile(first[obj.name], (n, 1))
        probe.objects[obj.name] = ObjectProbe(
            pos=pose[:, :3],
            quat=pose[:, 3:],
            size=np.asarray(obj.size_m),
            start_pos=start[:, :3],
            start_quat=start[:, 3:],
            vel_linear=np.zeros((n, 3)),
            vel_angular=np.zeros((n, 3)),
            grasped=np.zeros(n),
            touched=np.zeros(n),
        )
    _put_hand(probe, scene, hand)
    return probe


def _put_hand(probe: Probe, scene: Scene, hand: str) -> None:
    obj = scene.manipulated
    o = probe.objects[obj.name]
    n = len(probe)
    half = rest_height(obj, o.start_quat[0])
    grip = o.pos + np.array([0.0, 0.0, max(half - 0.035, 0.0)])
    if hand == "held":
        probe.eef_pos = grip
        probe.gripper_width = np.full(n, min(min(obj.size_m), GRIPPER_OPENING_M))
        o.grasped = np.ones(n)
        o.touched = np.ones(n)
    elif hand == "by tool":
        tool = next(t for t in scene.others if t.role == "tool")
        t = probe.objects[tool.name]
        way = (o.start_pos - t.start_pos)[:, :2]
        way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        behind = (max(obj.size_m[:2]) + max(tool.size_m[:2])) / 2
        t.pos = t.start_pos.copy()
        t.pos[:, :2] = o.pos[:, :2] - way * behind
        t.grasped = np.ones(n)
        t.touched = np.ones(n)
        probe.eef_pos = t.pos.copy()
        probe.gripper_width = np.full(n, min(min(tool.size_m), GRIPPER_OPENING_M))
        o.grasped = np.zeros(n)
        o.touched = np.zeros(n)
    elif hand == "touching":
        probe.eef_pos = grip
        probe.gripper_width = np.zeros(n)
        o.grasped = np.zeros(n)
        o.touched = np.ones(n)
    else:
        probe.eef_pos = o.pos + np.array([0.0, 0.0, half + 0.12])
        probe.gripper_width = np.full(n, GRIPPER_OPENING_M)
        o.grasped = np.zeros(n)
        o.touched = np.zeros(n)


def _resets(scene: Scene, rng: np.random.Generator) -> Probe:
    probe = at_rest(scene, RESET_ROWS)
    shift = np.column_stack([rng.uniform(-0.1, 0.1, (RESET_ROWS, 2)), np.zeros(RESET_ROWS)])
    for o in probe.objects.values():
        o.pos = o.pos + shift
        o.start_pos = o.pos.copy()
        yaw = rng.uniform(-np.pi, np.pi, RESET_ROWS)
        turn = Rotation.from_rotvec(np.column_stack([0 * yaw, 0 * yaw, yaw]))
        o.quat = (turn * Rotation.from_quat(o.quat, scalar_first=True)).as_quat(scalar_first=True)
        o.start_quat = o.quat.copy()
    low, high = np.array(WORKSPACE_M)
    probe.eef_pos = np.column_stack(
        [rng.uniform(low, high, (RESET_ROWS, 2)), np.full(RESET_ROWS, HAND_HEIGHT_M)]
    )
    return probe


def _flung(scene: Scene, moments: list[Poses]) -> Probe:
    """The object passes the end of the path at high speed, nobody holding it."""
    probe = _at_pose(scene, moments * 4, "let go")
    o = probe.objects[scene.manipulated.name]
    o.vel_linear = FLUNG_M_S * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    return probe


def _in_the_air(scene: Scene) -> Probe:
    """For kinds that end on the table: the end of the path, but 25 cm up. For lifting: 1 cm up."""
    tracked = _tracked(scene)
    name = scene.manipulated.name
    may_end_high = KINDS[scene.kind].may_end_high
    pose = (tracked[0] if may_end_high else _path(scene)[0][AT_END])[name].copy()
    pose[2] += 0.01 if may_end_high else 0.25
    return _at_pose(scene, [{**tracked[0], name: pose}], "held")


def _off_the_table(scene: Scene) -> Probe:
    """The object lies beside and below the table, or far out on it."""
    first = _tracked(scene)[0]
    name = scene.manipulated.name
    moments: list[Poses] = []
    for offset in ([0.3, 0.0, -0.7], [0.0, 0.5, -0.7], [0.0, -0.5, -0.7], [0.05, 0.1, -0.3]):
        pose = first[name].copy()
        pose[:3] += offset
        moments.append({**first, name: pose})
    return _at_pose(scene, moments, "let go")


def _anywhere(scene: Scene, rng: np.random.Generator, hand: str) -> Probe:
    """Return states drawn over the workspace: standing and tipped, on the table, carried, at the other object."""
    main = scene.manipulated
    first = _tracked(scene)[0]
    low, high = np.array(WORKSPACE_M)
    moments: list[Poses] = []
    for k in range(REACH_ROWS // len(hands_of(scene))):
        quat = first[main.name][3:]
        if k % 4 == 0:
            axis = rng.normal(size=3) * [1, 1, 0]
            fall = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.pi / 2)
            quat = (fall * Rotation.from_quat(quat, scalar_first=True)).as_quat(scalar_first=True)
        height = rest_height(main, quat)
        xy = rng.uniform(low, high)
        if scene.others and k % 2:
            other = scene.others[0]
            xy, top = _near(rng, first[other.name], other.size_m, main.size_m)
            height += float(rng.choice([0.0, top, 0.005]))
        if k % 3 == 0:
            height += rng.uniform(0.0, 0.3)
        if k % 8 == 7:  # along the start's axes, as pushes and lifts go
            xy = first[main.name][:2] + rng.choice([-1, 0, 1], 2) * rng.uniform(0.05, 0.2)
        moments.append({**first, main.name: np.array([*xy, height, *quat])})
    return _at_pose(scene, moments, hand)


def _near(
    rng: np.random.Generator,
    other: np.ndarray,
    other_size: tuple[float, float, float],
    size: tuple[float, float, float],
) -> tuple[np.ndarray, float]:
    """Return a point at, in or beside another object, and that object's top [m]."""
    angle = rng.uniform(-np.pi, np.pi)
    reach = (max(other_size[:2]) + max(size[:2])) / 2
    distance = rng.choice(
        [rng.uniform(0, 0.02), reach * rng.uniform(0.7, 1.0), reach + rng.uniform(0, 0.05)]
    )
    return other[:2] + distance * np.array([np.cos(angle), np.sin(angle)]), float(
        other[2] + other_size[2] / 2
    )


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    turn = Rotation.from_quat(a, scalar_first=True).inv() * Rotation.from_quat(
        b, scalar_first=True
    )
    return float(turn.magnitude())


# --- verdict -------------------------------------------------------------------------------------------------


def audit(scene: Scene, probes: AuditProbes, result: SmokeResult) -> Audit:
    """Return the audit table of one sample from what the child said."""
    if not result.runnable:
        return Audit(vetoed=f"it does not run: {result.error}")
    success = np.array(result.probe_success, bool)
    reward = np.array(result.probe_reward)
    answers = {name: success[rows] for name, rows in probes.rows.items()}
    num_hands = len(hands_of(scene))

    def any_hand(name: str) -> Any:
        return np.any(answers[name].reshape(num_hands, -1), axis=0)

    path = any_hand("path")
    begins = int(np.argmax(path)) if path.any() else None
    threshold = probes.path_m[begins] if begins is not None else None
    length = probes.path_m[-1] / PATH_END
    tracked = any_hand("tracked")
    last = bool(any_hand("last").any())
    if (
        KINDS[scene.kind].end == "in_air"
    ):  # true at the highest pose will do: the clip may set it down again
        last = last or bool(tracked.any())

    rises = _reward_rises(probes, reward, num_hands)
    turns = KINDS[scene.kind].end == "on_side"
    threshold_good = threshold is not None and (
        turns or SMALLEST_M <= threshold <= max(1.3 * length, 0.15)
    )
    checks = (
        _must_be_false("first_pose", "false at the video's first pose?", answers["first"], 0.0, veto=True),
        _must_be_false("reset", "false at every reset?", answers["reset"], 0.0, veto=True),
        Check(
            name="reachable",
            asks="true somewhere in the workspace?",
            passed=bool(answers["reachable"].any() or path.any()),
            share=float(answers["reachable"].mean()),
            weight=0.0,
            is_veto=True,
        ),
        Check(
            name="last_pose",
            asks="true at the video's last pose?",
            passed=last,
            share=float(last),
            weight=0.25,
        ),
        Check(
            name="becomes_true",
            asks="true after a plausible displacement?",
            passed=threshold_good,
            share=-1.0 if threshold is None else threshold,
            weight=0.1,
        ),
        _must_be_false("touched", "false when merely touched?", answers["touched"], 0.15),
        _must_be_false("flung", "false when it flies past?", answers["flung"], 0.15),
        _must_be_false("in_the_air", "false where it should stand, or barely lifted?", answers["in_the_air"], 0.15),
        _must_be_false("off_the_table", "false off the table?", answers["off_the_table"], 0.1),
        Check(
            name="reward_rises",
            asks="does the reward rise along the video's motion?",
            passed=rises > 0,
            share=rises,
            weight=0.05,
        ),
        Check(
            name="no_warnings",
            asks="did the trial run go without warnings?",
            passed=not result.warnings,
            share=float(len(result.warnings)),
            weight=0.05,
        ),
    )  # fmt: skip
    failed = [VETO_WORDS[c.name] for c in checks if c.is_veto and not c.passed]
    if success.all():
        failed = [ALWAYS_TRUE]
    total = sum(c.weight for c in checks)
    return Audit(
        checks=checks,
        score=round(sum(c.weight for c in checks if c.passed) / total, 4),
        vetoed=failed[0] if failed else "",
        true_from_pose=_true_from(tracked),
        threshold_m=threshold,
        notes=result.warnings,
    )


def _must_be_false(
    name: str, asks: str, answers: np.ndarray, weight: float, *, veto: bool = False
) -> Check:
    return Check(
        name=name,
        asks=asks,
        passed=not answers.any(),
        share=float(answers.mean()),
        weight=weight,
        is_veto=veto,
    )


def _true_from(answers: np.ndarray) -> int | None:
    """Return the first index from which all are true."""
    wrong = np.flatnonzero(~answers)
    first = int(wrong[-1]) + 1 if len(wrong) else 0
    return first if first < len(answers) else None


def _reward_rises(probes: AuditProbes, reward: np.ndarray, num_hands: int) -> float:
    """Return by how much the best reward over the hands is higher at the video's end than at its start."""
    path = reward[probes.rows["path"]].reshape(num_hands, -1).max(0)
    return float(path[AT_END] - path[0])
