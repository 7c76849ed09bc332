"""A mark goes into the caption file beside the videos: what is there stays, and a kill loses nothing."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.video.caption_files import CAPTIONS_FILE, written_captions
from v2p_data.video.captions import (
    VideoItem,
    checked_entry,
    find_videos,
)
from v2p_data.video.clip import Hint


def save_hint(
    video: VideoItem, phrase: str, hint: Mapping[str, Any] | None, *, keeps_old: bool
) -> dict[str, Hint]:
    """Put one object's hint in place of its old one, or take it away, and return all hints of the video.

    All else that the file holds at this moment stays, what somebody wrote into it meanwhile too. The file is either
    whole or as it was.

    Args:
        video: the video, beside its caption file.
        phrase: the object.
        hint: None takes the old one away.
        keeps_old: the file as it was is copied beside it.

    Raises:
        V2PError: the caption file or the hint cannot be used, or the folder cannot be written.
    """
    folder, name = video.path.parent, video.path.name
    path = folder / CAPTIONS_FILE
    names = [other.path.name for other in find_videos(folder)]
    captions = {name: entry for name, (entry, _) in written_captions(folder, names).items()}
    old = captions.get(name, {})
    old = old if isinstance(old, dict) else {"caption": old}
    hints = {key: value for key, value in old.get("hints", {}).items() if key != phrase}
    if hint is not None:
        hints[phrase] = dict(hint)
    new = {"caption": video.caption, "objects": list(video.objects), **old, "hints": hints}
    new = {key: new[key] for key in ("caption", "objects", "hints")}
    _, _, checked = checked_entry(new, f"{path}, entry '{name}'")
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        if keeps_old and path.is_file():
            shutil.copyfile(path, _free_name(path))
        with temporary.open("w", encoding="utf-8") as stream:
            json.dump({**captions, name: new}, stream, indent=1, ensure_ascii=False)
            stream.write("\n")
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        raise V2PError(
            f"{path} cannot be written: {error.strerror}; nothing was changed"
        ) from error
    return checked


def _free_name(path: Path) -> Path:
    backup, number = path.with_name(f"{path.name}.bak"), 2
    while backup.exists():
        backup, number = path.with_name(f"{path.name}.bak{number}"), number + 1
    return backup
