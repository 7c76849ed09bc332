import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from v2p_data.errors import V2PError
from v2p_data.scene.frames import network
from v2p_data.scene.frames.classes import CLASSES, HAND, MOVED
from v2p_data.scene.frames.network import SceneNetwork, classify, inputs_of, net_size
from v2p_data.scene.frames.segmentation import segment_clip
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.video.captions import find_videos
from v2p_data.video.decode import read_clip

SAMPLES = Path(__file__).parents[3] / "datasets" / "sample_videos"


def _stills(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.broadcast_to(frames[0], frames.shape), np.broadcast_to(frames[1], frames.shape)


@pytest.mark.parametrize(("h", "w"), [(240, 320), (180, 320), (427, 320), (33, 320), (320, 320)])
def test_the_network_looks_at_multiples_of_sixteen_with_the_picture_s_proportions(h, w):
    rows, columns = net_size(h, w)

    assert rows % 16 == columns % 16 == 0
    assert max(rows, columns) == 256
    assert abs(rows / columns - h / w) <= 16 / min(rows, columns)


def test_shares_are_probabilities_at_the_frames_own_size():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 255, (3, 90, 120, 3), dtype=np.uint8)

    seen = classify(frames, *_stills(frames), batch=2)

    assert seen.shares.shape == (3, len(CLASSES), 90, 120)
    np.testing.assert_allclose(seen.shares.sum(1), 1, atol=1e-3)
    assert seen.camera.pitch_sd_rad > 0
    assert 0.2 < seen.camera.focal_widths < 5


def test_the_batch_size_does_not_change_what_is_seen():
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 255, (3, 48, 64, 3), dtype=np.uint8)

    together, apart = (classify(frames, *_stills(frames), batch=n) for n in (3, 1))

    np.testing.assert_allclose(together.shares, apart.shares, atol=1e-4)


def test_the_input_holds_the_three_pictures_and_how_much_they_differ():
    black, white = (torch.full((1, 3, 16, 16), v, dtype=torch.uint8) for v in (0, 255))

    x = inputs_of(black, black, white)

    assert x.shape == (1, 15, 16, 16)
    assert torch.equal(x[0, 9], torch.zeros(16, 16))  # frame against early
    assert torch.equal(x[0, 10], torch.full((16, 16), 2.0))  # frame against late


@pytest.mark.parametrize(
    ("which", "load"),
    [("WEIGHTS", network.network), ("CAMERA_WEIGHTS", network.camera_network)],
)
def test_missing_weights_are_one_clear_sentence(which, load, tmp_path, monkeypatch):
    monkeypatch.setattr(network, which, tmp_path / "some.safetensors")
    load.cache_clear()

    with pytest.raises(V2PError, match=r"some\.safetensors .*train_scene_network\.py"):
        load()

    load.cache_clear()


def test_the_weights_are_small_enough_to_travel_with_the_code():
    assert network.WEIGHTS.stat().st_size + network.CAMERA_WEIGHTS.stat().st_size < 5_000_000
    assert sum(p.numel() for p in SceneNetwork().parameters()) < 2_500_000


@pytest.mark.parametrize("item", [v.item for v in find_videos(SAMPLES)])
def test_hand_and_moved_thing_of_a_sample_clip_are_seen_where_they_were_drawn(item):
    video = next(v for v in find_videos(SAMPLES) if v.item == item)
    folder = SAMPLES / "truth"
    truth = json.loads((folder / f"{video.path.stem}.json").read_text())
    clip = read_clip(video)
    working = working_clip_of(clip)

    segmentation = segment_clip(clip, working)

    for when, i in (("first", 0), ("last", -1)):
        labels = cv2.imread(str(folder / truth["masks"][when]), cv2.IMREAD_UNCHANGED)
        assert labels is not None
        h, w = working.shape
        labels = cv2.resize(labels, (w, h), interpolation=cv2.INTER_NEAREST)
        true = labels == truth["mask_labels"]["object"]
        seen = segmentation.shares[i].argmax(0) == MOVED
        assert (true & seen).sum() / (true | seen).sum() > 0.5, when
    assert any((one.argmax(0) == HAND).mean() > 0.01 for one in segmentation.shares)
