"""Name the system libraries that are missing, with the command that installs them, and lend LeRobot the FFmpeg of PyAV.

LeRobot streams datasets, and prints its system report, with torchcodec, which looks for FFmpeg's
libraries by their plain names. PyAV's wheel holds them under names of its own. Links with the
plain names, on the path that an activated shell gives to the loader, are enough. Nothing outside
the virtual environment is changed.
"""

import ctypes.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

NEEDED_TO_DRAW = {"EGL": "libegl1", "GL": "libgl1"}
FFMPEG_FOLDER = Path("lib/ffmpeg")
"""In the virtual environment."""
_WHEEL_NAME = re.compile(r"(lib(?:av|sw)[a-z]+)-[0-9a-f]+(\.so\.\d+)[.\d]*")
_ACTIVATION = """
# FFmpeg's libraries, as PyAV brought them, for torchcodec (scripts/check_system.py)
if [ -d "$VIRTUAL_ENV/lib/ffmpeg" ]; then
    export LD_LIBRARY_PATH="$VIRTUAL_ENV/lib/ffmpeg${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
fi
"""


def main() -> int:
    """Print what is missing; never fail, because there is a way without each of them."""
    if sys.platform != "linux":
        if ctypes.util.find_library("avcodec") is None:
            _say(_WITHOUT_FFMPEG.format(install="brew install ffmpeg"))
        return 0
    missing = [
        package
        for name, package in NEEDED_TO_DRAW.items()
        if ctypes.util.find_library(name) is None
    ]
    if missing:
        _say(
            "setup: off-screen drawing needs system libraries that are not here. As root:\n"
            f"    apt-get update && apt-get install -y {' '.join(missing)}\n"
            "  Until then masks are drawn by slower ray casting, and the sample clips cannot be drawn anew."
        )
    prefix = Path(sys.prefix)
    if ctypes.util.find_library("avcodec") is not None:
        shutil.rmtree(prefix / FFMPEG_FOLDER, ignore_errors=True)
    elif lend_ffmpeg(prefix, Path(sysconfig.get_path("platlib")) / "av.libs"):
        _say(
            "setup: FFmpeg is not on this system. In a shell where .venv is activated (source "
            ".venv/bin/activate) LeRobot uses"
            " the one that PyAV brought; elsewhere its dataset streaming and lerobot-info fail, and it says at length"
            " that it decodes with PyAV instead. 'apt-get install -y ffmpeg' (as root) helps everywhere."
        )
    else:
        _say(
            _WITHOUT_FFMPEG.format(
                install="apt-get install -y ffmpeg' (as root), then 'make setup"
            )
        )
    return 0


_WITHOUT_FFMPEG = (
    "setup: FFmpeg is not here. LeRobot's dataset streaming (StreamingLeRobotDataset) and lerobot-info fail without it;"
    " all else decodes with PyAV, after a long notice about torchcodec. '{install}' helps."
)


def lend_ffmpeg(prefix: Path, wheel_libraries: Path) -> bool:
    """Link PyAV's libraries by their plain names into a virtual environment, and have its activation name them.

    Args:
        prefix: the virtual environment.
        wheel_libraries: the folder of PyAV's shared libraries.

    Returns:
        Whether torchcodec loads with them; if not, nothing is left.
    """
    folder = prefix / FFMPEG_FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    activate = prefix / "bin/activate"
    if not (wheel_libraries.is_dir() and activate.is_file()):
        return False
    folder.mkdir(parents=True)
    for path in wheel_libraries.iterdir():
        (folder / path.name).symlink_to(path)
        if found := _WHEEL_NAME.fullmatch(path.name):
            (folder / "".join(found.groups())).symlink_to(path)
    loads = _torchcodec_loads(folder)
    if (
        not loads
    ):  # a Python without a shared library of its own, which torchcodec asks for as well
        name = str(sysconfig.get_config_var("INSTSONAME"))
        library = Path(str(sysconfig.get_config_var("LIBDIR"))) / name
        if library.is_file():
            (folder / name).symlink_to(library)
            loads = _torchcodec_loads(folder)
    if not loads:
        shutil.rmtree(folder)
    else:
        name_in_activation(activate)
    return loads


def name_in_activation(script: Path) -> None:
    """Have a virtual environment's activation name the folder to the loader; nothing is written twice."""
    if _ACTIVATION not in script.read_text(encoding="utf-8"):
        with script.open("a", encoding="utf-8") as end:
            end.write(_ACTIVATION)


def _torchcodec_loads(folder: Path) -> bool:
    paths = [str(folder), *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
    tried = subprocess.run(
        [sys.executable, "-c", "import torchcodec"],
        env={**os.environ, "LD_LIBRARY_PATH": ":".join(paths)},
        capture_output=True,
        check=False,
    )
    return tried.returncode == 0


def _say(words: str) -> None:
    print(words, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
