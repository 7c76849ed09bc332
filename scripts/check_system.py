"""Name the system libraries that are missing, with the command that installs them."""

import ctypes.util
import sys

NEEDED_TO_DRAW = {"EGL": "libegl1", "GL": "libgl1"}


def main() -> int:
    """Print what is missing; never fail, because there is a slower way without each of them."""
    if sys.platform != "linux":
        return 0
    missing = [
        package
        for name, package in NEEDED_TO_DRAW.items()
        if ctypes.util.find_library(name) is None
    ]
    if missing:
        print(
            "setup: off-screen drawing needs system libraries that are not here. As root:\n"
            f"    apt-get update && apt-get install -y {' '.join(missing)}\n"
            "  Until then masks are drawn by slower ray casting, and the sample clips cannot be drawn anew.",
            file=sys.stderr,
        )
    if ctypes.util.find_library("avcodec") is None:
        print(
            "setup: FFmpeg is not here, so LeRobot says at length that torchcodec cannot be loaded and decodes"
            " with PyAV instead. That is fine; 'apt-get install -y ffmpeg' silences it.",
            file=sys.stderr,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
