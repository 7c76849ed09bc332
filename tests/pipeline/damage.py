"""Ways in which files of a run get damaged, and the files that a run holds: a corpus for tests and for fuzzing.

`HARMS` harm any file, `JSON_HARMS` one that holds a JSON object; `KINDS` names the files by what
they are. Each harm leaves a file that differs from what was written, so whatever lists sizes and
digests must notice.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Harm = Callable[[Path], None]
CUTS = (0.0, 0.1, 0.5, 0.9)
"""Shares of a file that a cut leaves."""


def cut(share: float) -> Harm:
    """Return the harm that leaves the first part of a file, at most all but one byte."""

    def harm(path: Path) -> None:
        data = path.read_bytes()
        path.write_bytes(data[: min(int(share * len(data)), len(data) - 1)])

    return harm


def cut_last(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def flip(place: float, count: int = 2) -> Harm:
    """Return the harm that turns over bits of bytes from a place on, a share of the file; its size stays."""

    def harm(path: Path) -> None:
        data = bytearray(path.read_bytes())
        start = min(int(place * len(data)), len(data) - count)
        for k in range(max(0, start), len(data[: start + count])):
            data[k] ^= 0x41
        path.write_bytes(bytes(data))

    return harm


def append(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")


def noise(path: Path) -> None:
    """Put bytes of the same number in its place that are no text."""
    size = max(1, path.stat().st_size)
    path.write_bytes(bytes((131 * k + 200) % 256 for k in range(size)))


def delete(path: Path) -> None:
    path.unlink()


def folder_instead(path: Path) -> None:
    path.unlink()
    path.mkdir()


def loop(path: Path) -> None:
    """Put a link in its place that leads to itself: nobody can read it, root neither."""
    path.unlink()
    path.symlink_to(path.name)


HARMS: dict[str, Harm] = {
    **{f"cut to {share:.0%}": cut(share) for share in CUTS},
    "last byte lost": cut_last,
    "one byte more": append,
    "flipped near the start": flip(0.05),
    "flipped in the middle": flip(0.5),
    "flipped near the end": flip(0.95),
    "noise": noise,
    "deleted": delete,
    "a folder": folder_instead,
    "a loop of links": loop,
}
"""Harms of any file that holds two bytes or more."""


def text(words: str) -> Harm:
    def harm(path: Path) -> None:
        path.write_text(words)

    return harm


def set_entry(key: str, value: Any) -> Harm:
    """Return the harm that gives one entry of a JSON object another value."""

    def harm(path: Path) -> None:
        data = json.loads(path.read_text())
        data[key] = value
        path.write_text(json.dumps(data, indent=1))

    return harm


def remove_entry(key: str) -> Harm:
    def harm(path: Path) -> None:
        data = json.loads(path.read_text())
        del data[key]
        path.write_text(json.dumps(data, indent=1))

    return harm


JSON_HARMS: dict[str, Harm] = {
    "no JSON": text("{ this is no JSON"),
    "a list": text("[1, 2]"),
    "null": text("null"),
    "a number": text("7"),
    "a text": text('"words"'),
    "an empty object": text("{}"),
    "nested too deeply": text("[" * 100_000),
    "a byte order mark": text("\ufeff{}"),
}
WRONG_VALUES: tuple[Any, ...] = (None, -1, 0.5, True, "x", [], ["x"], {}, {"x": [None]})


def harms_of_entries(path: Path) -> Iterator[tuple[str, Harm]]:
    """Yield a harm for each entry of a JSON object and each value of another kind, and one that leaves it out."""
    for key, value in json.loads(path.read_text()).items():
        yield f"without {key}", remove_entry(key)
        for wrong in WRONG_VALUES:
            if type(wrong) is not type(value):
                yield f"{key} is {wrong!r}", set_entry(key, wrong)


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Files of a run that are of one kind."""

    name: str
    pattern: str
    """From the run folder; finished folders have a name and eight hex digits."""
    is_listed: bool = True
    """Records list it, so no change goes unnoticed."""

    def files(self, root: Path) -> list[Path]:
        """Return a run's files of this kind."""
        return [
            p for p in sorted(root.glob(self.pattern)) if p.is_file() and ".partial" not in str(p)
        ]


KINDS = (
    Kind(name="record", pattern="*/*/record.json", is_listed=False),
    Kind(name="last command", pattern="run.json", is_listed=False),
    Kind(name="what was compared", pattern=".checked/*/*.json", is_listed=False),
    Kind(name="scene", pattern="scene/*/scene.json"),
    Kind(name="mesh", pattern="scene/*/meshes/*"),
    Kind(name="overlay", pattern="scene/*/overlay*"),
    Kind(name="object masks", pattern="scene/*/masks/*.npz"),
    Kind(name="task code", pattern="task/*/task.py"),
    Kind(name="task", pattern="task/*/task.json"),
    Kind(name="scene of a task", pattern="task/*/scene/**/*"),
    Kind(name="expert weights", pattern="expert/*/weights.safetensors"),
    Kind(name="expert", pattern="expert/*/expert.json"),
    Kind(name="expert's judgement", pattern="expert/*/evaluation.json"),
    Kind(name="staged episode", pattern="episodes/*/episodes/*.npz"),
    Kind(name="ledger", pattern="episodes/*/batches/*.json"),
    Kind(name="dataset info", pattern="dataset/*/meta/info.json"),
    Kind(name="dataset statistics", pattern="dataset/*/meta/stats.json"),
    Kind(name="dataset metadata", pattern="dataset/*/meta/v2p.json"),
    Kind(name="dataset tasks", pattern="dataset/*/meta/tasks.parquet"),
    Kind(name="episode table", pattern="dataset/*/meta/episodes/*/*.parquet"),
    Kind(name="dataset rows", pattern="dataset/*/data/*/*.parquet"),
    Kind(name="dataset video", pattern="dataset/*/videos/*/*/*.mp4"),
    Kind(name="carried task", pattern="dataset/*/v2p/tasks/*/task*"),
    Kind(name="carried scene", pattern="dataset/*/v2p/tasks/*/scene/scene.json"),
    Kind(name="student", pattern="distillation/*/student/*"),
    Kind(name="handover episode", pattern="distillation/*/rounds/*/*/episodes/*.npz"),
    Kind(name="handover ledger", pattern="distillation/*/rounds/*/*/batches/*.json"),
    Kind(name="policy weights", pattern="policy/*/policy/model.safetensors"),
    Kind(name="policy settings", pattern="policy/*/policy/config.json"),
    Kind(name="processors", pattern="policy/*/policy/policy_*"),
    Kind(name="training settings", pattern="policy/*/policy/train_config.json"),
    Kind(name="evaluation", pattern="evaluation/*/evaluation.json"),
    Kind(name="films", pattern="evaluation/*/videos/*/*"),
)


def harmed_copy(source: Path, target: Path, path: Path, harm: Harm) -> Path:
    """Copy a folder, harm one of its files there, and return that file."""
    shutil.copytree(source, target, symlinks=True)
    hurt = target / path.relative_to(source)
    harm(hurt)
    return hurt
