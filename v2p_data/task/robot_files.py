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

ROBOT_FOLDER = "robot"
"""Folder of a task with copies of another arm's files."""
MAX_XML_BYTES = 4_000_000
MAX_FILE_BYTES = 64_000_000
MAX_TOTAL_BYTES = 256_000_000
MAX_FILES = 500
MAX_BODIES = 200
MAX_ELEMENTS = 20_000
MAX_DEPTH = 100
MAX_COUNT = 1_000_000
"""Most that `<size>` may reserve."""
GRID_ATTRIBUTES = frozenset(
    {"width", "height", "nrow", "ncol", "gridsize", "octree_maxdepth", "nsample", "maxhullvert"}
)
MAX_GRID = 4096
"""Most pixels or cells along one side."""
MAX_PICTURE_PIXELS = MAX_GRID**2
MAX_ALL_PIXELS = 4 * MAX_PICTURE_PIXELS
"""Most pixels of all pictures together; decoded they take three bytes each."""
MULTIPLYING = frozenset(
    {
        "replicate",
        "composite",
        "flexcomp",
        "flex",
        "skin",
        "attach",
        "model",
        "plugin",
        "extension",
    }
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
    pixels = [_pixels(path) for path in files if path.suffix.lower() == ".png"]
    if max(pixels, default=0) > MAX_PICTURE_PIXELS or sum(pixels) > MAX_ALL_PIXELS:
        raise V2PError(
            f"robot file {main} has pictures of {sum(pixels) / 1e6:.0f} million pixels, the largest of "
            f"{max(pixels) / 1e6:.0f} million; at most {MAX_PICTURE_PIXELS / 1e6:.0f} million each and "
            f"{MAX_ALL_PIXELS / 1e6:.0f} million together are decoded: make them smaller"
        )
    return list(files)


def _pixels(path: Path) -> int:
    """Return how many pixels a PNG says that it has, which its first chunk must; 0 for what is none."""
    with path.open("rb") as stream:
        head = stream.read(24)
    is_png = head[:8] == b"\x89PNG\r\n\x1a\n" and head[12:16] == b"IHDR"
    return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24]) if is_png else 0


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

    def _inside(self, folder: str, name: str) -> Path:
        path = Path(os.path.normpath(self.main.parent / folder / name))
        is_absolute = any(p.startswith("/") or "\\" in p or ":" in p for p in (folder, name))
        root = self.root and Path(os.path.abspath(self.root))  # noqa: PTH100
        if is_absolute or (root is not None and not path.is_relative_to(root)):
            raise V2PError(
                f"robot file {self.main} names {str(PurePosixPath(folder) / name)[:200]!r}, which does not lie "
                + (f"in {root}" if root and not is_absolute else "at a relative path")
                + "; put the file into its folder and name it by a relative path"
            )
        return path


def _read(path: Path, main: Path) -> _Text:
    """Read one XML file, without its entities: a file that declares some is refused."""
    if path.stat().st_size > MAX_XML_BYTES:
        raise V2PError(
            f"robot file {path} has {path.stat().st_size / 1e6:.1f} MB; at most {MAX_XML_BYTES / 1e6:.0f} MB of MJCF "
            "are read: keep meshes in files of their own"
        )
    text, depth = _Text(), 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        text.root = text.root or tag
        text.elements += 1
        text.bodies += tag == "body"
        if tag in MULTIPLYING:
            raise V2PError(
                f"robot file {main} has an element <{tag}>, which an arm does not need; leave it "
                "out, or save the compiled "
                "model as MJCF and use that"
            )
        if depth > MAX_DEPTH or text.elements > MAX_ELEMENTS or text.bodies > MAX_BODIES:
            raise V2PError(_too_much(main))
        if tag == "size":
            _check_size(attributes, main)
        if tag == "mesh" and "builtin" in attributes:
            raise V2PError(f"robot file {main} has a mesh that MuJoCo makes up; save it as a file")
        for name in GRID_ATTRIBUTES & attributes.keys():
            if any(_number(v) > MAX_GRID for v in attributes[name].split()):
                raise V2PError(
                    f"robot file {main} has {name}={attributes[name][:50]!r} in <{tag}>; at most {MAX_GRID} is taken"
                )
        for name, value in attributes.items():
            if tag == "include" and name == "file":
                text.includes.append(value)
            elif name.startswith("file"):
                text.assets.append(value)
            elif name.endswith("dir") and tag == "compiler":
                text.folders.append(value)

    def end(tag: str) -> None:
        nonlocal depth
        del tag
        depth -= 1

    def refuse(*_: object) -> None:
        raise V2PError(f"robot file {main} declares a document type or entities; MJCF has neither")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(path.read_bytes(), True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise V2PError(
            f"robot file {main} is no MJCF that MuJoCo reads: {path.name}: {error}"
        ) from error
    return text


def _check_size(attributes: dict[str, str], main: Path) -> None:
    for name, value in attributes.items():
        digits = value.strip().lstrip("+-")
        if not (digits.isdecimal() and digits.isascii() and int(digits[:20]) <= MAX_COUNT):
            raise V2PError(
                f"robot file {main} reserves {name}={value[:50]!r}; leave <size> out, MuJoCo finds the sizes itself"
            )


def _number(text: str) -> float:
    """Return a number; infinity for what is none, or might be read as another one."""
    try:
        return abs(float(text))
    except ValueError:
        return float("inf")


def _check_counts(texts: dict[Path, _Text], main: Path) -> None:
    if (
        sum(t.bodies for t in texts.values()) > MAX_BODIES
        or sum(t.elements for t in texts.values()) > MAX_ELEMENTS
    ):
        raise V2PError(_too_much(main))


def _too_much(main: Path) -> str:
    return (
        f"robot file {main} has more than {MAX_BODIES} bodies, {MAX_ELEMENTS} elements or {MAX_DEPTH} levels with what "
        "it includes; an arm has fewer"
    )
