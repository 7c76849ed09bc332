"""`v2p scene models`, `detectors`, `hands`, `outlines`: which learned models the settings take, and their download."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from v2p_data.cli import parse
from v2p_data.errors import V2PError
from v2p_data.scene.backends import hands_setup, mobile_sam_setup, nanodet_setup
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.preset import (
    UNWANTED_FILES,
    checkpoints_of,
    missing,
    this_machine,
    told,
    with_preset,
)

Scene = Annotated[SceneConfig, tyro.conf.arg(name="scene")]


@dataclass(frozen=True, kw_only=True)
class Models:
    fetch: bool = False
    """Download what is not here yet, into the Hub's cache."""
    scene: Scene = field(default_factory=lambda: SceneConfig(preset="learned"))


@dataclass(frozen=True, kw_only=True)
class Detectors:
    setup: bool = False
    """Fetch NanoDet's weights into the user's cache folder; what is there already is kept."""
    package: Path | None = None
    """With --setup: the package's file, where it was fetched by hand; nothing is downloaded then."""


@dataclass(frozen=True, kw_only=True)
class Hands:
    setup: bool = False
    """Install MediaPipe into an environment of its own in the user's cache folder; what is there already is kept."""


@dataclass(frozen=True, kw_only=True)
class Outlines:
    setup: bool = False
    """Fetch MobileSAM's weights into the user's cache folder; what is there already is kept."""


def detectors_command(argv: list[str]) -> int:
    """Say whether things are known by sight here; with --setup fetch the model's weights."""
    args = parse(Detectors, argv, "scene detectors")
    if args.setup:
        nanodet_setup.set_up_nanodet(_tell, args.package)
    weights = nanodet_setup.weights_file()
    return _show("detectors", "things", nanodet_setup, weights if weights.is_file() else None)


def hands_command(argv: list[str]) -> int:
    """Say whether hands are found by a model here; with --setup install it."""
    if parse(Hands, argv, "scene hands").setup:
        hands_setup.set_up_hands(_tell)
    folder = hands_setup.hands_folder() if hands_setup.installed_worker() else None
    return _show("hands", "hands", hands_setup, folder)


def outlines_command(argv: list[str]) -> int:
    """Say whether objects are outlined by a model here; with --setup fetch its weights."""
    if parse(Outlines, argv, "scene outlines").setup:
        mobile_sam_setup.set_up_mobile_sam(_tell)
    weights = mobile_sam_setup.installed_weights()
    if weights is not None and not mobile_sam_setup.transformers_is_there():
        print(  # noqa: T201
            f"its weights are in {weights}, but transformers is missing, so 'v2p scene' goes without it; "
            "next: pip install 'lerobot_policy_v2p[learned]'"
        )
        return 0
    place = weights and f"{weights} ({weights.stat().st_size / 1e6:.0f} MB)"
    return _show("outlines", "outline", mobile_sam_setup, place)


def _tell(words: str) -> None:
    print(words, flush=True)  # noqa: T201


def _show(command: str, setting: str, model: ModuleType, place: Path | str | None) -> int:
    print(  # noqa: T201
        f"set up in {place}; 'v2p scene' uses it, unless --scene.{setting}.backend=none"
        if place
        else f"not set up: 'v2p scene' goes without it; next: v2p scene {command} --setup   "
        f"(about {model.DOWNLOAD_MB} MB to download, {model.DISK_MB} MB on disk)"
    )
    return 0


def models_command(argv: list[str]) -> int:
    """List the checkpoints with their sizes; with --fetch download them, and set up the models of hands and outlines."""
    args = parse(Models, argv, "scene models")
    cfg = with_preset(args.scene)
    models = checkpoints_of(cfg)
    absent = missing(models)
    memory = this_machine().gpu_memory_gb
    where = f"a GPU with {memory:.0f} GB" if memory else "a machine without CUDA"
    print(f"for {where}: {told(models) or 'no learned model'}")  # noqa: T201
    to_set_up = not_set_up(args.scene)
    if args.fetch:
        if absent:
            fetch_learned(absent)
        for set_up in to_set_up.values():
            set_up(lambda words: print(words, file=sys.stderr, flush=True))  # noqa: T201
    elif absent or to_set_up:
        if absent:
            print(f"not here yet: {told(absent)}")  # noqa: T201
        if to_set_up:
            print(f"not set up: {', '.join(to_set_up)}")  # noqa: T201
        print("next: v2p scene models --fetch")  # noqa: T201
        return 0
    print("all are here; next: v2p scene VIDEOS --out DIR --scene.preset=learned")  # noqa: T201
    return 0


type Tell = Callable[[str], None]


def not_set_up(cfg: SceneConfig) -> dict[str, Callable[[Tell], object]]:
    """Return how the models beside the preset are set up, by name and download, of those that are wanted and missing.

    Args:
        cfg: settings before the preset is written out.
    """
    hands, outline, things = cfg.hands.backend, cfg.outline, cfg.things.backend
    known: tuple[tuple[str, int, bool, Callable[[Tell], object]], ...] = (
        (
            "MediaPipe for hands",
            hands_setup.DOWNLOAD_MB,
            hands in ("auto", "mediapipe") and not hands_setup.installed_worker(),
            hands_setup.set_up_hands,
        ),
        (
            "MobileSAM for outlines",
            mobile_sam_setup.DOWNLOAD_MB,
            outline.backend in ("auto", "mobile_sam")
            and not (outline.weights or mobile_sam_setup.installed_weights()),
            mobile_sam_setup.set_up_mobile_sam,
        ),
        (
            "NanoDet for things",
            nanodet_setup.DOWNLOAD_MB,
            things in ("auto", "nanodet") and not nanodet_setup.weights_file().is_file(),
            nanodet_setup.set_up_nanodet,
        ),
    )
    return {
        f"{name} ({size} MB)": set_up for name, size, is_missing, set_up in known if is_missing
    }


def fetch_learned(models: Sequence[str]) -> None:
    """Say what is downloaded, and download it.

    Raises:
        V2PError: one cannot be downloaded; it says what to do.
    """
    from v2p_data.episodes.hub.hub import fetch_model

    print(f"downloading learned models: {told(models)}", file=sys.stderr, flush=True)  # noqa: T201
    try:
        for model in models:
            fetch_model(model, ignore=UNWANTED_FILES)
    except V2PError as error:
        raise V2PError(
            f"{error}. Without a network, copy the Hub's cache folder (HF_HOME) from a machine that has them, or name folders"
            " with --scene.ground.model, --scene.segment.model and --scene.depth.model"
        ) from error
