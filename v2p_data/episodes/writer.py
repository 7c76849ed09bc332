"""Staged episodes become one LeRobot dataset: the only place that holds LeRobot's writer.

The dataset grows in `<root>.partial`, is checked, and is renamed into place at the end, so that what lies at
`root` is finished. Masks are H.264 with crf 0 in greys, which is exact; LeRobot's default codec would alter
42 % of a mask's pixels. One encoder thread, so that the same episodes give the same bytes anywhere.
"""

import logging
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.episodes.features import (
    ACTION_KEY,
    ACTION_NAMES,
    FPS,
    MASK_KEY,
    METADATA_FILE,
    ROBOT_TYPE,
    STATE_KEY,
    STATE_NAMES,
    SUCCESS_KEY,
    features,
)
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.sim.masks import PALETTE, label_names, labels_to_rgb

logger = logging.getLogger(__name__)

VIDEO_FILE_MB = 10
"""Many episodes share a file, but each new one rewrites its file, so files must not grow forever."""
METADATA_SCHEMA = 1
_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


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
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> Packed:
    """Write staged episodes, in this order, as a LeRobot v3 dataset at `root`.

    Args:
        staged: files that `Episode.save` wrote.
        repo_id: `user/name`, under which it will be pushed.
        root: where it shall lie; must not exist.
        provenance: how the episodes came about, JSON; kept in `meta/v2p.json`.
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: there is something at `root`, nothing to pack, or the episodes do not go together.
    """
    check_repo_id(repo_id)
    if root.exists():
        raise V2PError(
            f"{root} exists already; delete it to write the dataset anew, or choose another place with --out"
        )
    size_px = _check_staged(staged)
    partial = root.with_name(root.name + ".partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.parent.mkdir(parents=True, exist_ok=True)
    on_progress(0.0, "starting LeRobot")
    described = _write(staged, repo_id, partial, size_px, on_progress)
    _drop_leftovers(partial)
    write_json_atomically(
        partial / METADATA_FILE,
        {
            "schema": METADATA_SCHEMA,
            "repo_id": repo_id,
            "palette": {str(label): grey for label, grey in enumerate(PALETTE)},
            "state": list(STATE_NAMES),
            "action": list(ACTION_NAMES),
            "episodes": described,
            "provenance": dict(provenance or {}),
        },
    )
    partial.rename(root)
    num_frames = sum(e["length"] for e in described)
    logger.info("packed %d episodes, %d frames, at %s", len(described), num_frames, root)
    return Packed(root=root, repo_id=repo_id, num_episodes=len(described), num_frames=num_frames)


def check_repo_id(repo_id: str) -> None:
    """Raise unless `repo_id` reads `user/name`.

    Raises:
        V2PError: it does not.
    """
    if not _REPO_ID.fullmatch(repo_id) or "--" in repo_id or ".." in repo_id:
        raise V2PError(
            f"'{repo_id}' is no repository id; it reads USER/NAME, of letters, digits, '-', '_' and '.'"
        )


def _check_staged(staged: Sequence[Path]) -> int:
    if not staged:
        raise V2PError("there are no staged episodes to pack; collect some with 'v2p episodes'")
    ids = [path.stem for path in staged]
    if len(set(ids)) != len(ids):
        twice = sorted({i for i in ids if ids.count(i) > 1})
        raise V2PError(f"episodes are given twice: {', '.join(twice[:5])}")
    height, width = Episode.load(staged[0]).labels.shape[1:]
    if height != width:
        raise V2PError(f"masks must be square, {staged[0]} has {height} x {width}")
    return height


def _write(
    staged: Sequence[Path],
    repo_id: str,
    partial: Path,
    size_px: int,
    on_progress: Callable[[float, str], None],
) -> list[dict[str, Any]]:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset.create(
        repo_id,
        fps=FPS,
        features=features(size_px),
        root=partial,
        robot_type=ROBOT_TYPE,
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=0, pix_fmt="yuv420p", g=2),
        encoder_threads=1,
        video_files_size_in_mb=VIDEO_FILE_MB,
    )
    described: list[dict[str, Any]] = []
    try:
        for number, path in enumerate(staged):
            episode = Episode.load(path)
            _add(dataset, episode, size_px, path)
            described.append(_describe(episode))
            on_progress((number + 1) / len(staged), f"packed {number + 1}/{len(staged)} episodes")
    finally:
        dataset.finalize()
    frames = sum(e["length"] for e in described)
    counted = (dataset.meta.total_episodes, dataset.meta.total_frames)
    if counted != (len(described), frames):
        raise RuntimeError(
            f"LeRobot wrote {counted} episodes and frames, not {(len(described), frames)}"
        )
    return described


def _add(dataset: Any, episode: Episode, size_px: int, path: Path) -> None:
    if episode.labels.shape[1:] != (size_px, size_px):
        raise V2PError(
            f"{path} has masks of {episode.labels.shape[1:]}, the first episode of {size_px} px; "
            "collect all episodes at one size"
        )
    if episode.num_frames < 2:
        raise V2PError(f"{path} has {episode.num_frames} frames; an episode has two at least")
    pictures = labels_to_rgb(episode.labels)
    for t in range(episode.num_frames):
        dataset.add_frame(
            {
                MASK_KEY: pictures[t],
                STATE_KEY: episode.state[t],
                ACTION_KEY: episode.action[t],
                SUCCESS_KEY: episode.success[t : t + 1],
                "task": episode.task,
            }
        )
    dataset.save_episode(parallel_encoding=False)


def _describe(episode: Episode) -> dict[str, Any]:
    return {
        "id": episode.id,
        "item": episode.item,
        "task": episode.task,
        "seed": episode.seed,
        "length": episode.num_frames,
        "labels": {str(k): name for k, name in label_names(episode.objects).items()},
        "success": bool(np.any(episode.success)),
        "referee": episode.referee,
        "params": episode.params,
    }


def _drop_leftovers(root: Path) -> None:
    """Remove LeRobot's temporary pictures; a push would upload `tmp*`."""
    for path in [root / "images", *root.glob("tmp*")]:
        if path.is_dir():
            shutil.rmtree(path)
