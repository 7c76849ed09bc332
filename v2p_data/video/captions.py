"""Which videos a folder holds, and what a person said about each.

A caption comes from `captions.json` beside the videos, else from a label file of Something-Something-v2 in the
same folder (a JSON list of `{id, label, template, placeholders}`), else from the file's own name:

    {"lift.mp4": "Lifting red box up",
     "push.mp4": {"caption": "Pushing blue box next to can", "objects": ["blue box", "can"],
                  "hints": {"can": {"frame": 0, "box": [310, 120, 380, 240], "size_m": [0.066, 0.066, 0.12]}}}}

A hint marks one object: `box` and `points` in one `frame`, `size_m`, or the `name` of what is meant where the
caption's words do not say it.
"""

import json
import os
import re
import shutil
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.video.clip import Hint
from v2p_data.video.meaning import Meaning as Meaning
from v2p_data.video.meaning import parse_caption as parse_caption

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".webm", ".mkv", ".gif")
CAPTIONS_FILE = "captions.json"
NO_CAPTION = "moving object"
"""What stands for a caption where nobody gave one and the file's name tells nothing."""
MIN_SIZE_M = 0.002
"""Thinner than a coin is a slip of the unit, and nothing a simulator can hold."""
MAX_SIZE_M = 1.5
"""No object on a table is longer."""
MAX_NAME = 60
"""Letters; a longer name is a sentence."""

_ENTRY_KEYS = ("caption", "hints", "objects")
_HINT_KEYS = ("box", "frame", "name", "points", "size_m")
_MARK_KEYS = ("box", "frame", "points")
"""What belongs to one frame and is replaced together."""
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


def find_videos(folder: Path) -> list[VideoItem]:
    """Return the videos of a folder, or the one video given, sorted by file name.

    Raises:
        V2PError: no such folder, no videos in it, or captions that cannot be used.
    """
    if not folder.exists():
        raise V2PError(f"there is no folder or video {folder}; check the path")
    home = folder if folder.is_dir() else folder.parent
    here = [p for p in sorted(home.iterdir()) if _is_video(p)]
    wanted = here if folder.is_dir() else [p for p in here if p.name == folder.name]
    if not wanted:
        raise V2PError(
            f"{folder} {'holds no videos' if folder.is_dir() else 'is no video'}; "
            f"known endings are {' '.join(VIDEO_SUFFIXES)}"
        )
    written = _read_captions(home, [p.name for p in here])
    labelled = _read_labels(home)
    items = dict(zip(here, unique_items([p.stem for p in here]), strict=True))
    return [
        _item(items[p], p, written.get(p.name) or labelled.get(p.stem) or (_from_name(p), (), {}))
        for p in wanted
    ]


def check_hints(
    hints: Mapping[str, Hint], size_px: tuple[int, int], num_frames: int, where: str
) -> None:
    """Check marks against the picture they were made in.

    Args:
        hints: by object phrase, in the file's pixels and frame numbers.
        size_px: width and height of the picture as a player shows it.
        num_frames: frames that the file holds.
        where: what a sentence begins with, such as the file's name.

    Raises:
        V2PError: a mark lies outside of the picture, or in a frame that there is not.
    """
    width, height = size_px
    for name, hint in hints.items():
        frame = hint.get("frame", 0)
        if frame >= num_frames:
            raise V2PError(
                f"{where}, hint '{name}': there is no frame {frame}; the video's frames are 0 to {num_frames - 1}"
            )
        x0, y0, x1, y1 = hint.get("box", [0, 0, width, height])
        # a box drawn to the border may round to the pixel behind it
        if x1 > width + 1 or y1 > height + 1:
            raise V2PError(
                f"{where}, hint '{name}': the box {[x0, y0, x1, y1]} reaches outside of the picture, "
                f"which is {width} x {height} px"
            )
        for x, y in hint.get("points", []):
            if not (0 <= x <= width and 0 <= y <= height):
                raise V2PError(
                    f"{where}, hint '{name}': the point {[x, y]} lies outside of the picture, "
                    f"which is {width} x {height} px"
                )


@dataclass(frozen=True, kw_only=True)
class Merged:
    """A caption file with hints added, not yet written."""

    path: Path
    captions: dict[str, Any]
    """All that the file is to hold: entries that got no hint are as they were, to the letter."""
    hints: dict[str, dict[str, Hint]]
    """By file name, all hints of each video that got one; their marks are not yet checked against the picture."""
    added: tuple[str, ...]
    """One line for each object whose hint changed."""
    kept: tuple[str, ...]
    """One sentence for each caption or list of objects that differs and stays as it is in the folder."""


def merge_captions(folder: Path, addition: Path) -> Merged:
    """Return a folder's captions with the hints of another caption file, or of a review, added.

    Nothing is taken away: hints for other objects and videos stay. For one object a new box or new points replace the
    old marks together, because they belong to one frame; a size or a name replaces only itself.

    Args:
        folder: the folder of the videos.
        addition: a `captions.json`, or a `review.json` (`{"clips": [{"video", "hints"}]}`).

    Raises:
        V2PError: no such file, the folder's own captions, a clip or an object that is not known, or a hint that
            cannot be used.
    """
    items = {video.path.name: video for video in find_videos(folder)}
    path = folder / CAPTIONS_FILE
    if addition.resolve() == path.resolve():
        raise V2PError(
            f"{addition} is the very file that the hints go into; give the one that was downloaded from the review page"
        )
    captions: dict[str, Any] = _read_json(path) if path.is_file() else {}
    changed: dict[str, dict[str, Hint]] = {}
    added: list[str] = []
    kept: list[str] = []
    for name, entry in _entries_of(addition).items():
        where = f"{addition}, entry '{name}'"
        if name not in items:
            raise V2PError(
                f"{where}: there is no such video in {folder}.{did_you_mean(name, items)}"
            )
        video = items[name]
        hints = entry.get("hints") or {}
        for key, here in (("caption", video.caption), ("objects", list(video.objects))):
            if entry.get(key, here) != here:
                kept.append(f"{name}: {key} stays {here!r}; the other file has {entry[key]!r}")
        if not hints:
            continue
        entry_here = captions.get(name)
        old: dict[str, Any] = (
            entry_here if isinstance(entry_here, dict) else {"caption": video.caption}
        )
        both: dict[str, Any] = dict(old.get("hints", {}))
        for phrase, hint in hints.items():
            both[phrase] = _merged_hint(both.get(phrase), hint)
        if both == old.get("hints", {}):
            continue
        new = {"objects": list(video.objects), **old, "hints": both}
        new = {key: new[key] for key in ("caption", "objects", "hints")}
        _, _, checked = _entry(new, where)
        changed[name] = checked
        added += [
            f"{name}, '{phrase}': {', '.join(k for k in sorted(both[phrase]) if k != 'frame')}"
            for phrase in hints
            if both[phrase] != old.get("hints", {}).get(phrase)
        ]
        captions[name] = new
    return Merged(
        path=path, captions=captions, hints=changed, added=tuple(added), kept=tuple(kept)
    )


def write_captions(merged: Merged) -> Path | None:
    """Write the caption file so that it is either whole or as it was; return the copy of the old one, if there was one.

    Raises:
        V2PError: the folder cannot be written.
    """
    path, backup = merged.path, None
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        if path.is_file():
            backup = _free_name(path)
            shutil.copyfile(path, backup)
        with temporary.open("w", encoding="utf-8") as stream:
            json.dump(merged.captions, stream, indent=1, ensure_ascii=False)
            stream.write("\n")
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        raise V2PError(
            f"{path} cannot be written: {error.strerror}; nothing was changed"
        ) from error
    return backup


def unique_items(stems: list[str]) -> list[str]:
    """Return an identifier for each file name; where two would be the same, the later gets a number."""
    taken: set[str] = set()
    items: list[str] = []
    for stem in stems:
        plain = unicodedata.normalize("NFKD", stem).encode("ascii", "ignore").decode().lower()
        base = re.sub(r"[^a-z0-9_]+", "_", plain).strip("_")[:80] or "video"
        item, number = base, 2
        while item in taken:
            item, number = f"{base}_{number}", number + 1
        taken.add(item)
        items.append(item)
    return items


def _entries_of(path: Path) -> dict[str, dict[str, Any]]:
    """Return caption, objects and hints by file name, from either kind of file."""
    data = _read_json(path)
    if not isinstance(data, dict):
        raise V2PError(
            f"{path} is neither a caption file nor a review: both are objects, not a {_type_of(data)}"
        )
    if isinstance(data.get("clips"), list):
        clips = [c for c in data["clips"] if isinstance(c, dict) and c.get("hints")]
        data = {str(c.get("video", "")): {"hints": c["hints"]} for c in clips}
    entries: dict[str, dict[str, Any]] = {}
    for name, entry in data.items():
        where = f"{path}, entry '{name}'"
        entry = {"caption": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, dict):
            raise V2PError(
                f"{where}: give a caption, or an object with caption, objects and hints, not a {_type_of(entry)}"
            )
        _check_keys(entry, _ENTRY_KEYS, where)
        if not isinstance(entry.get("hints", {}), dict):
            raise V2PError(
                f"{where}: 'hints' must be an object, name -> hint, not a {_type_of(entry['hints'])}"
            )
        entries[name] = entry
    return entries


def _merged_hint(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    if "box" in new or "points" in new:
        old = {k: v for k, v in old.items() if k not in _MARK_KEYS}
        return {**old, **new}
    return {**old, **{k: v for k, v in new.items() if k != "frame"}}


def _free_name(path: Path) -> Path:
    backup, number = path.with_name(f"{path.name}.bak"), 2
    while backup.exists():
        backup, number = path.with_name(f"{path.name}.bak{number}"), number + 1
    return backup


_Said = tuple[str, tuple[str, ...], dict[str, Hint]]
"""Caption, objects, hints."""


def _is_video(path: Path) -> bool:
    hidden = path.name.startswith(".")
    return path.suffix.lower() in VIDEO_SUFFIXES and not hidden and path.is_file()


def _item(item: str, path: Path, said: _Said) -> VideoItem:
    caption, objects, hints = said
    if not objects:
        found = parse_caption(caption).phrases
        objects = tuple(dict.fromkeys([*found, *hints]))
    return VideoItem(item=item, path=path, caption=caption, objects=objects, hints=hints)


def _read_captions(folder: Path, names: list[str]) -> dict[str, _Said]:
    path = folder / CAPTIONS_FILE
    if not path.is_file():
        return {}
    data = _read_json(path)
    if not isinstance(data, dict):
        raise V2PError(f"{path} must hold an object, file name -> caption, not a {_type_of(data)}")
    for name in data:
        if name not in names:
            raise V2PError(
                f"{path} has a caption for '{name}', which is not in the folder; "
                f"rename or remove the entry.{did_you_mean(name, names)}"
            )
    return {name: _entry(entry, f"{path}, entry '{name}'") for name, entry in data.items()}


def _entry(entry: Any, where: str) -> _Said:
    if isinstance(entry, str):
        entry = {"caption": entry}
    if not isinstance(entry, dict):
        raise V2PError(
            f"{where}: give a caption, or an object with caption, objects and hints, "
            f"not a {_type_of(entry)}"
        )
    _check_keys(entry, _ENTRY_KEYS, where)
    caption = _words(entry.get("caption"), f"{where}: 'caption'")
    objects = entry.get("objects", [])
    if not isinstance(objects, list):
        raise V2PError(f"{where}: 'objects' must be a list of names, not a {_type_of(objects)}")
    objects = tuple(_words(o, f"{where}: each of 'objects'") for o in objects)
    if len(set(objects)) < len(objects):
        raise V2PError(f"{where}: 'objects' names one object twice; give each its own name")
    hints = entry.get("hints", {})
    if not isinstance(hints, dict):
        raise V2PError(
            f"{where}: 'hints' must be an object, name -> hint, not a {_type_of(hints)}"
        )
    known = objects or parse_caption(caption).phrases
    for name in hints:
        if name not in known:
            raise V2PError(
                f"{where}: there is a hint for '{name}', which is none of the objects."
                f"{did_you_mean(name, known)}"
            )
    return caption, objects, {n: _hint(h, f"{where}, hint '{n}'") for n, h in hints.items()}


def _hint(hint: Any, where: str) -> Hint:
    if not isinstance(hint, dict):
        raise V2PError(f"{where}: must be an object, not a {_type_of(hint)}")
    _check_keys(hint, _HINT_KEYS, where)
    frame = hint.get("frame", 0)
    if not isinstance(frame, int) or isinstance(frame, bool) or frame < 0:
        raise V2PError(f"{where}: 'frame' must be a frame number from 0, not {frame!r}")
    checked = Hint(frame=frame)
    if "box" in hint:
        box = _numbers(hint["box"], 4, f"{where}: 'box' must be [x0, y0, x1, y1]")
        if not (0 <= box[0] < box[2] and 0 <= box[1] < box[3]):
            raise V2PError(
                f"{where}: 'box' needs 0 <= x0 < x1 and 0 <= y0 < y1 in pixels, got {box}"
            )
        checked["box"] = box
    if "points" in hint:
        points = hint["points"]
        if not isinstance(points, list) or not points:
            raise V2PError(f"{where}: 'points' must be a list of [x, y], not {json.dumps(points)}")
        checked["points"] = [_numbers(p, 2, f"{where}: a point must be [x, y]") for p in points]
    if "size_m" in hint:
        size = _numbers(hint["size_m"], 3, f"{where}: 'size_m' must be [length, width, height]")
        if not all(MIN_SIZE_M <= side <= MAX_SIZE_M for side in size):
            raise V2PError(
                f"{where}: 'size_m' is in metres, each from {MIN_SIZE_M} to {MAX_SIZE_M}, got {size}"
            )
        checked["size_m"] = size
    if "name" in hint:
        name = _words(hint["name"], f"{where}: 'name'")
        if len(name) > MAX_NAME:
            raise V2PError(
                f"{where}: 'name' is the object's name in a word or two, at most {MAX_NAME} letters, "
                f"not {len(name)}"
            )
        checked["name"] = name
    if len(checked) == 1:
        raise V2PError(f"{where}: says nothing; give a box, points, size_m or name")
    return checked


def _read_labels(folder: Path) -> dict[str, _Said]:
    """Return what the label files of Something-Something-v2 in the folder say, by video id."""
    said: dict[str, _Said] = {}
    for path in sorted(folder.glob("*.json")):
        if path.name == CAPTIONS_FILE:
            continue
        data = _read_json(path)
        if not (isinstance(data, list) and data and all(isinstance(d, dict) for d in data)):
            continue
        if not all("id" in d and ("label" in d or "template" in d) for d in data):
            continue
        for label in data:
            where = f"{path}, id '{label['id']}'"
            objects = label.get("placeholders", [])
            if not isinstance(objects, list):
                raise V2PError(
                    f"{where}: 'placeholders' must be a list, not a {_type_of(objects)}"
                )
            objects = [_words(o, f"{where}: each of 'placeholders'") for o in objects]
            caption = label.get("label") or _filled(str(label.get("template") or ""), objects)
            caption = _words(caption, f"{where}: 'label'")
            said.setdefault(str(label["id"]), (caption, tuple(dict.fromkeys(objects)), {}))
    return said


def _filled(template: str, objects: list[str]) -> str:
    """Return the template with its `[something]` replaced by the objects, in order."""
    for name in objects:
        template = re.sub(r"\[[^\]]*\]", lambda _, name=name: name, template, count=1)
    return template


def _from_name(path: Path) -> str:
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|[^A-Za-z0-9]+", " ", path.stem).split()
    kept = [w for w in words if not re.fullmatch(_NO_WORDS, w.lower())]
    return " ".join(kept) or NO_CAPTION


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text("utf-8-sig"), object_pairs_hook=_no_duplicates)
    except json.JSONDecodeError as error:
        raise V2PError(
            f"{path}, line {error.lineno}, column {error.colno}: {error.msg}; this is not valid JSON"
        ) from error
    except UnicodeDecodeError as error:
        raise V2PError(f"{path} is not UTF-8 text; save it as UTF-8") from error
    except RecursionError as error:
        raise V2PError(f"{path} is nested too deeply; this is no caption file") from error
    except _DuplicateKeyError as error:
        raise V2PError(f"{path} has two entries for '{error}'; remove one") from error
    except OSError as error:
        raise V2PError(f"{path} cannot be read: {error.strerror}") from error


class _DuplicateKeyError(Exception):
    pass


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise _DuplicateKeyError(key)
        seen[key] = value
    return seen


def _check_keys(data: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    for key in data:
        if key not in known:
            raise V2PError(f"{where}: unknown key '{key}'.{did_you_mean(key, known)}")


def _words(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise V2PError(f"{what} must be text, not a {_type_of(value)}")
    if not any(c.isalnum() for c in value):
        raise V2PError(f"{what} is empty; say in words what happens or what it is")
    return " ".join(value.split())


def _numbers(value: Any, count: int, what: str) -> list[float]:
    def fits(v: Any) -> bool:
        return isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e6

    if not (isinstance(value, list) and len(value) == count and all(fits(v) for v in value)):
        raise V2PError(f"{what}, {count} numbers, not {json.dumps(value)}")
    return [float(v) for v in value]


def _type_of(value: Any) -> str:
    names = {dict: "object", list: "list", str: "text", bool: "true/false", type(None): "null"}
    return names.get(type(value), "number")
