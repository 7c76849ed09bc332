"""The files of an arm that is described in MJCF: which they are, and that they describe an arm and nothing enormous.

A task carries copies of them, so that it needs nothing outside its own folder. They are read here as XML only; MuJoCo
compiles them after that.
"""

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from xml.parsers import expat

from v2p_data.errors import V2PError

MAX_XML_BYTES = 4_000_000
MAX_FILE_BYTES = 64_000_000
MAX_TOTAL_BYTES = 256_000_000
MAX_FILES = 500
MAX_BODIES = 200
MAX_ELEMENTS = 20_000
MAX_DEPTH = 100
MAX_COUNT = 1_000_000
"""Of what `<size>` reserves."""
MULTIPLYING = frozenset(
    {"replicate", "composite", "flexcomp", "flex", "skin", "attach", "model", "plugin", "extension"}
)
"""Elements that make many bodies of one, or load code or other models; an arm needs none of them."""
XML_KINDS = (".xml", ".mjcf")
ASSET_KINDS = (".obj", ".stl", ".msh", ".ply", ".png", ".bin", ".hf")


@dataclass(kw_only=True)
class _Text:
    """What one XML file says that matters here."""

    includes: list[str] = field(default_factory=list[str])
    assets: list[str] = field(default_factory=list[str])
    folders: list[str] = field(default_factory=list[str])
    """Values of `meshdir`, `texturedir` and `assetdir`."""
    root: str = ""
    bodies: int = 0
    elements: int = 0


def robot_files(main: Path, root: Path | None = None) -> list[Path]:
    """Return the files that an arm consists of, its MJCF file first.

    Args:
        main: the MJCF file.
        root: the folder that all of them must lie in; None: wherever the file says, since the user named it.

    Raises:
        V2PError: a file is missing or lies elsewhere, is too large, or describes more than an arm.
    """
    main = Path(os.path.abspath(main))  # noqa: PTH100 - without following links
    places = _Places(main, root)
    texts: dict[Path, _Text] = {}
    waiting = [main]
    while waiting:
        path = waiting.pop()
        if path in texts:
            continue
        texts[path] = _read(path, main)
        for name in texts[path].includes:
            found = places.of(name, {""}, XML_KINDS)
            if not found:
                raise V2PError(f"robot file {main} includes {name[:200]!r}, which is missing")
            waiting += found
        if len(texts) > MAX_FILES:
            raise V2PError(f"robot file {main} includes more than {MAX_FILES} files")
    if texts[main].root != "mujoco":
        raise V2PError(
            f"robot file {main} is no MJCF that MuJoCo reads: its root is <{texts[main].root[:50]}>, not <mujoco>"
        )
    _check_counts(texts, main)
    folders = {"", *(folder for text in texts.values() for folder in text.folders)}
    files = dict.fromkeys(texts)
    for asset in dict.fromkeys(a for text in texts.values() for a in text.assets):
        files |= dict.fromkeys(places.of(asset, folders, ASSET_KINDS))
    sizes = [path.stat().st_size for path in files]
    if len(sizes) > MAX_FILES or max(sizes) > MAX_FILE_BYTES or sum(sizes) > MAX_TOTAL_BYTES:
        raise V2PError(
            f"robot file {main} names {len(sizes)} files of {sum(sizes) / 1e6:.0f} MB, the largest of "
            f"{max(sizes) / 1e6:.0f} MB; at most {MAX_FILES} files, {MAX_FILE_BYTES / 1e6:.0f} MB each and "
            f"{MAX_TOTAL_BYTES / 1e6:.0f} MB together are read"
        )
    return list(files)


def copy_robot(main: Path, into: Path) -> Path:
    """Copy an arm's files, and the licences beside its MJCF file; return where that file is, relative to `into`.

    Raises:
        V2PError: as `robot_files`.
    """
    files = robot_files(main)
    base = Path(os.path.commonpath([path.parent for path in files]))
    licences = [p for p in files[0].parent.glob("LICEN[CS]E*") if p.is_file()]
    for path in (*files, *licences):
        place = into / path.relative_to(base)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)
    return files[0].relative_to(base)


@dataclass(frozen=True)
class _Places:
    """Finds the files that an MJCF file names."""

    main: Path
    root: Path | None

    def of(self, name: str, folders: set[str], kinds: tuple[str, ...]) -> list[Path]:
        """Return the files that a name may stand for: MuJoCo looks in the folders that `<compiler>` names."""
        if not name.isprintable() or not name.lower().endswith(kinds):
            raise V2PError(
                f"robot file {self.main} names the file {name[:200]!r}; only files of the kinds {', '.join(kinds)} are "
                "taken"
            )
        found: dict[Path, None] = {}
        for folder in sorted(folders):
            for short in dict.fromkeys((name, PurePosixPath(name).name)):
                path = self._inside(folder, short)
                if path.is_file():
                    found[path] = None
        return list(found)
