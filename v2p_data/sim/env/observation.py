"""The base observation that every expert sees: a table of named terms, from which all columns follow.

`states` fills it on the CPU and `tensor_states` on the GPU. `COLUMNS` finds a term, `table` prints them all
for `docs/observation.md`. A value is a quantity times its scale, so that it is of order one, clipped to
+-`LIMIT`.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32

from v2p_data.sim.robot.robot import FINGER_TRAVEL_M
from v2p_data.task.task import BASE_OBSERVATION_DIM

LIMIT = 5.0
"""Largest magnitude of a value."""
OBJECT_SLOTS = ("manipulated", "other")
"""Objects that are described: the manipulated one, then the first other. Without an other one its terms are 0."""
TOOL_CENTRE_M = (0.5, 0.0, 0.15)
"""Point from which the tool's position is measured, world frame."""
OBJECT_CENTRE_M = (0.5, 0.0, 0.05)
"""Point from which an object's position is measured, world frame."""

Frame = Literal["world", "gripper", "-"]


@dataclass(frozen=True, kw_only=True)
class Term:
    """One entry of the table."""

    name: str
    width: int
    """Number of columns."""
    scale: float
    """Factor from the quantity in its unit to the value."""
    frame: Frame
    """Axes of a vector; `-` for numbers without a direction in space."""
    unit: str
    meaning: str


def _of_robot() -> tuple[Term, ...]:
    turned = Term(name="", width=3, scale=1.0, frame="world", unit="1", meaning="")
    open_m = 1 / FINGER_TRAVEL_M
    return (
        Term(
            name="tool_pos",
            width=3,
            scale=5.0,
            frame="world",
            unit="m",
            meaning="position of the tool's centre, from (0.5, 0, 0.15)",
        ),
        Term(**{**vars(turned), "name": "tool_axis_x", "meaning": "x axis of the tool"}),
        Term(
            **{
                **vars(turned),
                "name": "tool_axis_y",
                "meaning": "y axis of the tool, along which the pads close",
            }
        ),
        Term(
            name="fingers",
            width=2,
            scale=open_m,
            frame="-",
            unit="m",
            meaning="travel of both fingers; 1 is open",
        ),
        Term(
            name="target_ahead",
            width=3,
            scale=20.0,
            frame="world",
            unit="m",
            meaning="target of the tool minus its position",
        ),
        Term(
            name="target_finger",
            width=1,
            scale=open_m,
            frame="-",
            unit="m",
            meaning="target of the fingers",
        ),
        Term(
            name="last_action",
            width=7,
            scale=0.5,
            frame="world",
            unit="1",
            meaning="the action before",
        ),
    )


def _of_object(slot: str) -> tuple[Term, ...]:
    of = f"of the {slot} object"
    return (
        Term(
            name=f"{slot}_away",
            width=3,
            scale=10.0,
            frame="world",
            unit="m",
            meaning=f"position {of}, from the tool",
        ),
        Term(
            name=f"{slot}_away_in_gripper",
            width=3,
            scale=10.0,
            frame="gripper",
            unit="m",
            meaning=f"position {of}, from the tool",
        ),
        Term(
            name=f"{slot}_axis_x",
            width=3,
            scale=1.0,
            frame="gripper",
            unit="1",
            meaning=f"x axis {of}",
        ),
        Term(
            name=f"{slot}_axis_y",
            width=3,
            scale=1.0,
            frame="gripper",
            unit="1",
            meaning=f"y axis {of}",
        ),
        Term(
            name=f"{slot}_up", width=3, scale=1.0, frame="world", unit="1", meaning=f"z axis {of}"
        ),
        Term(
            name=f"{slot}_pos",
            width=3,
            scale=5.0,
            frame="world",
            unit="m",
            meaning=f"position {of}, from (0.5, 0, 0.05)",
        ),
        Term(
            name=f"{slot}_vel",
            width=3,
            scale=1.0,
            frame="world",
            unit="m/s",
            meaning=f"velocity {of}",
        ),
    )


def _of_both(
    name: str, width: int, scale: float, frame: Frame, unit: str, meaning: str
) -> tuple[Term, ...]:
    return tuple(
        Term(
            name=f"{slot}_{name}",
            width=width,
            scale=scale,
            frame=frame,
            unit=unit,
            meaning=f"{meaning} of the {slot} object",
        )
        for slot in OBJECT_SLOTS
    )


def _touches(slot: str) -> Term:
    return Term(
        name=f"{slot}_touches",
        width=2,
        scale=1.0,
        frame="-",
        unit="1",
        meaning=f"1 where the left, right pad touches the {slot} object",
    )


def _grip(slot: str) -> tuple[Term, ...]:
    of = f"of the {slot} object"
    return (
        Term(
            name=f"{slot}_grip_turn",
            width=1,
            scale=1.0,
            frame="world",
            unit="90 deg",
            meaning=f"turn about the vertical until the pads fit over a side {of}",
        ),
        Term(
            name=f"{slot}_grip_extents",
            width=3,
            scale=10.0,
            frame="gripper",
            unit="m",
            meaning=f"extents of the box {of}",
        ),
    )


TERMS: tuple[Term, ...] = (
    *_of_robot(),
    *_of_object("manipulated"),
    *_of_object("other"),
    *_of_both("size", 3, 15.0, "-", "m", "extents along its own axes"),
    _touches("manipulated"),
    Term(
        name="progress",
        width=1,
        scale=1.0,
        frame="-",
        unit="1",
        meaning="share of the horizon that has passed; experts know values up to 1",
    ),
    *_of_both("moved", 3, 5.0, "world", "m", "displacement from the start"),
    Term(
        name="has_other",
        width=1,
        scale=1.0,
        frame="-",
        unit="1",
        meaning="1 if there is an other object",
    ),
    *_grip("manipulated"),
    *_grip("other"),
    _touches("other"),
)
"""All terms in the order of their columns."""


def _laid_out() -> dict[str, slice]:
    start, columns = 0, {}
    for term in TERMS:
        columns[term.name] = slice(start, start + term.width)
        start += term.width
    if start != BASE_OBSERVATION_DIM or len(columns) != len(TERMS):
        raise ValueError(
            f"the terms of sim/env/observation.py have {start} columns under {len(columns)} names; the task interface "
            f"promises {BASE_OBSERVATION_DIM} columns, and each term a name of its own"
        )
    return columns


COLUMNS: dict[str, slice] = _laid_out()
"""Columns of each term."""
PROGRESS_COLUMN = COLUMNS["progress"].start
SCALES: Float32[np.ndarray, "90"] = np.concatenate(
    [np.full(term.width, term.scale, np.float32) for term in TERMS]
)
"""Scale of each column."""


def _joined(first: str, last: str) -> slice:
    return slice(COLUMNS[first].start, COLUMNS[last].stop)


SLOT_COLUMNS = _joined("manipulated_away", "other_vel")
"""Columns of all slots' terms from `away` to `vel`, equally many per slot."""
IN_SLOT: dict[str, slice] = {
    term.name.removeprefix("manipulated_"): slice(
        COLUMNS[term.name].start - SLOT_COLUMNS.start, COLUMNS[term.name].stop - SLOT_COLUMNS.start
    )
    for term in _of_object("manipulated")
}
"""Columns of these terms within a slot."""
SLOT_WIDTH = IN_SLOT["vel"].stop
SIZE_COLUMNS = _joined("manipulated_size", "other_size")
MOVED_COLUMNS = _joined("manipulated_moved", "other_moved")
GRIP_COLUMNS = tuple(_joined(f"{slot}_grip_turn", f"{slot}_grip_extents") for slot in OBJECT_SLOTS)
"""Per slot the columns of `grips.grip_features`."""
TOUCH_COLUMNS = tuple(COLUMNS[f"{slot}_touches"] for slot in OBJECT_SLOTS)


def value_of(base: np.ndarray, name: str) -> np.ndarray:
    """Return a term of observations `(env, 90)` in its unit, `(env, width)`; exact where it was not clipped."""
    scales = {term.name: term.scale for term in TERMS}
    return base[:, COLUMNS[name]] / scales[name]


def table() -> str:
    """Return all terms as a Markdown table."""
    lines = ["| columns | term | frame | unit | scale | meaning |", "|---|---|---|---|---|---|"]
    for term in TERMS:
        at = COLUMNS[term.name]
        where = f"{at.start}" if term.width == 1 else f"{at.start}-{at.stop - 1}"
        lines.append(
            f"| {where} | `{term.name}` | {term.frame} | {term.unit} | {term.scale:.4g} | {term.meaning} |"
        )
    return "\n".join(lines)
