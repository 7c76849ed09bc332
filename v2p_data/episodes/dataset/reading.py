"""A dataset's rows through LeRobot, one after the other, as a training gets them.

Asked for one frame, LeRobot opens the video, seeks and decodes up to it; asked for a window of frames, as for a
policy that looks back, it does so once. So windows are asked for.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.episodes.dataset.tables import camera_keys, read_info

WINDOW_FRAMES = 32
"""A second or so: 30 MB of a camera of 640 x 480."""


class Rows:
    """The dataset at `root`, opened.

    Args:
        root: folder of the dataset.
        repo_id: its name, for LeRobot's messages.

    Raises:
        Exception: whatever LeRobot stumbles over.
    """

    def __init__(self, root: Path, repo_id: str = "local/dataset") -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        info = read_info(root)
        self.videos = camera_keys(info, "video")
        # Pictures that are no video come with each row, and windows would decode them again and again.
        self.in_windows = bool(self.videos) and not camera_keys(info, "image")
        windows = None
        if self.in_windows:
            later = [k / float(info["fps"]) for k in range(WINDOW_FRAMES)]
            windows = dict.fromkeys(self.videos, later)
        self.dataset: Any = LeRobotDataset(
            repo_id, root=root, return_uint8=True, delta_timestamps=windows
        )
        self.columns = self.dataset.hf_dataset.with_format("numpy")

    def __len__(self) -> int:
        return len(self.dataset)

    def episode(self, start: int, length: int) -> Iterator[dict[str, Any]]:
        """Yield the rows `start` to `start + length`, which must be of one episode."""
        if not self.in_windows:
            for i in range(start, start + length):
                yield self.dataset[i]
            return
        for first in range(start, start + length, WINDOW_FRAMES):
            count = min(WINDOW_FRAMES, start + length - first)
            shown = self.dataset[first]
            table = self.columns[first : first + count]
            for t in range(count):
                row = {key: values[t] for key, values in table.items()}
                row |= {key: shown[key][t] for key in self.videos}
                yield row | {"task": self.dataset.meta.tasks.iloc[int(row["task_index"])].name}


def same(a: Any, b: Any) -> bool:
    """Whether two entries are equal, NaN being equal to NaN."""
    one, two = np.asarray(a), np.asarray(b)
    return np.array_equal(one, two, equal_nan=one.dtype.kind == two.dtype.kind == "f")
