"""What was seen and done becomes a LeRobot dataset of one episode: pictures, states, actions.

It is staged and packed as demonstrations are, so that `v2p verify`, `v2p merge` and LeRobot read it.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.deployment.robot import Reading
from v2p_data.deployment.sight import Seen
from v2p_data.episodes.dataset import encoding
from v2p_data.episodes.dataset.layout import NewDataset
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode, refusals_named
from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import MASK_CAMERA, RGB_CAMERA

FEWEST_FRAMES = 2
STAGED = "staged"


class Recorder:
    """Collects one run.

    Args:
        task: the instruction in words.
    """

    def __init__(self, task: str) -> None:
        self.task = task
        self._steps: list[tuple[Reading, Seen, np.ndarray, tuple[str, ...]]] = []

    def add(
        self, reading: Reading, seen: Seen, action: np.ndarray, acted: tuple[str, ...]
    ) -> None:
        """Note one step: what was seen, and what was then done."""
        self._steps.append((reading, seen, action, acted))

    def __len__(self) -> int:
        return len(self._steps)

    def save(
        self, out: Path, repo_id: str, objects: tuple[str, ...], about: Mapping[str, Any]
    ) -> NewDataset | None:
        """Write the dataset at `out`; None where nothing worth keeping was seen.

        Args:
            out: must not exist.
            repo_id: `user/name`.
            objects: names of what was clicked.
            about: how the run was made and ended, JSON; kept in `meta/v2p.json`.

        Raises:
            V2PError: something lies at `out`, or it cannot be written.
        """
        check_free(out)
        if len(self) < FEWEST_FRAMES:
            return None
        readings, seen, actions, acted = zip(*self._steps, strict=True)
        pictures = [reading.picture for reading in readings]
        has_rgb = pictures[0] is not None
        staged = out.with_name(out.name + ".partial") / STAGED
        with refusals_named("recording", out.parent):
            episode = Episode(
                id="run_00000",
                item="run",
                task=self.task,
                seed=0,
                labels=np.stack([one.labels for one in seen]),
                state=np.stack([reading.state for reading in readings]).astype(np.float32),
                action=np.stack(actions).astype(np.float32),
                # Nobody judges a run on a robot; what a simulated one says of itself is in `about`.
                success=np.zeros(len(self), bool),
                referee=False,
                objects=objects,
                params={
                    **about,
                    "limits_acted": [list(names) for names in acted],
                    "confidences": np.round(
                        np.array([one.confidences for one in seen]), 3
                    ).tolist(),
                },
                cameras=(MASK_CAMERA, RGB_CAMERA) if has_rgb else (MASK_CAMERA,),
                rgb_mp4=encoding.encode_rgb(np.stack(pictures)).mp4 if has_rgb else b"",
            )
            path = episode.save(staged)
            packed = pack([path], repo_id, out, provenance=json.loads(json.dumps(dict(about))))
            shutil.rmtree(staged.parent, ignore_errors=True)
        return packed


def check_free(out: Path) -> None:
    """Refuse a place that is taken, before anything moves.

    Raises:
        V2PError: it is.
    """
    if out.exists():
        raise V2PError(
            f"{out} exists already; choose another place for the recording with --record"
        )
