"""What household nouns usually are: size, shape, mass, friction. The scene's metric scale comes from here.

The table is `nouns.tsv` beside this file, one noun a row, in centimetres and grams for reading;
`docs/nouns.md` explains its columns and counts its sources. Sizes are (length, width, height) [m]
in the pose the thing usually rests in; `spread` is the standard deviation of log size within the
noun. A word that is not in the table becomes a fist-sized box and costs confidence.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from v2p_data.errors import V2PError
from v2p_data.scene.schema import Symmetry

Form = Literal["box", "cylinder", "sphere"]
Matter = Literal["rigid", "soft", "clear"]
SourceKind = Literal["standard", "YCB", "USDA", "retail", "estimate"]

TABLE = Path(__file__).with_name("nouns.tsv")
COLUMNS: tuple[str, ...] = (
    "noun",
    "form",
    "length_cm",
    "width_cm",
    "height_cm",
    "spread",
    "mass_g",
    "friction",
    "hollow",
    "taper",
    "matter",
    "colour",
    "symmetric",
    "synonyms",
    "source",
)
COLOURS = frozenset(
    {
        "red",
        "orange",
        "yellow",
        "green",
        "blue",
        "purple",
        "pink",
        "brown",
        "black",
        "white",
        "grey",
    }
)
_CLEAR_WORDS = {"transparent", "clear", "glass", "crystal"}
_AFTER_THE_NOUN = re.compile(
    r" (?:with|without|on|in|inside|onto|into|from|at|for|next|near|behind|under|over|above|below|beside|containing|filled|full"
    r"|lying|standing|facing|that|which|made|upright|to|by)(?: .*)?$"
)
_MEASURES = frozenset(
    {
        "piece",
        "pair",
        "bit",
        "slice",
        "stack",
        "pile",
        "bunch",
        "set",
        "sheet",
        "lot",
        "kind",
        "type",
        "row",
        "group",
        "couple",
        "number",
        "half",
        "pack",
        "packet",
        "heap",
        "handful",
        "chunk",
        "strip",
        "bar",
        "roll",
        "stick",
        "block",
        "loaf",
        "cube",
    }
)
"""Words before `of` that count or portion what follows: a piece of paper is paper, a box of pens is a box."""
_ADJECTIVES = COLOURS | frozenset(
    {
        "glass",
        "tin",
        "paper",
        "rubber",
        "wood",
        "cardboard",
        "cotton",
        "wool",
        "iron",
        "card",
        "clay",
        "stone",
        "light",
        "lime",
        "peach",
        "plum",
        "olive",
        "lemon",
        "cherry",
        "rose",
        "mint",
        "chocolate",
        "coffee",
        "tea",
        "milk",
        "juice",
        "cell",
        "foil",
        "nickel",
    }
)
"""Nouns that say what a thing is made of, or its colour, when another word follows them."""
_KINDS: dict[str, tuple[str, ...]] = {
    "matter": get_args(Matter),
    "symmetric": get_args(Symmetry),
    "source": get_args(SourceKind),
}
_PLAIN_WORDS = re.compile(r"[a-z0-9]+(?: [a-z0-9]+)*")
_IRREGULAR = {"mice": "mouse", "knives": "knife", "leaves": "leaf", "loaves": "loaf"}


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
    """Open at the top, so that something can be put in or it can be put over something."""
    taper: float = 1.0
    """Base diameter over top diameter, for solids of revolution."""
    spread: float = 0.2
    matter: Matter = "rigid"
    known: bool = True
    symmetry: Symmetry = "none"
    """Turns that nobody sees on the real thing: `box` half turns about each axis, `round` any turn
    about the upright axis, `sphere` any turn. A round thing with `none` has a handle or spout,
    which the fitted solid of revolution does not show."""
    colours: tuple[str, ...] = ()
    """Colours it has when nobody says which; empty where anything goes."""
    source: str = "estimate"
    """A `SourceKind`, then a colon and where the numbers come from, where there is more to say."""

    @property
    def handled(self) -> bool:
        """Whether things of that name are vessels with a handle or a spout, round but for that."""
        return self.form == "cylinder" and self.hollow and self.symmetry == "none"


def read_nouns(text: str, where: str) -> tuple[dict[str, Noun], dict[str, Noun]]:
    """Return the nouns of a tab-separated table by their word, and by their word and every synonym.

    Args:
        text: the table; its first line holds `COLUMNS`.
        where: the table's name, for messages.

    Raises:
        V2PError: a row is broken; the sentence names it.
    """
    header, *lines = text.splitlines() or [""]
    if tuple(header.split("\t")) != COLUMNS:
        raise V2PError(f"{where}:1 must name these columns, tab-separated: {', '.join(COLUMNS)}.")
    nouns: dict[str, Noun] = {}
    index: dict[str, Noun] = {}
    for number, line in enumerate(lines, start=2):
        cells = line.split("\t")
        try:
            noun, synonyms = _noun(cells)
            for word in (noun.word, *synonyms):
                _add(index, word, noun)
        except ValueError as error:
            raise V2PError(f"{where}:{number}, the row of '{cells[0]}': {error}.") from error
        nouns[noun.word] = noun
    return nouns, index


def noun_for(phrase: str) -> Noun:
    """Return the entry for what a phrase is about: its head noun in the longest form known, else the fallback.

    The head is the last word before any preposition ('a red cup with a handle' is a cup,
    'chocolate box' a box). Of `X of Y` it is the compound where there is one ('box of tissues' is
    a tissue box), Y where X only counts, and X otherwise.
    """
    said = " ".join(_words(phrase))
    if found := _INDEX.get(said):
        return found
    words = _before_and(_AFTER_THE_NOUN.sub("", said).split())
    if "of" in words[1:-1]:
        cut = words.index("of", 1)
        head, rest = words[:cut], words[cut + 1 :]
        if found := _of(head, rest):
            return found
        words = head
    return _last_known(words) or FALLBACK


def is_clear(phrase: str) -> bool:
    """Return whether the phrase says, or its noun implies, that one can see through the object."""
    return noun_for(phrase).matter == "clear" or bool(_CLEAR_WORDS & set(phrase.lower().split()))


def _add(index: dict[str, Noun], word: str, noun: Noun) -> None:
    if not _PLAIN_WORDS.fullmatch(word):
        raise ValueError(f"'{word}' must be lower-case words of letters and digits")
    if index.setdefault(word, noun) is not noun:
        raise ValueError(f"'{word}' is taken already by '{index[word].word}'")


def _noun(cells: list[str]) -> tuple[Noun, list[str]]:
    if len(cells) != len(COLUMNS):
        raise ValueError(f"it has {len(cells)} cells, not {len(COLUMNS)}")
    row = dict(zip(COLUMNS, cells, strict=True))
    for column, known in _KINDS.items():
        if row[column].partition(":")[0] not in known:
            raise ValueError(f"{column} '{row[column]}' is none of {', '.join(known)}")
    synonyms = [word for word in row["synonyms"].split(",") if word]
    colours = tuple(word for word in row["colour"].split(",") if word)
    if unknown := set(colours) - COLOURS:
        raise ValueError(f"'{min(unknown)}' is no colour; known: {', '.join(sorted(COLOURS))}")
    if row["hollow"] not in ("0", "1"):
        raise ValueError(f"hollow is '{row['hollow']}', not 0 or 1")
    value = {column: _positive(row, column) for column in (*COLUMNS[2:8], "taper")}
    form = row["form"]
    if form not in get_args(Form):
        raise ValueError(f"form '{form}' is none of {', '.join(get_args(Form))}")
    length, width, height = (round(value[side] / 100, 6) for side in COLUMNS[2:5])
    size_m = (length, width, height)
    noun = Noun(
        word=row["noun"],
        form=form,  # pyright: ignore[reportArgumentType]
        size_m=size_m,
        mass_kg=round(value["mass_g"] / 1000, 9),
        friction=value["friction"],
        hollow=row["hollow"] == "1",
        taper=value["taper"],
        spread=value["spread"],
        matter=row["matter"],  # pyright: ignore[reportArgumentType]
        symmetry=row["symmetric"],  # pyright: ignore[reportArgumentType]
        colours=colours,
        source=row["source"],
    )
    round_sides = size_m[:2] if noun.form == "cylinder" else size_m
    if noun.form != "box" and len(set(round_sides)) > 1:
        raise ValueError(f"a {noun.form} has one diameter, its size is {size_m} m")
    if noun.form == "sphere" and noun.hollow:
        raise ValueError("a sphere cannot be open at the top")
    if noun.form != "cylinder" and noun.taper != 1:
        raise ValueError(f"only solids of revolution taper, not a {noun.form}")
    fits = {"box": ("box",), "cylinder": ("round",), "sphere": ("round", "sphere")}[noun.form]
    if noun.symmetry not in ("none", *fits):
        raise ValueError(f"a {noun.form} cannot have the symmetry '{noun.symmetry}'")
    return noun, synonyms


def _positive(row: dict[str, str], column: str) -> float:
    try:
        value = float(row[column])
    except ValueError:
        raise ValueError(f"{column} '{row[column]}' is not a number") from None
    if not 0 < value < float("inf"):
        raise ValueError(f"{column} must be positive and finite, it is {row[column]}")
    return value


def _words(phrase: str) -> list[str]:
    return re.findall(r"[a-z0-9]+", re.sub(r"['\u2019]", "", phrase.lower()))


def _before_and(words: list[str]) -> list[str]:
    """Return the first thing of a list; 'blue and yellow can' is one thing."""
    if "and" in words[1:-1]:
        cut = words.index("and", 1)
        if words[cut - 1] not in _ADJECTIVES and _known(words[cut - 1 : cut]):
            return words[:cut]
    return words


def _of(head: list[str], rest: list[str]) -> Noun | None:
    """Return the noun of 'HEAD of REST' where REST names it or makes a compound with HEAD."""
    measure = next((w for w in _singulars(head[-1]) if w in _MEASURES), None)
    for first in _singulars(head[-1]):
        for start in range(len(rest)):
            for last in _singulars(rest[-1]):
                if found := _INDEX.get(" ".join([*rest[start:-1], last, first])):
                    return found
    return _last_known(rest) if measure or not _last_known(head) else None


def _last_known(words: list[str]) -> Noun | None:
    """Return the noun that ends last in these words, the longest of them."""
    for end in range(len(words), 0, -1):
        for start in range(max(0, end - 4), end):
            found = _known(words[start:end])
            if found and (end == len(words) or end - start > 1 or words[start] not in _ADJECTIVES):
                return found
    return None


def _known(words: list[str]) -> Noun | None:
    for last in _singulars(words[-1]):
        if found := _INDEX.get(" ".join([*words[:-1], last])):
            return found
    return None


def _singulars(word: str) -> list[str]:
    """Return the word and what it may be the plural of."""
    forms = [word]
    if word in _IRREGULAR:
        forms.append(_IRREGULAR[word])
    if word.endswith("s") and not word.endswith("ss"):
        forms.append(word[:-1])
    if word.endswith("ies"):
        forms.append(word[:-3] + "y")
    if word.endswith("es"):
        forms.append(word[:-2])
    return forms


FALLBACK = Noun(
    word="",
    form="box",
    size_m=(0.11, 0.09, 0.08),
    mass_kg=0.25,
    friction=0.5,
    spread=0.45,
    known=False,
)
NOUNS, _INDEX = read_nouns(TABLE.read_text(encoding="utf-8"), TABLE.name)
"""Every noun by its word; `noun_for` knows synonyms and plurals as well."""
