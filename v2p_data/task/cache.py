"""Where this machine keeps what it found out once and need not find out again."""

import os
from pathlib import Path


def cache_folder(what: str) -> Path:
    """Return a folder in `$V2P_CACHE_DIR`, else below `$XDG_CACHE_HOME` or `~/.cache`."""
    if named := os.environ.get("V2P_CACHE_DIR"):
        return Path(named) / what
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "v2p" / what
