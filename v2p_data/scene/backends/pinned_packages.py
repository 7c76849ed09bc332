"""Pinned packages that are installed beside ours, each set in a folder of its own in the user's cache."""

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from v2p_data.errors import V2PError
from v2p_data.processes import ending_with_us
from v2p_data.scene.files import user_cache

_TIMEOUT_S = 1200


def cache_folder(name: str, requirements: Path) -> Path:
    """Return the folder of these pinned packages, whether it exists or not; `V2P_CACHE` names another cache folder.

    Args:
        name: start of the folder's name; the digest of the pins follows.
        requirements: file with one pin per package, each with its hashes.
    """
    named = os.environ.get("V2P_CACHE")
    cache = Path(named) if named else user_cache("V2P_CACHE")
    return cache / f"{name}-{hashlib.sha256(requirements.read_bytes()).hexdigest()[:8]}"


def find_uv() -> str | None:
    """Return the path of uv, on the search path or in an environment beside this one; None where there is none."""
    near = Path(sys.prefix).resolve().parent
    beside = (str(p) for p in near.glob("*/bin/uv") if os.access(p, os.X_OK))
    return shutil.which("uv") or next(beside, None)


def install_pinned(python: str, requirements: Path, *options: str, thing: str, needs: str) -> None:
    """Install pinned packages and no others for a Python, with uv where there is one.

    Args:
        python: the interpreter.
        requirements: file with one pin per package, each with its hashes.
        *options: more options of `uv pip install` and `pip install`.
        thing: what is set up, for the message.
        needs: what the installation needs, for the message.

    Raises:
        V2PError: the packages cannot be had.
    """
    uv = find_uv()
    words = [uv, "pip", "install", "--python", python] if uv else [python, "-m", "pip", "install"]
    words += [*options, "--quiet", "--no-deps", "--require-hashes", "-r", str(requirements)]
    call_installer(words, thing=thing, needs=needs)


@contextmanager
def writing_in(folder: Path, thing: str) -> Iterator[None]:
    """Make a folder, and say in one sentence where it or what is in it cannot be written.

    Raises:
        V2PError: the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise V2PError(
            f"{thing} cannot be set up in {folder}: {error}; V2P_CACHE names another folder"
        ) from error


def call_installer(words: list[str], *, thing: str, needs: str) -> None:
    """Run one command of an installation.

    Args:
        words: the command line.
        thing: what is set up, for the message.
        needs: what the installation needs, for the message.

    Raises:
        V2PError: the command cannot be run or fails.
    """
    env = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "VIRTUAL_ENV")
    }
    try:
        done = subprocess.run(
            ending_with_us(words),
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            env=env,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise V2PError(f"{thing} cannot be set up: {words[0]}: {error}") from error
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise V2PError(
            f"{thing} cannot be set up: '{shlex.join(words[:4])} ...' failed "
            f"({said[-1].strip() if said else 'no word'}); "
            f"it needs {needs}, or packages that uv or pip have in their cache; without {thing} "
            "everything works as before"
        )
