"""What went wrong in a failed episode, told from the motions of tool and objects.

The first of these that is true is the episode's kind of failure:

| kind | it means |
|---|---|
| `simulation_broke` | the simulation's state was not finite |
| `toppled` | what should stay upright leans at the end |
| `never_reached` | no pad ever touched what has to be touched: the manipulated object, or the tool it is pushed with |
| `not_grasped` | a task that needs a grasp: touched, but never between both pads for long enough |
| `dropped` | it was held; at the end it is not. Where letting go is right, it was let go far from the other object |
| `wrong_place` | where letting go is right: it was let go near the other object, and that was not right |
| `stopped_halfway` | the tool hardly moved for the last second |
| `wrong_place` | none of these: the object was handled and did not end as the task asks |

Distances are horizontal, between the objects' outlines if both were as wide as their larger side.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from v2p_data.kinds import KINDS
from v2p_data.task.task import TaskBundle

SIMULATION_BROKE = "simulation_broke"
TOPPLED = "toppled"
NEVER_REACHED = "never_reached"
NOT_GRASPED = "not_grasped"
DROPPED = "dropped"
STOPPED_HALFWAY = "stopped_halfway"
WRONG_PLACE = "wrong_place"

TOPPLED_RAD = np.deg2rad(25)
"""The referee denies what leans by more than this."""
GRASP_STEPS = 3
"""Control steps (0.15 s) on end with both pads at the object: less is a touch in passing."""
END_STEPS = 5
"""Control steps (0.25 s) at the end in which what is held must have been held."""
FAR_M = 0.10
"""Let go with a larger gap to the other object, a thing was lost on its way."""
STILL_STEPS = 20
"""Control steps: the last second."""
STILL_M = 0.01
"""A tool that stays within a box of this diagonal stands still."""

History = Mapping[str, np.ndarray]
"""Per key of the task interface's `states` an array `(time, env, ...)`, the moment after the reset first."""


def failure_kinds(
    bundle: TaskBundle, history: History, broke: Bool[np.ndarray, "env"]
) -> tuple[str, ...]:
    """Return the kind of failure of each of these episodes, which all failed and are of the same length."""
    kinds = np.full(len(broke), SIMULATION_BROKE, dtype=object)
    sound = np.flatnonzero(~broke)
    if len(sound):
        case = _Case(
            bundle=bundle, history={key: value[:, sound] for key, value in history.items()}
        )
        kinds[sound] = _kinds_of_sound(case)
    return tuple(str(kind) for kind in kinds)


@dataclass(frozen=True, kw_only=True)
class _Case:
    """Failed episodes of one task, of simulations that did not break."""

    bundle: TaskBundle
    history: History

    @property
    def thing(self) -> str:
        return self.bundle.scene.manipulated.name

    @property
    def other(self) -> str | None:
        others = self.bundle.scene.others
        return others[0].name if others else None

    def of(self, name: str, what: str) -> np.ndarray:
        return self.history[f"{name}_{what}"]

    def first_touched(self) -> str:
        """Return the name of the object that the gripper has to touch."""
        by_tool = KINDS[self.bundle.kind].grasps == "tool" and self.other is not None
        return str(self.other) if by_tool else self.thing

    def leaned_rad(self) -> Float[np.ndarray, "env"]:
        """Return the angle between the thing's own z axis at the start and at the end."""
        up = [_own_z(self.of(self.thing, "quat")[time]) for time in (0, -1)]
        return np.arccos(np.clip((up[0] * up[1]).sum(-1), -1.0, 1.0))

    def last_held(self) -> np.ndarray:
        """Return the last moment at which the thing was held; -1 where it never was."""
        held = _on_end(self.of(self.thing, "grasped") > 0, GRASP_STEPS)
        last = len(held) - 1 - np.argmax(held[::-1], axis=0)
        return np.where(held.any(0), last, -1)

    def gap_m(self, time: np.ndarray) -> Float[np.ndarray, "env"]:
        """Return the gap between thing and other object at a moment per episode."""
        name = self.other
        if name is None:
            return np.full(len(time), np.inf)
        env = np.arange(len(time))
        between = self.of(name, "pos")[time, env, :2] - self.of(self.thing, "pos")[time, env, :2]
        sizes = [self.of(n, "size")[0, :, :2].max(-1) / 2 for n in (name, self.thing)]
        return np.linalg.norm(between, axis=-1) - sizes[0] - sizes[1]

    def stands_still(self) -> Bool[np.ndarray, "env"]:
        last = self.history["eef_pos"][-STILL_STEPS - 1 :]
        return np.linalg.norm(np.ptp(last, axis=0), axis=-1) < STILL_M


def _kinds_of_sound(case: _Case) -> np.ndarray:
    kind = KINDS[case.bundle.kind]
    never = np.zeros(case.history["eef_pos"].shape[1], bool)
    touched = (case.of(case.first_touched(), "touched") > 0).any(0)
    leans = case.leaned_rad() > TOPPLED_RAD if kind.stays_upright else never
    last_held = case.last_held()
    was_held = last_held >= 0
    is_held = (case.of(case.thing, "grasped")[-END_STEPS:] > 0).any(0)
    let_go = was_held & ~is_held
    not_grasped, dropped, misplaced = never, never, never
    if kind.must_grasp:
        not_grasped = ~was_held
        if kind.is_put_down:
            dropped = let_go & (case.gap_m(last_held) > FAR_M)
            misplaced = let_go & ~dropped
        elif kind.family == "throw":
            misplaced = let_go
        else:
            dropped = let_go
    return np.select(
        [leans, ~touched, not_grasped, dropped, misplaced, case.stands_still()],
        [TOPPLED, NEVER_REACHED, NOT_GRASPED, DROPPED, WRONG_PLACE, STOPPED_HALFWAY],
        WRONG_PLACE,
    )


def _own_z(quat_wxyz: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()[..., 2]


def _on_end(true: np.ndarray, steps: int) -> np.ndarray:
    """Tell where it has been true for this many moments on end."""
    out = np.zeros_like(true)
    count = np.zeros(true.shape[1], int)
    for time, now in enumerate(true):
        count = np.where(now, count + 1, 0)
        out[time] = count >= steps
    return out
