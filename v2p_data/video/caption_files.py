"""Captions that lie in files beside the videos: JSON, JSON Lines, or tables of programs.

`captions.json` goes before `captions.csv`, and both before files that are almost named so, and before `metadata.csv`
and `metadata.jsonl` of a Hugging Face folder.
"""

import csv
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.json_files import read_json
from v2p_data.video.checked import same_name, shortened, type_of

CAPTIONS_FILE = "captions.json"
CAPTIONS_TABLE = "captions.csv"
MAX_TABLE_BYTES = 20_000_000
VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".qt", ".3gp", ".3g2"),
    *(".mkv", ".webm", ".avi", ".gif", ".ogv", ".flv", ".wmv", ".asf"),
    *(".mpg", ".mpeg", ".ts", ".mts", ".m2ts"),
)
"""In small letters or capitals."""

_NAME = re.compile(
    r"captions?\.(?P<form>jsonl?|csv|tsv)(?:\.txt)?|metadata\.(?:csv|jsonl)", re.IGNORECASE
)
_FILE_TITLES = ("file", "file_name", "filename", "video", "video_file", "path", "name", "clip")
_CAPTION_TITLES = ("caption", "captions", "text", "description", "label", "prompt")
_NO_TITLES = ("", "unnamed: 0", "index", "id")
"""What stands over the column of row numbers that pandas writes."""


def caption_files(folder: Path) -> list[Path]:
    """Return the files of a folder that hold captions, those with the last word last."""
    rank = (CAPTIONS_TABLE, CAPTIONS_FILE)
    files = [p for p in sorted(folder.iterdir()) if _NAME.fullmatch(p.name) and p.is_file()]
    files = [
        p for p in files if not p.name.lower().startswith("metadata") or _is_of_hugging_face(p)
    ]
    return sorted(files, key=lambda p: rank.index(p.name) if p.name in rank else -1)


def written_captions(folder: Path, names: Sequence[str]) -> dict[str, tuple[Any, Path]]:
    """Return what caption files say of a folder's videos, and which file; `{}` where there is none.

    Args:
        folder: the folder of the videos.
        names: the videos' file names.

    Raises:
        V2PError: a file holds no captions, or it names a file that is not there or names one twice.
    """
    written: dict[str, tuple[Any, Path]] = {}
    for path in caption_files(folder):
        form = path.name.lower().removesuffix(".txt").rpartition(".")[2]
        data = {"json": read_json, "jsonl": _read_lines}.get(form, _read_table)(path)
        if isinstance(data, list) and data and all(_file_key(row) for row in data):
            data = _of_rows(path, enumerate(data, 1), "entry")
        if not isinstance(data, dict):
            raise V2PError(
                f"{path} must hold an object, file name -> caption, not a {type_of(data)}"
            )
        for name, entry in _of_the_folder(data, path, names).items():
            written[name] = entry, path
    return written


def _is_of_hugging_face(path: Path) -> bool:
    with path.open("rb") as file:
        titles = re.findall(r"\w+", file.readline(10_000).decode("utf-8", "replace").lower())
    return "file_name" in titles and not set(titles).isdisjoint(_CAPTION_TITLES)


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


def _file_key(row: Any) -> str | None:
    """Return under which key an object holds the file that it is about; None where it is no such object."""
    titles = _FILE_TITLES if isinstance(row, dict) else ()
    return next((k for k in titles if isinstance(row.get(k), str)), None)


def _of_rows(path: Path, rows: Any, what: str) -> dict[str, Any]:
    """Return the entries of numbered objects: a file and what is said of it, or names of files with their entries."""
    found: dict[str, Any] = {}
    for number, row in rows:
        if not isinstance(row, dict):
            raise V2PError(f"{path}, {what} {number}, must be an object, not a {type_of(row)}")
        if key := _file_key(row):
            caption = next((row[k] for k in _CAPTION_TITLES if k in row), None)
            row = {
                row[key]: {"caption": caption}
                | {k: row[k] for k in ("objects", "hints") if k in row}
            }
        for name, entry in row.items():
            _add(found, name, entry, path)
    return found


def _add(found: dict[str, Any], name: str, entry: Any, path: Path) -> None:
    if name in found:
        raise V2PError(f"{path} has two entries for '{shortened(name)}'; remove one")
    found[name] = entry


def _read_lines(path: Path) -> dict[str, Any]:
    """Return the entries of JSON Lines."""
    rows: list[tuple[int, Any]] = []
    for number, line in enumerate(_text_of(path).splitlines(), 1):
        try:
            rows += [(number, json.loads(line))] if line.strip() else []
        except (ValueError, RecursionError) as error:
            raise V2PError(
                f"{path}, line {number}, is no JSON ({error}); JSON Lines hold an object a line"
            ) from error
    return _of_rows(path, rows, "line")


def _text_of(path: Path) -> str:
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
    return text


def _read_table(path: Path) -> dict[str, str]:
    """Return the captions of a table: of two columns, or of more where a row of titles tells them apart."""
    text = _text_of(path)
    said = re.match(
        r"\"?sep=(.)\"?\s*?(?:\r\n|\r|\n)", text, re.IGNORECASE
    )  # as table programs note it
    between = said[1] if said else next((c for c in text if c in ",;\t"), ",")
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=between, strict=True)
    try:
        read = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except csv.Error as error:
        raise V2PError(
            f"{path}, line {rows.line_num}, is no row of a table ({error}); is a quotation mark left open?"
        ) from error
    table = [(line, cells) for line, cells in read[bool(said) :] if any(cells)]
    columns = _columns(table[0][1]) if table else None
    count = len(table.pop(0)[1]) if columns else 2
    file, caption = columns or (0, 1)
    found: dict[str, str] = {}
    for line, cells in table:
        if not columns and len(cells) == 3 and cells[0].isdecimal():
            del cells[0]
        if len(cells) != count:
            raise V2PError(
                f"{path}, line {line}, has {len(cells)} cells, not {count}"
                f"{'' if columns else f', file{between}caption'}; put a caption that holds "
                f"'{between}' between quotation marks"
            )
        _add(found, cells[file], cells[caption], path)
    return found


def _columns(cells: list[str]) -> tuple[int, int] | None:
    """Return which columns hold file and caption, by the row of titles; None where it is a row of them."""
    titles = [cell.lower() for cell in cells]
    captions = [i for i, title in enumerate(titles) if title in _CAPTION_TITLES]
    if not captions or any(title.endswith(VIDEO_SUFFIXES) for title in titles):
        return None
    others = [i for i, title in enumerate(titles) if i != captions[0] and title not in _NO_TITLES]
    files = [i for i in others if titles[i] in _FILE_TITLES] or others
    return (files[0], captions[0]) if files else None
