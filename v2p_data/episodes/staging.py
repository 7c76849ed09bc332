"""Finished episodes on disk before any LeRobot writer sees them: one file each, whole or absent.

LeRobot's own writer loses everything when its process dies before `finalize`. A staged file is written under
a temporary name, flushed and renamed, so a kill loses only the episode in hand. Its bytes depend on its
content alone.
"""

import hashlib
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.errors import V2PError, write_refusal
from v2p_data.sim.render.masks import MASK_CAMERA, MASK_CAMERAS, RGB_CAMERA

EPISODES_FOLDER = "episodes"
SCHEMA = 1
ARRAYS = ("labels", "state", "action", "success")
INTERVENTION = "intervention"
"""The array that only handovers have."""
KNOWN = "simulated."
"""How the names of arrays begin that only a simulator can fill; the column's name follows."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One demonstration, or a handover: a student acts and the expert takes over.

    Row `t` is what was seen before the action of row `t` was taken.
    """

    id: str
    """`<item>_<number of the world it ran in>`."""
    item: str
    task: str
    """The instruction in words."""
    seed: int
    labels: UInt8[np.ndarray, "time h w"]
    """0 background, 1 robot, 2 manipulated object, 3.. the others; of two cameras below each other."""
    state: Float32[np.ndarray, "time state"]
    action: Float32[np.ndarray, "time act"]
    success: Bool[np.ndarray, "time"]
    """Whether success has held (0.25 s on end) by the end of the row's action; never falls back."""
    simulated: Mapping[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """What a simulator knows besides, by column (`features.SIMULATED`); empty for a robot's recording."""
    referee: bool
    """The verdict of the independent success function, which no training saw."""
    objects: tuple[str, ...]
    """Names behind labels 2, 3, ..."""
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    """What the randomisation drew."""
    cameras: tuple[str, ...] = (MASK_CAMERA,)
    """Which pictures go into a dataset: `mask`, `mask_wrist`, `rgb`. Label images are staged in any case."""
    rgb_mp4: bytes = b""
    """The pictures of `rgb`, a video already."""
    actions: tuple[str, ...] = ()
    """Names of the action's entries; empty: steps of the tool."""
    family: str = ""
    """Title of the scene of which the task's object is a cousin; empty: its own."""
    intervention: Bool[np.ndarray, "time"] | None = None
    """Who acted: True the expert, which took over from a student; False the student. None for a demonstration.
    Where the student acted, `action` holds the expert's label: what it would have done, for that is to be learned."""

    def __post_init__(self) -> None:
        lengths = {len(self.labels), len(self.state), len(self.action), len(self.success)}
        lengths |= {len(values) for values in self.simulated.values()}
        if self.intervention is not None:
            lengths.add(len(self.intervention))
        if len(lengths) != 1:
            raise ValueError(f"episode {self.id}: columns differ in length: {sorted(lengths)}")
        if (RGB_CAMERA in self.cameras) != bool(self.rgb_mp4):
            raise ValueError(
                f"episode {self.id}: cameras are {self.cameras}, rgb_mp4 has {len(self.rgb_mp4)} bytes"
            )

    @property
    def num_frames(self) -> int:
        return len(self.state)

    def labels_of(self, camera: str) -> UInt8[np.ndarray, "time h w"]:
        """Return the label images of one mask camera."""
        masks = [c for c in MASK_CAMERAS if c in self.cameras]
        return np.split(self.labels, len(masks), axis=1)[masks.index(camera)]

    @property
    def is_handover(self) -> bool:
        return self.intervention is not None

    @property
    def expert_acted(self) -> Bool[np.ndarray, "time"]:
        """Whether the expert acted, per row; in a demonstration it did throughout."""
        if self.intervention is None:
            return np.ones(self.num_frames, bool)
        return self.intervention

    def save(self, folder: Path) -> Path:
        """Write `folder/<id>.npz` atomically and return it."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.id}.npz"
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
        arrays = {name: getattr(self, name) for name in ARRAYS}
        arrays |= {KNOWN + column: values for column, values in self.simulated.items()}
        if self.cameras != (MASK_CAMERA,):
            about["cameras"] = list(self.cameras)
        if self.family:
            about["family"] = self.family
        if self.actions:
            about["actions"] = list(self.actions)
        if self.intervention is not None:
            arrays[INTERVENTION] = self.intervention
        if self.rgb_mp4:
            arrays["rgb_mp4"] = np.frombuffer(self.rgb_mp4, np.uint8)
        arrays["about"] = np.array(json.dumps(about, sort_keys=True))
        save_arrays(path, arrays)
        return path

    @staticmethod
    def load(path: Path, *, pictures: bool = True) -> "Episode":
        """Read a staged episode; without pictures its `labels` are of size 0 and it has no cameras.

        Raises:
            V2PError: the file is damaged or was written by another version.
        """
        with _damage_named(path), np.load(path) as data:
            about = _about(data, path)
            names = ARRAYS if pictures else ARRAYS[1:]
            arrays: dict[str, Any] = {k: data[k] for k in names}
            arrays["simulated"] = {column: data[KNOWN + column] for column in _known(data)}
            if INTERVENTION in data:
                arrays[INTERVENTION] = data[INTERVENTION]
            if not pictures:
                arrays["labels"] = np.zeros((len(arrays["state"]), 0, 0), np.uint8)
                about["cameras"] = ()
            elif "rgb_mp4" in data:
                arrays["rgb_mp4"] = data["rgb_mp4"].tobytes()
        return Episode(**about, **arrays)


@dataclass(frozen=True, kw_only=True)
class Heading:
    """What a staged file says of itself, read without unpacking its pictures."""

    path: Path
    id: str
    item: str
    task: str
    num_frames: int
    size_px: tuple[int, int]
    """Height and width of the label images."""
    cameras: tuple[str, ...]
    actions: tuple[str, ...]
    """Names of the action's entries; empty: steps of the tool."""
    num_states: int
    """Entries of the state."""
    is_handover: bool
    """It holds who acted."""
    known: Mapping[str, int]
    """Columns that only a simulator can fill, and how many entries a row of each has; none in a robot's recording."""
    digest: str
    """SHA-256 of the file."""

    @staticmethod
    def read(path: Path) -> "Heading":
        """Return it.

        Raises:
            V2PError: the file is damaged or was written by another version.
        """
        with _damage_named(path):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            with np.load(path) as data:
                about = _about(data, path)
                is_handover = INTERVENTION in data
                columns = _known(data)
            with zipfile.ZipFile(path) as archive:
                known = {c: math.prod(_shape(archive, KNOWN + c)[1:]) for c in columns}
                count, height, width = _shape(archive, "labels")
                _, num_states = _shape(archive, "state")
        return Heading(
            path=path,
            id=about["id"],
            item=about["item"],
            task=about["task"],
            num_frames=count,
            size_px=(height, width),
            cameras=about.get("cameras", (MASK_CAMERA,)),
            actions=about.get("actions", ()),
            num_states=num_states,
            is_handover=is_handover,
            known=known,
            digest=digest,
        )


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a compressed `.npz` that is whole or absent."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
            stream.flush()
            os.fsync(stream.fileno())
    except OSError:
        with suppress(OSError):  # half a file takes room that may be what is missing
            temporary.unlink()
        raise
    temporary.replace(path)


@contextmanager
def refusals_named(doing: str, where: Path) -> Iterator[None]:
    """Turn a full disk, a limit or a read-only folder into one sentence.

    Args:
        doing: what stops, e.g. `collecting episodes`.
        where: the folder that is written to.

    Raises:
        V2PError: nothing can be written at `where`.
    """
    try:
        yield
    except V2PError:
        raise
    except Exception as error:
        reason = write_refusal(error)
        if reason is None:
            raise
        raise V2PError(
            f"{doing} at {where} stopped: {reason} and run the same command again; "
            "what was finished is kept"
        ) from error


def _about(data: Any, path: Path) -> dict[str, Any]:
    about: dict[str, Any] = json.loads(str(data["about"]))
    if about.pop("schema", None) != SCHEMA:
        raise V2PError(f"staged episode {path} was written by another version; remake it")
    named = ("objects", "cameras", "actions")
    return about | {name: tuple(about[name]) for name in named if name in about}


def _shape(archive: zipfile.ZipFile, name: str) -> tuple[int, ...]:
    with archive.open(f"{name}.npy") as member:
        np.lib.format.read_magic(member)
        shape, _, _ = np.lib.format.read_array_header_1_0(member)
    return shape


def _known(data: Any) -> tuple[str, ...]:
    return tuple(name.removeprefix(KNOWN) for name in data if name.startswith(KNOWN))


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn what a missing or damaged file does to its reader into one sentence."""
    try:
        yield
    except FileNotFoundError:
        raise V2PError(f"there is no staged episode {path}") from None
    except V2PError:
        raise
    except Exception as error:
        raise V2PError(
            f"staged episode {path} cannot be read ({type(error).__name__}: {error}); "
            "delete it and run the same command again"
        ) from error


def staged_episodes(folder: Path) -> list[Path]:
    """Return the staged episodes under an episodes artefact, in the order they are packed."""
    return sorted((folder / EPISODES_FOLDER).glob("*.npz"))
