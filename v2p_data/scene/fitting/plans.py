"""How an object is fitted at the start, at the end and between: one plan per kind of task."""

from dataclasses import dataclass
from typing import Literal

from v2p_data.kinds import KINDS, Kind, TaskKind


@dataclass(frozen=True, kw_only=True)
class FitPlan:
    """What a kind of task says of the manipulated object's rest, motion and end."""

    end: Literal["on_table", "in_air", "tipped"] = "on_table"
    """How the object is at its last pose; `on_table` includes resting in or on the other object."""
    goal: Literal["anywhere", "inside", "on_top"] = "anywhere"
    """Where the object comes to rest: in the other object, over its top, or wherever the outline says."""
    slides: bool = False
    """The object keeps its height all the way."""
    may_end_held: bool = False
    """The clip may end before the object is put down: then it is fitted in the air where that
    covers its outline better."""
    may_be_hidden: bool = False
    """The goal may hide the object at the end: then it is taken to lie in the goal's middle."""
    starts_on_other: bool = False
    """The object covers the other one at first: a lid lies on top of it."""
    mouth_first: Literal["as_usual", "down", "down_or_up"] = "as_usual"
    """How a hollow object rests at first."""
    mouth_last: Literal["as_first", "down", "down_or_up"] = "as_first"
    """How a hollow object rests at the end."""


TOOL = FitPlan(slides=True)
"""For what a hand moves beside the manipulated object."""
STATIC = FitPlan()
"""For static objects."""


def plan_of(kind: Kind) -> FitPlan:
    """Return the plan of a kind of task."""
    row = KINDS[kind]
    covers = row.end == "over"
    return FitPlan(
        end=_end_of(row),
        goal=_goal_of(row),
        slides=row.slides,
        may_end_held=row.may_end_held,
        may_be_hidden=row.hides,
        starts_on_other=row.starts_over,
        mouth_first="down" if row.starts_over else "down_or_up" if covers else "as_usual",
        mouth_last="down_or_up" if row.starts_over else "down" if covers else "as_first",
    )


def _end_of(row: TaskKind) -> Literal["on_table", "in_air", "tipped"]:
    if row.end == "in_air":
        return "in_air"
    return "tipped" if row.end == "on_side" else "on_table"


def _goal_of(row: TaskKind) -> Literal["anywhere", "inside", "on_top"]:
    if row.end == "over":
        return "on_top"
    return "inside" if row.touches else "anywhere"
