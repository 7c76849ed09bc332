"""Finished episodes on disk before any LeRobot writer sees them: one file each, whole or absent.

LeRobot's own writer loses everything when its process dies before `finalize`. A staged file is written under
a temporary name, flushed and renamed, so a kill loses only the episode in hand. Its bytes depend on its
content alone.
"""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.errors import V2PError

EPISODES_FOLDER = "episodes"
SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One demonstration. Row `t` is what was seen before the action of row `t` was taken."""

    id: str
    """`<item>_<number of the world it ran in>`."""
    item: str
    task: str
    """The instruction in words."""
    seed: int
    labels: UInt8[np.ndarray, "time h w"]
    """0 background, 1 robot, 2 manipulated object, 3.. the others."""
    state: Float32[np.ndarray, "time 7"]
    action: Float32[np.ndarray, "time 7"]
    success: Bool[np.ndarray, "time"]
    """Whether success has held (0.25 s on end) by the end of the row's action; never falls back."""
    referee: bool
    """The verdict of the independent success function, which no training saw."""
    objects: tuple[str, ...]
    """Names behind labels 2, 3, ..."""
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    """What the randomisation drew."""

    def __post_init__(self) -> None:
        lengths = {len(self.labels), len(self.state), len(self.action), len(self.success)}
        if len(lengths) != 1:
            raise ValueError(f"episode {self.id}: columns differ in length: {sorted(lengths)}")

    @property
    def num_frames(self) -> int:
        return len(self.state)

    def save(self, folder: Path) -> Path:
        """Write `folder/<id>.npz` atomically and return it."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.id}.npz"
        temporary = path.with_name(path.name + ".tmp")
        about = {
            "schema": SCHEMA,
            "id": self.id,
            "item": self.item,
            "task": self.task,
            "seed": self.seed,
            "referee": self.referee,
            "objects": list(self.objects),
            "params": self.params,
        }
        with temporary.open("wb") as stream:
            np.savez_compressed(
                stream,
                labels=self.labels,
                state=self.state,
                action=self.action,
                success=self.success,
                about=np.array(json.dumps(about, sort_keys=True)),
            )
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
        return path

    @staticmethod
    def load(path: Path) -> "Episode":
        """Read a staged episode.

        Raises:
            V2PError: the file is damaged or was written by another version.
        """
        try:
            with np.load(path) as data:
                about: dict[str, Any] = json.loads(str(data["about"]))
                arrays = {k: data[k] for k in ("labels", "state", "action", "success")}
        except FileNotFoundError:
            raise V2PError(f"there is no staged episode {path}") from None
        except Exception as error:
            raise V2PError(
                f"staged episode {path} cannot be read ({type(error).__name__}: {error}); "
                "delete it and run the same command again"
            ) from error
        if about.pop("schema", None) != SCHEMA:
            raise V2PError(f"staged episode {path} was written by another version; remake it")
        return Episode(**{**about, "objects": tuple(about["objects"])}, **arrays)


def staged_episodes(folder: Path) -> list[Path]:
    """Return the staged episodes under an episodes artefact, in the order they are packed."""
    return sorted((folder / EPISODES_FOLDER).glob("*.npz"))
