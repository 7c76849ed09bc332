"""Staged episodes become one LeRobot dataset.

The video is encoded first (`shards`) and put into files; then the tables, by LeRobot's own functions for metadata and statistics. The
dataset grows in `<root>.partial`, is checked, and is renamed into place at the end, so that what lies at `root` is
finished. The same episodes give the same bytes, after any number of kills, with any number of threads.
"""

import json
import logging
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.cut import write_stats
from v2p_data.episodes.dataset.edited import number_digest
from v2p_data.episodes.dataset.encoding import MASK_CRF, RGB_CRF, encoder_config
from v2p_data.episodes.dataset.episode_stats import number_stats
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    ACTION_NAMES,
    CONTACT_KEY,
    DEMONSTRATION,
    DONE_KEY,
    EPISODE_COLUMN,
    EXECUTED_KEY,
    FPS,
    HANDOVER,
    INTERVENTION_KEY,
    KEY_OF_CAMERA,
    METADATA_FILE,
    METADATA_SCHEMA,
    ROBOT_TYPE,
    SIMULATED,
    STATE_KEY,
    SUCCESS_KEY,
    features,
    state_names,
)
from v2p_data.episodes.dataset.repo_id import check_repo_id
from v2p_data.episodes.dataset.shards import (
    Shard,
    make_shards,
    plan_files,
    plan_shards,
    stats_of,
    write_file,
)
from v2p_data.episodes.staging import (
    Episode,
    Heading,
    refusals_told,
)
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.sim.render.masks import MASK_CAMERAS, PALETTE, WRIST_CAMERA, label_names

logger = logging.getLogger(__name__)

VIDEO_FILE_MB = 200
"""LeRobot's own limit, for us and for its tools when they add to the dataset; 400,000 frames of masks."""
DATA_FILE_FRAMES = 400_000
"""Rows per file, 40 MB; each episode is a row group of its own, as LeRobot writes it."""
EPISODES_PER_WRITE = 100


@dataclass(frozen=True, kw_only=True)
class Packed:
    """A finished dataset."""

    root: Path
    repo_id: str
    num_episodes: int
    num_frames: int


def pack(
    staged: Sequence[Path],
    repo_id: str,
    root: Path,
    *,
    provenance: Mapping[str, Any] | None = None,
    num_threads: int = 0,
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> Packed:
    """Write staged episodes, in this order, as a LeRobot v3 dataset at `root`.

    A packing that was stopped goes on where it was when it is called again. Where handovers are among the episodes,
    all frames have the column `intervention`: whether the expert acted. What only a simulator knows is kept where all
    episodes have it; those of earlier versions and of robots have not.

    Args:
        staged: files that `Episode.save` wrote.
        repo_id: `user/name`, under which it will be pushed.
        root: where it shall lie; must not exist.
        provenance: how the episodes came about, JSON; kept in `meta/v2p.json`.
        num_threads: 0 for all cores; changes no byte.
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: there is something at `root`, nothing to pack, the episodes do not go together, or nothing can be
            written there.
    """
    check_repo_id(repo_id)
    if root.exists():
        raise V2PError(
            f"{root} exists already; delete it to write the dataset anew, or choose another place with --out"
        )
    headings = _headings(staged)
    partial = root.with_name(root.name + ".partial")
    with refusals_told("packing", root.parent):
        partial.mkdir(parents=True, exist_ok=True)
        on_progress(0.0, "starting LeRobot")
        shards = plan_shards(headings)
        make_shards(shards, partial / "shards", num_threads=num_threads,
                    on_progress=lambda share, words: on_progress(0.9 * share, words))  # fmt: skip
        growing = partial / "dataset"
        if growing.exists():
            shutil.rmtree(growing)
        on_progress(0.9, "writing the tables")
        described = _write(shards, partial / "shards", repo_id, growing)
        write_json_atomically(
            growing / METADATA_FILE, _about(repo_id, headings, described, provenance or {})
        )
        _check_tables(growing, shards)
        _flush(growing)
        growing.rename(root)
        _flush_folder(root.parent)
        shutil.rmtree(partial)
    num_frames = sum(h.num_frames for h in headings)
    logger.info("packed %d episodes, %d frames, at %s", len(headings), num_frames, root)
    return Packed(root=root, repo_id=repo_id, num_episodes=len(headings), num_frames=num_frames)


def _about(
    repo_id: str,
    headings: Sequence[Heading],
    described: Sequence[dict[str, Any]],
    provenance: Mapping[str, Any],
) -> dict[str, Any]:
    return {
        "schema": METADATA_SCHEMA,
        "repo_id": repo_id,
        "palette": {str(label): grey for label, grey in enumerate(PALETTE)},
        "state": list(state_names(headings[0].num_states)),
        "action": list(headings[0].actions or ACTION_NAMES),
        "episodes": described,
        "provenance": dict(provenance),
    }


def _headings(staged: Sequence[Path]) -> list[Heading]:
    if not staged:
        raise V2PError("there are no staged episodes to pack; collect some with 'v2p episodes'")
    headings = [Heading.read(path) for path in staged]
    ids = [h.id for h in headings]
    if len(set(ids)) != len(ids):
        twice = sorted({i for i in ids if ids.count(i) > 1})
        raise V2PError(f"episodes are given twice: {', '.join(twice[:5])}")
    first = headings[0]
    if first.size_px[0] != first.size_px[1] * (1 + (WRIST_CAMERA in first.cameras)):
        raise V2PError(
            f"masks must be square, {first.path} has {first.size_px[0]} x {first.size_px[1]}"
        )
    for heading in headings:
        if heading.size_px != first.size_px:
            raise V2PError(
                f"{heading.path} has masks of {heading.size_px} px, the first episode of {first.size_px} px; "
                "collect all episodes at one size"
            )
        if heading.cameras != first.cameras:
            raise V2PError(
                f"{heading.path} has pictures of {', '.join(heading.cameras)}, the first episode of "
                f"{', '.join(first.cameras)}; collect all episodes with one --episodes.render and --episodes.wrist"
            )
        if heading.actions != first.actions:
            raise V2PError(
                f"{heading.path} has actions of {', '.join(heading.actions or ACTION_NAMES)}, the first episode of "
                f"{', '.join(first.actions or ACTION_NAMES)}; collect all episodes with one --episodes.actions and one arm"
            )
        if heading.num_states != first.num_states:
            raise V2PError(
                f"{heading.path} has states of {heading.num_states} numbers, the first episode of "
                f"{first.num_states}; collect all episodes with one --episodes.joint-state and one arm"
            )
        if heading.num_frames < 2:
            raise V2PError(
                f"{heading.path} has {heading.num_frames} frames; an episode has two at least"
            )
    return headings


def _write(
    shards: Sequence[Shard], finished: Path, repo_id: str, root: Path
) -> list[dict[str, Any]]:
    """Write everything but our own metadata; return what is told of each episode there."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.io_utils import write_info

    first = shards[0].episodes[0]
    headings = [heading for shard in shards for heading in shard.episodes]
    has_handovers = any(e.is_handover for e in headings)
    is_simulated = all(SIMULATED.keys() <= set(e.known) for e in headings)
    meta: Any = LeRobotDatasetMetadata.create(
        repo_id,
        fps=FPS,
        features=features(
            first.size_px[1],
            first.cameras,
            actions=first.actions or ACTION_NAMES,
            states=state_names(first.num_states),
            has_handovers=has_handovers,
            is_simulated=is_simulated,
        ),
        robot_type=ROBOT_TYPE,
        root=root,
        video_files_size_in_mb=VIDEO_FILE_MB,
        metadata_buffer_size=EPISODES_PER_WRITE,
    )
    lies_in = _write_videos(shards, finished, first.cameras, meta)
    described: list[dict[str, Any]] = []
    data = _DataFiles(meta)
    try:
        for shard in shards:
            frame = 0
            for heading, stats in zip(
                shard.episodes, stats_of(shard, finished) or [], strict=True
            ):
                episode = Episode.load(heading.path, pictures=False)
                where: dict[str, Any] = {}
                for camera in first.cameras:
                    number, start = lies_in[camera, shard.number]
                    key, begin = f"videos/{KEY_OF_CAMERA[camera]}", start + frame
                    where |= {
                        f"{key}/chunk_index": number // meta.chunks_size,
                        f"{key}/file_index": number % meta.chunks_size,
                        f"{key}/from_timestamp": begin / FPS,
                        f"{key}/to_timestamp": (begin + episode.num_frames) / FPS,
                    }
                described.append(_describe(episode, meta.features))
                where[EPISODE_COLUMN] = json.dumps(described[-1])
                data.add(episode, {KEY_OF_CAMERA[c]: s for c, s in stats.items()}, where)
                frame += episode.num_frames
    finally:
        data.close()
        meta.finalize()
    write_info(meta.info, root)
    write_stats(root)
    return described


def _write_videos(
    shards: Sequence[Shard], finished: Path, cameras: Sequence[str], meta: Any
) -> dict[tuple[str, int], tuple[int, int]]:
    """Write each camera's video files; return the file, and the frame in it, of every camera and shard."""
    lies_in: dict[tuple[str, int], tuple[int, int]] = {}
    for camera in cameras:
        planned = plan_files(shards, finished, camera, VIDEO_FILE_MB * 2**20)
        for number, group in enumerate(planned):
            write_file(group, finished, camera, _video_path(meta, number, camera))
            frame = 0
            for shard in group:
                lies_in[camera, shard.number] = number, frame
                frame += shard.num_frames
    for camera in cameras:
        crf = MASK_CRF if camera in MASK_CAMERAS else RGB_CRF
        meta.update_video_info(KEY_OF_CAMERA[camera], video_encoder=encoder_config(crf))
    return lies_in


class _DataFiles:
    """Writes rows and what LeRobot notes of each episode.

    Args:
        meta: LeRobot's metadata, which grows.
    """

    def __init__(self, meta: Any) -> None:
        from lerobot.datasets.feature_utils import get_hf_features_from_features

        self.meta = meta
        self.schema: pa.Schema = get_hf_features_from_features(meta.features).arrow_schema
        self.numbers = {k: f for k, f in meta.features.items() if f["dtype"] != "video"}
        self.file = 0
        self.first_row = 0
        self.writer: pq.ParquetWriter | None = None

    def add(self, episode: Episode, picture_stats: dict[str, Any], where: dict[str, Any]) -> None:
        """Append an episode."""
        meta, count = self.meta, episode.num_frames
        index, first = int(meta.total_episodes), int(meta.total_frames)
        meta.save_episode_tasks([episode.task])
        columns = {
            STATE_KEY: episode.state,
            ACTION_KEY: episode.action,
            SUCCESS_KEY: episode.success,
            INTERVENTION_KEY: episode.expert_acted,
            DONE_KEY: np.arange(count) == count - 1,
            **episode.simulated,
            "timestamp": (np.arange(count) / FPS).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, index),
            "index": np.arange(first, first + count),
            "task_index": np.full(count, meta.get_task_index(episode.task)),
        }
        if self.writer is None or first - self.first_row + count > DATA_FILE_FRAMES:
            self._next_file(first)
        assert self.writer is not None
        table = pa.table({n: _column(columns[n], self.schema.field(n)) for n in self.schema.names})
        self.writer.write_table(table.cast(self.schema))
        chunk, file = divmod(self.file - 1, meta.chunks_size)
        meta.save_episode(
            index,
            count,
            [episode.task],
            picture_stats | number_stats({n: columns[n] for n in self.numbers}, self.numbers),
            {
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": first,
                "dataset_to_index": first + count,
                **where,
            },
        )

    def _next_file(self, first_row: int) -> None:
        self.close()
        chunk, file = divmod(self.file, self.meta.chunks_size)
        path = self.meta.root / self.meta.data_path.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.writer = pq.ParquetWriter(
            path, schema=self.schema, compression="snappy", use_dictionary=True
        )
        self.file += 1
        self.first_row = first_row

    def close(self) -> None:
        """Finish the file in hand."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None


def _column(values: np.ndarray, field: pa.Field) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values, type=field.type)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), type=field.type.value_type)
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _video_path(meta: Any, number: int, camera: str) -> Path:
    chunk, file = divmod(number, meta.chunks_size)
    name = meta.video_path.format(
        video_key=KEY_OF_CAMERA[camera], chunk_index=chunk, file_index=file
    )
    return Path(meta.root) / name


def _describe(episode: Episode, columns: Collection[str]) -> dict[str, Any]:
    numbers = [episode.state, episode.action]
    known = [k for k in (*SIMULATED, EXECUTED_KEY) if k in columns and k != CONTACT_KEY]
    numbers += [episode.simulated[k] for k in known]
    source = {
        "source": HANDOVER if episode.is_handover else DEMONSTRATION,
        "student_frames": int((~episode.expert_acted).sum()),
    }
    return {
        "id": episode.id,
        "item": episode.item,
        "family": episode.family or episode.item,
        "task": episode.task,
        "seed": episode.seed,
        "length": episode.num_frames,
        "labels": {str(k): name for k, name in label_names(episode.objects).items()},
        "success": bool(np.any(episode.success)),
        "referee": episode.referee,
        "numbers": number_digest(numbers),
        "params": episode.params,
        **(source if INTERVENTION_KEY in columns else {}),
    }


def _check_tables(root: Path, shards: Sequence[Shard]) -> None:
    """Raise unless the files on disk hold as many rows and episodes as were put in."""

    def rows(pattern: str) -> int:
        return sum(pq.ParquetFile(p).metadata.num_rows for p in root.glob(pattern))

    wanted = (sum(len(s.episodes) for s in shards), sum(s.num_frames for s in shards))
    counted = (rows("meta/episodes/*/*.parquet"), rows("data/*/*.parquet"))
    if counted != wanted:
        raise RuntimeError(f"the tables hold {counted} episodes and frames, not {wanted}")


def _flush(root: Path) -> None:
    """Have everything on disk before it is renamed: after a power cut, too, it is whole or absent."""
    for path in _files(root):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())


def _flush_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _files(root: Path) -> Iterator[Path]:
    return (path for path in root.rglob("*") if path.is_file())
