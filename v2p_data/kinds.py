"""The kinds of task: one row each in `KINDS`, read by every room from the caption to the report.

To add a kind: a name in `Kind`, a row in `KINDS`, a template in `task/templates/recipes.py`, a rule in
`task/referee.py`. A row that contradicts itself, or a kind without one of the other parts, stops the import with
one sentence. Left and right are those of the camera: +y of the world is left.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

from v2p_data.errors import V2PError, did_you_mean

Kind = Literal[
    "lift_up",
    "push_left",
    "push_right",
    "tip_over",
    "push_next_to",
    "cover",
    "uncover",
    "push_with",
    "drop_in_front_of",
    "insert",
    "slide_to",
    "throw_into",
    "place_onto",
    "generic",
]
Family = Literal["carry", "push", "tip", "throw", "generic"]
End = Literal[
    "in_air", "on_table", "on_side", "beside", "inside", "on_top", "over", "away", "unknown"
]
Other = Literal["ignored", "needed", "welcome"]
Grasps = Literal["manipulated", "tool", "nothing", "unknown"]
OtherStarts = Literal["anywhere", "under_manipulated", "far_side", "beyond_reach"]

_ENDS_AT_OTHER = ("beside", "inside", "on_top", "over", "away")


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """What an episode of a kind must show and may not show; the referee judges by it."""

    seen: str = ""
    """What must be seen, in words."""
    never: str = ""
    """What must not be seen."""
    moved_m: float = 0.03
    """The robot moves the object at least this far from where it settled."""
    raised_m: float = 0.03
    """What must be grasped is raised by this in the grip."""


@dataclass(frozen=True, kw_only=True)
class TaskKind:
    """What the engine knows of one kind of task.

    Raises:
        ValueError: two of the fields contradict each other.
    """

    name: Kind
    phrases: tuple[tuple[str, str], ...]
    """Pairs of verb and preposition that ask for it, by their names in `video/meaning.py`. An empty preposition
    stands for the verb alone."""
    family: Family
    """How the arm moves."""
    end: End
    """Where the manipulated object is at the end; `beside`, `inside`, `on_top`, `over` and `away` refer to the other
    object."""
    other: Other
    """The second object: `ignored` unless the caption names it, `needed`, or `welcome`."""
    grasps: Grasps
    """What the gripper must hold. `unknown`: the task's own code tells."""
    may_drag: bool = False
    """Grasps nothing, and may drag the object in its grip."""
    meaning: Meaning = Meaning()
    programs: tuple[str, ...] = ()
    """How the names of the preferred scripted policies begin, the best one first."""
    slides: bool = False
    """The manipulated object stays on the table all the way."""
    side: Literal[-1, 0, 1] = 0
    """Direction of the motion along y: 1 to the left, -1 to the right, 0 for no fixed direction."""
    other_starts: OtherStarts = "anywhere"
    """Where the second object may stand when an episode begins."""
    may_end_held: bool = False
    """The clip may end before the object is put down."""
    horizon_steps: int | None = None
    """Control steps (20 Hz) of an episode; without a number, `TaskConfig.horizon_steps`."""
    motion_scale: float = 1.0
    """Factor of the gripper's highest speed, which is 0.6 m/s at 1."""
    end_weight: float = 0.7
    """Weight of the object's look at the end against its look at the start, 0 to 1; less where the other object
    hides a part of it."""

    def __post_init__(self) -> None:
        if self.end in _ENDS_AT_OTHER and self.other != "needed":
            raise ValueError(
                f"task kind '{self.name}' ends {self.end}: its `other` must be needed"
            )
        if self.slides and self.grasps == "manipulated":
            raise ValueError(
                f"task kind '{self.name}' slides: it cannot grasp what it manipulates"
            )
        if not (self.programs or self.family == "generic"):
            raise ValueError(f"task kind '{self.name}' names no scripted policy in `programs`")

    @property
    def comes_near(self) -> bool:
        """Whether the object ends near the other one, without touching it."""
        return self.end == "beside"

    @property
    def locates_other(self) -> bool:
        """Whether the object's path tells where the other one is."""
        return self.comes_near or self.touches or self.starts_over

    @property
    def hides(self) -> bool:
        """Whether the other object may hide the manipulated one at the end."""
        return self.end == "inside"

    @property
    def touches(self) -> bool:
        """Whether the object ends in, on or over the other one."""
        return self.end in ("inside", "on_top", "over")

    @property
    def starts_over(self) -> bool:
        """Whether the object stands over the other one at the start."""
        return self.other_starts == "under_manipulated"

    @property
    def has_cover(self) -> bool:
        """Whether the manipulated object is a cover, open below."""
        return self.end == "over" or self.starts_over

    @property
    def needs_hollow(self) -> bool:
        """Whether one of the objects must be hollow."""
        return self.hides or self.has_cover

    @property
    def must_grasp(self) -> bool:
        """Whether the gripper must take the manipulated object itself."""
        return self.grasps == "manipulated"

    @property
    def grip(self) -> str:
        """What the table says of the gripper."""
        if self.grasps == "nothing":
            return "allowed" if self.may_drag else "never"
        return {"manipulated": "needed", "tool": "of the tool"}.get(self.grasps, "allowed")

    @property
    def is_put_down(self) -> bool:
        """Whether the gripper carries the object to the other one and opens there."""
        return self.family == "carry" and (self.comes_near or self.touches)

    @property
    def stays_upright(self) -> bool:
        """Whether the object must not topple on its way."""
        return self.slides or self.has_cover

    @property
    def may_end_high(self) -> bool:
        """Whether success may be reached high above the table."""
        return self.end in ("in_air", "away", "unknown")


_ROWS = (
    TaskKind(
        name="lift_up",
        phrases=(("push", "up"), ("lift", ""), ("take", "up")),
        family="carry",
        end="in_air",
        other="ignored",
        grasps="manipulated",
        programs=("lift",),
        horizon_steps=60,
        meaning=Meaning(
            seen="held 6 cm above where it settled, steady for 0.25 s",
            never="waved or thrown past that height",
            moved_m=0.06,
            raised_m=0.06,
        ),
    ),
    TaskKind(
        name="push_left",
        phrases=(("push", "left"),),
        family="push",
        end="on_table",
        other="ignored",
        grasps="nothing",
        programs=("push as",),
        slides=True,
        side=1,
        horizon_steps=60,
        meaning=Meaning(
            seen="it slid to the left (+y), at most 0.6 as far forward or back; upright, at rest",
            never="gripped over 2 cm; raised over 1 cm; toppled; held at the end",
            moved_m=0.06,
        ),
    ),
    TaskKind(
        name="push_right",
        phrases=(("push", "right"),),
        family="push",
        end="on_table",
        other="ignored",
        grasps="nothing",
        programs=("push as",),
        slides=True,
        side=-1,
        horizon_steps=60,
        meaning=Meaning(
            seen="it slid to the right (-y), at most 0.6 as far forward or back; upright, at rest",
            never="as `push_left`",
            moved_m=0.06,
        ),
    ),
    TaskKind(
        name="tip_over",
        phrases=(("push", "over"), ("tip", ""), ("poke", "over")),
        family="tip",
        end="on_side",
        other="ignored",
        grasps="nothing",
        programs=("tip",),
        horizon_steps=60,
        meaning=Meaning(
            seen="turned by over 60 degrees, lies on the table at rest",
            never="gripped over 2 cm; raised over 3 cm; held at the end",
            moved_m=0.02,
        ),
    ),
    TaskKind(
        name="push_next_to",
        phrases=(("push", "next"), ("lift", "next"), ("put", "next")),
        family="push",
        end="beside",
        other="needed",
        grasps="nothing",
        programs=("push next",),
        slides=True,
        meaning=Meaning(
            seen="a gap over 3 cm became one below 3 cm; upright, at rest",
            never="as `push_left`; the other object moved 3 cm",
            moved_m=0.02,
        ),
    ),
    TaskKind(
        name="cover",
        phrases=(("cover", ""), ("put", "over")),
        family="carry",
        end="over",
        other="needed",
        grasps="manipulated",
        programs=("put over",),
        end_weight=0.5,
        meaning=Meaning(
            seen="carried; let go upright on the table, centres within 2.5 cm",
            never="pushed after letting go; the other object moved 3 cm",
        ),
    ),
    TaskKind(
        name="uncover",
        phrases=(("uncover", ""),),
        family="carry",
        end="away",
        other="needed",
        grasps="manipulated",
        programs=("lift",),
        other_starts="under_manipulated",
        may_end_held=True,
        meaning=Meaning(
            seen="carried upright from over the other object to beside it, or held 8 cm high",
            never="pushed off; the other object moved 3 cm",
        ),
    ),
    TaskKind(
        name="push_with",
        phrases=(("push", "with"),),
        family="push",
        end="on_table",
        other="needed",
        grasps="tool",
        programs=("push with",),
        slides=True,
        meaning=Meaning(
            seen="the gripped tool was within 3 cm of the object, which slid; upright, at rest",
            never="the arm touched the object; raised over 1 cm; toppled",
            moved_m=0.06,
        ),
    ),
    TaskKind(
        name="drop_in_front_of",
        phrases=(("drop", "front"), ("put", "front")),
        family="carry",
        end="beside",
        other="needed",
        grasps="manipulated",
        programs=("put in front",),
        other_starts="far_side",
        may_end_held=True,
        meaning=Meaning(
            seen="carried; let go; lies on the table within 10 cm of the other object, on the robot's side",
            never="pushed or dragged over half of its way; pushed after letting go; the other object moved 3 cm",
        ),
    ),
    TaskKind(
        name="insert",
        phrases=(
            ("push", "into"),
            ("lift", "into"),
            ("drop", "into"),
            ("put", "into"),
            ("insert", ""),
        ),
        family="carry",
        end="inside",
        other="needed",
        grasps="manipulated",
        programs=("put into",),
        end_weight=0.4,
        meaning=Meaning(
            seen="carried; let go; at rest, its lowest point between floor and rim",
            never="pressed through the floor; pushed after letting go; the container moved 6 cm",
        ),
    ),
    TaskKind(
        name="slide_to",
        phrases=(("push", "to"),),
        family="push",
        end="beside",
        other="needed",
        grasps="nothing",
        programs=("drag next", "push next"),
        slides=True,
        may_drag=True,
        meaning=Meaning(
            seen="a gap over 3 cm became one below 3 cm; upright, at rest",
            never="raised over 1 cm; toppled; held at the end; the other object moved 3 cm",
            moved_m=0.02,
        ),
    ),
    TaskKind(
        name="throw_into",
        phrases=(("throw", "into"),),
        family="throw",
        end="inside",
        other="needed",
        grasps="manipulated",
        programs=("throw",),
        other_starts="beyond_reach",
        motion_scale=2.0,
        end_weight=0.4,
        meaning=Meaning(
            seen="let go in the air, over 10 cm before the rim; in the container, not held",
            never="lowered in; the container moved 6 cm",
            moved_m=0.1,
        ),
    ),
    TaskKind(
        name="place_onto",
        phrases=(("push", "onto"), ("lift", "onto"), ("drop", "onto"), ("put", "onto")),
        family="carry",
        end="on_top",
        other="needed",
        grasps="manipulated",
        programs=("put onto",),
        end_weight=0.5,
        meaning=Meaning(
            seen="carried; let go; at rest on the other object, over its middle part",
            never="pushed after letting go; the other object moved 3 cm",
        ),
    ),
    TaskKind(
        name="generic",
        phrases=(("tip", "into"),),
        family="generic",
        end="unknown",
        other="welcome",
        grasps="unknown",
        may_end_held=True,
        meaning=Meaning(
            seen="moved as far as half of the video's way, ends near the video's place; at rest",
            never="left where it was",
            moved_m=0.0,
        ),
    ),
)

KINDS: dict[Kind, TaskKind] = {row.name: row for row in _ROWS}
"""Every kind of task by its name."""


def meanings_table() -> str:
    """Return what each kind means, as Markdown."""
    lines = [
        "| kind | moved | raised | grip | must be seen | must not be seen |",
        "|---|---|---|---|---|---|",
    ]
    for name, kind in KINDS.items():
        means = kind.meaning
        raised = f"{100 * means.raised_m:g} cm" if kind.must_grasp else ""
        lines.append(
            f"| `{name}` | {100 * means.moved_m:g} cm | {raised} | {kind.grip} | {means.seen} | {means.never} |"
        )
    return "\n".join(lines)


def check_every_kind(known: Collection[str], part: str, where: str) -> None:
    """Demand that a table has an entry for every kind; called when the table's module is loaded.

    Args:
        known: the kinds that the table has.
        part: what the table gives to a kind, e.g. "referee rule".
        where: the table's name and file.

    Raises:
        ValueError: the first kind without an entry, or the first entry without a kind.
    """
    for name in KINDS:
        if name not in known:
            raise ValueError(f"task kind '{name}' has no {part}; add one to {where}")
    for name in known:
        if name not in KINDS:
            raise ValueError(
                f"{where} has a {part} of '{name}'; add that kind to v2p_data/kinds.py"
            )


def kind_named(name: str, where: str) -> Kind:
    """Return a name as a kind.

    Args:
        name: as it was read.
        where: what to name in the error, e.g. the file.

    Raises:
        V2PError: there is no such kind.
    """
    for kind in KINDS:
        if kind == name:
            return kind
    raise V2PError(f"{where}: there is no task kind '{name}'.{did_you_mean(name, KINDS)}")


check_every_kind(get_args(Kind), "name", "`Kind` in v2p_data/kinds.py")
