"""Which videos a folder holds, and what a person said about each.

A caption comes from `captions.json` beside the videos, else from a table `captions.csv` (file,caption), else from a
label file of Something-Something-v2 in the same folder (`labels.py`), else from the file's own name:

    {"lift.mp4": "Lifting red box up",
     "push.mp4": {"caption": "Pushing blue box next to can", "objects": ["blue box", "can"],
                  "hints": {"can": {"frame": 0, "box": [310, 120, 380, 240], "size_m": [0.066, 0.066, 0.12]}}}}

A hint marks one object: `box`, `click`, `stroke` or `points` in one `frame`, `size_m`, or the
    `name` of the object where
the caption's words do not say it. A hint called `table` marks the table itself. `"crop": [x, y, width, height]` says
which part of the picture counts.
"""

import csv
import io
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.json_files import read_json
from v2p_data.video.checked import check_keys, listed, same_name, shortened, type_of, words
from v2p_data.video.clip import Hint
from v2p_data.video.hints import CROP, TABLE, boxes_as_read, read_crop, read_hint
from v2p_data.video.labels import Labels, read_labels
from v2p_data.video.meaning import Meaning as Meaning
from v2p_data.video.meaning import parse_caption as parse_caption

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".qt", ".3gp", ".3g2"),
    *(".mkv", ".webm", ".avi", ".gif", ".ogv", ".flv", ".wmv", ".asf"),
    *(".mpg", ".mpeg", ".ts", ".mts", ".m2ts"),
)
"""In small letters or capitals."""
CAPTIONS_FILE = "captions.json"
CAPTIONS_TABLE = "captions.csv"
MAX_TABLE_BYTES = 20_000_000
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
        for name, (entry, path) in _written(home, [p.name for p in here]).items()
    }
    files = [p for p in entries if p.suffix.lower() == ".json" and p.name != CAPTIONS_FILE]
    labels = read_labels([p for p in files if p.is_file()], [p.stem for p in here])
    labelled = {stem: (*said, {}) for stem, said in labels.said.items()}
    ids = dict(zip(here, unique_items([p.stem for p in here]), strict=True))
    videos = tuple(
        _item(ids[p], p, written.get(p.name) or labelled.get(p.stem) or (_from_name(p), (), {}))
        for p in wanted
    )
    passed = _passed_over(entries, labels) if folder.is_dir() else []
    boxes = [box for v in videos for box in boxes_as_read(v.hints, v.path.name)]
    notes = [
        *labels.notes,
        *([f"{len(passed)} in {home} passed over, no videos: {listed(passed)}"] if passed else []),
        *([f"boxes read as x0, y0, x1, y1 in pixels: {listed(boxes, 3)}"] if boxes else []),
    ]
    return Footage(videos=videos, notes=tuple(notes))


def written_captions(folder: Path, names: Sequence[str]) -> dict[str, Any]:
    """Return the content of a folder's caption file, under the names as the folder has them; `{}` where there is none.

    Args:
        folder: the folder of the videos.
        names: the videos' file names.

    Raises:
        V2PError: no JSON object, or it names a file that is not there or names one twice.
    """
    return {name: entry for name, (entry, _) in _written(folder, names).items()}


def _written(folder: Path, names: Sequence[str]) -> dict[str, tuple[Any, Path]]:
    """Return each entry with the file that it is from; of two entries for a video that of `captions.json`."""
    written: dict[str, tuple[Any, Path]] = {}
    for file, read in ((CAPTIONS_TABLE, _read_table), (CAPTIONS_FILE, read_json)):
        path = folder / file
        if path.is_file():
            data = read(path)
            if not isinstance(data, dict):
                raise V2PError(
                    f"{path} must hold an object, file name -> caption, not a {type_of(data)}"
                )
            for name, entry in _of_the_folder(data, path, names).items():
                written[name] = entry, path
    return written


def _of_the_folder(data: dict[str, Any], path: Path, names: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for said_name, entry in data.items():
        name = same_name(said_name, names)
        if name is None:
            raise V2PError(
                f"{path} has a caption for '{shortened(said_name)}', which is not in the folder; "
                f"rename or remove the entry.{did_you_mean(said_name, names)}"
            )
        if name in found:
            raise V2PError(
                f"{path} has two entries for '{name}', with its accents encoded in two ways; remove one"
            )
        found[name] = entry
    return found


def _read_table(path: Path) -> dict[str, str]:
    """Return the captions of a table of two columns, with a row of titles or without one."""
    try:
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise V2PError(f"{path} has more than {MAX_TABLE_BYTES // 10**6} MB; split the folder")
        text = path.read_bytes().decode("utf-8-sig")
        is_text = "\0" not in text  # UTF-16 of English words decodes
    except OSError as error:
        raise V2PError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError:
        text, is_text = "", False
    if not is_text:
        raise V2PError(
            f"{path} is not UTF-8 text; save it as UTF-8 ('CSV UTF-8' in a table program)"
        )
    between = next((c for c in text if c in ",;\t"), ",")
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=between, strict=True)
    try:
        read = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except csv.Error as error:
        raise V2PError(
            f"{path}, line {rows.line_num}, is no row of a table ({error}); is a quotation mark left open?"
        ) from error
    table = [(line, cells) for line, cells in read if any(cells)]
    if table and _are_titles(table[0][1]):
        del table[0]
    found: dict[str, str] = {}
    for line, cells in table:
        if len(cells) != 2:
            raise V2PError(
                f"{path}, line {line}, has {len(cells)} cells, not two, file{between}caption; put a caption that holds "
                f"'{between}' between quotation marks"
            )
        if cells[0] in found:
            raise V2PError(f"{path} has two entries for '{shortened(cells[0])}'; remove one")
        found[cells[0]] = cells[1]
    return found


def _are_titles(cells: list[str]) -> bool:
    return not cells[0].lower().endswith(VIDEO_SUFFIXES) and cells[-1].lower() == "caption"


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


_Said = tuple[str, tuple[str, ...], dict[str, Hint]]
"""Caption, objects, hints."""


def _is_video(path: Path) -> bool:
    hidden = path.name.startswith(".")
    return path.suffix.lower() in VIDEO_SUFFIXES and not hidden and path.is_file()


def _item(item: str, path: Path, said: _Said) -> VideoItem:
    caption, objects, hints = said
    if not objects:
        found = parse_caption(caption).phrases
        objects = tuple(
            dict.fromkeys([*found, *(name for name in hints if name not in (TABLE, CROP))])
        )
    return VideoItem(item=item, path=path, caption=caption, objects=objects, hints=hints)


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
            name.startswith((".", CAPTIONS_FILE, CAPTIONS_TABLE))
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
