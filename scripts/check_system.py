"""Name the system libraries that are missing, with the command that installs them."""

import ctypes.util
import os
import sys

LIBRARIES = {"EGL": "libegl1", "GL": "libgl1"}


def main() -> int:
    """Print what is missing; never fail, because masks can be drawn without GL as well."""
    if sys.platform != "linux":
        return 0
    missing = [package for name, package in LIBRARIES.items() if ctypes.util.find_library(name) is None]
    if missing:
        print(
            "setup: off-screen rendering needs system libraries that are not here. Install them with\n"
            f"    apt-get install -y {' '.join(missing)}\n"
            "  (as root, after 'apt-get update'). Until then, drawing falls back to slower ray casting.",
            file=sys.stderr,
        )
    os.environ.setdefault("MUJOCO_GL", "egl")
    return 0


if __name__ == "__main__":
    sys.exit(main())
