"""What a caption asks for: the kind of task, which object is manipulated, and what the others are for.

`parse_caption` works in four steps:

1. `chatter` takes away links, tags and remarks.
2. `_clauses` cuts the text at its verbs.
3. `_read` cuts each clause at its prepositions ("Pushing plate | from left to right | next to brown box") and looks the
   verb and a preposition up in `TaskKind.phrases`. Where several prepositions are known, `_RANK` chooses: a direction
   before a neighbour, a neighbour before a tool.
4. The last clause with a known kind wins: it tells how the clip ends.

To teach a new phrase, add it to its kind in `v2p_data/kinds.py`.
"""

import re
from dataclasses import dataclass
from typing import Literal

from v2p_data.kinds import KINDS, Kind
from v2p_data.video.chatter import DECORATION, sentences_of

Role = Literal["reference", "tool", "container", "cover"]


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """A caption, understood."""

    kind: Kind
    """`generic` when the words name no kind of task that we know."""
    manipulated: str
    """Phrase for the object that moves; `object` when the caption names none."""
    others: tuple[tuple[str, Role], ...] = ()
    """Phrases for the other objects, with what they are for."""

    @property
    def phrases(self) -> tuple[str, ...]:
        return self.manipulated, *(phrase for phrase, _ in self.others)


_VERBS = {
    "push": "push shov nudg pull drag mov slid",
    "lift": "lift pick rais",
    "tip": "tip toppl knock",
    "poke": "pok hit",
    "cover": "cover",
    "uncover": "uncover",
    "drop": "drop",
    "put": "put plac set stack",
    "insert": "insert plug",
    "throw": "throw threw toss",
    "take": "tak took remov",
}
"""Verb -> word stems; the endings are added by `_inflected`."""

_PREPOSITIONS = {
    "right": r"(?:from )?(?:the )?left to (?:the )?right|to (?:the )?right(?! of)|rightwards?|^right|right$",
    "left": r"(?:from )?(?:the )?right to (?:the )?left|to (?:the )?left(?! of)|leftwards?|^left|left$",
    "next": r"next to|to the (?:left|right) of|beside|alongside|near|close to|closer to|nearer to|against",
    "front": r"in front of",
    "behind": r"behind|underneath|under|below",
    "into": r"into|inside|in",
    "onto": r"on top of|onto|upon|on",
    "off": r"off of|off|out of|away from|from",
    "to": r"towards?|to",
    "over": r"over",
    "upright": r"upright",
    "up": r"up",
    "down": r"down",
    "by": r"by",
    "with": r"with|using",
    "carrying": r"carrying",
    "at": r"at",
}
"""Preposition or particle -> how it is written. The first that fits at a place is taken."""

_RANK = {"left": 0, "right": 0, "up": 2, "over": 2, "with": 3}
"""Preposition -> rank; the lowest rank is looked up first. Others have rank 1, in the order of the caption."""

_PARTICLES = {"left", "right", "over", "upright", "up", "down", "off"}
"""These may stand without a phrase of their own ("lift the box up")."""


def _phrases() -> dict[tuple[str, str], Kind]:
    """Return which kind each verb with a preposition asks for.

    Raises:
        ValueError: a kind has a phrase of unknown words, or the phrase of another kind.
    """
    found: dict[tuple[str, str], Kind] = {}
    for kind in KINDS.values():
        for verb, preposition in kind.phrases:
            if verb not in _VERBS or preposition not in (*_PREPOSITIONS, ""):
                raise ValueError(
                    f"task kind '{kind.name}' has the phrase ('{verb}', '{preposition}'); add its words to "
                    "_VERBS and _PREPOSITIONS in v2p_data/video/meaning.py"
                )
            if (verb, preposition) in found:
                raise ValueError(
                    f"task kinds '{found[verb, preposition]}' and '{kind.name}' both have the phrase "
                    f"('{verb}', '{preposition}'); give it to one of them"
                )
            found[verb, preposition] = kind.name
    return found


_phrases()  # refuses wrong rows when this module is loaded

_NEGATIONS = r"\b(?:pretend\w*|try\w*|fail\w*|unsuccessful\w*|almost|one end of)\b"
"""Words after which the caption no longer says what its verb says."""
_OUTCOME = re.compile(
    r",?\s+(?:so|but|until|without|causing|(?:then|and) letting|(?:to )?reveal\w*)\b(.*)$"
)
"""Where a caption begins to tell what came of it."""
_BAD_OUTCOME = r"\bslight|\bfall|\bdrop|\bnot\b|n't\b|\bnothing\b"
_LIDS = r"\b(?:lid|cover|cap|cloth|napkin|towel|top)(?: of .*)?$"
_FLAT_LIDS = r"\b(?:lid|cap)$"
_SURFACES = r"(?:flat |slanted )?(?:table|tabletop|desk|surface|floor|ground|counter|countertop|air|camera|side)$"
_NO_OBJECT = re.compile(
    r"(?:[\w' ]+ of (?:\w+ )?)?"
    r"(?:(?:left|right|both|bare|two|one|single|own|other|gloved|robot|robot's|robotic|index|middle|human) )*"
    r"(?:hands?|fingers?|finger ?tips?|thumbs?|palms?|fists?|arms?|knuckles?|grippers?|care|ease|caution|force)(?: side| \d+)?"
    r"|house|home|apartment|flat|lab|laboratory|studio|hall|sofa|couch|bed|carpet|(?!§)[\W\d_]*"
    r"|(?!.*\b(?:toy|doll|dog|cat|bird|mouse|lego|model|mini\w*|play|pool|pong)\b)(?:.* )?"
    r"(?:table|tabletop|desk|floor|ground|counter|countertop|worktop|workbench|kitchen|"
    r"(?:bed|bath|class|work|living )?room|office|garage|garden|yard|workshop|basement)"
)
"""What a preposition leads to and yet is no object: who acts, how, where, and bare numbers."""
_TAKE_NUMBER = re.compile(r"(?<= )(up|down|left|right|over|upright|off) (?:v\.?|no )?\d+(?=$|,)")
_ARTICLES = r"^(?:a|an|the|some|his|her|its|my|your|their|one|another|of|again|slowly|gently|quickly|completely|carefully)\b"
_PRONOUNS = {"", "it", "them", "everything"}
_ANYTHING = ("object", "other object")
"""What "something" is called, the first time and later."""
_COLOURS = set(
    [
        "red",
        "orange",
        "yellow",
        "green",
        "blue",
        "purple",
        "violet",
        "pink",
        "brown",
        "black",
        "white",
        "grey",
        "gray",
        "silver",
        "gold",
        "beige",
        "cyan",
        "dark",
        "light",
    ]
)
_OBJECT = re.compile(r"§(\d+)")


def parse_caption(caption: str, objects: tuple[str, ...] = ()) -> Meaning:
    """Return what the caption asks for.

    Args:
        caption: a sentence such as "Pushing red box from left to right", or the words of a file name.
        objects: phrases for the objects, if they are known; those that the caption does not name become
            references, and the first stands in where the caption names nothing that moves.
    """
    sentences = sentences_of(_marked(caption.replace("§", " ").lower(), objects), _INSIDE)
    sentences = [_marked(_normal(sentence), objects) for sentence in sentences]
    # where something is done in one of them, the others are talk
    text = ", ".join([s for s in sentences if _has_verb(s)] or sentences[:1])
    is_negated = re.search(_NEGATIONS, text)
    text = _TAKE_NUMBER.sub(r"\1", text)
    text = re.sub(r"\bsome(?:thing|one)(?: else)?\b", _ANYTHING[0], text)
    first, *rest = text.split(_ANYTHING[0])
    text = _ANYTHING[0].join([first, _ANYTHING[1].join(rest)]) if rest else text
    text = re.sub(r"\bwith (\S+) (?:on|in|inside) it\b", r"carrying \1", text)
    outcome = _OUTCOME.search(text)
    if outcome:
        text = text[: outcome.start()]

    kind: Kind = "generic"
    moved, others, named_before = "", [], ""
    for clause in _clauses(text):
        its_kind, its_moved, its_others = _read(*clause)
        its_moved = its_moved or named_before
        named_before = its_moved
        if its_kind != "generic" or not moved:
            kind, moved, others = its_kind, its_moved, its_others
    if outcome:
        kind = _after(kind, outcome.group(0), moved)
        revealed = re.search(r"reveal\w* (.*?)(?: behind| under\w*)?$", outcome.group(0))
        if revealed:
            others = [*others, (_phrase(revealed.group(1)), "reference")]
    if is_negated:
        kind = "generic"
    return _named(kind, moved, others, objects)


def _marked(text: str, objects: tuple[str, ...]) -> str:
    """Return a text with §0, §1 in place of the objects' names, longer names first."""
    for index in sorted(range(len(objects)), key=lambda i: -len(objects[i])):
        words = re.escape(_normal(objects[index]))
        text = re.sub(rf"(?<![\w§]){words}(?!\w)", f"§{index}", text)
    return text


def _normal(text: str) -> str:
    return " ".join(re.sub(r"[\[\]\"“”.!?_]|(?<!\w)'|'(?!\w)", " ", text.lower()).split())


def _inflected(stems: str) -> str:
    """Return a pattern for the stems with their endings: put, puts, putting; slide, sliding."""
    each = "|".join(rf"{s}{s[-1]}?" for s in stems.split())
    return rf"(?:{each})(?:ing|es|s|ed|en|e)?"


_VERB = {verb: re.compile(_inflected(stems)) for verb, stems in _VERBS.items()}
_ANY_VERB = "|".join(pattern.pattern for pattern in _VERB.values())
_CUT = re.compile(rf"(?:,| and| then|, and| and then|, then) (?=(?:{_ANY_VERB})\b)")
_PREPOSITION = re.compile(
    "|".join(rf"(?P<{name}>(?<!\w)(?:{p})(?!\w))" for name, p in _PREPOSITIONS.items())
)

_INSIDE = re.compile(
    rf"(?<!\w)(?P<open>{_ANY_VERB}|{'|'.join(sorted(_COLOURS))}|small|big|large|little|tiny|plastic|wooden|metal|toy|"
    rf"a|an|the|my|his|her|into|onto|in|next to|in front of|behind|with|of|to){DECORATION}(?=\w)"
    rf"|{DECORATION}(?=(?:{_PREPOSITION.pattern}))"
)
"""Decorations within a phrase: behind a word that a noun must follow, or before a preposition."""


def _has_verb(text: str) -> bool:
    return any(v.fullmatch(word) for word in text.split() for v in _VERB.values())


def _clauses(text: str) -> list[tuple[str, str, str]]:
    """Return (verb, words before it, words after it) for every clause that has a known verb."""
    found: list[tuple[str, str, str]] = []
    for clause in _CUT.split(text):
        words = clause.split()
        verbs = [(i, v) for i, w in enumerate(words) for v in _VERB if _VERB[v].fullmatch(w)]
        if not verbs:
            continue
        # "watering can cover lifting": a gerund is the verb, wherever it stands
        at, verb = next(((i, v) for i, v in verbs if words[i].endswith("ing")), verbs[0])
        found.append((verb, " ".join(words[:at]), " ".join(words[at + 1 :])))
    if not found:
        words = text.split(" ", 1)
        rest = words[1] if words[0].endswith("ing") and len(words) == 2 else text
        found.append(("", "", rest))
    return found


def _read(verb: str, before: str, after: str) -> tuple[Kind, str, list[tuple[str, Role]]]:
    """Return kind, moved phrase and the other phrases of one clause."""
    marks = list(_PREPOSITION.finditer(after))
    ends = [*(m.start() for m in marks[1:]), len(after)][: len(marks)]
    direct = _phrase(after[: marks[0].start()] if marks else after)
    parts: list[tuple[str, str]] = []
    for mark, end in zip(marks, ends, strict=True):
        name, phrase = str(mark.lastgroup), _phrase(after[mark.end() : end])
        phrase = "" if _NO_OBJECT.fullmatch(phrase) else phrase
        if name in _PARTICLES and phrase and not direct:
            direct, phrase = phrase, ""
        parts.append((name, phrase))
    direct = direct or _phrase(before)
    others: list[tuple[str, Role]] = [(p, _role(name)) for name, p in parts if p]

    kinds = _phrases()
    if verb == "cover" and ("with", "") in parts and not re.search(r"\bit$", after):
        return "generic", direct, others  # a hand covers it
    if verb in ("cover", "uncover"):
        hand_moves = {"cover": "with", "uncover": "by"}[verb]
        moved = next((p for name, p in parts if name == hand_moves), "")
        stays: list[tuple[str, Role]] = [(direct, "reference")] if direct else []
        return kinds[verb, ""], moved, stays + [o for o in others if o[0] != moved]
    if verb == "take" and re.search(_LIDS, direct):
        return "uncover", direct, others

    for name, phrase in sorted(parts, key=lambda part: _RANK.get(part[0], 1)):
        kind = kinds.get((verb, name))
        if (
            kind
            and (phrase or name in _PARTICLES)
            and not (name == "over" and verb == "put" and not phrase)
        ):
            return kind, direct, others
    return kinds.get((verb, ""), "generic"), direct, others


def _role(preposition: str) -> Role:
    return {"into": "container", "with": "tool"}.get(preposition, "reference")  # pyright: ignore[reportReturnType]


def _phrase(words: str) -> str:
    """Return the noun phrase without articles; empty for pronouns and for the table itself."""
    words = words.strip(" ,;:-")
    if found := _OBJECT.search(words):
        return found.group(0)
    while shorter := re.sub(_ARTICLES, "", words).strip():
        if shorter == words:
            break
        words = shorter
    words = re.sub(rf"^(?:{_ANY_VERB})\s+(?=\w)", "", words) if " " in words else words
    words = re.sub(_ARTICLES, "", words).strip()
    first, *rest = re.split(r",| and ", words)
    if rest and first.split() and first.split()[-1] in _COLOURS:  # "blue and yellow can"
        first = words
    first = re.sub(r"\s+(?:slowly|gently|quickly|completely|carefully|again)$", "", first).strip()
    return "" if first in _PRONOUNS or re.fullmatch(_SURFACES, first) else first


def _after(kind: Kind, outcome: str, moved: str) -> Kind:
    """Return the kind that the words on the outcome leave."""
    if re.search(r"\breveal", outcome) and moved:
        return "uncover"
    if re.search(r"\bfalls? over\b|\btips? over\b", outcome):
        return "tip_over"
    if kind == "tip_over" or re.search(r"\bwithout\b", outcome):
        return kind
    return "generic" if re.search(_BAD_OUTCOME, outcome) else kind


def _named(
    kind: Kind, moved: str, others: list[tuple[str, Role]], objects: tuple[str, ...]
) -> Meaning:
    """Return the meaning; a phrase that means one of `objects` gets that object's name."""
    said = " ".join([moved, *(phrase for phrase, _ in others)])
    used = {objects[int(index)] for index in _OBJECT.findall(said)}

    def name_of(phrase: str) -> str:
        if found := _OBJECT.search(phrase):
            name = objects[int(found.group(1))]
        else:
            noun = phrase.split()[-1:]
            alike = [
                o
                for o in objects
                if o not in used and (phrase in _ANYTHING or _normal(o).split()[-1:] == noun)
            ]
            name = alike[0] if alike else phrase
        used.add(name)
        return name

    named: list[tuple[str, Role]] = []
    manipulated = name_of(moved) if moved else ""
    for phrase, role in others:
        if (name := name_of(phrase)) and name != manipulated and name not in dict(named):
            named.append((name, role))
    left = [o for o in objects if o not in used]
    if manipulated not in objects and left:
        manipulated = left.pop(0)
    named.extend((unsaid, "reference") for unsaid in left)
    if kind == "cover" and re.search(_FLAT_LIDS, manipulated):
        kind = "place_onto"  # it rests on the rim: nothing fits into it, as into a cup that covers
    unnamed = "cover" if KINDS[kind].has_cover else _ANYTHING[0]
    return Meaning(kind=kind, manipulated=manipulated or unnamed, others=tuple(named))
