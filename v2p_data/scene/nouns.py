"""What household nouns usually are: size, shape, mass, friction. The scene's metric scale comes from here.

Sizes are (length, width, height) [m] in the pose the thing usually rests in, from nominal product sizes; `spread` is the
standard deviation of log size within the noun. A word that is not in the table becomes a fist-sized box and costs confidence.
"""

import re
from dataclasses import dataclass
from typing import Literal

Form = Literal["box", "cylinder", "sphere"]
Matter = Literal["rigid", "soft", "clear"]


@dataclass(frozen=True, kw_only=True)
class Noun:
    """What is usual for one noun."""

    word: str
    form: Form
    """Silhouette to fit; `cylinder` covers every solid of revolution."""
    size_m: tuple[float, float, float]
    mass_kg: float
    friction: float
    hollow: bool = False
    taper: float = 1.0
    """Base diameter over top diameter, for solids of revolution."""
    spread: float = 0.2
    matter: Matter = "rigid"
    known: bool = True


Number = int | float


def _box(
    d: Number, w: Number, h: Number, mass: Number, mu: Number = 0.5, **more: object
) -> dict[str, object]:
    return {
        "form": "box",
        "size_m": (d / 100, w / 100, h / 100),
        "mass_kg": float(mass),
        "friction": float(mu),
        **more,
    }


def _round(
    d: Number, h: Number, mass: Number, mu: Number = 0.5, **more: object
) -> dict[str, object]:
    return {
        "form": "cylinder",
        "size_m": (d / 100, d / 100, h / 100),
        "mass_kg": float(mass),
        "friction": float(mu),
        **more,
    }


def _ball(d: Number, mass: Number, mu: Number = 0.6, **more: object) -> dict[str, object]:
    return {
        "form": "sphere",
        "size_m": (d / 100,) * 3,
        "mass_kg": float(mass),
        "friction": float(mu),
        **more,
    }


_CUP = {"hollow": True, "taper": 0.75}
_BOWL = {"hollow": True, "taper": 0.5}
_SOFT = {"matter": "soft", "spread": 0.35}
_VAGUE = {"spread": 0.35}

# Numbers in centimetres here, for reading; mass in kg.
_TABLE: dict[str, dict[str, object]] = {
    # boxes and books
    "box": _box(9, 6.5, 5, 0.2, **_VAGUE), "cracker box": _box(16, 6, 21, 0.41, spread=0.08),
    "cereal box": _box(19, 6, 28, 0.4, spread=0.12), "snack box": _box(21, 16, 6, 0.4, spread=0.15),
    "tea box": _box(14, 8, 8, 0.15), "cardboard box": _box(30, 22, 18, 0.4, **_VAGUE),
    "brown box": _box(30, 20, 12, 0.4, **_VAGUE), "carton": _box(6, 6, 14.5, 0.4, spread=0.25),
    "milk carton": _box(9, 9, 20, 1.0), "juice box": _box(6, 4, 11, 0.25), "package": _box(22, 15, 7, 0.3, **_SOFT),
    "parcel": _box(25, 18, 10, 0.5, **_VAGUE), "matchbox": _box(11, 6.5, 2, 0.05, **_VAGUE), "gift": _box(15, 15, 10, 0.4, **_VAGUE),
    "book": _box(23.5, 15.5, 3.0, 0.6, 0.4), "notebook": _box(21, 15, 1.2, 0.3, 0.4), "magazine": _box(27, 20, 0.5, 0.2, 0.4),
    "phone": _box(15, 7.2, 0.9, 0.19, 0.4, spread=0.08), "smartphone": _box(15, 7.2, 0.9, 0.19, 0.4, spread=0.08),
    "tablet": _box(25, 17, 0.8, 0.5, 0.4), "laptop": _box(32, 22, 1.8, 1.5, 0.4), "keyboard": _box(43, 14, 2.5, 0.6),
    "remote": _box(17, 4.5, 2, 0.12), "calculator": _box(15, 8, 1.5, 0.12), "wallet": _box(11, 9, 2, 0.12),
    "card": _box(8.6, 5.4, 0.2, 0.01, 0.3), "envelope": _box(22, 11, 0.3, 0.02, 0.3), "eraser": _box(5.5, 2.2, 1.3, 0.02, 0.8),
    "sponge": _box(11, 7, 3, 0.02, 0.8, spread=0.15), "soap": _box(9, 6, 2.8, 0.1, 0.4), "brick": _box(21, 10, 6.5, 2.5, 0.7),
    "block": _box(4, 4, 4, 0.05, spread=0.25), "cube": _box(5, 5, 5, 0.06, **_VAGUE), "die": _box(1.6, 1.6, 1.6, 0.005),
    "lego": _box(3.2, 1.6, 1.1, 0.003), "butter": _box(12, 6.5, 3.5, 0.25), "chocolate bar": _box(13, 4.5, 2, 0.06),
    "bar": _box(13, 4.5, 2, 0.06), "bread": _box(12, 11, 1.6, 0.04, **_SOFT), "toast": _box(11, 11, 1.4, 0.03),
    "cheese": _box(12, 8, 4, 0.25), "sandwich": _box(13, 12, 4, 0.2, **_SOFT), "tofu": _box(10, 7, 4, 0.3),
    "toaster": _box(28, 17, 19, 1.3, spread=0.15), "microwave": _box(46, 33, 27, 11.0), "drawer": _box(30, 25, 10, 1.0),
    "bin": _box(26, 20, 12, 0.35, hollow=True), "tray": _box(35, 25, 3, 0.5, hollow=True),
    "basket": _box(28, 20, 12, 0.3, hollow=True), "crate": _box(35, 25, 18, 0.8, hollow=True),
    "container": _box(18, 12, 7, 0.15, hollow=True, **_VAGUE), "tub": _box(20, 14, 8, 0.2, hollow=True, **_VAGUE),
    "dish rack": _box(40, 28, 12, 0.8, hollow=True), "rack": _box(35, 25, 12, 0.8, hollow=True, **_VAGUE),
    "toy boat": _box(22, 7, 9, 0.15, hollow=True, **_VAGUE), "boat": _box(22, 7, 9, 0.15, hollow=True, **_VAGUE),
    "toy car": _box(8, 3.8, 3, 0.06, **_VAGUE), "car": _box(8, 3.8, 3, 0.06, **_VAGUE), "toy": _box(10, 8, 8, 0.1, **_VAGUE),
    "truck": _box(15, 7, 8, 0.2, **_VAGUE), "train": _box(12, 4, 6, 0.1, **_VAGUE), "robot": _box(9, 6, 14, 0.2, **_VAGUE),
    "cutting board": _box(35, 24, 1.8, 0.9), "board": _box(35, 24, 1.8, 0.9, **_VAGUE), "mouse": _box(11, 6.2, 3.8, 0.09),
    "stapler": _box(14, 4, 6, 0.2), "tape dispenser": _box(15, 6, 8, 0.4), "camera": _box(12, 7, 8, 0.5),
    "tissue box": _box(23, 12, 8, 0.2), "speaker": _box(18, 8, 7, 0.6, **_VAGUE), "clock": _box(10, 5, 10, 0.3, **_VAGUE),
    # soft things
    "chip bag": _box(21, 15, 5, 0.06, **_SOFT), "bag": _box(22, 16, 6, 0.1, **_SOFT), "pouch": _box(16, 11, 4, 0.15, **_SOFT),
    "cloth": _box(25, 25, 1, 0.05, 0.8, **_SOFT), "towel": _box(30, 20, 2.5, 0.2, 0.8, **_SOFT), "napkin": _box(16, 16, 0.5, 0.01, **_SOFT),
    "plush": _box(28, 22, 8, 0.2, 0.8, **_SOFT), "teddy": _box(22, 16, 14, 0.25, 0.8, **_SOFT), "pillow": _box(45, 45, 14, 0.6, **_SOFT),
    "shirt": _box(35, 30, 3, 0.2, 0.8, **_SOFT), "glove": _box(24, 12, 2, 0.05, **_SOFT), "shoe": _box(28, 10, 10, 0.35, 0.8),
    "sock": _box(22, 10, 2, 0.04, **_SOFT), "rope": _box(30, 10, 2, 0.1, **_SOFT), "cable": _box(25, 10, 2, 0.05, **_SOFT),
    # drinkware and tins
    "mug": _round(8.2, 9.5, 0.33, hollow=True, taper=0.95, spread=0.12), "cup": _round(8.5, 11, 0.1, **_CUP),
    "glass": _round(7.5, 12, 0.25, hollow=True, taper=0.85, matter="clear"), "tumbler": _round(8, 15, 0.25, **_CUP),
    "teacup": _round(8.5, 6.5, 0.2, hollow=True, taper=0.6), "can": _round(6.6, 12.2, 0.36, spread=0.08),
    "soda can": _round(6.6, 12.2, 0.36, spread=0.06), "coke can": _round(6.6, 12.2, 0.36, spread=0.06),
    "tin": _round(7.5, 11, 0.4), "soup can": _round(6.6, 10.1, 0.35, spread=0.08), "tuna can": _round(8.5, 3.4, 0.17, spread=0.08),
    "yellow can": _box(10, 5.8, 8.4, 0.37, spread=0.2), "bottle": _round(7, 22, 0.5), "water bottle": _round(6.5, 21, 0.5, matter="clear"),
    "mustard bottle": _box(9.5, 5.8, 19, 0.6), "ketchup bottle": _round(7, 20, 0.6), "shampoo bottle": _box(8, 4.5, 20, 0.4),
    "jar": _round(8.5, 12, 0.45), "pill bottle": _round(4.5, 8.5, 0.05), "spray bottle": _round(8, 25, 0.5),
    "thermos": _round(7.5, 24, 0.45), "vase": _round(11, 22, 0.7, hollow=True, taper=0.7, spread=0.3), "candle": _round(7, 9, 0.3, **_VAGUE),
    "salt shaker": _round(4.5, 8.5, 0.1), "pepper shaker": _round(4.5, 8.5, 0.1), "spool": _round(5, 6, 0.1), "battery": _round(1.45, 5, 0.024),
    "roll": _round(11, 10, 0.15), "tape": _round(9, 4.8, 0.15), "glue stick": _round(2.5, 9, 0.03),
    # dishes and pots
    "bowl": _round(16, 6, 0.25, spread=0.15, **_BOWL), "plate": _round(24, 2.2, 0.4, hollow=True, taper=0.6, spread=0.15),
    "saucer": _round(15, 2, 0.2, hollow=True, taper=0.6), "dish": _round(20, 3.5, 0.35, hollow=True, taper=0.6, **_VAGUE),
    "pan": _round(24, 5, 0.9, hollow=True, taper=0.8, spread=0.2), "pot": _round(20, 12, 1.0, hollow=True, spread=0.2),
    "lid": _round(9, 2, 0.06, spread=0.3), "pot lid": _round(20, 4, 0.4), "coaster": _round(10, 0.8, 0.03, spread=0.12),
    "plant pot": _round(14, 13, 0.5, hollow=True, taper=0.75), "bucket": _round(24, 22, 0.7, **_CUP),
    "ashtray": _round(12, 3.5, 0.3, **_BOWL), "basin": _round(32, 12, 0.6, **_BOWL), "colander": _round(24, 11, 0.4, **_BOWL),
    "puck": _round(7.6, 2.5, 0.16), "disc": _round(12, 1.5, 0.1, **_VAGUE), "cylinder": _round(5, 10, 0.15, **_VAGUE),
    "watering can": _round(18, 26, 0.4, hollow=True, spread=0.25), "kettle": _round(17, 22, 1.0, spread=0.2), "teapot": _round(16, 13, 0.6),
    "hat": _round(26, 13, 0.1, **_SOFT), "flower pot": _round(14, 13, 0.5, hollow=True, taper=0.75),
    # round things and food
    "ball": _ball(6.7, 0.06, spread=0.25), "orange ball": _ball(6.5, 0.1), "tennis ball": _ball(6.7, 0.058, spread=0.05),
    "baseball": _ball(7.4, 0.145, spread=0.05), "golf ball": _ball(4.3, 0.046, spread=0.03), "softball": _ball(9.6, 0.18, spread=0.06),
    "apple": _ball(7.5, 0.18, spread=0.1), "orange": _ball(7.8, 0.2, spread=0.1), "peach": _ball(6.2, 0.13), "tomato": _ball(6.8, 0.13),
    "lemon": _ball(6, 0.1), "lime": _ball(5, 0.07), "pear": _ball(8, 0.18), "plum": _ball(5, 0.07), "onion": _ball(7.5, 0.17),
    "potato": _ball(7.5, 0.18), "egg": _ball(5, 0.06, spread=0.1), "strawberry": _ball(3.5, 0.02), "grapefruit": _ball(11, 0.4),
    "melon": _ball(15, 1.5), "avocado": _ball(8, 0.2), "marble": _ball(1.6, 0.006), "globe": _ball(20, 0.6, **_VAGUE),
    "duck": _box(8.5, 7, 8, 0.06, spread=0.2), "banana": _box(19, 5, 4, 0.12), "carrot": _box(18, 3.5, 3.5, 0.08), "cucumber": _box(20, 4.5, 4.5, 0.3),
    "corn": _box(19, 5, 5, 0.2), "eggplant": _box(20, 8, 8, 0.3), "bell pepper": _box(8, 8, 9, 0.16), "croissant": _box(14, 7, 5, 0.06),
    # slender things
    "pen": _box(14, 1.1, 1.1, 0.012), "pens": _box(14, 1.1, 1.1, 0.012), "pencil": _box(18, 0.8, 0.8, 0.006), "marker": _box(14, 1.6, 1.6, 0.02),
    "spoon": _box(18, 4, 2, 0.05, 0.3), "fork": _box(19, 2.6, 2, 0.05, 0.3), "knife": _box(22, 2.2, 1.5, 0.08, 0.3),
    "spatula": _box(30, 8, 4, 0.1), "scissors": _box(17, 7, 1.2, 0.08), "screwdriver": _box(20, 3, 3, 0.12), "hammer": _box(28, 11, 3, 0.5),
    "wrench": _box(18, 4, 1.5, 0.2), "toothbrush": _box(19, 1.5, 1.8, 0.02), "hairbrush": _box(22, 6, 4, 0.1), "comb": _box(18, 4, 0.5, 0.02),
    "stick": _box(20, 1.5, 1.5, 0.03, **_VAGUE), "ruler": _box(30, 3.5, 0.3, 0.03), "tongs": _box(24, 4, 3, 0.12), "key": _box(6, 2.5, 0.3, 0.01),
    "glasses": _box(14, 5, 4, 0.03), "watch": _box(8, 6, 4, 0.08), "lighter": _box(8, 2.4, 1.2, 0.02), "whisk": _box(28, 7, 7, 0.1),
}  # fmt: skip

NOUNS: dict[str, Noun] = {word: Noun(word=word, **fields) for word, fields in _TABLE.items()}  # type: ignore[arg-type]
FALLBACK = Noun(
    word="",
    form="box",
    size_m=(0.11, 0.09, 0.08),
    mass_kg=0.25,
    friction=0.5,
    spread=0.45,
    known=False,
)
_CLEAR_WORDS = {"transparent", "clear", "glass", "crystal"}


def noun_for(phrase: str) -> Noun:
    """Return the entry for the longest run of words in the phrase, the later the better; else the fallback."""
    words = re.findall(r"[a-z]+", phrase.lower())
    forms = [words, [_singular(word) for word in words]]
    for length in (3, 2, 1):
        for start in range(len(words) - length, -1, -1):
            for form in forms:
                found = NOUNS.get(" ".join(form[start : start + length]))
                if found:
                    return found
    return FALLBACK


def is_clear(phrase: str) -> bool:
    """Return whether the phrase says, or its noun implies, that one can see through the object."""
    return noun_for(phrase).matter == "clear" or bool(_CLEAR_WORDS & set(phrase.lower().split()))


def _singular(word: str) -> str:
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("xes", "shes", "ches", "oes")):
        return word[:-2]
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word
