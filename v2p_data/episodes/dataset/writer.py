"""Staged episodes become one LeRobot dataset.

The video is encoded first (`shards`) and put into files; then the tables, by LeRobot's own
functions for metadata and statistics. The dataset grows in `<root>.partial`, is checked, and is
renamed into place at the end, so that a folder at `root` is finished. The same episodes give the
same bytes, after any number of kills, with any number of threads.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from v2p_data.episodes.dataset.encoding import MASK_CRF, RGB_CRF, encoder_config
from v2p_data.episodes.dataset.episode_stats import number_stats
from v2p_data.episodes.dataset.features import (
    ACTION_NAMES,
    COLUMNS,
    CONTACT_KEY,
    DEMONSTRATION,
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
    columns_of,
    features,
    state_names,
)
from v2p_data.episodes.dataset.layout import (
    CHUNK_FILES,
    VIDEO_FILE_MB,
    NewDataset,
    RowFiles,
    file_in,
    write_stats,
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
from v2p_data.episodes.dataset.tables import VIDEO_PATH, layout_problems, read_info
from v2p_data.episodes.staging import (
    Episode,
    Heading,
    refusals_named,
)
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import commit_folder, write_json_atomically
from v2p_data.sim.render.masks import MASK_CAMERAS, PALETTE, WRIST_CAMERA, label_names

EPISODES_PER_WRITE = 100
ALIKE = {
    "size_px": ("masks of {} px", "--episodes.size-px"),
    "cameras": ("pictures of {}", "--episodes.render and --episodes.wrist"),
    "actions": ("actions of {}", "--episodes.actions and one arm"),
    "num_states": ("states of {} numbers", "--episodes.joint-state and one arm"),
}
"""Fields of `Heading` that are the same in all episodes of a dataset -> what they say, and the
options that decide it."""


def pack(
    staged: Sequence[Path],
    repo_id: str,
    root: Path,
    *,
    provenance: Mapping[str, Any] | None = None,
    num_threads: int = 0,
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> NewDataset:
    """Write staged episodes, in this order, as a LeRobot v3 dataset at `root`.

    A packing that was stopped goes on when it is called again. With handovers, `intervention` tells who acted.

    Args:
        staged: files that `Episode.save` wrote.
        repo_id: `user/name`, under which it will be pushed.
        root: where it shall lie; must not exist.
        provenance: how the episodes came about, JSON; kept in `meta/v2p.json`.
        num_threads: 0 for all cores; changes no byte.
        on_progress: called with the share that is done and a few words.

    Raises:
        V2PError: `root` exists or cannot be written, there is no episode, or they do not go together.
    """
    check_repo_id(repo_id)
    if root.exists():
        raise V2PError(
            f"{root} exists already; delete it to write the dataset anew, or choose another place with --out"
        )
    headings = _headings(staged)
    partial = root.with_name(root.name + ".partial")
    with refusals_named("packing", root.parent):
        partial.mkdir(parents=True, exist_ok=True)
        on_progress(0.0, "starting LeRobot")
        shards = plan_shards(headings)
        make_shards(
            shards,
            partial / "shards",
            num_threads=num_threads,
            on_progress=lambda share, words: on_progress(0.9 * share, words),
        )
        growing = partial / "dataset"
        shutil.rmtree(growing, ignore_errors=True)
        on_progress(0.9, "writing the tables")
        described = _write(shards, partial / "shards", repo_id, growing)
        write_json_atomically(
            growing / METADATA_FILE, _about(repo_id, headings, described, provenance or {})
        )
        if problems := layout_problems(growing, read_info(growing)):
            raise RuntimeError(f"{problems[0].where} {problems[0].detail}")
        _flush(growing)
        commit_folder(growing, root)
        shutil.rmtree(partial)
    return NewDataset(
        root=root,
        repo_id=repo_id,
        num_episodes=len(headings),
        num_frames=sum(h.num_frames for h in headings),
        tasks=tuple(dict.fromkeys(h.task for h in headings)),
    )


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
        for name, (what, options) in ALIKE.items():
            mine, theirs = (getattr(h, name) or ACTION_NAMES for h in (heading, first))
            if mine != theirs:
                raise V2PError(
                    f"{heading.path} has {what.format(mine)}, the first episode "
                    f"{what.format(theirs)}; collect all episodes "
                    f"with one {options}"
                )
        odd = [key for key in SIMULATED if heading.known.get(key) != COLUMNS[key].width]
        if heading.known and odd:
            raise V2PError(
                f"{heading.path} is of another version: it has no {', '.join(odd)} as this one records it;"
                " collect it anew with 'v2p episodes'"
            )
        if bool(heading.known) != bool(first.known):
            raise V2PError(
                f"of {heading.path} and {first.path} one has the columns of a simulator and one has none; "
                "pack them as two datasets"
            )
        if heading.num_frames < 2:
            raise V2PError(
                f"{heading.path} has {heading.num_frames} frames; an episode has two at least"
            )
    return headings


def _write(
    shards: Sequence[Shard], finished: Path, repo_id: str, root: Path
) -> list[dict[str, Any]]:
    """Write everything but our own metadata; return what it holds of each episode."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.feature_utils import get_hf_features_from_features
    from lerobot.datasets.io_utils import write_info

    first = shards[0].episodes[0]
    headings = [heading for shard in shards for heading in shard.episodes]
    has_handovers = any(e.is_handover for e in headings)
    meta: Any = LeRobotDatasetMetadata.create(
        repo_id,
        fps=FPS,
        features=features(
            first.size_px[1],
            first.cameras,
            actions=first.actions or ACTION_NAMES,
            states=state_names(first.num_states),
            has_handovers=has_handovers,
            is_simulated=bool(first.known),
        ),
        robot_type=ROBOT_TYPE,
        root=root,
        video_files_size_in_mb=VIDEO_FILE_MB,
        metadata_buffer_size=EPISODES_PER_WRITE,
    )
    lies_in = _write_videos(shards, finished, first.cameras, meta)
    described: list[dict[str, Any]] = []
    schema = get_hf_features_from_features(meta.features).arrow_schema
    files = RowFiles(root, schema)
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
                        f"{key}/chunk_index": number // CHUNK_FILES,
                        f"{key}/file_index": number % CHUNK_FILES,
                        f"{key}/from_timestamp": begin / FPS,
                        f"{key}/to_timestamp": (begin + episode.num_frames) / FPS,
                    }
                described.append(_describe(episode, meta.features))
                where[EPISODE_COLUMN] = json.dumps(described[-1])
                of_pictures = {KEY_OF_CAMERA[c]: s for c, s in stats.items()}
                _save_episode(meta, files, episode, of_pictures, where)
                frame += episode.num_frames
    finally:
        files.close()
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
            path = file_in(VIDEO_PATH, number, video_key=KEY_OF_CAMERA[camera])
            write_file(group, finished, camera, Path(meta.root) / path)
            frame = 0
            for shard in group:
                lies_in[camera, shard.number] = number, frame
                frame += shard.num_frames
    for camera in cameras:
        crf = MASK_CRF if camera in MASK_CAMERAS else RGB_CRF
        meta.update_video_info(KEY_OF_CAMERA[camera], video_encoder=encoder_config(crf))
    return lies_in


def _save_episode(
    meta: Any,
    files: RowFiles,
    episode: Episode,
    picture_stats: dict[str, Any],
    where: dict[str, Any],
) -> None:
    """Append an episode's rows, and what LeRobot's metadata holds of it."""
    index, count = int(meta.total_episodes), episode.num_frames
    first = int(meta.total_frames)
    meta.save_episode_tasks([episode.task])
    columns = {
        **columns_of(episode),
        "timestamp": (np.arange(count) / FPS).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, index),
        "index": np.arange(first, first + count),
        "task_index": np.full(count, meta.get_task_index(episode.task)),
    }
    schema = files.schema
    table = pa.table({n: _column(columns[n], schema.field(n)) for n in schema.names})
    lies_in = files.add(table)
    numbers = {k: f for k, f in meta.features.items() if f["dtype"] != "video"}
    stats = picture_stats | number_stats({n: columns[n] for n in numbers}, numbers)
    meta.save_episode(index, count, [episode.task], stats, lies_in | where)


def _column(values: np.ndarray, field: pa.Field) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values, type=field.type)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), type=field.type.value_type)
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


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
        "numbers": _number_digest(numbers),
        "params": episode.params,
        **(source if INTERVENTION_KEY in columns else {}),
    }


def _number_digest(columns: Sequence[np.ndarray]) -> str:
    """Return the digest of an episode's columns of fractions, in the order of the features."""
    digest = hashlib.sha256()
    for values in columns:
        digest.update(np.asarray(values, np.float64).tobytes())
    return digest.hexdigest()


def _flush(root: Path) -> None:
    """Have everything on disk before it is renamed: after a power cut, too, it is whole or absent."""
    for path in (p for p in root.rglob("*") if p.is_file()):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
