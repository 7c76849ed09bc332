"""Staged episodes become video files, each with many episodes: what takes the time, in parallel and kept.

A shard is some episodes on end and, per camera, a file that holds them. It is encoded, decoded again,
compared and renamed into place, then noted down with the digests of what it was made from. A packing that was
killed makes only the shards that are missing. Which episode lies in which shard follows from their lengths alone,
and each is encoded by itself, so neither the number of threads nor a kill changes a byte. Shards on end then make a
video file of the dataset: LeRobot's `StreamingLeRobotDataset` finds frames in the first file of a camera only.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2p_data.episodes.dataset import encoding
from v2p_data.episodes.dataset.episode_stats import Stats, mask_stats, rgb_stats
from v2p_data.episodes.staging import Episode, Heading
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.processes import num_cores
from v2p_data.sim.render.masks import MASK_CAMERAS

SHARD_FRAMES = 4096
"""A shard is full once it has so many: 2 MB of masks, lost at most when a packing is killed."""
ENCODING = 1
"""Raised by hand when the same episode gives other bytes than before."""
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class Shard:
    """Episodes that are encoded and kept together."""

    number: int
    episodes: tuple[Heading, ...]

    @property
    def num_frames(self) -> int:
        return sum(e.num_frames for e in self.episodes)

    @property
    def fingerprint(self) -> str:
        """Of everything that decides the files' bytes."""
        what = [[e.id, e.digest] for e in self.episodes]
        return hashlib.sha256(json.dumps([ENCODING, what]).encode()).hexdigest()

    def file(self, folder: Path, camera: str) -> Path:
        return folder / f"{self.number:05d}.{camera}.mp4"

    def note(self, folder: Path) -> Path:
        return folder / f"{self.number:05d}.json"


def plan_shards(episodes: Sequence[Heading]) -> list[Shard]:
    """Return the episodes in order, in shards."""
    shards: list[Shard] = []
    some: list[Heading] = []
    for k, episode in enumerate(episodes):
        some.append(episode)
        if sum(e.num_frames for e in some) >= SHARD_FRAMES or k == len(episodes) - 1:
            shards.append(Shard(number=len(shards), episodes=tuple(some)))
            some = []
    return shards


def make_shards(
    shards: Sequence[Shard],
    folder: Path,
    *,
    num_threads: int = 0,
    on_progress: Progress = lambda share, words: None,
) -> None:
    """Make the shards that are not finished in `folder`; all memory taken is that of a shard's video.

    Raises:
        V2PError: a staged episode is damaged or is not what its heading says.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob("*.tmp"):
        leftover.unlink()
    missing = [s for s in shards if stats_of(s, folder) is None]
    total = sum(len(s.episodes) for s in shards)
    done = total - sum(len(s.episodes) for s in missing)
    workers = num_threads or num_cores()
    with ThreadPoolExecutor(workers) as pool:
        jobs = (e for s in missing for e in s.episodes)
        encoded = _in_order(pool, _encode, jobs, ahead=2 * workers)
        for shard in missing:
            parts: list[_Encoded] = []
            for _ in shard.episodes:
                parts.append(next(encoded))
                done += 1
                on_progress(done / total, f"packed {done}/{total} episodes")
            for camera in shard.episodes[0].cameras:
                encoding.join([p.videos[camera] for p in parts], shard.file(folder, camera))
            stats = [
                {c: {k: v.tolist() for k, v in s.items()} for c, s in p.stats.items()}
                for p in parts
            ]
            note = {"fingerprint": shard.fingerprint, "stats": stats}
            write_json_atomically(shard.note(folder), note)


def stats_of(shard: Shard, folder: Path) -> list[dict[str, Stats]] | None:
    """Return the pictures' statistics per episode and camera of a finished shard; None where it is not finished."""
    note = json_or_none(shard.note(folder), max_bytes=None)
    if not isinstance(note, dict):
        return None
    files = [shard.file(folder, camera) for camera in shard.episodes[0].cameras]
    if note.get("fingerprint") != shard.fingerprint or not all(f.is_file() for f in files):
        return None
    return [
        {c: {k: np.asarray(v) for k, v in s.items()} for c, s in episode.items()}
        for episode in note["stats"]
    ]


def plan_files(
    shards: Sequence[Shard], folder: Path, camera: str, max_bytes: int
) -> list[list[Shard]]:
    """Return the finished shards in order, in groups whose files of a camera are smaller than `max_bytes` together."""
    groups: list[list[Shard]] = []
    room = 0
    for shard in shards:
        size = shard.file(folder, camera).stat().st_size
        if size >= room:
            groups.append([])
            room = max_bytes
        groups[-1].append(shard)
        room -= size
    return groups


def write_file(shards: Sequence[Shard], folder: Path, camera: str, path: Path) -> None:
    """Write what finished shards hold of a camera, one after the other, as the file `path`; the shards stay."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if len(shards) > 1:
        encoding.join(
            (
                encoding.Encoded(mp4=s.file(folder, camera).read_bytes(), num_frames=s.num_frames)
                for s in shards
            ),
            path,
        )
        return
    source = shards[0].file(folder, camera)
    with contextlib.suppress(OSError):
        os.link(source, path)
        return
    shutil.copyfile(source, path)


@dataclass(frozen=True, kw_only=True)
class _Encoded:
    videos: dict[str, encoding.Encoded]
    stats: dict[str, Stats]


def _encode(heading: Heading) -> _Encoded:
    episode = Episode.load(heading.path)
    if episode.labels.shape != (heading.num_frames, *heading.size_px):
        raise V2PError(f"{heading.path} changed while it was packed; run the same command again")
    videos: dict[str, encoding.Encoded] = {}
    stats: dict[str, Stats] = {}
    try:
        for camera in heading.cameras:
            if camera in MASK_CAMERAS:
                labels = np.ascontiguousarray(episode.labels_of(camera))
                videos[camera] = encoding.encode_masks(labels)
                stats[camera] = mask_stats(labels)
            else:
                videos[camera] = encoding.Encoded(
                    mp4=episode.rgb_mp4, num_frames=episode.num_frames
                )
                stats[camera] = rgb_stats(encoding.decode_rgb(episode.rgb_mp4))
    except ValueError as error:
        raise V2PError(f"{heading.path} cannot be packed: {error}") from error
    return _Encoded(videos=videos, stats=stats)


def _in_order(
    pool: ThreadPoolExecutor,
    work: Callable[[Heading], _Encoded],
    jobs: Iterable[Heading],
    ahead: int,
) -> Iterator[_Encoded]:
    """Yield results in the jobs' order, working on a few at a time."""
    waiting: deque[Future[_Encoded]] = deque()
    try:
        for job in jobs:
            waiting.append(pool.submit(work, job))
            if len(waiting) >= ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()
