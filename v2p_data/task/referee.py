"""Independent success functions, one per task kind, that no training ever sees.

They look at a whole recorded episode, in numpy, and ask for what the words say: a thing pressed through the
table is not inserted, a thing toppled is not pushed, a thing still held is not dropped.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.kinds import KINDS, Kind, check_every_kind
from v2p_data.scene.scene import Scene, SceneObject, hollow_floor_m

LAST = 5
"""Samples at the end (0.25 s) over which a final state must hold."""
CLEAR_M = 0.06
"""Lifted and pushed things have moved by at least this."""
SLIDES_M = 0.03
"""A pushed thing never leaves the table by more than this."""
NEXT_TO_M = 0.03
"""Largest gap between things that are next to each other."""
STAYS_M = 0.03
"""A thing that should stay moves by less than this."""
REST_M = 0.01
"""Movement over the last samples of a thing at rest."""
BELOW_M = 0.005
"""A thing this far below its support was pressed through it."""
STEADY_M = 0.05
"""Movement over the last samples (0.2 m/s) of a thing that is held up."""
REACHED_M = 0.04
"""The gripper was at a thing if its tool centre came this near its box: fingers also push with their sides, which no
pad feels. Pushes without a pad came within 2.2 cm in 64 episodes; arms start at least 5 cm away."""
FINGER_REACHED_M = 0.02
"""The same for the outer side of a finger, 5.5 cm beside the tool's centre if the gripper is open:
its tip is 1.5 cm lower. What it hits may be gone at the next sample, so the thing is taken where
it was one sample before."""
FALLEN_RAD = np.deg2rad(60)
STANDS_RAD = np.deg2rad(25)


@dataclass(frozen=True, kw_only=True)
class ObjectTrack:
    """One object in every world over an episode, world frame."""

    pos: Float[np.ndarray, "time env 3"]
    quat_wxyz: Float[np.ndarray, "time env 4"]
    size_m: Float[np.ndarray, "env 3"]
    """Full extents along its own axes."""
    touched: Bool[np.ndarray, "time env 2"]
    """By either pad."""

    @property
    def moved(self) -> Float[np.ndarray, "env"]:
        """Horizontal distance between first and last position [m]."""
        return np.linalg.norm(self.pos[-1, :, :2] - self.pos[0, :, :2], axis=-1)

    @property
    def is_at_rest(self) -> Bool[np.ndarray, "env"]:
        return np.linalg.norm(np.ptp(self.pos[-LAST:], axis=0), axis=-1) < REST_M

    @property
    def is_free(self) -> Bool[np.ndarray, "env"]:
        """No pad touches it at the end."""
        return np.logical_not(self.touched[-LAST:].any(axis=(0, 2)))

    @property
    def is_held(self) -> Bool[np.ndarray, "env"]:
        """Both pads touch it at the end."""
        return np.asarray(self.touched[-LAST:].all(axis=(0, 2)))

    @cached_property
    def axes(self) -> Float[np.ndarray, "time env 3 3"]:
        """Rotation matrices; column k is the object's own axis k in the world."""
        flat = Rotation.from_quat(self.quat_wxyz.reshape(-1, 4), scalar_first=True).as_matrix()
        return flat.reshape(*self.quat_wxyz.shape[:2], 3, 3)

    def outside(self, point: Float[np.ndarray, "step env 3"]) -> Float[np.ndarray, "step env"]:
        """Return how far points are from the object's box at the first samples, as many as there are points [m]."""
        n = len(point)
        local = np.einsum("tejk,tej->tek", self.axes[:n], point - self.pos[:n])
        return np.linalg.norm(np.maximum(np.abs(local) - self.size_m / 2, 0.0), axis=-1)

    def leaned(self) -> Float[np.ndarray, "env"]:
        """Return the angle between its own z axis at the start and at the end [rad]."""
        z = self.axes[..., 2]
        return np.arccos(np.clip((z[0] * z[-1]).sum(-1), -1.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """What happened in a batch of episodes of the same length, recorded at the fine time step."""

    objects: dict[str, ObjectTrack]
    eef_pos: Float[np.ndarray, "time env 3"]
    finger_pos: Float[np.ndarray, "time env 2 3"]
    """Outer sides of the two fingers, at the height of the tool's centre."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One task's episodes, as the rules see them."""

    scene: Scene
    trajectory: Trajectory

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

    def reach(
        self, track: ObjectTrack, direction: Float[np.ndarray, "env 3"], time: int
    ) -> Float[np.ndarray, "env"]:
        """Return how far an object extends from its centre along unit directions [m]."""
        shape = self.scene.manipulated.shape if track is self.thing else self._other.shape
        half = track.size_m / 2
        if shape == "sphere":
            return half.max(axis=-1)
        along = np.einsum("ej,ejk->ek", direction, track.axes[time])
        if shape == "cylinder":
            c = np.abs(along[:, 2])
            return c * half[:, 2] + np.sqrt(np.clip(1 - c**2, 0, 1)) * half[:, :2].max(axis=-1)
        return (np.abs(along) * half).sum(axis=-1)

    def lowest(self, track: ObjectTrack, time: int = -1) -> Float[np.ndarray, "env"]:
        """Return the height of an object's lowest point [m]; of meshes, of their bounding box."""
        down = np.tile([0.0, 0.0, -1.0], (len(track.size_m), 1))
        return track.pos[time, :, 2] - self.reach(track, down, time)

    def highest_clearance(self) -> Float[np.ndarray, "env"]:
        """Return the largest height of the manipulated object's lowest point [m]."""
        return np.max([self.lowest(self.thing, t) for t in range(len(self.thing.pos))], axis=0)

    def gap(self, time: int = -1) -> Float[np.ndarray, "env"]:
        """Return the horizontal distance between the two objects' outlines, along their centres' line [m]."""
        between = self.other.pos[time] - self.thing.pos[time]
        between[:, 2] = 0.0
        distance = np.linalg.norm(between, axis=-1)
        u = np.where(distance[:, None] > 1e-6, between, [1.0, 0.0, 0.0])
        u = u / np.linalg.norm(u, axis=-1, keepdims=True)
        return distance - self.reach(self.thing, u, time) - self.reach(self.other, -u, time)

    def was_reached(self) -> Bool[np.ndarray, "env"]:
        """Tell whether the robot has been at the object that moved, or has touched the tool that pushed it."""
        thing, fingers = self.thing, self.trajectory.finger_pos
        reached = np.linalg.norm(np.ptp(thing.pos, axis=0), axis=-1) < REST_M  # then nothing moved
        reached |= thing.touched.any(axis=(0, 2))
        reached |= (thing.outside(self.trajectory.eef_pos) < REACHED_M).any(axis=0)
        for side in (fingers[1:, :, 0], fingers[1:, :, 1]):
            reached |= (thing.outside(side) < FINGER_REACHED_M).any(axis=0)
        if KINDS[self.scene.kind].grasps == "tool":
            reached |= self.other.touched.any(axis=(0, 2))
        return reached

    def within(self) -> Bool[np.ndarray, "env"]:
        """Tell whether the manipulated object's centre lies over the other's footprint at the end."""
        local = np.einsum(
            "ejk,ej->ek", self.other.axes[-1], self.thing.pos[-1] - self.other.pos[-1]
        )
        return (np.abs(local[:, :2]) < self.other.size_m[:, :2] / 2).all(axis=-1)

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
                low = np.min([self.lowest(track, t) for t in range(-LAST, 0)], axis=0)
            above &= low > -BELOW_M
        return above


Verdict = Bool[np.ndarray, "env"]


def referee_success(kind: Kind, scene: Scene, trajectory: Trajectory) -> Bool[np.ndarray, "env"]:
    """Return per world whether the robot did what its kind of task says.

    What moves while the robot is away from it does not count. How something was carried is not
    looked at: a push may be a carry. Docs: `docs/experts.md`.

    Raises:
        V2PError: the kind needs an object that the scene lacks.
    """
    case = Case(scene=scene, trajectory=trajectory)
    return np.asarray(RULES[kind](case) & case.is_above_table() & case.was_reached(), bool)


def _lifted(case: Case) -> Verdict:
    lows = np.min([case.lowest(case.thing, t) for t in range(-LAST, 0)], axis=0)
    way = np.linalg.norm(np.ptp(case.thing.pos[-LAST:], axis=0), axis=-1)
    return (lows > CLEAR_M) & (way < STEADY_M) & case.thing.is_held


def _pushed(side: int) -> Callable[[Case], Verdict]:
    def rule(case: Case) -> Verdict:
        way = (case.thing.pos[-1] - case.thing.pos[0]) * np.array([1, side, 1])
        is_sideways = (way[:, 1] >= CLEAR_M) & (np.abs(way[:, 0]) <= 0.6 * way[:, 1])
        return is_sideways & _slid(case)

    return rule


def _slid(case: Case) -> Verdict:
    stood = case.thing.leaned() < STANDS_RAD
    return stood & (case.highest_clearance() < SLIDES_M) & case.thing.is_at_rest


def _tipped(case: Case) -> Verdict:
    lies = np.abs(case.lowest(case.thing)) < 2 * REST_M
    return (case.thing.leaned() > FALLEN_RAD) & case.thing.is_at_rest & lies


def _pushed_next_to(case: Case) -> Verdict:
    was_apart = case.gap(0) > NEXT_TO_M
    return was_apart & (case.gap() < NEXT_TO_M) & (case.other.moved < STAYS_M) & _slid(case)


def _pushed_with(case: Case) -> Verdict:
    """The tool does it: the gripper never touches the thing itself."""
    by_tool = ~case.thing.touched.any(axis=(0, 2)) & case.other.touched.any(axis=(0, 2))
    return by_tool & (case.thing.moved >= CLEAR_M) & _slid(case)


def _put_down(case: Case, lift_m: Float[np.ndarray, "env"] | float = SLIDES_M) -> Verdict:
    was_carried = case.highest_clearance() > lift_m
    return was_carried & case.thing.is_free & case.thing.is_at_rest


def _dropped_in_front(case: Case) -> Verdict:
    """In front of: on the viewer's and the robot's side, which is -x."""
    way = case.other.pos[-1] - case.thing.pos[-1]
    beside = (case.thing.size_m[:, :2].max(-1) + case.other.size_m[:, :2].max(-1)) / 2
    is_in_front = (way[:, 0] > 0) & (np.abs(way[:, 1]) < beside) & (case.gap() < 0.10)
    on_table = np.abs(case.lowest(case.thing)) < 2 * REST_M
    return is_in_front & on_table & (case.other.moved < STAYS_M) & _put_down(case)


def _inside(case: Case) -> Verdict:
    rim = case.other.pos[-1, :, 2] + case.other.size_m[:, 2] / 2
    low = case.lowest(case.thing)
    # Pressed through the container's floor is not inside. A mesh reaches less deep than its box.
    floor = case.other.pos[-1, :, 2] - case.other.size_m[:, 2] / 2
    if case.scene.manipulated.shape != "mesh" and case.container_is_hollow:
        floor = floor + hollow_floor_m(case.other.size_m[:, 2])
    return case.within() & (low < rim) & (low > floor - BELOW_M) & (case.other.moved < 2 * STAYS_M)


def _inserted(case: Case) -> Verdict:
    return _inside(case) & _put_down(case)


def _thrown(case: Case) -> Verdict:
    """Released well before the container, not lowered into it."""
    touched = np.asarray(case.thing.touched.any(axis=2))
    last_touch = len(touched) - 1 - np.argmax(touched[::-1], axis=0)
    env = np.arange(touched.shape[1])
    there = np.linalg.norm(
        case.thing.pos[last_touch, env, :2] - case.other.pos[last_touch, env, :2], axis=-1
    )
    flew = touched.any(axis=0) & (there - case.other.size_m[:, :2].max(-1) / 2 > 0.10)
    return _inside(case) & flew & case.thing.is_free


def _placed_onto(case: Case) -> Verdict:
    top = case.other.pos[-1, :, 2] + case.other.size_m[:, 2] / 2
    low = case.lowest(case.thing)
    # A thing may sink a little into a bowl or a tray, but no deeper than the table.
    on_top = case.within() & (low < top + 0.015) & (low > -BELOW_M)
    lift_m = np.minimum(SLIDES_M, top + REST_M)  # onto a coaster nobody lifts a mug higher
    return on_top & (case.other.moved < STAYS_M) & _put_down(case, lift_m)


def _covered(case: Case) -> Verdict:
    off = np.linalg.norm(case.thing.pos[-1, :, :2] - case.other.pos[-1, :, :2], axis=-1)
    over = (off < 0.025) & (case.thing.leaned() < STANDS_RAD)
    down = np.abs(case.lowest(case.thing)) < 2 * REST_M
    return over & down & (case.other.moved < STAYS_M) & _put_down(case)


def _uncovered(case: Case) -> Verdict:
    away = (case.gap() > 0) | ((case.lowest(case.thing) > 0.08) & case.thing.is_held)
    upright = case.thing.leaned() < STANDS_RAD
    was_over = case.gap(0) < 0
    return was_over & away & upright & (case.other.moved < STAYS_M)


def _moved_as_in_the_video(case: Case) -> Verdict:
    obj = case.scene.manipulated
    wanted = obj.last_pose[:3] - obj.first_pose[:3]
    got = case.thing.pos[-1] - case.thing.pos[0]
    near = max(0.05, 0.5 * float(np.linalg.norm(wanted)))
    return (np.linalg.norm(got - wanted, axis=-1) < near) & case.thing.is_at_rest


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
