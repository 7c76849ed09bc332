"""The preset of learned models: sizes by machine, tiny checkpoints through the whole chain, and their download."""

import contextlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "episodes"))

from hub_server import TOKEN, Repo, running_hub

from v2p_data.commands.setup import fetch_learned, fetch_preset
from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.backends.checkpoint import load_checkpoint
from v2p_data.scene.backends.config import (
    DepthConfig,
    GroundConfig,
    OutlineConfig,
    SegmentConfig,
)
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.preset import SIZES, WEIGHTS_GB, checkpoints_of, missing, with_preset
from v2p_data.scene.reconstruct import reconstruct

LEARNED = SceneConfig(preset="learned")


def on(gpu_memory_gb: float, cfg: SceneConfig = LEARNED) -> SceneConfig:
    return with_preset(cfg, lambda: gpu_memory_gb)


def tiny(checkpoint) -> SceneConfig:
    """Return the preset with the smallest checkpoints there are."""
    return SceneConfig(
        preset="learned",
        ground=GroundConfig(model=checkpoint("grounding_dino")),
        segment=SegmentConfig(model=checkpoint("sam2")),
        depth=DepthConfig(model=checkpoint("depth_anything")),
    )


def test_a_larger_gpu_gets_larger_models_and_every_size_is_known():
    downloads = [
        sum(WEIGHTS_GB[model] for model in checkpoints_of(on(float(memory))))
        for memory in (0, 8, 24)
    ]

    assert downloads == sorted(downloads)
    assert downloads[0] < 1.0 < downloads[2]
    assert SIZES[-1].least_gpu_gb == 0
    assert on(0.0).ground.backend == "grounding_dino"
    assert on(0.0).segment.backend == "sam2"
    assert on(0.0).depth.backend == "depth_anything"


def test_a_stage_that_was_set_keeps_its_backend():
    cfg = SceneConfig(
        preset="learned",
        ground=GroundConfig(backend="worker", worker="mine"),
        depth=DepthConfig(backend="worker", worker="my_worker"),
    )

    resolved = on(24.0, cfg)

    assert resolved.ground == cfg.ground
    assert resolved.depth == cfg.depth
    assert resolved.segment.model == "facebook/sam2.1-hiera-large"


def test_without_the_preset_nothing_changes_and_the_machine_is_not_asked():
    def machine() -> float:
        raise AssertionError

    without_models = SceneConfig(
        outline=OutlineConfig(backend="none"),
    )
    assert with_preset(SceneConfig(), machine) == without_models
    assert checkpoints_of(SceneConfig()) == ()
    assert with_preset(on(0.0), machine) == on(0.0)


@pytest.mark.slow
def test_the_preset_takes_a_clip_through_all_three_models(checkpoint, draw):
    load_checkpoint.cache_clear()

    with contextlib.suppress(ItemRejectedError):  # the weights are random
        reconstruct(draw(num_frames=12), tiny(checkpoint).without_gate(), np.random.default_rng(0))

    assert load_checkpoint.cache_info().currsize == 3


def test_what_is_missing_is_named_and_downloaded_once(
    checkpoint, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = Path(checkpoint("sam2"))
    cfg = replace(tiny(checkpoint), segment=SegmentConfig(model="user/tiny"))
    with running_hub() as hub:
        files = {p.name: p.read_bytes() for p in folder.iterdir()}
        hub.repos["models/user/tiny"] = Repo(files=files | {"model.bin": b"the same again"})
        hub.repos["models/user/tiny"].commit()
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))

        assert missing(checkpoints_of(with_preset(cfg))) == ("user/tiny",)
        fetch_preset(cfg)
        assert "downloading learned models: user/tiny" in capsys.readouterr().err
        assert missing(["user/tiny"]) == ()
        asked = len(hub.requests)
        fetch_preset(cfg)
        assert len(hub.requests) == asked

    assert not list((tmp_path / "cache").rglob("model.bin"))


def test_a_model_that_cannot_be_had_is_one_sentence_with_what_to_do(
    checkpoint, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    with running_hub() as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))

        with pytest.raises(V2PError, match=r"user/none.*HF_HOME"):
            fetch_learned(["user/none"])
