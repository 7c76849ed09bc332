"""`v2p scene hands`: whether the model that finds hands is set up here, and its installation."""

from dataclasses import dataclass

from v2p_data.cli import parse
from v2p_data.scene.backends.hands_setup import (
    DISK_MB,
    DOWNLOAD_MB,
    hands_folder,
    installed_worker,
    set_up_hands,
)


@dataclass(frozen=True, kw_only=True)
class Hands:
    setup: bool = False
    """Install MediaPipe into an environment of its own in the user's cache folder; what is there already is kept."""


def hands_command(argv: list[str]) -> int:
    """Say whether hands are found by a model here; with --setup install it."""
    args = parse(Hands, argv, "scene hands")
    if args.setup:
        set_up_hands(lambda words: print(words, flush=True))  # noqa: T201
    if installed_worker():
        print(  # noqa: T201
            f"set up in {hands_folder()}; 'v2p scene' uses it, unless --scene.hands.backend=none"
        )
    else:
        print(  # noqa: T201
            f"not set up: 'v2p scene' goes without it; next: v2p scene hands --setup   (about {DOWNLOAD_MB} MB to download, "
            f"{DISK_MB} MB on disk)"
        )
    return 0
