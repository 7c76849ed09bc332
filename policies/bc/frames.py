"""All frames of a dataset in memory, pictures as the network takes them: what a trainer draws its batches from.

Video is decoded once, from the first frame of each file to the last, and what the encoders prepare of it is kept in a
cache of memory-mapped arrays beside the training. The cache knows which dataset and which encoder it was made for and
is made anew when either has changed, or where its arrays have not the checksums that were written beside them. It is
whole or absent, and one process at a time reads or writes it.
"""

import hashlib
import json
import logging
import shutil
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from filelock import FileLock
from jaxtyping import Float32, Int64, UInt8
from torch import Tensor

from policies.bc.encoders import PREPARE_VERSION, CameraEncoder, Prepared
from policies.bc.modeling_v2p_bc import BCNet

logger = logging.getLogger(__name__)

CACHE_FILE = "cache.json"
CACHE_VERSION = 2
DECODED_AT_ONCE = 64
ACTION = "action"


class DatasetError(ValueError):
    """A dataset cannot be trained on; the message names file and field."""


@dataclass(kw_only=True)
class FrameTable:
    """Frames of many episodes, in order. Rows of an episode follow each other."""

    pictures: dict[str, Prepared]
    """Per camera what its encoder prepared, `(frame, ...)`."""
    vectors: dict[str, Float32[Tensor, "frame dim"]]
    """States, as recorded."""
    action: Float32[Tensor, "frame act"]
    task: Int64[Tensor, "frame"]
    """Index into `tasks`."""
    tasks: list[str]
    first: Int64[Tensor, "frame"]
    """Row at which the frame's episode starts."""
    last: Int64[Tensor, "frame"]
    """Row at which it ends, itself included."""

    def __len__(self) -> int:
        return len(self.action)

    def extended(self, other: "FrameTable") -> "FrameTable":
        """Return this table followed by the frames of another one."""
        tasks = [*self.tasks, *(t for t in other.tasks if t not in self.tasks)]
        renumbered = torch.tensor([tasks.index(t) for t in other.tasks])[other.task]
        return FrameTable(
            pictures={
                key: {
                    name: torch.cat([value, other.pictures[key][name]])
                    for name, value in prepared.items()
                }
                for key, prepared in self.pictures.items()
            },
            vectors={k: torch.cat([v, other.vectors[k]]) for k, v in self.vectors.items()},
            action=torch.cat([self.action, other.action]),
            task=torch.cat([self.task, renumbered]),
            tasks=tasks,
            first=torch.cat([self.first, other.first + len(self)]),
            last=torch.cat([self.last, other.last + len(self)]),
        )

    @property
    def num_bytes(self) -> int:
        """Memory of pictures, states and actions [bytes]."""
        pictures = [value for prepared in self.pictures.values() for value in prepared.values()]
        return sum(value.nbytes for value in [*pictures, *self.vectors.values(), self.action])

    def on(self, device: torch.device) -> "FrameTable":
        """Return this table with pictures, states and actions on a device; indices stay on the CPU."""
        return replace(
            self,
            pictures=moved(self.pictures, device),
            vectors=moved(self.vectors, device),
            action=moved(self.action, device),
        )

    def batch(
        self, rows: Int64[Tensor, "n"], observed: Sequence[int], acted: Sequence[int]
    ) -> dict[str, Any]:
        """Return training samples: observations around each row and the actions from it on.

        Args:
            rows: frames.
            observed: steps relative to the row, repeated at the episode's start.
            acted: steps of the action chunk; beyond the episode's end `action_is_pad` is true.
        """
        first, last = self.first[rows][:, None], self.last[rows][:, None]
        seen = torch.minimum(torch.maximum(rows[:, None] + torch.tensor(observed), first), last)
        wanted = rows[:, None] + torch.tensor(acted)
        taken = torch.minimum(wanted, last).to(self.action.device)
        seen = seen.to(self.action.device)
        return {
            **{
                key: {name: value[seen] for name, value in prepared.items()}
                for key, prepared in self.pictures.items()
            },
            **{key: value[seen] for key, value in self.vectors.items()},
            ACTION: self.action[taken],
            "action_is_pad": wanted > last,
            "task": [self.tasks[k] for k in self.task[rows].tolist()],
        }


def moved(value: Any, device: torch.device) -> Any:
    """Return a tensor, or a nested dict with all its tensors, on a device."""
    if isinstance(value, Tensor):
        return value.to(device, non_blocking=True)
    if isinstance(value, dict):
        return {key: moved(v, device) for key, v in value.items()}
    return value


def frames_of(
    *,
    net: BCNet,
    pictures: dict[str, Float32[np.ndarray, "frame h w"] | UInt8[np.ndarray, "frame h w"]],
    vectors: dict[str, Float32[np.ndarray, "frame dim"]],
    action: Float32[np.ndarray, "frame act"],
    task: str,
    lengths: Sequence[int],
) -> FrameTable:
    """Return a table of episodes that were not read from a dataset; `pictures` hold one channel, e.g. greys."""
    prepared = {
        key: _prepared(net, key, torch.from_numpy(np.ascontiguousarray(frames))[:, None])
        for key, frames in pictures.items()
    }
    first, last = _spans(np.asarray(lengths))
    return FrameTable(
        pictures=prepared,
        vectors={key: torch.from_numpy(value) for key, value in vectors.items()},
        action=torch.from_numpy(action),
        task=torch.zeros(len(action), dtype=torch.int64),
        tasks=[task],
        first=first,
        last=last,
    )


def read_frames(dataset: Path, repo_id: str, net: BCNet, cache: Path) -> FrameTable:
    """Return all frames of a LeRobot dataset, decoding its video unless a cache has it.

    Args:
        dataset: its folder.
        repo_id: its name.
        net: whose encoders see the pictures.
        cache: folder for what is decoded; made, or made anew where it is not of this dataset and these encoders.

    Raises:
        DatasetError: a column that the network takes is missing or not finite, or the video does not hold its frames.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta: Any = LeRobotDatasetMetadata(repo_id, root=dataset)
    for key in net.camera_keys:
        if key not in meta.camera_keys:
            raise DatasetError(
                f"{dataset} has no camera '{key}'; it has {', '.join(meta.camera_keys) or 'none'}"
            )
    rows = _read_rows(dataset, [*net.vector_keys, ACTION])
    lengths = np.asarray(meta.episodes["length"])
    if int(lengths.sum()) != len(rows[ACTION]):
        raise DatasetError(
            f"{dataset} says {int(lengths.sum())} frames in meta/episodes and holds {len(rows[ACTION])} rows in data/"
        )
    first, last = _spans(lengths)
    tasks = meta.tasks.reset_index()
    named = tasks.sort_values("task_index")
    words = [str(w) for w in named.iloc[:, [c != "task_index" for c in named.columns]].iloc[:, 0]]
    return FrameTable(
        pictures={
            key: _cached_pictures(dataset, meta, net, key, cache / key) for key in net.camera_keys
        },
        vectors={key: torch.from_numpy(rows[key]) for key in net.vector_keys},
        action=torch.from_numpy(rows[ACTION]),
        task=torch.from_numpy(rows["task_index"]),
        tasks=words,
        first=first,
        last=last,
    )


def _spans(lengths: np.ndarray) -> tuple[Tensor, Tensor]:
    ends = np.cumsum(lengths)
    first = np.repeat(ends - lengths, lengths)
    last = np.repeat(ends - 1, lengths)
    return torch.from_numpy(first.astype(np.int64)), torch.from_numpy(last.astype(np.int64))


def _read_rows(dataset: Path, keys: list[str]) -> dict[str, np.ndarray]:
    """Return the columns, float32, in the order of `index`."""
    parts: dict[str, list[np.ndarray]] = {key: [] for key in [*keys, "task_index", "index"]}
    for path in sorted(dataset.glob("data/*/*.parquet")):
        schema = pq.read_schema(path)
        for key in parts:
            if key not in schema.names:
                raise DatasetError(
                    f"{path} has no column '{key}'; it has {', '.join(schema.names)}"
                )
        table = pq.read_table(path, columns=list(parts))
        for key in parts:
            column = table.column(key).combine_chunks()
            values = _as_array(column)
            if key in keys and not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(1))[0])
                raise DatasetError(f"column '{key}' of {path} is not finite in row {row}")
            parts[key].append(values)
    if not parts["index"]:
        raise DatasetError(f"{dataset} holds no data/*/*.parquet: it is no LeRobot v3 dataset")
    columns = {key: np.concatenate(values) for key, values in parts.items()}
    order = np.argsort(columns.pop("index"), kind="stable")
    tasks = columns.pop("task_index")[order].astype(np.int64)
    # LeRobot stores features with one entry as plain numbers.
    vectors = {k: v[order].reshape(len(v), -1).astype(np.float32) for k, v in columns.items()}
    return {"task_index": tasks, **vectors}


def _as_array(column: Any) -> np.ndarray:
    if pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type):
        flat = column.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


def _cached_pictures(dataset: Path, meta: Any, net: BCNet, key: str, cache: Path) -> Prepared:
    num_frames = int(np.sum(meta.episodes["length"]))
    identity = _identity(dataset, meta, net, key)
    with _lock_of(cache):
        stored = _open_cache(cache, identity)
        if stored is not None:
            return stored
        partial = cache.with_name(f"{cache.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
        partial.mkdir()
        arrays: dict[str, np.ndarray] = {}
        done = 0
        for frames in _pictures(dataset, meta, key):
            prepared = _prepared(net, key, torch.from_numpy(frames))
            for name, value in prepared.items():
                if name not in arrays:
                    shape = (num_frames, *value.shape[1:])
                    arrays[name] = np.lib.format.open_memmap(
                        partial / f"{name}.npy", "w+", value.numpy().dtype, shape
                    )
                arrays[name][done : done + len(value)] = value.numpy()
            done += len(frames)
        for array in arrays.values():
            array.flush()  # pyright: ignore[reportAttributeAccessIssue] - a memmap
        (partial / CACHE_FILE).write_text(
            json.dumps({"identity": identity, "crc32": _checksums(partial)}),
            encoding="utf-8",
        )
        shutil.rmtree(cache, ignore_errors=True)
        partial.rename(cache)
        stored = _open_cache(cache, identity)
    assert stored is not None
    return stored


def _lock_of(cache: Path) -> FileLock:
    """Return the lock under which a cache is read and written."""
    cache.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(cache.with_name(f"{cache.name}.lock"))


def _identity(dataset: Path, meta: Any, net: BCNet, key: str) -> str:
    """Return a digest of what the cached arrays depend on: the dataset's files and the encoder's settings."""
    digest = hashlib.sha256()
    # Pictures that are no video are columns of the table.
    is_image = meta.features[key]["dtype"] == "image"
    files = "data/**/*.parquet" if is_image else f"videos/{key}/**/*.mp4"
    for path in sorted(dataset.glob(files)):
        stat = path.stat()
        digest.update(f"{path.relative_to(dataset)} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    for path in sorted([*dataset.glob("meta/episodes/*/*.parquet"), dataset / "meta/info.json"]):
        digest.update(path.read_bytes())
    cfg = net.cfg
    settings = (
        *(cfg.is_mask(key), cfg.mask_greys, cfg.num_labels, cfg.input_size_px),
        *(cfg.encoder, cfg.mask_moments, PREPARE_VERSION, CACHE_VERSION),
    )
    digest.update(repr(settings).encode())
    return digest.hexdigest()


def _open_cache(cache: Path, identity: str) -> Prepared | None:
    """Return the arrays of a cache, None where it is not of this dataset or damaged."""
    try:
        described = json.loads((cache / CACHE_FILE).read_text(encoding="utf-8"))
        if described["identity"] != identity:
            return None
        if (found := _checksums(cache)) != described["crc32"]:
            raise ValueError(f"the checksums of its arrays are {found}")  # noqa: TRY301
        # Copy on write: torch wants writable memory, and nothing writes.
        arrays = {name: np.load(cache / f"{name}.npy", mmap_mode="c") for name in found}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        logger.warning("the cache %s is damaged (%s) and is made anew", cache, error)
        return None
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _checksums(cache: Path) -> dict[str, int]:
    """Return a checksum of each array's file: 3 GB/s on one core."""
    return {
        path.stem: zlib.crc32(np.memmap(path, np.uint8, "r"))
        for path in sorted(cache.glob("*.npy"))
    }


def _prepared(net: BCNet, key: str, frames: UInt8[Tensor, "frame c h w"]) -> Prepared:
    camera = net.cameras[net.camera_keys.index(key)]
    assert isinstance(camera, CameraEncoder)
    parts = [
        camera.prepare(frames[start : start + DECODED_AT_ONCE, None])
        for start in range(0, len(frames), DECODED_AT_ONCE)
    ]
    return {name: torch.cat([part[name][:, 0] for part in parts]) for name in parts[0]}


def _pictures(dataset: Path, meta: Any, key: str) -> Iterator[UInt8[np.ndarray, "frame c h w"]]:
    """Yield a camera's frames in the order of the dataset's rows, some at once."""
    if meta.features[key]["dtype"] == "image":
        yield from _stored_images(meta, key)
        return
    episodes = meta.episodes
    fps = float(meta.fps)
    places = [
        (int(c), int(f), round(float(t) * fps), int(n))
        for c, f, t, n in zip(
            *(
                episodes[f"videos/{key}/{name}"]
                for name in ("chunk_index", "file_index", "from_timestamp")
            ),
            episodes["length"],
            strict=True,
        )
    ]
    reader: Iterator[np.ndarray] | None = None
    current: tuple[int, int] | None = None
    position = 0
    for chunk, file, start, length in places:
        path = dataset / meta.video_path.format(video_key=key, chunk_index=chunk, file_index=file)
        if current != (chunk, file) or start < position:
            reader, current, position = _decoded(path), (chunk, file), 0
        assert reader is not None
        episode: list[np.ndarray] = []
        while len(episode) < length:
            frame = next(reader, None)
            if frame is None:
                raise DatasetError(
                    f"{path} ends at frame {position}; meta/episodes says that an episode of {length} frames starts"
                    f" at frame {start}"
                )
            if position >= start:
                episode.append(frame)
            position += 1
        yield np.stack(episode)


def _decoded(path: Path) -> Iterator[UInt8[np.ndarray, "3 h w"]]:
    import av
    from av import FFmpegError

    try:
        with av.open(str(path)) as video:
            if not video.streams.video:
                raise DatasetError(f"{path} cannot be decoded (it holds no video)")
            for frame in video.decode(video=0):
                yield frame.to_ndarray(format="rgb24").transpose(2, 0, 1)
    except FFmpegError as error:
        words = "is missing" if isinstance(error, FileNotFoundError) else "cannot be decoded"
        raise DatasetError(f"{path} {words} ({error.strerror})") from error


def _stored_images(meta: Any, key: str) -> Iterator[UInt8[np.ndarray, "frame c h w"]]:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset: Any = LeRobotDataset(meta.repo_id, root=meta.root)
    for k in range(len(dataset)):
        yield (np.asarray(dataset[k][key]) * 255).round().astype(np.uint8)[None]
