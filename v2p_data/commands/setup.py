"""`v2p setup`: which learned models are set up here, and their download by name."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import tyro

from v2p_data.cli import parse
from v2p_data.errors import V2PError
from v2p_data.scene.backends import mobile_sam_setup
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.preset import (
    UNWANTED_FILES,
    checkpoints_of,
    missing,
    named_with_sizes,
    with_preset,
)


@dataclass(frozen=True, kw_only=True)
class Setup:
    model: tyro.conf.Positional[Literal["outlines", "learned"] | None] = None
    """Which to set up: MobileSAM outlines objects, `learned` are the models of
    --scene.preset=learned. What is there already is kept. Without a name all are listed."""


def setup_command(argv: list[str]) -> int:
    args = parse(Setup, argv, "setup")
    learned = SceneConfig(preset="learned")
    if args.model == "outlines":
        mobile_sam_setup.set_up_mobile_sam(_say)
    elif args.model == "learned":
        fetch_preset(learned)
    models = checkpoints_of(with_preset(learned))
    absent = missing(models)
    print(f"outlines  MobileSAM; {_outlines()}")  # noqa: T201
    state = f"missing: {named_with_sizes(absent)}" if absent else "all are here"
    print(f"learned   {named_with_sizes(models)}; {state}")  # noqa: T201
    print("Next: v2p setup NAME, or v2p scene VIDEOS --out DIR: what is set up is used")  # noqa: T201
    return 0


def fetch_preset(cfg: SceneConfig) -> None:
    """Download what the preset `learned` lacks, where it is asked for, before any work begins.

    Raises:
        V2PError: a model cannot be downloaded.
    """
    if cfg.preset == "learned" and (absent := missing(checkpoints_of(with_preset(cfg)))):
        fetch_learned(absent)


def fetch_learned(models: Sequence[str]) -> None:
    """Say what is downloaded, and download it.

    Raises:
        V2PError: one cannot be downloaded; it says what to do.
    """
    from v2p_data.episodes.hub.hub import fetch_model

    print(f"downloading learned models: {named_with_sizes(models)}", file=sys.stderr, flush=True)  # noqa: T201
    try:
        for model in models:
            fetch_model(model, ignore=UNWANTED_FILES)
    except V2PError as error:
        raise V2PError(
            f"{error}. Without a network, copy the Hub's cache folder (HF_HOME) from a machine that has them, or name"
            " folders with --scene.ground.model, --scene.segment.model and --scene.depth.model"
        ) from error


def _outlines() -> str:
    weights = mobile_sam_setup.installed_weights()
    if weights is not None and not mobile_sam_setup.transformers_is_there():
        return f"in {weights}, but transformers is missing: run 'make setup' in the repository"
    size = f"{mobile_sam_setup.DOWNLOAD_MB} MB to download, {mobile_sam_setup.DISK_MB} MB on disk"
    return f"set up in {weights}" if weights else f"not set up ({size})"


def _say(words: str) -> None:
    print(words, flush=True)  # noqa: T201
