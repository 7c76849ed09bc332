"""Hints go into the caption file beside the videos: what is there stays, and a kill loses nothing."""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.json_files import read_json
from v2p_data.video.captions import (
    CAPTIONS_FILE,
    ENTRY_KEYS,
    VideoItem,
    checked_entry,
    find_videos,
    written_captions,
)
from v2p_data.video.checked import check_keys, same_name, type_of
from v2p_data.video.clip import Hint
from v2p_data.video.hints import MARK_KEYS


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
        V2PError: no such file, the folder's own captions, an unknown clip or object, or a hint of no use.
    """
    items = {video.path.name: video for video in find_videos(folder)}
    path = folder / CAPTIONS_FILE
    if addition.resolve() == path.resolve():
        raise V2PError(
            f"{addition} is the very file that the hints go into; give the one that was downloaded from the review page"
        )
    captions = written_captions(folder, list(items))
    changed: dict[str, dict[str, Hint]] = {}
    added: list[str] = []
    kept: list[str] = []
    for said_name, entry in _entries_of(addition).items():
        where = f"{addition}, entry '{said_name}'"
        name = same_name(said_name, items)
        if name is None:
            raise V2PError(
                f"{where}: there is no such video in {folder}.{did_you_mean(said_name, items)}"
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
        hints = {same_name(phrase, both) or phrase: hint for phrase, hint in hints.items()}
        for phrase, hint in hints.items():
            both[phrase] = _merged_hint(both.get(phrase), hint)
        if both == old.get("hints", {}):
            continue
        new = {"objects": list(video.objects), **old, "hints": both}
        new = {key: new[key] for key in ("caption", "objects", "hints")}
        _, _, checked = checked_entry(new, where)
        changed[name] = checked
        added += [
            f"{name}, '{phrase}': {', '.join(str(k) for k in both[phrase] if k != 'frame')}"
            for phrase in hints
            if both[phrase] != old.get("hints", {}).get(phrase)
        ]
        captions[name] = new
    return Merged(
        path=path, captions=captions, hints=changed, added=tuple(added), kept=tuple(kept)
    )


def with_hint(
    folder: Path, video: VideoItem, phrase: str, hint: Mapping[str, Any] | None
) -> Merged:
    """Return a folder's captions with one object's hint in place of its old one, or without any.

    All else that the file holds at this moment stays, what somebody wrote into it meanwhile too.

    Raises:
        V2PError: the caption file or the hint cannot be used.
    """
    names = [other.path.name for other in find_videos(folder)]
    captions = written_captions(folder, names)
    name = video.path.name
    old = captions.get(name, {})
    old = old if isinstance(old, dict) else {"caption": old}
    hints = {key: value for key, value in old.get("hints", {}).items() if key != phrase}
    if hint is not None:
        hints[phrase] = dict(hint)
    new = {"caption": video.caption, "objects": list(video.objects), **old, "hints": hints}
    new = {key: new[key] for key in ("caption", "objects", "hints")}
    _, _, checked = checked_entry(new, f"{folder / CAPTIONS_FILE}, entry '{name}'")
    return Merged(
        path=folder / CAPTIONS_FILE, captions={**captions, name: new}, hints={name: checked}, added=(phrase,), kept=(),
    )  # fmt: skip


def write_captions(merged: Merged, *, keeps_old: bool = True) -> Path | None:
    """Write the caption file so that it is either whole or as it was; return the copy of the old one, if one was kept.

    Raises:
        V2PError: the folder cannot be written.
    """
    path, backup = merged.path, None
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        if keeps_old and path.is_file():
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


def _entries_of(path: Path) -> dict[str, dict[str, Any]]:
    """Return caption, objects and hints by file name, from either kind of file."""
    data = read_json(path)
    if not isinstance(data, dict):
        raise V2PError(
            f"{path} is neither a caption file nor a review: both are objects, not a {type_of(data)}"
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
                f"{where}: give a caption, or an object with caption, objects and hints, not a {type_of(entry)}"
            )
        check_keys(entry, ENTRY_KEYS, where)
        if not isinstance(entry.get("hints", {}), dict):
            raise V2PError(
                f"{where}: 'hints' must be an object, name -> hint, not a {type_of(entry['hints'])}"
            )
        entries[name] = entry
    return entries


def _merged_hint(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    if any(key in new for key in MARK_KEYS if key != "frame"):
        old = {k: v for k, v in old.items() if k not in MARK_KEYS}
        return {**old, **new}
    return {**old, **{k: v for k, v in new.items() if k != "frame"}}


def _free_name(path: Path) -> Path:
    backup, number = path.with_name(f"{path.name}.bak"), 2
    while backup.exists():
        backup, number = path.with_name(f"{path.name}.bak{number}"), number + 1
    return backup
