"""`v2p scene models`: which learned models the settings take, and their download."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from v2p_data.cli import parse
from v2p_data.episodes.hub import fetch_model
from v2p_data.errors import V2PError
from v2p_data.scene.backends.hands_setup import installed_worker, set_up_hands
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


def models_command(argv: list[str]) -> int:
    """List the checkpoints with their sizes; with --fetch download them, and set up the model that finds hands."""
    args = parse(Models, argv, "scene models")
    cfg = with_preset(args.scene)
    models = checkpoints_of(cfg)
    absent = missing(models)
    memory = this_machine().gpu_memory_gb
    where = f"a GPU with {memory:.0f} GB" if memory else "a machine without CUDA"
    print(f"for {where}: {told(models) or 'no learned model'}")  # noqa: T201
    wants_hands = args.scene.hands.backend in ("auto", "mediapipe") and not installed_worker()
    if args.fetch:
        if absent:
            fetch_learned(absent)
        if wants_hands:
            set_up_hands(lambda words: print(words, file=sys.stderr, flush=True))  # noqa: T201
    elif wants_hands and not absent:
        print("hands: not set up; next: v2p scene models --fetch")  # noqa: T201
        return 0
    elif absent:
        print(f"not here yet: {told(absent)}\nnext: v2p scene models --fetch")  # noqa: T201
        return 0
    print("all are here; next: v2p scene VIDEOS --out DIR --scene.preset=learned")  # noqa: T201
    return 0


def fetch_learned(models: Sequence[str]) -> None:
    """Say what is downloaded, and download it.

    Raises:
        V2PError: one cannot be downloaded; it says what to do.
    """
    print(f"downloading learned models: {told(models)}", file=sys.stderr, flush=True)  # noqa: T201
    try:
        for model in models:
            fetch_model(model, ignore=UNWANTED_FILES)
    except V2PError as error:
        raise V2PError(
            f"{error}. Without a network, copy the Hub's cache folder (HF_HOME) from a machine that has them, or name folders"
            " with --scene.ground.model, --scene.segment.model and --scene.depth.model"
        ) from error
