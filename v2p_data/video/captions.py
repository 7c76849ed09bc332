"""Which videos a folder holds, and what a person said about each.

A caption comes from `captions.json` beside the videos, else from a table `captions.csv` or the like
(`caption_files.py`), else from a label file of Something-Something-v2 in the same folder (`labels.py`), else from the
file's own name:

    {"lift.mp4": "Lifting red box up",
     "push.mp4": {"caption": "Pushing blue box next to can", "objects": ["blue box", "can"],
                  "hints": {"can": {"frame": 0, "box": [310, 120, 380, 240], "size_m": [0.066, 0.066, 0.12]}}}}

A hint marks one object: `box`, `click`, `stroke` or `points` in one `frame`, `size_m`, or the
    `name` of the object where
the caption's words do not say it. A hint called `table` marks the table itself. `"crop": [x, y, width, height]` says
which part of the picture counts.
"""

import hashlib
import os
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.video.caption_files import CAPTIONS_FILE as CAPTIONS_FILE
from v2p_data.video.caption_files import (
    CAPTIONS_TABLE,
    VIDEO_SUFFIXES,
    caption_files,
    written_captions,
)
from v2p_data.video.checked import check_keys, listed, same_name, type_of, words
from v2p_data.video.clip import Hint
from v2p_data.video.hints import CROP, TABLE, boxes_as_read, read_crop, read_hint
from v2p_data.video.labels import Labels, read_labels
from v2p_data.video.meaning import Meaning as Meaning
from v2p_data.video.meaning import parse_caption as parse_caption

LONGEST_ITEM = 80
"""Bytes: names of result folders add up to 40, and some file systems take 143."""
NO_CAPTION = "moving object"
"""What stands for a caption where nobody gave one and the file's name tells nothing."""

ENTRY_KEYS = ("caption", "hints", "objects")
_NO_WORDS = r"\d+|img|vid|video|videos|clip|mov|pxl|dsc|gopr|rec|screen|untitled|new|final|copy"


@dataclass(frozen=True, kw_only=True)
class VideoItem:
    """One video file and what was said about it."""

    item: str
    """Identifier, unique in its folder: lower case letters, digits and underscores."""
    path: Path
    caption: str
    objects: tuple[str, ...] = ()
    """Phrases for the objects; taken from the caption where the person listed none."""
    hints: Mapping[str, Hint] = field(default_factory=dict[str, Hint])
    """By object phrase; frame numbers and pixels are those of the file as a player shows it."""


@dataclass(frozen=True, kw_only=True)
class Footage:
    """The videos of a folder, and what a person should know about how it was read."""

    videos: tuple[VideoItem, ...]
    """Sorted by file name."""
    notes: tuple[str, ...]
    """Sentences: files that were passed over, labels that cannot be used, boxes as they were read."""


def find_videos(folder: Path) -> list[VideoItem]:
    """Return the videos of a folder, or the one video given, sorted by file name.

    Raises:
        V2PError: as `read_footage`.
    """
    return list(read_footage(folder).videos)


def read_footage(folder: Path) -> Footage:
    """Return the videos of a folder, or the one video given.

    Raises:
        V2PError: no such folder, no videos in it, or captions that cannot be used.
    """
    if not folder.exists():
        raise V2PError(f"there is no folder or video {folder}; check the path")
    home = folder if folder.is_dir() else folder.parent
    try:
        entries = sorted(home.iterdir())
    except OSError as error:
        raise V2PError(f"{home} cannot be listed: {error.strerror}") from error
    here = [p for p in entries if _is_video(p)]
    wanted = here if folder.is_dir() else [p for p in here if p.name == folder.name]
    if not wanted:
        deeper = [f"{p.name}/" for p in entries if p.is_dir() and _holds_videos(p)]
        inside = f", its folders {listed(deeper)} do" if deeper and folder.is_dir() else ""
        raise V2PError(
            f"{folder} {'holds no videos' if folder.is_dir() else 'is no video'}{inside}; "
            f"known endings are {' '.join(VIDEO_SUFFIXES)}"
        )
    written = {
        name: checked_entry(entry, f"{path}, entry '{name}'")
        for name, (entry, path) in written_captions(home, [p.name for p in here]).items()
    }
    read = caption_files(home)
    files = [p for p in entries if p.suffix.lower() == ".json" and p not in read]
    labels = read_labels([p for p in files if p.is_file()], [p.stem for p in here])
    labelled = {stem: (*said, {}) for stem, said in labels.said.items()}
    videos = tuple(
        _item(p, written.get(p.name) or labelled.get(p.stem) or (_from_name(p), (), {}))
        for p in wanted
    )
    almost = [p.name for p in read if p.name not in (CAPTIONS_FILE, CAPTIONS_TABLE)]
    almost = [p.name for p in read if p.name not in (CAPTIONS_FILE, CAPTIONS_TABLE)]
    others = _passed_over([p for p in entries if p not in read], labels) if folder.is_dir() else []
    unread = [name for name in others if "caption" in name.lower()]
    passed = [name for name in others if name not in unread]
    boxes = [box for v in videos for box in boxes_as_read(v.hints, v.path.name)]
    told = (
        (f"captions are read from {listed(almost)} in {home}", almost),
        (
            f"no captions are read from {listed(unread)} in {home}; a caption file is called {CAPTIONS_FILE} or "
            f"{CAPTIONS_TABLE}",
            unread,
        ),
        (f"{len(passed)} in {home} passed over, no videos: {listed(passed)}", passed),
        (f"boxes read as x0, y0, x1, y1 in pixels: {listed(boxes, 3)}", boxes),
    )
    notes = (*labels.notes, *(note for note, names in told if names))
    return Footage(videos=videos, notes=notes)


def item_of(name: str) -> str:
    """Return the identifier of a video, which its own file name alone decides.

    `a-z0-9_.mp4` of up to 80 letters keeps its stem. Another name keeps its letters, and a digest of it follows.
    """
    letters = (
        c if c == "_" or unicodedata.category(c)[0] in "LMN" else " "
        for c in Path(name).stem.lower()
    )
    slug = "_".join("".join(letters).split()).strip("_")
    slug = slug.encode()[:LONGEST_ITEM].decode(errors="ignore") or "video"
    if name == f"{slug}.mp4" and slug.isascii():
        return slug
    return f"{slug}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:10]}"


_Said = tuple[str, tuple[str, ...], dict[str, Hint]]
"""Caption, objects, hints."""


def _is_video(path: Path) -> bool:
    hidden = path.name.startswith(".")
    return path.suffix.lower() in VIDEO_SUFFIXES and not hidden and path.is_file()


def _item(path: Path, said: _Said) -> VideoItem:
    caption, objects, hints = said
    if not objects:
        found = parse_caption(caption).phrases
        objects = tuple(
            dict.fromkeys([*found, *(name for name in hints if name not in (TABLE, CROP))])
        )
    return VideoItem(
        item=item_of(path.name), path=path, caption=caption, objects=objects, hints=hints
    )


def checked_entry(entry: Any, where: str) -> _Said:
    """Return caption, objects and hints of an entry of a caption file.

    Raises:
        V2PError: it cannot be used; the sentence begins with `where`.
    """
    if isinstance(entry, str):
        entry = {"caption": entry}
    if not isinstance(entry, dict):
        raise V2PError(
            f"{where}: give a caption, or an object with caption, objects and hints, "
            f"not a {type_of(entry)}"
        )
    check_keys(entry, ENTRY_KEYS, where)
    caption = words(entry.get("caption"), f"{where}: 'caption'")
    objects = entry.get("objects", [])
    if not isinstance(objects, list):
        raise V2PError(f"{where}: 'objects' must be a list of names, not a {type_of(objects)}")
    objects = tuple(words(o, f"{where}: each of 'objects'") for o in objects)
    if len(set(objects)) < len(objects):
        raise V2PError(f"{where}: 'objects' names one object twice; give each its own name")
    hints = entry.get("hints", {})
    if not isinstance(hints, dict):
        raise V2PError(f"{where}: 'hints' must be an object, name -> hint, not a {type_of(hints)}")
    known = (*(objects or parse_caption(caption).phrases), TABLE, CROP)
    checked: dict[str, Hint] = {}
    for said_name, hint in hints.items():
        name = same_name(said_name, known)
        if name is None:
            raise V2PError(
                f"{where}: there is a hint for '{said_name}', which is none of the objects."
                f"{did_you_mean(said_name, known)}"
            )
        read = read_crop if name == CROP and CROP not in objects else read_hint
        checked[name] = read(hint, f"{where}, hint '{said_name}'")
    return caption, objects, checked


def _passed_over(entries: list[Path], labels: Labels) -> list[str]:
    """Return the names of files that are neither videos nor about them, and of folders with videos in them."""
    names: list[str] = []
    for path in entries:
        name = path.name
        if (
            name.startswith((".", f"{CAPTIONS_FILE}.bak"))
            or name in labels.files
            or _is_video(path)
        ):
            continue
        if not path.is_dir():
            names.append(name)
        elif path.suffix.lower() in VIDEO_SUFFIXES or _holds_videos(path):
            names.append(f"{name}/")
    return names


def _holds_videos(folder: Path) -> bool:
    try:
        return any(_is_video(p) for p in folder.iterdir())
    except OSError:
        return False


def _from_name(path: Path) -> str:
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|[^A-Za-z0-9]+", " ", path.stem).split()
    kept = [w for w in words if not re.fullmatch(_NO_WORDS, w.lower())]
    return " ".join(kept) or NO_CAPTION
