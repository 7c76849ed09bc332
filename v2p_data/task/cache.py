"""Where this machine keeps what it found out once and need not find out again."""

import os
from pathlib import Path

from v2p_data.scene.files import user_cache


def cache_folder(what: str) -> Path:
    """Return a folder in `$V2P_CACHE_DIR`, else below `$XDG_CACHE_HOME` or `~/.cache`."""
    if named := os.environ.get("V2P_CACHE_DIR"):
        return Path(named) / what
    return user_cache("V2P_CACHE_DIR") / what
