"""Label files of Something-Something-v2: lists of `{id, label, template, placeholders}`.

Nobody repairs thousands of labels of others by hand. So what cannot be used is told, and the rest is kept.
"""

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.json_files import read_json
from v2p_data.video.checked import listed, shortened, type_of, words

_SAYING = ("label", "template", "placeholders")
_SLOT = re.compile(r"\[([^\]]*)\]")
_ORDINALS = ("", "other ", "third ", "fourth ", "fifth ")
"""How equal things are told apart: cup, other cup, third cup."""


@dataclass(frozen=True, kw_only=True)
class Labels:
    """What the label files of a folder say of its videos."""

    said: dict[str, tuple[str, tuple[str, ...]]]
    """Caption and objects, by the stem of the video's file name."""
    files: tuple[str, ...]
    """Names of the files that hold labels."""
    notes: tuple[str, ...]
    """One sentence for each file with something that could not be used."""


def read_labels(paths: Iterable[Path], stems: Iterable[str]) -> Labels:
    """Return what label files say of the videos with these stems; other JSON files are passed over."""
    wanted = {unicodedata.normalize("NFC", stem): stem for stem in stems}
    said: dict[str, tuple[str, tuple[str, ...]]] = {}
    files: list[str] = []
    notes: list[str] = []
    for path in paths:
        try:
            data = read_json(path)
        except V2PError as error:
            notes.append(f"{error}; it was passed over")
            continue
        if not _is_label_file(data):
            continue
        files.append(path.name)
        trouble: list[str] = []
        for number, label in enumerate(data):
            name = label.get("id") if isinstance(label, dict) else None
            if not isinstance(name, str | int) or isinstance(name, bool):
                trouble.append(f"entry {number} has no id")
                continue
            stem = wanted.get(unicodedata.normalize("NFC", str(name)))
            if stem is None or stem in said:
                continue
            caption, objects, faults = _read(label)
            trouble += [f"id '{name}' {fault}" for fault in faults]
            if caption:
                said[stem] = caption, objects
        if trouble:
            notes.append(
                f"{path}: not all of it could be used ({listed(trouble, 4)}); the rest is kept"
            )
    return Labels(said=said, files=tuple(files), notes=tuple(notes))


def _is_label_file(data: Any) -> bool:
    return isinstance(data, list) and any(
        isinstance(d, dict) and "id" in d and any(key in d for key in _SAYING) for d in data
    )


def _read(label: dict[str, Any]) -> tuple[str, tuple[str, ...], list[str]]:
    """Return caption, objects (none where the caption knows more), and what of the label could not be used."""
    faults: list[str] = []
    try:
        objects = _objects(label.get("placeholders") or [])
    except V2PError as error:
        objects = []
        faults.append(str(error))
    given = label.get("label") or label.get("template")
    if not given:
        return "", (), [*faults, "has neither a label nor a template"]
    try:
        text = words(given, "its label")
    except V2PError as error:
        return "", (), [*faults, str(error)]
    slots = _SLOT.findall(str(label.get("template") or text))
    missing = len(_SLOT.findall(text)) - len(objects)
    if missing > 0:
        faults.append(f"has {len(objects)} placeholders for {len(objects) + missing} places")
    # "[number of] [something]": the first of them is no object
    is_object = [not slot.startswith("number") for slot in slots[: len(objects)]]
    is_object += [True] * (len(objects) - len(is_object))
    names = _told_apart(objects)
    text = _renamed(_filled(text, objects), objects, names)
    kept = tuple(n for n, kept in zip(names, is_object, strict=True) if kept)
    return text, kept if missing <= 0 else (), faults


def _objects(placeholders: Any) -> list[str]:
    if not isinstance(placeholders, list):
        raise V2PError(f"has placeholders that are a {type_of(placeholders)} and no list")
    return [words(p, f"has placeholders of which {shortened(repr(p), 40)}") for p in placeholders]


def _filled(text: str, objects: list[str]) -> str:
    """Return the text with its `[something]` replaced by the objects, in order; others lose their brackets."""
    left = iter(objects)
    return _SLOT.sub(lambda slot: next(left, slot.group(1)), text)


def _told_apart(objects: list[str]) -> list[str]:
    """Return names of which no two are equal."""
    names: list[str] = []
    for name in objects:
        taken = {n.casefold() for n in names}
        tried = (
            *(f"{ordinal}{name}" for ordinal in _ORDINALS),
            *(f"{name} {n}" for n in range(len(_ORDINALS), len(_ORDINALS) + len(objects) + 1)),
        )
        names.append(next(t for t in tried if t.casefold() not in taken))
    return names


def _renamed(text: str, objects: list[str], names: list[str]) -> str:
    """Return the text with each object, in the order of their places, called by its name."""
    at = 0
    for old, new in zip(objects, names, strict=True):
        found = re.compile(rf"(?<!\w){re.escape(old)}(?!\w)", re.IGNORECASE).search(text, at)
        if found:
            text = (
                text[: found.start()]
                + (new if new != old else found.group())
                + text[found.end() :]
            )
            at = found.start() + len(new)
    return text
