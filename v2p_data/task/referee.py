"""Independent success functions, one per task kind, that no training ever sees.

They look at a whole recorded episode, in numpy, and ask for what the words say. `Meaning` in `v2p_data/kinds.py`
says it in words and numbers. Three things hold for all kinds. The robot's contact, in this episode, moved the
object from where it lay at rest. The object was not at its goal before. Nothing is pressed through the table.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.kinds import KINDS, Kind, TaskKind, check_every_kind
from v2p_data.scene.scene import Scene, SceneObject, hollow_floor_m

LAST = 5
"""Samples at the end (0.25 s) over which a final state must hold."""
LEAVES_M = 0.01
"""What slides on the table never rises by more than this, and lies no lower at the end."""
IN_AIR_M = 0.01
"""What is carried is higher by this than where it lay."""
NEXT_TO_M = 0.03
"""Largest gap between things that are next to each other."""
STAYS_M = 0.03
"""A thing that should stay moves by less than this."""
IN_GRIP_M = 0.02
"""What is pushed or tipped makes no longer way than this in the grip."""
REST_M = 0.01
"""Movement over the last samples of a thing at rest."""
STILL_M = 0.003
"""Movement in one sample of a thing that lies where it settled: falling for 50 ms alone is 12 mm."""
BELOW_M = 0.005
"""A thing this far below its support was pressed through it."""
STEADY_M = 0.05
"""Movement over the last samples (0.2 m/s) of a thing that is held up."""
TIP_BELOW_TCP_M = 0.012
"""A point between the pads' ends, below the tool's centre."""
BETWEEN_PADS_M = 0.008
"""The tool is at most this far outside of what it grips. Pads that push with their edges are 11 mm away."""
CLOSED_M = 0.003
"""Between pads that hold nothing but each other."""
FALLEN_RAD = np.deg2rad(60)
STANDS_RAD = np.deg2rad(25)


@dataclass(frozen=True, kw_only=True)
class ObjectTrack:
    """One object in every world over an episode, world frame."""

    pos: Float[np.ndarray, "time env 3"]
    quat_wxyz: Float[np.ndarray, "time env 4"]
    size_m: Float[np.ndarray, "env 3"]
    """Full extents along its own axes."""
    by_arm: Bool[np.ndarray, "time env"]
    """Any part of the arm touched it since the sample before."""
    touched: Bool[np.ndarray, "time env"]
    """A pad touches it."""
    grasped: Bool[np.ndarray, "time env"]
    """Both pads touch it, and the gripper is not fully open."""

    @property
    def is_at_rest(self) -> Bool[np.ndarray, "env"]:
        return np.linalg.norm(np.ptp(self.pos[-LAST:], axis=0), axis=-1) < REST_M

    @cached_property
    def axes(self) -> Float[np.ndarray, "time env 3 3"]:
        """Rotation matrices; column k is the object's own axis k in the world."""
        flat = Rotation.from_quat(self.quat_wxyz.reshape(-1, 4), scalar_first=True).as_matrix()
        return flat.reshape(*self.quat_wxyz.shape[:2], 3, 3)

    @property
    def steps(self) -> Float[np.ndarray, "time env 2"]:
        """Horizontal way since the sample before [m]."""
        return np.diff(self.pos[..., :2], axis=0, prepend=self.pos[:1, :, :2])


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """What happened in a batch of episodes of the same length, recorded at the fine time step."""

    objects: dict[str, ObjectTrack]
    eef_pos: Float[np.ndarray, "time env 3"]
    opening_m: Float[np.ndarray, "time env"]
    """Between the pads."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One task's episodes, as the rules see them."""

    scene: Scene
    trajectory: Trajectory

    @property
    def kind(self) -> TaskKind:
        return KINDS[self.scene.kind]

    @property
    def thing(self) -> ObjectTrack:
        """The manipulated object."""
        return self.trajectory.objects[self.scene.manipulated.name]

    @property
    def other(self) -> ObjectTrack:
        """The object that the caption relates it to."""
        return self.trajectory.objects[self._other.name]

    @property
    def _other(self) -> SceneObject:
        if not self.scene.others:
            raise V2PError(
                f"task '{self.scene.kind}' of '{self.scene.title}' needs a second object, and the scene has one"
            )
        return self.scene.others[0]

    @property
    def container_is_hollow(self) -> bool:
        return self._other.hollow

    @property
    def handled(self) -> ObjectTrack:
        """What the robot itself touches: the object, or the tool that pushes it."""
        return self.other if self.kind.grasps == "tool" else self.thing

    @cached_property
    def settled(self) -> Int[np.ndarray, "env"]:
        """The last sample before the robot first touched what it handles; the first one where it never did."""
        return np.maximum(self.handled.by_arm.argmax(axis=0) - 1, 0)

    def before(self, values: np.ndarray) -> np.ndarray:
        """Return values per sample and world as they were when everything had settled."""
        return values[self.settled, np.arange(values.shape[1])]

    @property
    def way(self) -> Float[np.ndarray, "env 3"]:
        """From where the object settled to where it is at the end [m]."""
        return self.thing.pos[-1] - self.before(self.thing.pos)

    @property
    def leaned(self) -> Float[np.ndarray, "env"]:
        """The angle between the object's own z axis as it settled and at the end [rad]; a ball never leans."""
        z = self.thing.axes[..., 2]
        angle = np.arccos(np.clip((self.before(z) * z[-1]).sum(-1), -1.0, 1.0))
        return angle * (self.scene.manipulated.shape != "sphere")

    def reach(
        self, track: ObjectTrack, direction: Float[np.ndarray, "time env 3"]
    ) -> Float[np.ndarray, "time env"]:
        """Return how far an object extends from its centre along unit directions [m]."""
        shape = self.scene.manipulated.shape if track is self.thing else self._other.shape
        half = track.size_m / 2
        if shape == "sphere":
            return np.broadcast_to(half.max(axis=-1), direction.shape[:2])
        along = np.einsum("tej,tejk->tek", direction, track.axes)
        if shape == "cylinder":
            c = np.abs(along[..., 2])
            return c * half[:, 2] + np.sqrt(np.clip(1 - c**2, 0, 1)) * half[:, :2].max(axis=-1)
        return (np.abs(along) * half).sum(axis=-1)

    def lowest(self, track: ObjectTrack) -> Float[np.ndarray, "time env"]:
        """Return the height of an object's lowest point [m]; of meshes, of their bounding box."""
        down = np.zeros_like(track.pos)
        down[..., 2] = -1.0
        return track.pos[..., 2] - self.reach(track, down)

    @cached_property
    def rise(self) -> Float[np.ndarray, "time env"]:
        """How much higher the object's lowest point is than where it settled [m]; 0 before."""
        low = self.lowest(self.thing)
        is_after = np.arange(len(low))[:, None] >= self.settled
        return (low - self.before(low)) * is_after

    @cached_property
    def gap(self) -> Float[np.ndarray, "time env"]:
        """The horizontal distance between the two objects' outlines, along their centres' line [m]."""
        between = self.other.pos - self.thing.pos
        between[..., 2] = 0.0
        distance = np.linalg.norm(between, axis=-1)
        u = np.where(distance[..., None] > 1e-6, between, [1.0, 0.0, 0.0])
        u = u / np.linalg.norm(u, axis=-1, keepdims=True)
        return distance - self.reach(self.thing, u) - self.reach(self.other, -u)

    @property
    def other_moved(self) -> Float[np.ndarray, "env"]:
        """How far the other object is from where it settled, horizontally [m]."""
        return np.linalg.norm((self.other.pos[-1] - self.before(self.other.pos))[:, :2], axis=-1)

    def gripped(self, track: ObjectTrack) -> Bool[np.ndarray, "time env"]:
        """Tell when an object is between the pads, which touch it: not when both push it with their edges."""
        shape = self.scene.manipulated.shape if track is self.thing else self._other.shape
        away = np.full(track.grasped.shape, np.inf)
        for below in (0.0, TIP_BELOW_TCP_M):
            point = self.trajectory.eef_pos - [0.0, 0.0, below] - track.pos
            local = np.einsum("tejk,tej->tek", track.axes, point)
            if shape in ("cylinder", "sphere"):  # at an angle, the box about it reaches farther
                local[..., 0] = np.hypot(local[..., 0], local[..., 1])
                local[..., 1] = 0.0
            outside = np.maximum(np.abs(local) - track.size_m / 2, 0.0)
            away = np.minimum(away, np.linalg.norm(outside, axis=-1))
        holds = (away < BETWEEN_PADS_M) & (self.trajectory.opening_m > CLOSED_M)
        return track.grasped & holds

    def is_over(self) -> Bool[np.ndarray, "time env"]:
        """Tell when the manipulated object's centre lies over the other's footprint."""
        local = np.einsum("tejk,tej->tek", self.other.axes, self.thing.pos - self.other.pos)
        return (np.abs(local[..., :2]) < self.other.size_m[:, :2] / 2).all(axis=-1)

    def was_moved(self) -> Bool[np.ndarray, "env"]:
        """Tell whether the robot's contact moved the object, as far as its kind demands, from where it lay still."""
        last = np.maximum(self.settled - 1, 0), np.arange(len(self.settled))
        lay_still = (
            np.linalg.norm(self.before(self.thing.pos) - self.thing.pos[last], axis=-1) < STILL_M
        )
        moved = np.linalg.norm(self.way, axis=-1) >= self.kind.meaning.moved_m
        return self.handled.by_arm.any(axis=0) & lay_still & moved & (self.by_others() < STAYS_M)

    def by_others(self) -> Float[np.ndarray, "env"]:
        """Return how far the object went, after it had settled, in motions that the arm's contact did not begin [m]."""
        length = np.linalg.norm(np.diff(self.thing.pos, axis=0), axis=-1)
        driven, total = np.zeros(len(self.settled), bool), np.zeros(len(self.settled))
        if self.kind.grasps == "tool":
            return total  # by the tool: see `_pushed_with`
        for t, step in enumerate(length, start=1):
            driven = self.thing.by_arm[t] | (driven & (step > STILL_M / 3))
            total += step * ~driven * (t > self.settled)
        return total

    def is_above_table(self) -> Bool[np.ndarray, "env"]:
        """Tell whether no object is pressed into the table over the last samples."""
        objects = [(self.scene.manipulated, self.thing)]
        if self.scene.others:
            objects.append((self._other, self.other))
        above = np.ones(len(self.thing.size_m), bool)
        for obj, track in objects:
            if obj.shape == "mesh":
                # Its box reaches lower than it does; the smallest half extent is a bound for every pose.
                low = track.pos[-LAST:, :, 2].min(axis=0) - track.size_m.min(axis=-1) / 2
            else:
                low = self.lowest(track)[-LAST:].min(axis=0)
            above &= low > -BELOW_M
        return above


Verdict = Bool[np.ndarray, "env"]
Moments = Bool[np.ndarray, "time env"]


def referee_success(kind: Kind, scene: Scene, trajectory: Trajectory) -> Bool[np.ndarray, "env"]:
    """Return per world whether the robot did what its kind of task says. Docs: `docs/experts.md`.

    Raises:
        V2PError: the kind needs an object that the scene lacks.
    """
    case = Case(scene=scene, trajectory=trajectory)
    return np.asarray(RULES[kind](case) & case.is_above_table() & case.was_moved(), bool)


def _arrived(case: Case, there: Moments) -> Verdict:
    """It is there at the end, and was not when everything had settled."""
    return there[-1] & ~case.before(there)


def _lifted(case: Case) -> Verdict:
    is_high = case.rise[-LAST:].min(axis=0) > case.kind.meaning.raised_m
    way = np.linalg.norm(np.ptp(case.thing.pos[-LAST:], axis=0), axis=-1)
    return is_high & (way < STEADY_M) & case.gripped(case.thing)[-LAST:].all(axis=0)


def _pushed(side: int) -> Callable[[Case], Verdict]:
    def rule(case: Case) -> Verdict:
        aside = case.way[:, 1] * side
        is_sideways = np.abs(case.way[:, 0]) <= 0.6 * aside
        return is_sideways & (aside >= case.kind.meaning.moved_m) & _slid(case)

    return rule


def _without_grip(case: Case) -> Verdict:
    """It made its way out of the grip, and is not gripped at the end."""
    gripped = case.gripped(case.thing)
    in_grip = (np.linalg.norm(case.thing.steps, axis=-1) * gripped).sum(axis=0)
    return ~gripped[-LAST:].any(axis=0) & (case.kind.may_drag | (in_grip < IN_GRIP_M))


def _slid(case: Case) -> Verdict:
    """On the table all the way, upright; at rest at the end."""
    stayed = (case.rise.max(axis=0) < LEAVES_M) & (np.abs(case.way[:, 2]) < LEAVES_M)
    stood = case.leaned < STANDS_RAD
    return stood & stayed & case.thing.is_at_rest & _without_grip(case)


def _tipped(case: Case) -> Verdict:
    lies = np.abs(case.lowest(case.thing)[-1]) < 2 * REST_M
    fell = (case.leaned > FALLEN_RAD) & (case.rise.max(axis=0) < STAYS_M)
    return fell & case.thing.is_at_rest & lies & _without_grip(case)


def _pushed_next_to(case: Case) -> Verdict:
    is_near = _arrived(case, case.gap < NEXT_TO_M)
    return is_near & (case.other_moved < STAYS_M) & _slid(case)


def _pushed_with(case: Case) -> Verdict:
    """The tool does it: it is in the grip and at the thing, which the arm never touches."""
    by_tool = (case.gripped(case.other) & (case.gap < STAYS_M)).any(axis=0)
    return by_tool & ~case.thing.by_arm.any(axis=0) & _slid(case)


def _carried(case: Case, raised_m: Float[np.ndarray, "env"] | float | None = None) -> Verdict:
    """It was raised in the grip and went half of its way in the air."""
    is_carried = case.gripped(case.thing)
    raised = (case.rise * is_carried).max(axis=0)
    in_air = (case.thing.steps * (is_carried & (case.rise > IN_AIR_M))[..., None]).sum(axis=0)
    needed = case.kind.meaning.raised_m if raised_m is None else raised_m
    half = np.linalg.norm(case.way[:, :2], axis=-1) / 2
    return (raised >= needed) & (np.linalg.norm(in_air, axis=-1) >= half)


def _put_down(case: Case, raised_m: Float[np.ndarray, "env"] | float | None = None) -> Verdict:
    """It was carried, let go and not pushed thereafter."""
    gripped = case.gripped(case.thing)
    is_later = np.cumsum(gripped[::-1], axis=0)[::-1] == 0
    steps = np.linalg.norm(case.thing.steps, axis=-1)
    pushed = (steps * (is_later & case.thing.by_arm)).sum(axis=0)
    is_free = ~case.thing.touched[-LAST:].any(axis=0)
    return _carried(case, raised_m) & is_free & case.thing.is_at_rest & (pushed < STAYS_M)


def _dropped_in_front(case: Case) -> Verdict:
    """In front of: on the viewer's and the robot's side, which is -x."""
    way = case.other.pos - case.thing.pos
    beside = (case.thing.size_m[:, :2].max(-1) + case.other.size_m[:, :2].max(-1)) / 2
    is_in_front = (way[..., 0] > 0) & (np.abs(way[..., 1]) < beside) & (case.gap < 0.10)
    on_table = np.abs(case.lowest(case.thing)) < 2 * REST_M
    there = _arrived(case, is_in_front & on_table)
    return there & (case.other_moved < STAYS_M) & _put_down(case)


def _inside(case: Case) -> Verdict:
    rim = case.other.pos[..., 2] + case.other.size_m[:, 2] / 2
    low = case.lowest(case.thing)
    # Pressed through the container's floor is not inside. A mesh reaches less deep than its box.
    floor = case.other.pos[..., 2] - case.other.size_m[:, 2] / 2
    if case.scene.manipulated.shape != "mesh" and case.container_is_hollow:
        floor = floor + hollow_floor_m(case.other.size_m[:, 2])
    is_in = case.is_over() & (low < rim) & (low > floor - BELOW_M)
    return _arrived(case, is_in) & (case.other_moved < 2 * STAYS_M)


def _inserted(case: Case) -> Verdict:
    return _inside(case) & _put_down(case)


def _thrown(case: Case) -> Verdict:
    """Released in the air, well before the container, not lowered into it."""
    touched = case.thing.by_arm
    last_touch = len(touched) - 1 - np.argmax(touched[::-1], axis=0)
    env = np.arange(touched.shape[1])
    there = case.thing.pos[last_touch, env] - case.other.pos[last_touch, env]
    away = np.linalg.norm(there[:, :2], axis=-1) - case.other.size_m[:, :2].max(-1) / 2
    raised = (case.rise * case.gripped(case.thing)).max(axis=0)
    flew = (away > 0.10) & (raised >= case.kind.meaning.raised_m)
    return _inside(case) & flew & ~case.thing.touched[-LAST:].any(axis=0)


def _placed_onto(case: Case) -> Verdict:
    top = case.other.pos[..., 2] + case.other.size_m[:, 2] / 2
    low = case.lowest(case.thing)
    # A thing may sink a little into a bowl or a tray, but no deeper than the table.
    on_top = _arrived(case, case.is_over() & (low < top + 0.015) & (low > -BELOW_M))
    # Onto a coaster nobody lifts a mug higher.
    raised_m = np.minimum(case.kind.meaning.raised_m, top[-1] + REST_M)
    return on_top & (case.other_moved < STAYS_M) & _put_down(case, raised_m)


def _covered(case: Case) -> Verdict:
    off = np.linalg.norm(case.thing.pos[..., :2] - case.other.pos[..., :2], axis=-1)
    down = np.abs(case.lowest(case.thing)) < 2 * REST_M
    over = _arrived(case, (off < 0.025) & down) & (case.leaned < STANDS_RAD)
    return over & (case.other_moved < STAYS_M) & _put_down(case)


def _uncovered(case: Case) -> Verdict:
    is_held_high = (case.lowest(case.thing) > 0.08) & case.gripped(case.thing)
    away = _arrived(case, (case.gap > 0) | is_held_high)
    stood = (case.leaned < STANDS_RAD) & (case.other_moved < STAYS_M)
    return away & stood & _carried(case)


def _moved_as_in_the_video(case: Case) -> Verdict:
    poses = np.array(case.scene.manipulated.poses_world)[:, :3]
    wanted = poses[-1] - poses[0]
    near = max(0.05, 0.5 * float(np.linalg.norm(wanted)))
    # Where it returns to its start in the video, the robot takes it as far away on the way.
    farthest = 0.5 * float(np.linalg.norm(poses - poses[0], axis=-1).max())
    went = np.linalg.norm(case.thing.pos - case.before(case.thing.pos), axis=-1)
    is_after = np.arange(len(went))[:, None] >= case.settled
    far = (went * is_after).max(axis=0) >= max(STAYS_M, farthest)
    far &= np.linalg.norm(case.way, axis=-1) >= 0.5 * np.linalg.norm(wanted)
    return far & (np.linalg.norm(case.way - wanted, axis=-1) < near) & case.thing.is_at_rest


RULES: dict[Kind, Callable[[Case], Verdict]] = {
    "lift_up": _lifted,
    "push_left": _pushed(KINDS["push_left"].side),
    "push_right": _pushed(KINDS["push_right"].side),
    "tip_over": _tipped,
    "push_next_to": _pushed_next_to,
    "slide_to": _pushed_next_to,
    "push_with": _pushed_with,
    "drop_in_front_of": _dropped_in_front,
    "insert": _inserted,
    "throw_into": _thrown,
    "place_onto": _placed_onto,
    "cover": _covered,
    "uncover": _uncovered,
    "generic": _moved_as_in_the_video,
}
"""Which rule judges each kind."""

check_every_kind(RULES, "referee rule", "RULES in v2p_data/task/referee.py")
