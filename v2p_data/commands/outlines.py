"""`v2p scene outlines`: whether the model that outlines objects is set up here, and its download."""

from dataclasses import dataclass

from v2p_data.cli import parse
from v2p_data.scene.backends.mobile_sam_setup import (
    DISK_MB,
    DOWNLOAD_MB,
    installed_weights,
    set_up_mobile_sam,
    transformers_is_there,
)


@dataclass(frozen=True, kw_only=True)
class Outlines:
    setup: bool = False
    """Fetch MobileSAM's weights into the user's cache folder; what is there already is kept."""


def outlines_command(argv: list[str]) -> int:
    """Say whether objects are outlined by a model here; with --setup fetch its weights."""
    args = parse(Outlines, argv, "scene outlines")
    if args.setup:
        set_up_mobile_sam(lambda words: print(words, flush=True))  # noqa: T201
    weights = installed_weights()
    if weights is None:
        print(  # noqa: T201
            f"not set up: 'v2p scene' goes without it; next: v2p scene outlines --setup   (about {DOWNLOAD_MB} MB to download, "
            f"{DISK_MB} MB on disk)"
        )
    elif not transformers_is_there():
        print(  # noqa: T201
            f"its weights are in {weights}, but transformers is missing, so 'v2p scene' goes without it; "
            "next: pip install 'lerobot_policy_v2p[learned]'"
        )
    else:
        print(  # noqa: T201
            f"set up in {weights} ({weights.stat().st_size / 1e6:.0f} MB); 'v2p scene' uses it, unless --scene.outline.backend=none"
        )
    return 0
