"""The environment of the hands worker: MediaPipe needs an older numpy, so it has a virtual environment of its own.

It lies in the user's cache folder, under a name that holds the digest of its pinned packages, and is made by
`v2p scene hands --setup`. The worker itself is `hands_worker.py`; its models come inside MediaPipe's wheel.
"""

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from v2p_data.errors import V2PError

WORKER = Path(__file__).parent / "hands_worker.py"
REQUIREMENTS = Path(__file__).parent / "hands_requirements.lock"
DOWNLOAD_MB, DISK_MB = 130, 340
"""Of the pinned packages, measured on Linux."""
_READY = "ready"
"""File that is written last: an environment without it is not used."""
_TIMEOUT_S = 1200


def hands_folder() -> Path:
    """Return where the environment of these pinned packages is, or would be; `V2P_CACHE` names another cache folder."""
    shared = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    cache = Path(os.environ.get("V2P_CACHE") or shared / "v2p")
    digest = hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()[:8]
    return cache / f"hands-{digest}"


def installed_worker() -> str:
    """Return the worker's command line; empty where its environment was not set up."""
    folder = hands_folder()
    if not (folder / _READY).is_file():
        return ""
    return shlex.join([str(_python_of(folder)), str(WORKER)])


def set_up_hands(tell: Callable[[str], None]) -> Path:
    """Make the environment, unless it is there; return its folder.

    Args:
        tell: told what is downloaded, before it is.

    Raises:
        V2PError: the packages cannot be had, or the worker does not run with them.
    """
    folder = hands_folder()
    if (folder / _READY).is_file():
        return folder
    tell(f"installing MediaPipe: about {DOWNLOAD_MB} MB to download, {DISK_MB} MB in {folder}")
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    uv = shutil.which("uv") or next(
        (str(p) for p in Path(sys.prefix).parent.glob("*/bin/uv") if os.access(p, os.X_OK)), None
    )
    base = getattr(sys, "_base_executable", sys.executable)
    packages = ["--no-deps", "--require-hashes", "-r", str(REQUIREMENTS)]
    if uv:
        _call([uv, "venv", "--quiet", "--python", base, str(folder)])
        _call([uv, "pip", "install", "--quiet", "--python", str(_python_of(folder)), *packages])
    else:
        _call([base, "-m", "venv", str(folder)])
        _call([str(_python_of(folder)), "-m", "pip", "install", "--quiet", *packages])
    _call([str(_python_of(folder)), str(WORKER), "--help"])
    (folder / _READY).touch()
    return folder


def _python_of(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _call(words: list[str]) -> None:
    env = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "VIRTUAL_ENV")
    }
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, timeout=_TIMEOUT_S, env=env, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise V2PError(f"the hands worker cannot be set up: {words[0]}: {error}") from error
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise V2PError(
            f"the hands worker cannot be set up: '{shlex.join(words[:4])} ...' failed ({said[-1] if said else 'no word'}); "
            "it needs Python 3.12 and a package index, or packages that uv or pip have in their cache; without the worker "
            "everything works as before"
        )
