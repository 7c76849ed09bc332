"""A model in an environment of its own answers a request: a separate process, one folder in, one folder out.

This is for what has no class in transformers: InstantMesh or TripoSR (mesh), MoGe or UniDepth (depth), FoundationPose
(pose). `docs/workers.md` is the contract; `scripts/example_worker.py` keeps it. Nothing that comes
back is trusted: only three fixed file names are opened, no pickle, no link, nothing above a size;
every array is checked for name, type, shape, finiteness and range; a mesh that is not watertight
is repaired. The process runs with the user's rights all the same: a worker is a program you chose
to run.
"""

import json
import os
import secrets
import shlex
import shutil
import stat
import subprocess
import tempfile
import time
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Shaped
from trimesh.exchange.obj import load_obj

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.geometry.mesh import joined, welded
from v2p_data.processes import end_group, end_marked, ending_with_us

SCHEMA, VERSION = "v2p-worker", 1
EXIT_REFUSED = 3
"""The worker understood but cannot do this item; the sentence is in `result.json`."""
MAX_BYTES = 4 * 2**30
"""All that a worker may write, logs included."""
_MAX_JSON = 2**20
_MAX_OBJ = 2**29
_MAX_FACES = 2_000_000
_TAIL = 2000
_POLL_S = 0.05

type Kind = Literal["mesh", "depth", "pose", "segment", "ground"]
type Repair = Literal["none", "holes_filled", "convex_hull"]


@dataclass(frozen=True, kw_only=True)
class Array:
    """What an array of a request or a result must be."""

    dims: tuple[str | int, ...]
    """Names stand for sizes that must agree across the request and the result."""
    dtype: Literal["uint8", "bool", "int", "float"]
    required: bool = True
    low: float = -np.inf
    high: float = np.inf
    finite: bool = True
    """Whether NaN is refused; infinities always are."""


@dataclass(frozen=True)
class _Contract:
    given: Mapping[str, Array]
    answer: Mapping[str, Array]
    given_fields: Mapping[str, type]
    answer_fields: Mapping[str, type]
    has_mesh: bool = False


_VIDEO = Array(dims=("time", "h", "w", 3), dtype="uint8")
_IMAGES = Array(dims=("n", "h", "w", 3), dtype="uint8")
_K = Array(dims=(3, 3), dtype="float")
CONTRACTS: dict[str, _Contract] = {
    "mesh": _Contract(
        given={
            "image": Array(dims=("h", "w", 3), dtype="uint8"),
            "mask": Array(dims=("h", "w"), dtype="bool"),
        },
        answer={},
        given_fields={"name": str},
        answer_fields={"metric": bool},
        has_mesh=True,
    ),
    "depth": _Contract(
        given={"images": _IMAGES, "K": Array(dims=(3, 3), dtype="float", required=False)},
        answer={
            "depth_m": Array(dims=("n", "h", "w"), dtype="float", low=0.0, high=1e4, finite=False),
            "fov_rad": Array(dims=("n",), dtype="float", required=False, low=0.05, high=3.1),
        },
        given_fields={},
        answer_fields={"metric": bool},
    ),
    "pose": _Contract(
        given={
            "images": _VIDEO,
            "masks": Array(dims=("time", "h", "w"), dtype="bool"),
            "K": _K,
            "mesh_vertices": Array(dims=("v", 3), dtype="float"),
            "mesh_faces": Array(dims=("f", 3), dtype="int", low=0.0),
            "depth_m": Array(dims=("time", "h", "w"), dtype="float", required=False, finite=False),
        },
        answer={
            "T_cam_objs": Array(dims=("time", 4, 4), dtype="float", low=-1e4, high=1e4),
            "confidences": Array(dims=("time",), dtype="float", low=0.0, high=1.0),
        },
        given_fields={},
        answer_fields={},
    ),
    "segment": _Contract(
        given={
            "images": _VIDEO,
            "boxes_xyxy": Array(dims=("object", 4), dtype="float"),
            "frame_idx": Array(dims=("object",), dtype="int", low=0.0),
        },
        answer={
            "masks": Array(dims=("object", "time", "h", "w"), dtype="bool"),
            "scores": Array(dims=("object", "time"), dtype="float", low=0.0, high=1.0),
        },
        given_fields={},
        answer_fields={},
    ),
    "ground": _Contract(
        given={"images": _IMAGES},
        answer={
            "boxes_xyxy": Array(dims=("k", 4), dtype="float", low=-1e5, high=1e5),
            "scores": Array(dims=("k",), dtype="float", low=0.0, high=1.0),
            "image_idx": Array(dims=("k",), dtype="int", low=0.0),
            "phrase_idx": Array(dims=("k",), dtype="int", low=0.0),
        },
        given_fields={"phrases": list},
        answer_fields={},
    ),
}
"""Per kind the arrays and JSON fields that go in and come out; units and frames are in `docs/workers.md`."""


@dataclass(frozen=True, kw_only=True)
class WorkerRequest:
    """What a worker is asked."""

    kind: Kind
    arrays: Mapping[str, Shaped[np.ndarray, "..."]]
    fields: Mapping[str, Any] = field(default_factory=dict)
    """JSON values."""


@dataclass(frozen=True, kw_only=True)
class WorkerResult:
    """What a worker answered, checked."""

    arrays: Mapping[str, Shaped[np.ndarray, "..."]]
    fields: Mapping[str, Any]
    mesh: trimesh.Trimesh | None = None
    """Watertight, turned outwards; +z up, the side in the picture facing +x."""
    repair: Repair = "none"
    """What had to be done to the mesh; `convex_hull` closes hollows as well."""


def run_worker(
    command: str, request: WorkerRequest, timeout_s: float, *, max_bytes: int = MAX_BYTES
) -> WorkerResult:
    """Return the checked answer of `command --request DIR --result DIR`.

    All that the worker started is killed at the time limit, at the size limit, and when this call ends for any other
    reason, on Linux also what it put into a session of its own.

    Raises:
        V2PError: the request does not keep the contract, the command cannot be started, it fails, runs too long, writes
            too much, or its answer does not keep the contract.
        ItemRejectedError: the worker refuses this item (exit code 3), slug `worker_refused`.
    """
    words = shlex.split(command)
    if not words:
        raise V2PError(
            "no worker command was given; set one, such as 'python scripts/example_worker.py'"
        )
    contract = CONTRACTS[request.kind]
    sizes = _check_arrays(request.arrays, contract.given, {}, "the request")
    _check_fields(request.fields, contract.given_fields, "the request")
    if unknown := sorted(set(request.arrays) - set(contract.given)):
        raise V2PError(
            f"a '{request.kind}' request has no array '{unknown[0]}'; known: {', '.join(contract.given)}"
        )
    with tempfile.TemporaryDirectory(prefix="v2p-worker-") as folder:
        given, answer = Path(folder, "request"), Path(folder, "result")
        given.mkdir()
        answer.mkdir()
        _write_request(request, given)
        log = Path(folder, "log.txt")
        code = _run(
            [*words, "--request", str(given), "--result", str(answer)],
            answer,
            log,
            timeout_s,
            max_bytes,
        )
        if code == EXIT_REFUSED:
            said = _read_json(answer / "result.json").get("message") or "it gave no reason"
            said = " ".join(str(said)[:500].split())
            raise ItemRejectedError(
                "worker_refused", f"worker '{words[0]}' refuses the item: {said}"
            )
        if code != 0:
            how = f"was ended by signal {-code}" if code < 0 else f"failed with exit code {code}"
            raise V2PError(f"worker '{command}' {how}; it last said: {_tail(log)}")
        return _read_result(request, answer, contract, sizes, max_bytes)


def _run(words: list[str], answer: Path, log: Path, timeout_s: float, max_bytes: int) -> int:
    # Our own interpreter's settings would lead another environment's Python astray.
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH")}
    mark = f"V2P_WORKER={secrets.token_hex(8)}"
    env |= dict([mark.split("=")])
    if shutil.which(words[0]) is None:
        raise V2PError(
            f"worker '{words[0]}' cannot be started: there is no such program; check its command line"
        )
    with log.open("wb") as out:
        process = subprocess.Popen(
            ending_with_us(words),
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=env,
            start_new_session=True,
        )
        try:
            end = time.monotonic() + timeout_s
            while True:
                try:
                    return process.wait(timeout=_POLL_S)
                except subprocess.TimeoutExpired:
                    pass
                if time.monotonic() > end:
                    raise V2PError(
                        f"worker '{shlex.join(words[:-4])}' was stopped after {timeout_s:g} s (worker_timeout_s); "
                        f"it last said: {_tail(log)}"
                    )
                if _bytes_in(answer, log) > max_bytes:
                    raise V2PError(
                        f"worker '{shlex.join(words[:-4])}' was stopped: it wrote more than {max_bytes} bytes"
                    )
        finally:
            end_group(process, grace_s=1.0)
            end_marked(mark)


def _write_request(request: WorkerRequest, folder: Path) -> None:
    plain: dict[str, Any] = {k: np.ascontiguousarray(v) for k, v in request.arrays.items()}
    np.savez(folder / "arrays.npz", **plain)
    head = {
        "schema": SCHEMA,
        "version": VERSION,
        "kind": request.kind,
        "fields": dict(request.fields),
        "arrays": {
            k: {"shape": list(v.shape), "dtype": str(v.dtype)} for k, v in request.arrays.items()
        },
    }
    (folder / "request.json").write_text(json.dumps(head, indent=2), encoding="utf-8")


def _read_result(
    request: WorkerRequest,
    folder: Path,
    contract: _Contract,
    sizes: dict[str, int],
    max_bytes: int,
) -> WorkerResult:
    kind, num_phrases = request.kind, len(request.fields.get("phrases", ()))
    if _bytes_in(folder) > max_bytes:
        raise V2PError(f"the worker's result is larger than {max_bytes} bytes")
    head = _read_json(folder / "result.json")
    got = (head.get("schema"), head.get("version"), head.get("kind"))
    if got != (SCHEMA, VERSION, kind):
        raise V2PError(
            f"result.json is for schema, version, kind {got}, but ({SCHEMA!r}, {VERSION}, {kind!r}) was asked"
        )
    fields = head.get("fields", {})
    if not isinstance(fields, dict):
        raise V2PError("'fields' of result.json must be an object")
    _check_fields(fields, contract.answer_fields, "result.json")
    arrays: dict[str, np.ndarray] = {}
    if contract.answer:
        arrays = _read_npz(folder / "result.npz", set(contract.answer), max_bytes)
        _check_arrays(arrays, contract.answer, sizes, "result.npz")
    if kind == "pose":
        _check_rigid(arrays["T_cam_objs"])
    if "image_idx" in arrays and (arrays["image_idx"] >= sizes["n"]).any():
        raise V2PError(
            f"'image_idx' of result.npz must be below {sizes['n']}, the number of pictures"
        )
    if kind == "ground" and (arrays["phrase_idx"] >= num_phrases).any():
        raise V2PError(
            f"'phrase_idx' of result.npz must be below {num_phrases}, the number of phrases"
        )
    mesh, repair = _read_mesh(folder / "mesh.obj") if contract.has_mesh else (None, "none")
    return WorkerResult(arrays=arrays, fields=fields, mesh=mesh, repair=repair)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        head = json.loads(_bytes_of(path, _MAX_JSON).decode())
    except (ValueError, RecursionError) as error:
        raise V2PError(f"the worker's {path.name} is no JSON ({error})") from error
    if not isinstance(head, dict):
        raise V2PError(f"the worker's {path.name} must hold one JSON object")
    return head


def _read_npz(path: Path, wanted: set[str], max_bytes: int) -> dict[str, np.ndarray]:
    """Return the wanted arrays; each header is read first, so that none asks for more than the file holds."""
    _regular(path, max_bytes)
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = {m.filename.removesuffix(".npy"): m for m in archive.infolist()}
            if sum(m.file_size for m in members.values()) > max_bytes:
                raise V2PError(f"the arrays of the worker's {path.name} exceed {max_bytes} bytes")
            if unknown := sorted(set(members) - wanted):
                raise V2PError(
                    f"the worker's {path.name} has an array {unknown[0][:60]!r} that nobody asked for; "
                    f"known: {', '.join(sorted(wanted))}"
                )
            for name in wanted & set(members):
                with archive.open(members[name]) as file:
                    version = np.lib.format.read_magic(file)
                    read = {
                        (1, 0): np.lib.format.read_array_header_1_0,
                        (2, 0): np.lib.format.read_array_header_2_0,
                    }[version]
                    shape, _, dtype = read(file)
                if dtype.hasobject:
                    raise V2PError(
                        f"'{name}' of the worker's {path.name} holds Python objects, not numbers"
                    )
                if int(np.prod(shape, dtype=object)) * dtype.itemsize > members[name].file_size:
                    raise V2PError(f"'{name}' of the worker's {path.name} is cut off")
                with archive.open(members[name]) as file:
                    arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
    except (
        zipfile.BadZipFile,
        ValueError,
        KeyError,
        EOFError,
        OSError,
        NotImplementedError,
    ) as error:
        raise V2PError(f"the worker's {path.name} cannot be read as npz ({error})") from error
    return arrays


def _read_mesh(path: Path) -> tuple[trimesh.Trimesh, Repair]:
    """Return the mesh, watertight and turned outwards, and what had to be done to it."""
    text = _bytes_of(path, _MAX_OBJ).decode(errors="replace")
    if text.count("\nf ") > _MAX_FACES:
        raise V2PError(f"the worker's mesh.obj has more than {_MAX_FACES} faces; simplify it")
    try:
        # No resolver and no materials: an OBJ may name other files, which are not opened.
        loaded = load_obj(StringIO(text), resolver=None, skip_materials=True)
        # Several groups come as several meshes.
        groups = list(loaded["geometry"].values()) if "geometry" in loaded else [loaded]
        parts = [trimesh.Trimesh(g["vertices"], g["faces"], process=False) for g in groups]
        mesh = joined(parts)
    except Exception as error:
        raise V2PError(f"the worker's mesh.obj cannot be read ({error})") from error
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise V2PError("the worker's mesh.obj has no face, or vertices that are not numbers")
    if not (mesh.extents > 0).all() or mesh.extents.max() > 1e4:
        raise V2PError(
            f"the worker's mesh.obj is flat or out of scale: extents {mesh.extents.tolist()}"
        )
    try:
        mesh, repair = _closed(mesh)
    except (ValueError, RuntimeError, IndexError) as error:
        raise V2PError(
            f"the worker's mesh.obj cannot be closed ({str(error).splitlines()[0]})"
        ) from error
    if not mesh.is_watertight or mesh.volume <= 0:
        raise V2PError("the worker's mesh.obj encloses no volume, and could not be repaired")
    return mesh, repair


def _closed(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, Repair]:
    mesh = welded(mesh, merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    repair: Repair = "none"
    if not mesh.is_watertight:
        repair = "holes_filled"
        trimesh.repair.fill_holes(mesh)
    if not mesh.is_watertight:
        repair = "convex_hull"
        mesh = mesh.convex_hull
    trimesh.repair.fix_normals(mesh, multibody=True)
    return mesh, repair


def _check_arrays(
    arrays: Mapping[str, np.ndarray],
    contract: Mapping[str, Array],
    sizes: dict[str, int],
    where: str,
) -> dict[str, int]:
    """Return the sizes of the named dimensions; raise where an array is not what the contract says."""
    sizes = dict(sizes)
    for name, want in contract.items():
        if name not in arrays:
            if want.required:
                raise V2PError(f"{where} lacks the array '{name}' ({_shown(want)})")
            continue
        array = arrays[name]
        kinds = {"uint8": "u", "bool": "b", "int": "iu", "float": "f"}[want.dtype]
        most_bytes = 1 if want.dtype == "uint8" else 8
        right = array.dtype.kind in kinds and array.dtype.itemsize <= most_bytes
        right = right and array.ndim == len(want.dims)
        for dim, size in zip(want.dims, array.shape, strict=False):
            right = right and size == (
                dim if isinstance(dim, int) else sizes.setdefault(dim, size)
            )
        if not right:
            known = {k: v for k, v in sizes.items() if k in want.dims}
            raise V2PError(
                f"'{name}' of {where} must be {_shown(want)} with {known}, got {array.dtype} {list(array.shape)}"
            )
        if want.dtype in ("float", "int"):
            usable = array[~np.isnan(array)] if want.dtype == "float" else array
            if want.finite and usable.size != array.size:
                raise V2PError(f"'{name}' of {where} has {array.size - usable.size} NaN")
            if usable.size and not (
                want.low <= usable.min()
                and usable.max() <= want.high
                and np.isfinite(usable).all()
            ):
                raise V2PError(
                    f"'{name}' of {where} must lie in {want.low:g}..{want.high:g} and be finite, got "
                    f"{usable.min()}..{usable.max()}"
                )
    return sizes


def _check_fields(fields: Mapping[str, Any], wanted: Mapping[str, type], where: str) -> None:
    for name, kind in wanted.items():
        if not isinstance(fields.get(name), kind):
            raise V2PError(
                f"{where} needs the field '{name}' ({kind.__name__}), got {fields.get(name)!r}"
            )


def _check_rigid(T: Shaped[np.ndarray, "time 4 4"]) -> None:
    R = T[:, :3, :3]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0)
    if off > 1e-3 or (np.linalg.det(R) < 0).any() or np.abs(T[:, 3] - [0, 0, 0, 1]).max(initial=0):
        raise V2PError(
            "'T_cam_objs' of result.npz must be rotations and translations with the last row 0 0 0 1 "
            f"(off by {off:.3g})"
        )


def _shown(want: Array) -> str:
    return f"{want.dtype} [{' '.join(map(str, want.dims))}]"


def _regular(path: Path, max_bytes: int) -> None:
    """Raise unless the path is a plain file (no link, no pipe) of at most the size."""
    try:
        found = path.lstat()
    except OSError:
        raise V2PError(f"the worker wrote no {path.name}") from None
    if not stat.S_ISREG(found.st_mode):
        raise V2PError(f"the worker's {path.name} is no plain file")
    if found.st_size > max_bytes:
        raise V2PError(f"the worker's {path.name} is larger than {max_bytes} bytes")


def _bytes_of(path: Path, max_bytes: int) -> bytes:
    _regular(path, max_bytes)
    with path.open("rb") as file:
        return file.read(max_bytes)


def _bytes_in(folder: Path, *files: Path) -> int:
    total = 0
    for path in [*folder.rglob("*"), *files]:
        try:
            total += (
                path.lstat().st_blocks * 512
            )  # what it takes on disk: a sparse file takes nothing
        except OSError:
            continue  # gone in the meantime
    return total


def _tail(log: Path) -> str:
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL))
        return " ".join(file.read().decode(errors="replace").split()) or "nothing"
