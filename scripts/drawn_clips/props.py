"""The things of drawn clips: nouns with true shapes, sizes of real products, and what is printed on them.

Sizes are nominal sizes of products in centimetres, drawn up for this table alone: "YCB" is the YCB object set
(Calli et al. 2015, table 1); "product" is the maker's stated size of a common product; "standard" a standardised
size. Real things vary about them by `spread`. Nothing here may be taken from the nouns that reconstruction
uses, for the truth must not know its judge.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from drawn_clips.shapes import (
    Shape,
    bin_shape,
    box,
    centred,
    ellipsoid,
    flat_print,
    joined,
    moved,
    revolved,
    tube,
)
from drawn_clips.textures import PRINTS, Print, Rgb, any_colour, colour_called

Form = Literal["box", "cylinder", "sphere", "mesh"]
Symmetry = Literal["none", "box", "round", "sphere"]
Kind = Literal[
    "box",
    "book",
    "bin",
    "can",
    "cup",
    "mug",
    "bowl",
    "plate",
    "jar",
    "bottle",
    "pot",
    "pan",
    "lid",
    "coaster",
    "ball",
    "duck",
    "stick",
    "spoon",
]


@dataclass(frozen=True, kw_only=True)
class Noun:
    """One row of the table of products."""

    words: tuple[str, ...]
    kind: Kind
    size_cm: tuple[float, float, float]
    """Length (deep), width (across) and height as it stands on a table; the body's, without handles."""
    spread: float = 0.06
    colours: tuple[str, ...] = ()
    """Which colours it comes in; any where empty."""
    prints: tuple[Print, ...] = PRINTS
    source: str = "product"


_PAPER: tuple[Print, ...] = ("label", "label", "label", "photo", "stripes", "gradient", "plain")
_PLAIN: tuple[Print, ...] = ("plain", "plain", "plain", "gradient", "speckle")
_CHINA: tuple[Print, ...] = ("plain", "plain", "stripes", "speckle", "label", "gradient", "photo")

NOUNS: tuple[Noun, ...] = (
    Noun(
        words=("cracker box", "box"),
        kind="box",
        size_cm=(6.0, 15.8, 21.0),
        prints=_PAPER,
        source="YCB",
    ),
    Noun(
        words=("cereal box", "box"),
        kind="box",
        size_cm=(5.5, 19.0, 27.5),
        prints=_PAPER,
        source="product, 375 g",
    ),
    Noun(
        words=("tea box", "box"),
        kind="box",
        size_cm=(7.0, 13.0, 8.0),
        prints=_PAPER,
        spread=0.1,
        source="product, 50 bags",
    ),
    Noun(
        words=("pudding box", "small box"),
        kind="box",
        size_cm=(3.8, 11.0, 8.9),
        prints=_PAPER,
        source="YCB",
    ),
    Noun(
        words=("sugar box", "box"),
        kind="box",
        size_cm=(3.8, 8.9, 17.5),
        prints=_PAPER,
        source="YCB",
    ),
    Noun(
        words=("milk carton", "carton"),
        kind="box",
        size_cm=(7.1, 7.1, 19.5),
        prints=_PAPER,
        source="product, 1 l",
    ),
    Noun(
        words=("juice carton", "carton"),
        kind="box",
        size_cm=(4.0, 6.3, 11.5),
        prints=_PAPER,
        source="product, 200 ml",
    ),
    Noun(
        words=("book",),
        kind="book",
        size_cm=(13.0, 19.8, 2.4),
        spread=0.15,
        prints=_PAPER,
        source="standard, B format",
    ),
    Noun(
        words=("notebook",),
        kind="book",
        size_cm=(14.8, 21.0, 1.2),
        spread=0.08,
        prints=("plain", "label", "photo"),
        source="standard, A5",
    ),
    Noun(
        words=("phone", "mobile phone"),
        kind="book",
        size_cm=(7.2, 14.7, 0.8),
        spread=0.05,
        colours=("black", "white", "grey", "blue", "red"),
        prints=("plain", "photo"),
    ),
    Noun(
        words=("wallet",),
        kind="book",
        size_cm=(9.0, 11.2, 1.8),
        spread=0.1,
        colours=("brown", "black", "red", "grey"),
        prints=_PLAIN,
    ),
    Noun(
        words=("soap", "soap bar"),
        kind="book",
        size_cm=(5.8, 9.0, 2.9),
        spread=0.1,
        prints=_PLAIN,
        source="product, 100 g",
    ),
    Noun(
        words=("sponge",),
        kind="book",
        size_cm=(7.0, 11.0, 3.5),
        spread=0.1,
        colours=("yellow", "blue", "green", "pink"),
        prints=("speckle", "plain"),
    ),
    Noun(words=("matchbox",), kind="book", size_cm=(3.5, 5.3, 1.5), prints=_PAPER),
    Noun(
        words=("card box", "deck of cards"),
        kind="book",
        size_cm=(6.4, 8.9, 1.9),
        spread=0.03,
        prints=_PAPER,
        source="standard, poker",
    ),
    Noun(
        words=("wooden block", "block"),
        kind="box",
        size_cm=(5.0, 5.0, 5.0),
        spread=0.2,
        prints=("wood", "plain"),
    ),
    Noun(
        words=("rubik's cube", "cube"),
        kind="box",
        size_cm=(5.7, 5.7, 5.7),
        spread=0.02,
        prints=("checker",),
        source="YCB",
    ),
    Noun(
        words=("eraser",),
        kind="book",
        size_cm=(2.0, 4.3, 1.2),
        spread=0.12,
        colours=("white", "pink", "blue", "green"),
        prints=("plain", "label"),
    ),
    Noun(
        words=("can", "soda can"),
        kind="can",
        size_cm=(6.6, 6.6, 12.2),
        spread=0.02,
        prints=_PAPER,
        source="standard, 330 ml",
    ),
    Noun(
        words=("soup can", "can"),
        kind="can",
        size_cm=(6.8, 6.8, 10.1),
        spread=0.04,
        prints=_PAPER,
        source="YCB",
    ),
    Noun(
        words=("tuna can", "tin"),
        kind="can",
        size_cm=(8.5, 8.5, 3.3),
        spread=0.04,
        prints=_PAPER,
        source="YCB",
    ),
    Noun(
        words=("tape", "roll of tape"),
        kind="can",
        size_cm=(7.5, 7.5, 2.0),
        spread=0.15,
        prints=_PLAIN,
    ),
    Noun(words=("candle",), kind="can", size_cm=(6.0, 6.0, 8.0), spread=0.2, prints=_PLAIN),
    Noun(
        words=("mug",),
        kind="mug",
        size_cm=(8.2, 8.2, 9.5),
        spread=0.07,
        prints=_CHINA,
        source="product, 330 ml",
    ),
    Noun(
        words=("coffee mug", "mug"),
        kind="mug",
        size_cm=(8.0, 8.0, 8.2),
        spread=0.05,
        prints=_CHINA,
        source="YCB",
    ),
    Noun(
        words=("cup", "plastic cup"),
        kind="cup",
        size_cm=(7.8, 7.8, 9.5),
        spread=0.1,
        prints=_PLAIN,
    ),
    Noun(
        words=("paper cup", "cup"),
        kind="cup",
        size_cm=(8.0, 8.0, 9.2),
        spread=0.06,
        prints=("plain", "label", "stripes"),
        source="product, 240 ml",
    ),
    Noun(
        words=("tumbler", "glass"), kind="cup", size_cm=(7.4, 7.4, 11.5), spread=0.1, prints=_PLAIN
    ),
    Noun(
        words=("bowl",),
        kind="bowl",
        size_cm=(15.9, 15.9, 5.3),
        spread=0.12,
        prints=_CHINA,
        source="YCB",
    ),
    Noun(
        words=("salad bowl", "bowl"),
        kind="bowl",
        size_cm=(21.0, 21.0, 8.5),
        spread=0.08,
        prints=_CHINA,
    ),
    Noun(
        words=("plate",),
        kind="plate",
        size_cm=(21.0, 21.0, 2.2),
        spread=0.12,
        prints=_CHINA,
        source="product, side plate",
    ),
    Noun(
        words=("saucer", "small plate"),
        kind="plate",
        size_cm=(14.8, 14.8, 1.9),
        spread=0.06,
        prints=_CHINA,
    ),
    Noun(
        words=("jar",),
        kind="jar",
        size_cm=(7.5, 7.5, 10.5),
        spread=0.1,
        prints=_PAPER,
        source="product, 370 ml",
    ),
    Noun(
        words=("bottle", "plastic bottle"),
        kind="bottle",
        size_cm=(6.5, 6.5, 21.0),
        spread=0.05,
        prints=_PAPER,
        source="product, 500 ml",
    ),
    Noun(
        words=("mustard bottle", "bottle"),
        kind="bottle",
        size_cm=(5.8, 9.0, 19.0),
        spread=0.03,
        colours=("yellow", "red"),
        prints=("label", "plain"),
        source="YCB",
    ),
    Noun(
        words=("pot", "saucepan"),
        kind="pot",
        size_cm=(16.0, 16.0, 8.5),
        spread=0.1,
        colours=("grey", "black", "red", "white", "blue"),
        prints=("plain",),
    ),
    Noun(
        words=("pan", "frying pan"),
        kind="pan",
        size_cm=(20.0, 20.0, 4.2),
        spread=0.1,
        colours=("black", "grey", "red"),
        prints=("plain",),
    ),
    Noun(
        words=("lid", "pot lid"),
        kind="lid",
        size_cm=(17.5, 17.5, 4.8),
        spread=0.08,
        colours=("grey", "black", "red", "white", "blue"),
        prints=("plain", "gradient"),
    ),
    Noun(
        words=("coaster",),
        kind="coaster",
        size_cm=(9.5, 9.5, 0.6),
        spread=0.06,
        prints=("wood", "plain", "photo", "stripes"),
    ),
    Noun(
        words=("apple",),
        kind="ball",
        size_cm=(7.5, 7.5, 7.2),
        spread=0.06,
        colours=("red", "green", "yellow"),
        prints=("gradient", "plain"),
        source="YCB",
    ),
    Noun(
        words=("orange",),
        kind="ball",
        size_cm=(7.3, 7.3, 7.3),
        spread=0.05,
        colours=("orange",),
        prints=("plain",),
        source="YCB",
    ),
    Noun(
        words=("lemon",),
        kind="ball",
        size_cm=(5.4, 6.8, 5.4),
        spread=0.07,
        colours=("yellow",),
        prints=("plain",),
        source="YCB",
    ),
    Noun(
        words=("egg",),
        kind="ball",
        size_cm=(4.4, 5.7, 4.4),
        spread=0.05,
        colours=("white", "brown"),
        prints=("plain",),
    ),
    Noun(
        words=("ball", "tennis ball"),
        kind="ball",
        size_cm=(6.5, 6.5, 6.5),
        spread=0.04,
        prints=("plain", "speckle", "stripes"),
        source="YCB",
    ),
    Noun(
        words=("ball", "rubber ball"),
        kind="ball",
        size_cm=(4.8, 4.8, 4.8),
        spread=0.2,
        prints=("plain", "photo", "stripes"),
    ),
    Noun(
        words=("bin", "trash bin"),
        kind="bin",
        size_cm=(15.0, 17.0, 18.0),
        spread=0.12,
        prints=_PLAIN,
    ),
    Noun(
        words=("container", "plastic container"),
        kind="bin",
        size_cm=(12.0, 16.0, 7.0),
        spread=0.12,
        prints=_PLAIN,
    ),
    Noun(
        words=("basket",),
        kind="bin",
        size_cm=(18.0, 24.0, 10.0),
        spread=0.12,
        prints=("checker", "stripes", "wood", "plain"),
    ),
    Noun(
        words=("tray",),
        kind="bin",
        size_cm=(20.0, 28.0, 3.0),
        spread=0.1,
        prints=("wood", "plain", "stripes"),
    ),
    Noun(
        words=("toy duck", "duck", "rubber duck"),
        kind="duck",
        size_cm=(7.0, 8.5, 7.8),
        spread=0.15,
        colours=("yellow", "pink", "blue", "green"),
        prints=("plain",),
    ),
    Noun(
        words=("ruler",),
        kind="stick",
        size_cm=(3.0, 31.0, 0.3),
        spread=0.05,
        prints=("plain", "wood", "stripes"),
        source="standard, 30 cm",
    ),
    Noun(
        words=("stick", "wooden stick"),
        kind="stick",
        size_cm=(1.2, 30.0, 1.2),
        spread=0.15,
        colours=("brown", "yellow"),
        prints=("wood",),
    ),
    Noun(
        words=("pen",),
        kind="stick",
        size_cm=(1.1, 14.5, 1.1),
        spread=0.05,
        prints=("plain", "stripes"),
    ),
    Noun(
        words=("pencil",),
        kind="stick",
        size_cm=(0.75, 17.5, 0.75),
        spread=0.05,
        prints=("plain", "stripes"),
    ),
    Noun(
        words=("spoon",),
        kind="spoon",
        size_cm=(4.0, 19.0, 2.0),
        spread=0.08,
        colours=("grey", "white", "brown"),
        prints=("plain",),
    ),
    Noun(
        words=("wooden spoon", "spoon"),
        kind="spoon",
        size_cm=(5.5, 30.0, 2.2),
        spread=0.08,
        colours=("brown", "yellow"),
        prints=("wood",),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Prop:
    """One thing: which product, how big this one is, and how it looks."""

    noun: str
    """The words people use for it."""
    kind: Kind
    size_m: tuple[float, float, float]
    """The body's extents, without handles."""
    colour_word: str = ""
    print: Print = "plain"
    base: Rgb = (0.5, 0.5, 0.5)
    accent: Rgb = (0.9, 0.9, 0.9)
    second: Rgb = (0.8, 0.8, 0.8)
    detail: Rgb = (0.3, 0.3, 0.3)
    specular: float = 0.2
    shape_draw: float = 0.5
    """From 0 to 1: where between its kind's extremes the shape lies (taper, roundness)."""

    @property
    def hollow(self) -> bool:
        return self.kind in {"bin", "cup", "mug", "bowl", "plate", "pot", "pan"}

    @property
    def symmetry(self) -> Symmetry:
        if self.kind == "ball":
            return "sphere" if len({round(s, 4) for s in self.size_m}) == 1 else "round"
        if self.kind in {"box", "book", "bin", "coaster", "stick"}:
            return "round" if self.kind == "coaster" and self.shape_draw < 0.6 else "box"
        flat = self.kind == "bottle" and abs(self.size_m[0] - self.size_m[1]) > 1e-6
        return "none" if flat or self.kind in {"mug", "pot", "pan", "duck", "spoon"} else "round"

    @property
    def form(self) -> Form:
        if self.kind == "ball":
            return "sphere"
        if self.kind == "coaster":
            return "cylinder" if self.symmetry == "round" else "box"
        forms: dict[str, Form] = {
            "box": "box",
            "book": "box",
            "bin": "box",
            "stick": "box",
            "can": "cylinder",
        }
        return forms.get(self.kind, "mesh")

    def floor_m(self) -> float:
        """Return the height of the floor inside a hollow thing; the whole height of a solid one."""
        return wall_m(self) * 1.5 if self.hollow else self.size_m[2]

    def mouth_m(self) -> float:
        """Return the width that fits through a hollow thing's mouth, and down to its floor."""
        wall, x = wall_m(self), min(self.size_m[:2])
        floors = {
            "bowl": 0.62,
            "plate": 0.62,
            "cup": 0.78,
            "mug": 0.9,
            "pot": 0.95,
            "pan": 0.85,
            "bin": 0.84,
        }
        return floors.get(self.kind, 1.0) * x - 2 * wall


def wall_m(prop: Prop) -> float:
    """Return how thick a hollow thing's wall is."""
    thick = {
        "mug": 0.0042,
        "bowl": 0.004,
        "plate": 0.004,
        "cup": 0.0018,
        "bin": 0.0028,
        "pot": 0.003,
        "pan": 0.003,
    }
    return thick.get(prop.kind, 0.003)


def prop_called(noun: Noun, rng: np.random.Generator) -> Prop:
    """Return one specimen of a product with its look drawn at random."""
    common, each = rng.normal(0, noun.spread), rng.normal(0, noun.spread / 2, 3)
    factor = (1 + common + each).clip(1 - 2.5 * noun.spread, 1 + 2.5 * noun.spread)
    size = np.array(noun.size_cm) / 100 * factor
    if noun.size_cm[0] == noun.size_cm[1] and noun.kind not in {"box", "book", "bin"}:
        size[1] = size[0]
    if noun.size_cm[0] == noun.size_cm[2] and noun.kind in {"ball", "stick"}:
        size[2] = size[0]
    wide = (
        "red",
        "orange",
        "yellow",
        "green",
        "blue",
        "purple",
        "pink",
        "brown",
        "white",
        "white",
        "black",
        "grey",
    )
    word = str(rng.choice(noun.colours or wide))
    base = colour_called(word, rng)
    light = rng.random() < 0.4
    accent = (0.93, 0.92, 0.88) if light and word != "white" else any_colour(rng)
    second = base if rng.random() < 0.5 else (accent if rng.random() < 0.5 else (0.9, 0.9, 0.87))
    if noun.kind in {"can"}:
        second = (0.72, 0.72, 0.73) if noun.words[0] not in {"tape", "candle"} else second
    if noun.words[0] in {"book", "notebook"}:
        second = (0.92, 0.9, 0.84)
    if noun.kind in ("bowl", "plate", "bin", "coaster") or "block" in noun.words:
        # what one sees of these is their inside or top: it has the colour that people name
        second = base if rng.random() < 0.85 else second
    metal = noun.kind in {"pot", "pan", "lid", "spoon", "can"}
    return Prop(
        noun=str(rng.choice(noun.words)),
        kind=noun.kind,
        size_m=(float(size[0]), float(size[1]), float(size[2])),
        colour_word=word,
        print=noun.prints[int(rng.integers(len(noun.prints)))],
        base=base,
        accent=accent,
        second=second,
        detail=base
        if noun.kind in {"mug", "duck"} and rng.random() < 0.7
        else (0.1, 0.1, 0.1)
        if rng.random() < 0.5
        else any_colour(rng),
        specular=float(rng.uniform(0.3, 0.8) if metal else rng.choice([0.02, 0.1, 0.3, 0.6])),
        shape_draw=float(rng.uniform()),
    )


@lru_cache(maxsize=256)
def shape_of(prop: Prop) -> Shape:
    """Return the true shape, its bounding box's middle at the origin, upright along +z."""
    return centred(_SHAPES[prop.kind](prop, np.array(prop.size_m)))


def _walled(
    outside: list[tuple[float | int, float | int]], wall: float
) -> tuple[list[tuple[float | int, float | int]], list[int]]:
    """Return the profile of a vessel from its outside (from bottom centre to rim), and its patches."""
    top = outside[-1][1]
    floor = 1.5 * wall + outside[0][1]
    inside = [(max(r - wall, 0.0), max(z, floor)) for r, z in outside[1:]]
    inner = [(inside[-1][0], top), *reversed(inside[:-1])]
    inner = [p for k, p in enumerate(inner) if k == 0 or p != inner[k - 1]]
    profile = [*outside, *inner, (0.0, floor)]
    return profile, [1] + [0] * (len(outside) - 2) + [1] * (len(inner) + 1)


def _box(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    return box(s)


def _book(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    lying = box(s, side_patches=1, cap_patch=0)
    return (
        lying
        if p.noun in {"soap", "sponge"}
        else flat_print(box(s, side_patches=1))
        if p.shape_draw < 0
        else lying
    )


def _bin(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    return bin_shape(s, wall_m(p), float(0.07 * p.shape_draw * min(s[:2])))


def _can(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    if p.noun in {"tape", "roll of tape"}:
        q = 0.68 * r
        return revolved([(q, 0), (r, 0), (r, h), (q, h), (q, 0)], [1, 0, 1, 2])
    e = 0.05 * r
    return revolved(
        [
            (0, 0),
            (r - e, 0),
            (r, e),
            (r, h - e),
            (r - e, h),
            (0.9 * r, h),
            (0.88 * r, h - e),
            (0, h - e),
        ],
        [1, 1, 0, 1, 1, 1, 1],
    )


def _cup(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    low = r * (0.70 + 0.25 * p.shape_draw)
    return revolved(*_walled([(0, 0), (low, 0), (r, h)], wall_m(p)))


def _mug(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    low = r * (0.92 + 0.08 * p.shape_draw)
    body = revolved(*_walled([(0, 0), (low - 0.004, 0), (low, 0.004), (r, h)], wall_m(p)))
    a = np.linspace(-np.pi / 2, np.pi / 2, 12)
    out, tall = 0.030, 0.30 * h
    path = np.stack([0 * a, -(low - 0.002 + out * np.cos(a)), 0.52 * h + tall * np.sin(a)], 1)
    return joined([body, tube(path, 0.0052)])


def _bowl(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h, foot = s[0] / 2, s[2], (0.40 + 0.15 * p.shape_draw) * s[0] / 2
    a = np.linspace(0.0, np.pi / 2, 8)[1:]
    outside = [(0.0, 0.0), (foot, 0.0)] + [
        (foot + (r - foot) * float(np.sin(t)), h * float(1 - np.cos(t))) for t in a
    ]
    return revolved(*_walled(outside, wall_m(p)), sides=56)


def _plate(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    return revolved(
        *_walled([(0, 0), (0.62 * r, 0), (0.72 * r, 0.45 * h), (r, h)], wall_m(p)), sides=56
    )


def _jar(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    neck = (0.80 + 0.15 * p.shape_draw) * r
    return revolved(
        [
            (0, 0),
            (r - 0.004, 0),
            (r, 0.005),
            (r, 0.74 * h),
            (neck, 0.83 * h),
            (neck + 0.002, 0.83 * h),
            (neck + 0.002, h),
            (0, h),
        ],
        [1, 1, 0, 1, 2, 2, 2],
    )


def _bottle(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h, d = 0.5, s[2], 0.45 + 0.2 * p.shape_draw
    neck = 0.19 + 0.05 * p.shape_draw
    profile = [
        (0, 0),
        (r - 0.05, 0),
        (r, 0.03 * h),
        (r, d * h),
        (0.9 * r, (d + 0.08) * h),
        (neck, (d + 0.27) * h),
        (neck, 0.91 * h),
        (neck + 0.03, 0.91 * h),
        (neck + 0.03, h),
        (0, h),
    ]
    unit = revolved(profile, [1, 1, 0, 1, 1, 1, 2, 2, 2])
    return Shape(vertices=unit.vertices * (s[0], s[1], 1), uv=unit.uv, faces=unit.faces)


def _pot(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    body = revolved(*_walled([(0, 0), (r - 0.006, 0), (r, 0.006), (r, h)], wall_m(p)), sides=56)
    a = np.linspace(-1, 1, 9)
    ears = [
        tube(
            np.stack([0.03 * a, side * (r - 0.003 + 0.028 * (1 - a**4)), 0 * a + 0.8 * h], 1),
            0.005,
        )
        for side in (-1, 1)
    ]
    return joined([body, *ears])


def _pan(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    body = revolved(*_walled([(0, 0), (0.82 * r, 0), (r, h)], wall_m(p)), sides=56)
    t = np.linspace(0, 1, 8)
    path = np.stack([0 * t, -(r - 0.005 + 0.165 * t), 0.85 * h + 0.015 * t], 1)
    return joined([body, tube(path, 0.010)])


def _lid(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    r, h = s[0] / 2, s[2]
    dome = (0.15 + 0.25 * p.shape_draw) * h
    plate = [(0, 0), (r, 0), (r, 0.004), (0.85 * r, 0.004 + 0.6 * dome), (0.3 * r, 0.004 + dome)]
    knob = [(0.012, 0.004 + dome), (0.010, 0.75 * h), (0.019, 0.82 * h), (0.017, h), (0, h)]
    return revolved([*plate, *knob], [1, 0, 0, 0, 0, 2, 2, 2, 2], sides=56)


def _coaster(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    if p.symmetry == "box":
        return box(s, side_patches=1, cap_patch=0)
    r, h = s[0] / 2, s[2]
    return flat_print(revolved([(0, 0), (r, 0), (r, h), (0, h)], [1, 1, 0]))


def _ball(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    return ellipsoid(s)


def _duck(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    x, y, z = s
    body = moved(ellipsoid((0.95 * x, 0.95 * y, 0.62 * z)), (0, 0.02 * y, 0.31 * z))
    head = moved(ellipsoid((0.55 * x, 0.48 * y, 0.52 * z)), (0, -0.24 * y, 0.74 * z))
    beak = moved(ellipsoid((0.28 * x, 0.26 * y, 0.10 * z), patch=2), (0, -0.50 * y, 0.70 * z))
    tail = moved(ellipsoid((0.25 * x, 0.3 * y, 0.2 * z)), (0, 0.44 * y, 0.45 * z))
    return joined([body, head, beak, tail])


def _stick(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    return box(s, side_patches=0, cap_patch=0)


def _spoon(p: Prop, s: Float[np.ndarray, "3"]) -> Shape:
    x, y, z = s
    bowl = [(0.0, 0.0), (0.6, 0.15), (1.0, 1.0), (0.9, 1.0), (0.55, 0.3), (0.0, 0.15)]
    head = revolved(bowl, [0, 0, 0, 0, 0])
    long = 0.28 * y
    scoop = Shape(
        vertices=head.vertices * (x / 2, long / 2, 0.35 * z), uv=head.uv, faces=head.faces
    )
    t = np.linspace(0, 1, 10)
    path = np.stack(
        [0 * t, long / 2 - 0.004 + (y - long) * t, 0.3 * z + 0.55 * z * np.sin(np.pi * 0.6 * t)], 1
    )
    return joined([scoop, tube(path, 0.11 * x, patch=0)])


_SHAPES: dict[str, Callable[[Prop, Float[np.ndarray, "3"]], Shape]] = {
    "box": _box,
    "book": _book,
    "bin": _bin,
    "can": _can,
    "cup": _cup,
    "mug": _mug,
    "bowl": _bowl,
    "plate": _plate,
    "jar": _jar,
    "bottle": _bottle,
    "pot": _pot,
    "pan": _pan,
    "lid": _lid,
    "coaster": _coaster,
    "ball": _ball,
    "duck": _duck,
    "stick": _stick,
    "spoon": _spoon,
}
