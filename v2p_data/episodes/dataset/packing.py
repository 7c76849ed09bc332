"""Packs staged episodes as the dataset that is handed on: with its tasks and a card, compared frame by frame."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import CARRIED_TASKS
from v2p_data.episodes.dataset.card import write_card
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.errors import V2PError
from v2p_data.json_files import read_object
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.shareable import without_places
from v2p_data.scene.files import copy_folder
from v2p_data.task.task import REWARD_SEARCH_FOLDER, TASK_FILE

NOT_CARRIED = ("record.json", "samples", "overlay*", REWARD_SEARCH_FOLDER)
"""Of a task's folder: what tells how it was made."""


def pack_and_verify(
    staged: Sequence[Path],
    repo_id: str,
    out: Path,
    runtime: Runtime,
    *,
    provenance: Mapping[str, Any],
    tasks: Mapping[str, Path],
) -> dict[str, Any]:
    """Write staged episodes as a LeRobot dataset into `out`, with their tasks and a card, and no place of this machine.

    Raises:
        V2PError: there is nothing to pack, or the dataset differs from the episodes when it is read again.
    """
    if not staged:
        raise V2PError("no task gave a successful episode, so there is nothing to pack")
    root = out / "packed"
    pack(
        staged,
        repo_id,
        root,
        provenance=without_places(dict(provenance)),
        num_threads=runtime.num_threads,
        on_progress=lambda share, words: runtime.progress(0.7 * share, words),
    )
    copy_tasks(tasks, root)
    runtime.progress(0.75, "comparing every frame")
    report = verify(root, staged=staged)
    if not report.is_good:
        raise V2PError(f"the packed dataset differs from the episodes: {report.summary()}")
    write_card(root, repo_id)
    for path in list(root.iterdir()):
        path.rename(out / path.name)
    root.rmdir()
    return {
        "episodes": report.num_episodes,
        "frames": report.num_frames,
        "repo_id": repo_id,
    }


def copy_tasks(tasks: Mapping[str, Path], dataset: Path) -> None:
    """Put tasks, by item, into the dataset that was made in them, without a place of this machine."""
    for item, folder in tasks.items():
        carried = dataset / CARRIED_TASKS / item
        copy_folder(folder, carried, ignore=shutil.ignore_patterns(*NOT_CARRIED))
        described = carried / TASK_FILE
        task = read_object(described, "make the task anew")
        if (shareable := without_places(task)) != task:
            described.write_text(json.dumps(shareable, indent=1), encoding="utf-8")
