"""Who plays in a drawn clip and what is said of it: captions, cast, and where things stand and go."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from drawn_clips.props import NOUNS, Noun, Prop, prop_called, shape_of
from v2p_data.video.meaning import Kind

MotionKind = Literal[
    "push_left",
    "push_right",
    "lift_up",
    "tip_over",
    "cover",
    "uncover",
    "push_with",
    "push_next_to",
    "drop_in_front_of",
    "insert",
    "slide_to",
    "throw_into",
    "place_onto",
]
MOTION_KINDS: tuple[MotionKind, ...] = (
    "push_left",
    "push_right",
    "lift_up",
    "tip_over",
    "cover",
    "uncover",
    "push_with",
    "push_next_to",
    "drop_in_front_of",
    "insert",
    "slide_to",
    "throw_into",
    "place_onto",
)
Role = Literal["manipulated", "reference", "tool", "container", "cover", "bystander"]

CAPTIONS: dict[Kind, tuple[str, ...]] = {
    "push_left": (
        "Pushing {a} from right to left",
        "Moving {a} from right to left",
        "Pushing {a} to the left",
        "Sliding {a} to the left",
        "Pulling {a} from right to left",
    ),
    "push_right": (
        "Pushing {a} from left to right",
        "Moving {a} from left to right",
        "Pushing {a} to the right",
        "Sliding {a} to the right",
        "Pulling {a} from left to right",
    ),
    "lift_up": (
        "Lifting {a} up",
        "Picking {a} up",
        "Lifting up {a}",
        "Lifting {a}",
        "Raising {a}",
    ),
    "tip_over": (
        "Tipping {a} over",
        "Pushing {a} over",
        "Knocking {a} over",
        "Tipping over {a}",
        "Pushing {a} so that it falls over",
    ),
    "cover": ("Covering {b} with {a}", "Putting {a} over {b}", "Covering {b} using {a}"),
    "uncover": (
        "Uncovering {b} by lifting {a}",
        "Lifting {a} up to reveal {b}",
        "Lifting {a}, revealing {b}",
        "Uncovering {b}",
    ),
    "push_with": ("Pushing {a} with {b}", "Moving {a} with {b}", "Pushing {a} using {b}"),
    "push_next_to": (
        "Pushing {a} next to {b}",
        "Moving {a} closer to {b}",
        "Moving {a} next to {b}",
        "Pushing {a} close to {b}",
    ),
    "drop_in_front_of": ("Dropping {a} in front of {b}", "Putting {a} in front of {b}"),
    "insert": (
        "Putting {a} into {b}",
        "Dropping {a} into {b}",
        "Placing {a} in {b}",
        "Putting {a} inside {b}",
    ),
    "slide_to": (
        "Sliding {a} to {b}",
        "Sliding {a} towards {b}",
        "Pushing {a} towards {b}",
        "Moving {a} towards {b}",
    ),
    "throw_into": ("Throwing {a} into {b}", "Tossing {a} into {b}", "Throwing {a} in {b}"),
    "place_onto": (
        "Putting {a} onto {b}",
        "Placing {a} on {b}",
        "Putting {a} on top of {b}",
        "Placing {a} on top of {b}",
        "Stacking {a} on {b}",
    ),
}
"""Wordings after Something-Something v2's templates; a moves, b is the other thing."""

GRIP_MAX_M = 0.088


@dataclass(frozen=True, kw_only=True)
class Actor:
    """A thing with its part."""

    prop: Prop
    role: Role
    phrase: str | None = None
    """As the caption calls it."""
    xy_m: tuple[float, float] = (0.0, 0.0)
    """Where its bounding box's middle stands at first."""
    bottom_m: float = 0.0
    """How high it stands at first."""
    yaw_rad: float = 0.0
    upside_down: bool = False

    @property
    def extents_m(self) -> Float[np.ndarray, "3"]:
        return shape_of(self.prop).extents

    @property
    def radius_m(self) -> float:
        """Half its width on the table, handles and all."""
        return float(
            np.hypot(*self.extents_m[:2]) / 2
            if self.prop.symmetry in ("box", "none")
            else self.extents_m[:2].max() / 2
        )


@dataclass(frozen=True, kw_only=True)
class Story:
    """What happens with what."""

    kind: MotionKind
    caption: str
    actors: tuple[Actor, ...]
    """The one that moves first, then the others of the caption, then bystanders."""
    target_xy_m: tuple[float, float] = (0.0, 0.0)
    """Where the moving thing's middle ends on the table."""
    target_bottom_m: float = 0.0
    """How high it stands in the end."""
    turn_rad: float = 0.0
    """How much it turns about the vertical on its way."""
    lift_m: float = 0.12
    """How high it is carried."""


def random_story(
    kind: MotionKind, rng: np.random.Generator, others: int, arm_azimuth_rad: float = 3.5
) -> Story:
    """Return a cast with places for one kind of clip, a caption, and up to `others` bystanders."""
    a, b = _cast(kind, rng)
    wordings = CAPTIONS[kind]
    wording = wordings[int(rng.integers(len(wordings)))]
    says_colour = rng.random(2) < 0.6
    phrase_a = _phrase(a, bool(says_colour[0]))
    phrase_b = _phrase(b, bool(says_colour[1])) if b is not None else ""
    caption = wording.format(a=phrase_a, b=phrase_b)
    role: dict[str, Role] = {"insert": "container", "throw_into": "container", "push_with": "tool"}
    first = Actor(
        prop=a,
        role="cover" if kind in ("cover", "uncover") else "manipulated",
        phrase=phrase_a if "{a}" in wording else None,
        yaw_rad=_yaw(a, rng),
    )
    second = None
    if b is not None:
        second = Actor(
            prop=b, role=role.get(kind, "reference"), phrase=phrase_b, yaw_rad=_yaw(b, rng)
        )
    if a.kind == "mug" and not kind.startswith(("push", "slide")):
        # the handle stays out of the palm
        handle = arm_azimuth_rad + np.pi + rng.uniform(-1.0, 1.0)
        first = replace(
            first,
            yaw_rad=float(handle + (-np.pi / 2 if kind in ("cover", "uncover") else np.pi / 2)),
        )
    if kind == "tip_over":
        first = replace(first, yaw_rad=float(rng.uniform(-np.pi, np.pi)))
    story = _placed(kind, caption, first, second, rng)
    return replace(story, actors=(*story.actors, *_bystanders(story, rng, others)))


def _phrase(prop: Prop, with_colour: bool) -> str:
    clear = prop.print not in ("photo", "checker", "wood", "gradient") and prop.noun not in (
        "orange",
        "wooden block",
    )
    return f"{prop.colour_word} {prop.noun}" if with_colour and clear else prop.noun


def _yaw(prop: Prop, rng: np.random.Generator) -> float:
    return float(
        rng.uniform(-np.pi, np.pi)
        if rng.random() < 0.35 or prop.symmetry == "none"
        else rng.normal(0, 0.25)
    )


def _some(rng: np.random.Generator, fits, but: str = "") -> Prop:  # noqa: ANN001
    """Return a thing that fits, of another noun than `but`."""
    rows: list[Noun] = [n for n in NOUNS if not set(n.words) & set(but.split("|"))]
    for _ in range(400):
        prop = prop_called(rows[int(rng.integers(len(rows)))], rng)
        if fits(prop):
            return prop
    raise ValueError("no thing of the table of products fits this part")


def _words(prop: Prop) -> str:
    """Return the words of all products that share this one's noun."""
    return "|".join({w for n in NOUNS if prop.noun in n.words for w in n.words})


def _graspable(p: Prop) -> bool:
    return p.kind not in ("stick", "spoon", "pan", "pot", "lid", "coaster") and (
        min(p.size_m[:2]) < GRIP_MAX_M or p.hollow
    )


def _small(p: Prop) -> bool:
    return _graspable(p) and not p.hollow and max(p.size_m) < 0.12 and p.size_m[2] < 0.09


def _cast(kind: MotionKind, rng: np.random.Generator) -> tuple[Prop, Prop | None]:
    rolls = ("ball", "stick", "spoon")
    if kind in ("push_left", "push_right"):
        return _some(
            rng,
            lambda p: (
                p.kind not in (*rolls, "pan", "lid") and p.size_m[2] < 1.7 * min(p.size_m[:2])
            ),
        ), None
    if kind == "lift_up":
        return _some(rng, _graspable), None
    if kind == "tip_over":
        return _some(
            rng,
            lambda p: (
                p.kind in ("box", "can", "bottle", "jar")
                and p.size_m[2] > 1.35 * p.size_m[0]
                and p.size_m[2] > 0.08
            ),
        ), None
    if kind in ("cover", "uncover"):
        a = _some(
            rng,
            lambda p: (p.kind in ("cup", "mug", "bowl") and p.size_m[0] < 0.19) or p.kind == "lid",
        )
        if a.kind == "lid":
            b = _some(
                rng, lambda p: p.kind == "pot" or (p.kind == "bowl" and 0.13 < p.size_m[0] < 0.2)
            )
            wide = b.size_m[0] + 0.008
            return replace(a, size_m=(wide, wide, a.size_m[2])), b
        room = a.mouth_m() if a.kind != "bowl" else 0.7 * a.size_m[0]
        high = a.size_m[2] - 0.012 if a.kind != "bowl" else 0.7 * a.size_m[2]
        return a, _some(
            rng,
            lambda p: (
                not p.hollow
                and p.kind not in ("stick", "spoon", "lid")
                and np.hypot(*p.size_m[:2]) < room
                and p.size_m[2] < high
            ),
            _words(a),
        )
    if kind == "push_with":
        a = _some(
            rng,
            lambda p: (
                p.kind not in (*rolls, "pan", "lid", "coaster")
                and p.size_m[2] < 1.5 * min(p.size_m[:2])
                and p.size_m[2] > 0.012
                and max(p.size_m) < 0.2
            ),
        )
        return a, _some(rng, lambda p: p.kind in ("stick", "spoon"))
    if kind in ("push_next_to", "slide_to"):
        a = _some(
            rng,
            lambda p: (
                p.kind not in (*rolls, "pan", "lid")
                and p.size_m[2] < 1.6 * min(p.size_m[:2])
                and max(p.size_m) < 0.2
            ),
        )
        return a, _some(rng, lambda p: p.kind not in (*rolls, "coaster"), _words(a))
    if kind == "drop_in_front_of":
        a = _some(rng, lambda p: _small(p) and p.kind != "ball")
        return a, _some(rng, lambda p: p.kind not in ("stick", "spoon", "coaster"), _words(a))
    if kind in ("insert", "throw_into"):
        a = _some(rng, _small)
        if kind == "throw_into":
            b = _some(
                rng,
                lambda p: (
                    p.kind in ("bin", "bowl", "pot")
                    and p.mouth_m() > np.hypot(*a.size_m[:2]) + 0.015
                ),
                _words(a),
            )
        else:
            b = _some(
                rng,
                lambda p: (
                    p.hollow
                    and p.kind != "plate"
                    and p.mouth_m() > np.hypot(*a.size_m[:2]) + 0.004
                ),
                _words(a),
            )
        return a, b
    a = _some(
        rng,
        lambda p: (
            _graspable(p)
            and p.kind not in ("bin", "plate")
            and max(p.size_m[:2]) < 0.2
            and p.size_m[2] < 0.22
        ),
    )
    foot = np.hypot(*a.size_m[:2]) if a.symmetry == "box" else max(a.size_m[:2])

    def carries(p: Prop) -> bool:
        if p.kind in ("plate",) or p.noun == "tray":
            return p.mouth_m() > foot
        return (
            p.kind in ("book", "coaster", "box")
            and p.size_m[2] < 0.09
            and min(p.size_m[:2]) > 0.8 * min(a.size_m[:2])
        )

    if a.kind == "ball":
        return a, _some(rng, lambda p: p.kind == "plate" and p.mouth_m() > foot, _words(a))
    return a, _some(rng, carries, _words(a))


def _placed(
    kind: MotionKind, caption: str, a: Actor, b: Actor | None, rng: np.random.Generator
) -> Story:
    """Return the story with start and end places."""
    away = float(rng.uniform(0, 2 * np.pi))
    turn = float(rng.normal(0, 0.15))
    if b is None:
        if kind == "push_left" or kind == "push_right":
            sign = 1 if kind == "push_left" else -1
            to = (float(rng.normal(0, 0.02)), sign * float(rng.uniform(0.09, 0.26)))
            return Story(kind=kind, caption=caption, actors=(a,), target_xy_m=to, turn_rad=turn)
        return Story(
            kind=kind,
            caption=caption,
            actors=(a,),
            turn_rad=turn,
            lift_m=float(rng.uniform(0.08, 0.22)),
            target_xy_m=(float(rng.normal(0, 0.03)), float(rng.normal(0, 0.03))),
        )
    gap = float(rng.uniform(0.04, 0.16))
    far = a.radius_m + b.radius_m + gap
    there = (far * np.cos(away), far * np.sin(away))
    direction = np.array([np.cos(away), np.sin(away)])
    lift = float(rng.uniform(0.05, 0.10))
    if kind == "cover":
        lid = a.prop.kind == "lid"
        a = replace(a, upside_down=not lid)
        bottom = (
            b.extents_m[2] - 0.001
            if lid and b.prop.kind == "bowl"
            else b.prop.size_m[2] - 0.001
            if lid
            else 0.0
        )
        b = replace(b, xy_m=there)
        body = _body(b) if lid else np.array(there)
        own = body - (_body(a) - np.array(a.xy_m))
        return Story(
            kind=kind,
            caption=caption,
            actors=(a, b),
            target_bottom_m=float(bottom),
            target_xy_m=(float(own[0]), float(own[1])),
            turn_rad=0.0 if a.prop.kind == "mug" else turn,
            lift_m=lift + b.extents_m[2],
        )
    if kind == "uncover":
        lid = a.prop.kind == "lid"
        a = replace(a, upside_down=not lid, bottom_m=b.prop.size_m[2] - 0.001 if lid else 0.0)
        inside = (_body(a) - np.array(a.xy_m)) - (_body(b) - np.array(b.xy_m) if lid else 0.0)
        b = replace(b, xy_m=(float(inside[0]), float(inside[1])))
        return Story(
            kind=kind,
            caption=caption,
            actors=(a, b),
            target_xy_m=there,
            turn_rad=turn,
            lift_m=lift + b.extents_m[2],
        )
    if kind == "push_with":
        far = float(rng.uniform(0.08, 0.2))
        to = direction * far
        return Story(
            kind=kind,
            caption=caption,
            actors=(a, b),
            target_xy_m=(float(to[0]), float(to[1])),
            turn_rad=0.0,
        )
    if kind in ("push_next_to", "slide_to"):
        travel = float(rng.uniform(0.08, 0.22))
        left = float(rng.uniform(0.003, 0.025)) + _reach(a, direction) + _reach(b, -direction)
        if kind == "slide_to":
            travel, left = travel + 0.05, left + float(rng.uniform(0, 0.03))
        to, at = direction * travel, direction * (travel + left)
        b = replace(b, xy_m=(float(at[0]), float(at[1])))
        return Story(
            kind=kind,
            caption=caption,
            actors=(a, b),
            target_xy_m=(float(to[0]), float(to[1])),
            turn_rad=0.0,
        )
    b = replace(b, xy_m=(float(there[0]), float(there[1])))
    if kind == "drop_in_front_of":
        to = (
            there[0] - a.radius_m - b.radius_m - float(rng.uniform(0.01, 0.04)),
            there[1] + float(rng.normal(0, 0.015)),
        )
        return Story(
            kind=kind,
            caption=caption,
            actors=(a, b),
            target_xy_m=(float(to[0]), float(to[1])),
            turn_rad=turn,
            lift_m=float(rng.uniform(0.08, 0.14)),
        )
    to = _body(b) - (_body(a) - np.array(a.xy_m)) + rng.normal(0, 0.003, 2)
    bottom = b.prop.floor_m()
    return Story(
        kind=kind,
        caption=caption,
        actors=(a, b),
        target_xy_m=(float(to[0]), float(to[1])),
        target_bottom_m=float(bottom),
        turn_rad=turn,
        lift_m=b.extents_m[2] + lift,
    )


def _body(actor: Actor) -> Float[np.ndarray, "2"]:
    """Return where the body's axis stands: a handle moves the bounding box's middle away from it."""
    raw = handle_offset_m(actor.prop)
    c, s = np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)
    if actor.upside_down:
        raw = raw * (1, -1)
    return np.array(actor.xy_m) + np.array([c * raw[0] - s * raw[1], s * raw[0] + c * raw[1]])


def handle_offset_m(prop: Prop) -> Float[np.ndarray, "2"]:
    """Return the body's axis in the frame of the bounding box's middle."""
    if prop.kind not in ("mug", "pan"):
        return np.zeros(2)
    across = shape_of(prop).extents[1]
    return np.array([0.0, across / 2 - prop.size_m[0] / 2])


def _reach(actor: Actor, direction: Float[np.ndarray, "2"]) -> float:
    """Return how far the thing reaches from its middle in this direction."""
    half = actor.extents_m[:2] / 2
    c, s = np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)
    own = np.array([c * direction[0] + s * direction[1], -s * direction[0] + c * direction[1]])
    if actor.prop.symmetry == "round":
        return float(half.max())
    return float(np.abs(own) @ half)


def _bystanders(story: Story, rng: np.random.Generator, count: int) -> list[Actor]:
    """Return things that stand about, clear of where the others stand and go."""
    used = "|".join(_words(actor.prop) for actor in story.actors)
    found: list[Actor] = []
    stones = [(np.array(x.xy_m), x.radius_m) for x in story.actors]
    first, radius = story.actors[0], story.actors[0].radius_m
    if story.kind == "push_with":
        stones = stones[:1]
    reach = radius + (first.extents_m[2] if story.kind == "tip_over" else 0.0)
    stones += [
        (np.array(first.xy_m) + t * (np.array(story.target_xy_m) - first.xy_m), reach)
        for t in np.linspace(0, 1, 5)
    ]
    for _ in range(30 * count):
        if len(found) == count:
            break
        prop = _some(rng, lambda p: p.kind not in ("pan",), used)
        at = rng.uniform((-0.12, -0.38), (0.5, 0.38))
        actor = Actor(
            prop=prop, role="bystander", xy_m=(float(at[0]), float(at[1])), yaw_rad=_yaw(prop, rng)
        )
        if all(np.hypot(*(at - xy)) > r + actor.radius_m + 0.03 for xy, r in stones):
            found.append(actor)
            stones.append((at, actor.radius_m))
            used += "|" + _words(prop)
    return found
