"""Splits a concave mesh into convex parts with CoACD, in a child process with a time limit, once per mesh.

The parts lie in a cache folder, `$V2P_CACHE_DIR` or else `v2p` in the user's cache, under a digest of the mesh file
and the settings. They are in the file's own units, so that one entry serves every size of the object.
"""

import hashlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from v2p_data.processes import ending_with_us
from v2p_data.task.cache import cache_folder

VERSION = 1
"""Raise it when the same settings give other parts."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ConvexConfig:
    """How finely a mesh is split; each part costs contacts, hence time."""

    concave_above: float = 1.25
    """Meshes whose hull has this many times their volume are split; others are their hull."""
    max_parts: int = 8
    part_vertices: int = 32
    hull_vertices: int = 40
    """Vertices of the hull of a mesh that is not split."""
    concavity: float = 0.05
    """Parts as far from convex as this are left as they are, in CoACD's unit."""
    time_limit_s: float = 120.0
    """Then the hull is used. A mug takes 15 s on one core."""


def convex_parts(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    cfg: ConvexConfig,
    name: str,
) -> list[Float[np.ndarray, "k 3"]]:
    """Return the corner points of each part; none where splitting failed or took too long, which is warned of.

    Args:
        path: the mesh's file, whose content names the cache entry.
        vertices: of the closed mesh that was read from it.
        faces: of that mesh.
        cfg: how finely.
        name: of the object, for messages.
    """
    settings = {k: v for k, v in asdict(cfg).items() if k not in {"time_limit_s", "hull_vertices"}}
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    text = json.dumps({"mesh": digest, "version": VERSION, **settings}, sort_keys=True)
    entry = cache_folder("convex") / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.npz"
    if (parts := _read(entry)) is None:
        logger.info("splitting the mesh of '%s' into convex parts", name)
        parts, why = _split(vertices, faces, cfg)
        if why:
            logger.warning(
                "mesh of '%s' in %s is concave and cannot be split (%s): it collides as its hull. This is kept in "
                "%s; remove that file to try again",
                name,
                path,
                why,
                entry,
            )
        _write(entry, parts)
    return parts


def _split(
    vertices: np.ndarray, faces: np.ndarray, cfg: ConvexConfig
) -> tuple[list[np.ndarray], str]:
    """Return the parts, or none and why."""
    with tempfile.TemporaryDirectory(prefix="v2p-convex-") as folder:
        given, made = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(given, vertices=vertices, faces=faces)
        options = {
            "threshold": cfg.concavity,
            "max_convex_hull": cfg.max_parts,
            "max_ch_vertex": cfg.part_vertices,
        }
        script = Path(__file__).with_name("convex_child.py")
        command = [sys.executable, "-I", str(script), str(given), str(made), json.dumps(options)]
        try:
            # One thread: the parts must not depend on the number of cores.
            done = subprocess.run(
                ending_with_us(command),
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                capture_output=True,
                timeout=cfg.time_limit_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return [], f"not done after {cfg.time_limit_s:.0f} s"
        parts = _read(made)
        if not parts:
            words = done.stderr.decode(errors="replace").strip().splitlines()
            return [], words[-1] if words else f"exit code {done.returncode}"
        return parts, ""


def _read(path: Path) -> list[np.ndarray] | None:
    """Return the parts in a file, or None where there is none that can be read."""
    try:
        with np.load(path) as stored:
            return [stored[f"part_{k}"] for k in range(int(stored["count"]))]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _write(entry: Path, parts: list[np.ndarray]) -> None:
    """Write the entry in one go, so that other processes never read half of it."""
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        partial = entry.with_name(f"{entry.stem}.{os.getpid()}.tmp.npz")
        named = {f"part_{k}": p for k, p in enumerate(parts)}
        np.savez(partial, count=len(parts), **named)  # pyright: ignore[reportArgumentType]
        partial.replace(entry)
    except OSError as error:
        logger.warning("convex parts cannot be kept in %s (%s)", entry.parent, error)
