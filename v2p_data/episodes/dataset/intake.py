"""A dataset that anybody may have made is checked before its tables are read: files, sizes, metadata.

Format strings, counts and compressed tables of a few bytes can ask for all memory, and a pipe in a
file's place never ends.
"""

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from annotated_types import Ge, Le, Len
from pydantic import AfterValidator, ConfigDict, StringConstraints

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.scene.files import is_plain_path, own_file, read_own
from v2p_data.scene.schema import FileModel, parsed

INFO_FILE = "meta/info.json"
STATS_FILE = "meta/stats.json"
MAX_JSON_BYTES = {
    INFO_FILE: 5_000_000,
    STATS_FILE: 20_000_000,
    "meta/v2p.json": 200_000_000,
    "record.json": 50_000_000,
}
MAX_FILES = 1_000_000
MAX_TABLE_BYTES = {
    "meta/tasks.parquet": 2**26,
    "meta/episodes/*/*.parquet": 2**30,
    "data/*/*.parquet": 2**30,
}
"""Of all files of a kind, once read: seven million frames of a robot with two arms."""
MAX_COUNT = 100_000_000
MAX_ENTRIES = 50_000_000
"""Of a column in one row: a picture of 4,000 x 4,000."""
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8}
_TEXT = 16
"""Bytes of a text or a picture, less its letters, which are counted apart."""
_PATTERN = re.compile(
    r"(?:[A-Za-z0-9._/ -]|\{video_key\}|\{(?:chunk|file)_index(?::0?[1-9]d)?\})+", re.ASCII
)
ADVICE = "copy the dataset anew, or ask whoever made it"


def _file_pattern(text: str) -> str:
    if not _PATTERN.fullmatch(text) or not is_plain_path(text.replace(":", "")):
        raise ValueError(
            "is no path inside the dataset with the fields {chunk_index:03d}, {file_index:03d} and {video_key}"
        )
    return text


def _column_name(text: str) -> str:
    if "/" in text or not is_plain_path(text):
        raise ValueError("is no name of a column: up to 255 letters, no slash")
    return text


def _few(shape: tuple[int, ...]) -> tuple[int, ...]:
    if np.prod(shape, dtype=float) > MAX_ENTRIES:
        raise ValueError(f"asks for more than {MAX_ENTRIES:,} entries a row")
    return shape


Count = Annotated[int, Ge(0), Le(MAX_COUNT)]
Size = Annotated[int, Ge(1), Le(1_000_000)]
Pattern = Annotated[str, StringConstraints(max_length=200), AfterValidator(_file_pattern)]
Line = Annotated[str, StringConstraints(max_length=1_000)]


class _Open(FileModel):
    """Later versions of LeRobot may say more."""

    model_config = ConfigDict(extra="ignore")


class FeatureEntry(_Open):
    dtype: Annotated[str, StringConstraints(pattern=r"^[a-z]\w{1,31}$")]
    shape: Annotated[tuple[Annotated[int, Ge(1)], ...], Len(0, 8), AfterValidator(_few)]
    info: dict[str, Any] | None = None


class InfoFile(_Open):
    """The fields of LeRobot's `DatasetInfo`, as far as they are read."""

    codebase_version: Line
    fps: Annotated[float, Ge(1), Le(1_000)]
    features: Annotated[
        dict[Annotated[str, AfterValidator(_column_name)], FeatureEntry], Len(0, 1_000)
    ]
    total_episodes: Count
    total_frames: Count
    total_tasks: Count = 0
    chunks_size: Size = 1_000
    data_files_size_in_mb: Size = 100
    video_files_size_in_mb: Size = 200
    data_path: Pattern | None = None
    video_path: Pattern | None = None
    robot_type: Line | None = None
    splits: dict[Line, Line] | None = None


def demand_bounded(root: Path) -> None:
    """Raise unless a dataset's files, metadata and tables can be read in bounded memory and time.

    What is damaged otherwise, or missing, is left to `tables.layout_problems`.

    Raises:
        V2PError: names the file, what is wrong with it and what was possible.
    """
    _demand_plain(root)
    check_info(root)
    _check_stats(root)
    for pattern, most in MAX_TABLE_BYTES.items():
        files = sorted(root.glob(pattern))
        size = sum(sum(_decoded(path)) for path in files)
        if size > most:
            raise V2PError(
                f"{root / pattern} holds {size / 1e9:.1f} GB once it is read, and at most {most / 1e9:.1f} GB are; "
                "split the dataset, or ask whoever made it"
            )
    if (root / "meta/episodes").is_dir():
        _check_episodes(root)


def check_info(root: Path) -> None:
    """Raise unless `meta/info.json`, which is there, says what it may."""
    parsed(
        read_own(root, INFO_FILE, MAX_JSON_BYTES[INFO_FILE]), InfoFile, root / INFO_FILE, ADVICE
    )


def _demand_plain(root: Path) -> None:
    home, count = root.resolve(), 0
    for folder, subfolders, names in os.walk(root):
        for name in (*subfolders, *names):
            path = Path(folder) / name
            relative = path.relative_to(root).as_posix()
            try:
                mode = path.stat().st_mode
                is_inside = not path.is_symlink() or path.resolve().is_relative_to(home)
            except OSError as error:
                raise V2PError(f"{path} leads nowhere ({error.strerror}); {ADVICE}") from error
            if not is_inside:
                own_file(root, relative, 2**63)  # the Hub's cache consists of links
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise V2PError(
                    f"{path} is a pipe or a device, and a dataset holds plain files; {ADVICE}"
                )
            most = MAX_JSON_BYTES.get(relative)
            if most is not None and path.stat().st_size > most:
                raise V2PError(
                    f"{path} has {path.stat().st_size / 1e6:.0f} MB, at most {most / 1e6:g} MB are read; {ADVICE}"
                )
            count += 1
        if count > MAX_FILES:
            raise V2PError(
                f"{root} holds more than {MAX_FILES:,} files; name the folder of one dataset"
            )


def _check_stats(root: Path) -> None:
    found = json_or_none(root / STATS_FILE)
    if found is None:
        return
    for key, stats in found.items() if isinstance(found, dict) else [("the file", found)]:
        if not isinstance(stats, dict):
            raise V2PError(
                f"{root / STATS_FILE}: {str(key)[:100]!r} is no object of statistics; {ADVICE}"
            )
        for name, value in stats.items():
            try:
                kind = np.asarray(value).dtype.kind
            except ValueError:  # lists of unlike lengths
                kind = "O"
            if kind not in "biuf":
                raise V2PError(
                    f"{root / STATS_FILE}: {str(name)[:100]!r} of {str(key)[:100]!r} is no array of numbers; {ADVICE}"
                )


def _decoded(path: Path) -> Iterator[int]:
    """Yield how many bytes the parts of a table take once they are read, from what the file says of itself."""
    try:
        file = pq.ParquetFile(path)
    except (pa.ArrowException, OSError):
        return
    metadata = file.metadata
    repeated: set[str] = set()
    for group in range(metadata.num_row_groups):
        for k in range(metadata.num_columns):
            part = metadata.row_group(group).column(k)
            yield part.num_values * _WIDTHS.get(part.physical_type, _TEXT)
            if part.physical_type not in _WIDTHS:
                if not part.path_in_schema.endswith(".bytes"):  # pictures are read one by one
                    yield part.total_uncompressed_size
                if part.num_values * part.total_uncompressed_size > min(MAX_TABLE_BYTES.values()):
                    repeated.add(part.path_in_schema)
    yield from _repeated(path, sorted(n for n in repeated if not n.endswith(".bytes")))


def _repeated(path: Path, names: list[str]) -> Iterator[int]:
    """Yield the bytes of texts that stand in the file once and in its rows many times."""
    if not names:
        return
    file = pq.ParquetFile(path, read_dictionary=names)
    for batch in file.iter_batches(columns=names):
        for column in batch.columns:
            while not isinstance(column, pa.DictionaryArray | pa.StringArray | pa.BinaryArray):
                if not hasattr(column, "flatten"):
                    return
                column = column.flatten()
                column = column[0] if isinstance(column, list) else column
            if isinstance(column, pa.DictionaryArray):
                lengths = np.array([len(text or "") for text in column.dictionary.to_pylist()])
                counts = np.bincount(column.indices.drop_null().to_numpy(), minlength=len(lengths))
                yield int(lengths.astype(np.float64) @ counts)


def _check_episodes(root: Path) -> None:
    """Raise where the episode table counts what cannot be counted, or its instructions are no texts."""
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        try:
            schema = pq.read_schema(path)
            names = [n for n in schema.names if n == "length" or n.endswith("_index")]
            table = pq.read_table(path, columns=names)
        except (pa.ArrowException, OSError):
            return
        words = (
            pq.read_table(path, columns=["tasks"]).column(0) if "tasks" in schema.names else None
        )
        if words is not None and not (_is_texts(words.type) and _is_whole(words)):
            raise V2PError(f"{path}: 'tasks' is no column of lists of texts; {ADVICE}")
        for name, column in zip(table.column_names, table.columns, strict=True):
            if not pa.types.is_integer(column.type) or column.null_count:
                raise V2PError(f"{path}: '{name}' is no column of whole numbers; {ADVICE}")
            values = column.to_numpy()
            if len(values) and not 0 <= values.min() <= values.max() <= MAX_COUNT:
                raise V2PError(
                    f"{path}: '{name}' runs from {values.min()} to {values.max()}, possible are 0 "
                    f"to {MAX_COUNT:,}; {ADVICE}"
                )


def _is_whole(lists: pa.ChunkedArray) -> bool:
    return not lists.null_count and not pc.call_function("list_flatten", [lists]).null_count


def _is_texts(kind: pa.DataType) -> bool:
    is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind)
    return is_list and any(
        f(kind.value_type) for f in (pa.types.is_string, pa.types.is_large_string)
    )
