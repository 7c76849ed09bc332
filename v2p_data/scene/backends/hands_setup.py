"""The environment of the hands worker: MediaPipe needs an older numpy, so it has a virtual environment of its own.

It lies in the user's cache folder, under a name that holds the digest of its pinned packages, and is made by
`v2p setup hands`. The worker itself is `hands_worker.py`; its models come inside MediaPipe's wheel.
"""

import os
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from v2p_data.scene.backends.pinned_packages import (
    cache_folder,
    call_installer,
    find_uv,
    install_pinned,
    writing_in,
)

WORKER = Path(__file__).parent / "hands_worker.py"
REQUIREMENTS = Path(__file__).parent / "hands_requirements.lock"
DOWNLOAD_MB, DISK_MB = 130, 340
"""Size of the pinned packages, measured on Linux."""
_READY = "ready"
"""File that is written last: an environment without it is not used."""


def hands_folder() -> Path:
    """Return where the environment of these pinned packages is, or would be; `V2P_CACHE` names another cache folder."""
    return cache_folder("hands", REQUIREMENTS)


def installed_worker() -> str:
    """Return the worker's command line; empty where its environment was not set up."""
    folder = hands_folder()
    if not (folder / _READY).is_file():
        return ""
    return shlex.join([str(_python_of(folder)), str(WORKER)])


def set_up_hands(tell: Callable[[str], None]) -> Path:
    """Make the environment, unless it is there; return its folder.

    Args:
        tell: called with a sentence on what will be downloaded.

    Raises:
        V2PError: the packages cannot be had, or the worker does not run with them.
    """
    folder = hands_folder()
    if (folder / _READY).is_file():
        return folder
    tell(f"installing MediaPipe: about {DOWNLOAD_MB} MB to download, {DISK_MB} MB in {folder}")
    shutil.rmtree(folder, ignore_errors=True)
    words = {"thing": "the hands worker", "needs": "Python 3.12 and a package index"}
    base = getattr(sys, "_base_executable", sys.executable)
    python, uv = str(_python_of(folder)), find_uv()
    make = [uv, "venv", "--quiet", "--python", base] if uv else [base, "-m", "venv"]
    with writing_in(folder.parent, "the hands worker"):
        call_installer([*make, str(folder)], **words)
    install_pinned(python, REQUIREMENTS, **words)
    call_installer([python, str(WORKER), "--help"], **words)
    (folder / _READY).touch()
    return folder


def _python_of(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
