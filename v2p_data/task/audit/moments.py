"""Moments on which an audit tests a success function: the video's own poses, and poses that must not count.

Probes are built here and answered in the child process of `smoke`; nothing here runs task code.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene
from v2p_data.task.sandbox.probes import (
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
    rest_heights,
    turned,
)
from v2p_data.task.templates.variants import POSITION_ERROR_M, SIZE_ERROR_M, SIZE_ERROR_SHARE

RESET_ROWS = 32
PATH_ROWS = 31
PATH_END = 1.5
"""The straight path from the first to the last pose is followed this far, in units of its length."""
AT_END = 20
"""The path row that is the last pose."""
REACH_ROWS = 600
MAX_TRACKED = 24
FLUNG_M_S = 2.0
NOISE_SCALES = (0.5, 1.0, 1.5, 2.0)
"""Multiples of the measured errors by which poses and sizes are disturbed."""
NOISE_DRAWS = 12
"""Disturbed copies of a pose per scale; a near miss gets a quarter of them."""
POSITION_SIGMA_M = POSITION_ERROR_M / 1.54
"""Per axis: the median length of a vector of three normal numbers is 1.54 standard deviations."""
SIZE_SIGMA_M, SIZE_SIGMA_SHARE = SIZE_ERROR_M / 0.674, SIZE_ERROR_SHARE / 0.674
"""The median of a normal number's amount is 0.674 standard deviations. The smaller of the two counts."""
YAW_SIGMA_RAD = 0.1
SWAY_M_S, SWAY_RAD_S = 0.016, 0.1
"""Motion per axis of an object that is held up at the end. In 32 lifts at the fine step 90 % were
slower than 0.027 m/s and 0.15 rad/s over the last quarter of a second."""
LIFTED_M = 0.02
"""Height above its rest from which an object is off the table; that height may be wrong, too."""
TURNED_AWAY_M = 0.05
"""A motion longer than this on the table may also go in a wrong direction, or end too far from where it leads."""
HANDS = ("held", "let go", "touching")
"""What the robot may be doing at a pose of the video, which shows a hand instead; any of them may count."""


@dataclass(frozen=True, kw_only=True)
class AuditProbes:
    """The moments, and which rows belong to which question."""

    states: States
    rows: dict[str, list[int]]
    path_m: tuple[float, ...]
    """Displacement of the manipulated object along the path rows [m]."""
    starts: States
    """Layouts that the environment offers to a task's reset."""


def build_probes(scene: Scene, rng: np.random.Generator) -> AuditProbes:
    """Return every moment the audit asks about, as one batch."""
    tracked = _tracked(scene)
    path, path_m = _path(scene, tracked)
    builders: dict[str, Callable[[], list[Probe]]] = {
        "first": lambda: _hands(scene, tracked, tracked[:1]),
        "last": lambda: _hands(scene, tracked, tracked[-1:]),
        "tracked": lambda: _hands(scene, tracked, tracked),
        "path": lambda: _hands(scene, tracked, path),
        "reset": lambda: [_resets(scene, rng)],
        "touched": lambda: [
            _at_pose(scene, tracked, tracked[:1], hand) for hand in hands_of(scene)
        ],
        "flung": lambda: [_flung(scene, tracked, path[AT_END : AT_END + 1])],
        "in_the_air": lambda: [_in_the_air(scene, tracked, path)],
        "off_the_table": lambda: [_off_the_table(scene, tracked)],
        "reachable": lambda: [_anywhere(scene, tracked, rng, hand) for hand in hands_of(scene)],
        "disturbed_last": lambda: _disturbed(
            scene, tracked, [_end(scene, tracked)], NOISE_DRAWS, rng
        ),
        "disturbed_first": lambda: _disturbed(scene, tracked, tracked[:1], NOISE_DRAWS, rng),
        "near_misses": lambda: _near_misses(scene, tracked, rng),
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
    states = concatenated(batches)
    starts = {key: value[rows["reset"]] for key, value in states.items()}
    return AuditProbes(states=states, rows=rows, path_m=path_m, starts=starts)


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


def _path(scene: Scene, tracked: list[Poses]) -> tuple[list[Poses], tuple[float, ...]]:
    """Return poses on the straight line from the first to the last, and beyond, with their displacement."""
    name = scene.manipulated.name
    first, last = tracked[0][name], _end(scene, tracked)[name]
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


def _hands(scene: Scene, tracked: list[Poses], moments: list[Poses]) -> list[Probe]:
    return [_at_pose(scene, tracked, moments, hand) for hand in hands_of(scene)]


def _at_pose(scene: Scene, tracked: list[Poses], moments: list[Poses], hand: str) -> Probe:
    """Return the moments with everything still and the robot doing what `hand` says."""
    n = len(moments)
    probe = Probe(
        eef_pos=np.zeros((n, 3)), gripper_width=np.full(n, GRIPPER_OPENING_M), progress=0.8
    )
    for obj in scene.objects:
        pose = np.stack([m[obj.name] for m in moments])
        start = np.tile(tracked[0][obj.name], (n, 1))
        probe.objects[obj.name] = ObjectProbe.still(pose, start, obj)
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
        o.grasped = o.touched = np.ones(n)
    elif hand == "by tool":
        tool = next(t for t in scene.others if t.role == "tool")
        t = probe.objects[tool.name]
        way = (o.start_pos - t.start_pos)[:, :2]
        way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        behind = (max(obj.size_m[:2]) + max(tool.size_m[:2])) / 2
        t.pos = t.start_pos.copy()
        t.pos[:, :2] = o.pos[:, :2] - way * behind
        t.grasped = t.touched = np.ones(n)
        probe.eef_pos = t.pos.copy()
        probe.gripper_width = np.full(n, min(min(tool.size_m), GRIPPER_OPENING_M))
    elif hand == "touching":
        probe.eef_pos = grip
        probe.gripper_width = np.zeros(n)
        o.touched = np.ones(n)
    else:
        probe.eef_pos = o.pos + np.array([0.0, 0.0, half + 0.12])


def _resets(scene: Scene, rng: np.random.Generator) -> Probe:
    probe = at_rest(scene, RESET_ROWS)
    shift = np.column_stack([rng.uniform(-0.1, 0.1, (RESET_ROWS, 2)), np.zeros(RESET_ROWS)])
    for o in probe.objects.values():
        o.pos = o.pos + shift
        o.start_pos = o.pos.copy()
        yaw = rng.uniform(-np.pi, np.pi, RESET_ROWS)
        o.quat = turned(yaw, o.quat)
        o.start_quat = o.quat.copy()
    low, high = np.array(WORKSPACE_M)
    probe.eef_pos = np.column_stack(
        [rng.uniform(low, high, (RESET_ROWS, 2)), np.full(RESET_ROWS, HAND_HEIGHT_M)]
    )
    return probe


def _flung(scene: Scene, tracked: list[Poses], moments: list[Poses]) -> Probe:
    """The object passes the end of the path at high speed, nobody holding it; and slides by, a hand's breadth aside."""
    name = scene.manipulated.name
    aside = []
    for direction in np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
        pose = tracked[0][name].copy()
        pose[:3] += direction * (0.1 + _outline(scene))
        aside.append({**moments[0], name: pose})
    probe = _at_pose(scene, tracked, moments * 4 + aside, "let go")
    ways = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], *[[0.7, 0.7, 0]] * 4])
    probe.objects[name].vel_linear = FLUNG_M_S * ways
    return probe


def _outline(scene: Scene) -> float:
    """Return how far apart the two objects' centres are when they stand side by side [m].

    One's half without another.
    """
    sizes = [max(o.size_m[:2]) for o in scene.objects[:2]]
    return sum(sizes) / 2


def _end(scene: Scene, tracked: list[Poses]) -> Poses:
    """Return the video's last poses; of a lift the highest ones, because hands often set things down again."""
    name = scene.manipulated.name
    if KINDS[scene.kind].end == "in_air":
        return max(tracked, key=lambda poses: float(poses[name][2]))
    return tracked[-1]


def _disturbed(
    scene: Scene,
    tracked: list[Poses],
    moments: list[Poses],
    draws: int,
    rng: np.random.Generator,
    hands: tuple[str, ...] = (),
) -> list[Probe]:
    """Return moments with positions and sizes as wrong as reconstruction makes them, per hand scale by scale.

    What stands on the table stays on it; starts are those of the video.
    """
    many = [m for _ in NOISE_SCALES for m in moments for _ in range(draws)]
    n, scale = len(many), np.repeat(NOISE_SCALES, len(moments) * draws)[:, None]
    poses: dict[str, np.ndarray] = {}
    sizes: dict[str, np.ndarray] = {}
    starts: dict[str, np.ndarray] = {}
    for obj in scene.objects:
        size = np.asarray(obj.size_m)
        sigma = np.minimum(SIZE_SIGMA_M / size, SIZE_SIGMA_SHARE)
        larger = sizes[obj.name] = size * np.exp(rng.normal(size=(n, 3)) * sigma * scale)
        shift = rng.normal(size=(n, 3)) * POSITION_SIGMA_M * scale
        yaw = rng.normal(size=n) * YAW_SIGMA_RAD * scale[:, 0]
        at = np.stack([m[obj.name] for m in many])
        above = at[:, 2] - rest_heights(obj, at[:, 3:], np.tile(size, (n, 1)))
        at[:, 3:] = turned(yaw, at[:, 3:])
        at[:, :2] += shift[:, :2]
        lifted = np.where(above > LIFTED_M, above + shift[:, 2], above)
        at[:, 2] = rest_heights(obj, at[:, 3:], larger) + np.maximum(lifted, 0.0)
        poses[obj.name] = at
        first = np.tile(tracked[0][obj.name][3:], (n, 1))
        starts[obj.name] = rest_heights(obj, first, larger)
    moved = [{name: at[k] for name, at in poses.items()} for k in range(n)]
    made: list[Probe] = []
    for hand in hands or hands_of(scene):
        probe = _at_pose(scene, tracked, moved, hand)
        main = probe.objects[scene.manipulated.name]
        main.vel_linear = rng.normal(size=(n, 3)) * SWAY_M_S * scale
        main.vel_angular = rng.normal(size=(n, 3)) * SWAY_RAD_S * scale
        for name, o in probe.objects.items():
            o.size = sizes[name]
            o.start_pos[:, 2] = starts[name]
        made.append(probe)
    return made


def _near_misses(scene: Scene, tracked: list[Poses], rng: np.random.Generator) -> list[Probe]:
    """Return what is nearly the end of the video and must not count, disturbed like the end itself.

    A third of the way; the way in a wrong direction; beside what it should be in, on or over, or 5
    cm further from what it should be next to; toppled where things must stand; let go in mid-air
    where it must be held up; still held where it must be let go; still in the air above where it
    must stand.
    """
    kind, name = KINDS[scene.kind], scene.manipulated.name
    first, end = tracked[0], _end(scene, tracked)
    a, b = first[name], end[name]
    way = b[:3] - a[:3]
    moments: list[Poses] = []

    def add(pos: np.ndarray, quat: np.ndarray) -> None:
        pose = np.array([*pos, *quat])
        pose[2] = max(pose[2], rest_height(scene.manipulated, quat))
        moments.append({**first, name: pose})

    if kind.end != "on_side":
        add(a[:3] + way / 3, a[3:])
        if np.linalg.norm(way[:2]) > TURNED_AWAY_M:
            for angle in (np.pi / 2, -np.pi / 2, np.pi):
                add(a[:3] + Rotation.from_rotvec([0, 0, angle]).apply(way), b[3:])
    if scene.others and (kind.touches or kind.comes_near):
        other = first[scene.others[0].name]
        sizes = [max(o.size_m[:2]) / 2 for o in (scene.manipulated, scene.others[0])]
        for angle in np.arange(4) * np.pi / 2:
            side = np.array([np.cos(angle), np.sin(angle)])
            if kind.touches:  # a cover that covers half of a thing stands on its edge
                away = sizes[0] if kind.end == "over" else sum(sizes)
                add(np.array([*(other[:2] + away * side), 0.0]), b[3:])
        if kind.comes_near:
            line = b[:2] - other[:2]
            line = line / max(float(np.linalg.norm(line)), 1e-6)
            add(np.array([*(b[:2] + TURNED_AWAY_M * line), b[2]]), b[3:])
    if kind.stays_upright:
        fallen = Rotation.from_rotvec([np.pi / 2, 0, 0]) * Rotation.from_quat(
            b[3:], scalar_first=True
        )
        add(np.array([*b[:2], 0.0]), fallen.as_quat(scalar_first=True))
    if not kind.may_end_high:
        add(b[:3] + np.array([0.0, 0.0, 0.06]), b[3:])
    few = NOISE_DRAWS // 4
    probes = _disturbed(scene, tracked, moments, few, rng) if moments else []
    if kind.end == "in_air":
        probes += _disturbed(scene, tracked, [end], few, rng, ("let go",))
    elif kind.is_put_down and not kind.may_end_held:
        probes += _disturbed(scene, tracked, [end], few, rng, ("held",))
    return probes


def _in_the_air(scene: Scene, tracked: list[Poses], path: list[Poses]) -> Probe:
    """For kinds that end on the table: the end of the path, but 25 cm up. For lifting: 1 cm up."""
    name = scene.manipulated.name
    may_end_high = KINDS[scene.kind].may_end_high
    pose = (tracked[0] if may_end_high else path[AT_END])[name].copy()
    pose[2] += 0.01 if may_end_high else 0.25
    return _at_pose(scene, tracked, [{**tracked[0], name: pose}], "held")


def _off_the_table(scene: Scene, tracked: list[Poses]) -> Probe:
    """The object lies beside and below the table, or far out on it."""
    first = tracked[0]
    name = scene.manipulated.name
    moments: list[Poses] = []
    for offset in ([0.3, 0.0, -0.7], [0.0, 0.5, -0.7], [0.0, -0.5, -0.7], [0.05, 0.1, -0.3]):
        pose = first[name].copy()
        pose[:3] += offset
        moments.append({**first, name: pose})
    return _at_pose(scene, tracked, moments, "let go")


def _anywhere(scene: Scene, tracked: list[Poses], rng: np.random.Generator, hand: str) -> Probe:
    """Return states drawn over the workspace: standing and tipped, on the table, carried, at the other object."""
    main = scene.manipulated
    first = tracked[0]
    upright = first[main.name][3:]
    standing_m = rest_height(main, upright)
    low, high = np.array(WORKSPACE_M)
    moments: list[Poses] = []
    for k in range(REACH_ROWS // len(hands_of(scene))):
        quat, height = upright, standing_m
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
    return _at_pose(scene, tracked, moments, hand)


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
