"""What the network is told of a camera is what the camera shows, in whole pictures and in parts of them."""

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from v2p_data.scene.fitting.silhouette import camera_above

H, W = 240, 320
PITCH_RAD, FOV_RAD, HEIGHT_M = 0.7, 0.9, 0.6
CAMERA = np.array([PITCH_RAD, np.log(0.5 / np.tan(FOV_RAD / 2)), np.log(HEIGHT_M)])


@pytest.fixture(scope="module")
def trainer(load_script):
    return load_script("train_scene_network")


def _table_between(left: float, right: float, row: float) -> float:
    ends = camera_above((H, W), PITCH_RAD, FOV_RAD, HEIGHT_M).on_plane(
        np.array([[left, row], [right, row]])
    )
    return float(np.linalg.norm(ends[1] - ends[0]))


def test_a_whole_picture_shows_pitch_focal_length_and_the_table_s_width(trainer):
    known = trainer.known_of(CAMERA)

    np.testing.assert_allclose(known[:2], CAMERA[:2], rtol=1e-6)
    assert np.exp(known[2]) == pytest.approx(_table_between(0, W, H / 2))


def test_a_part_shows_how_much_of_the_table_lies_across_its_own_middle(trainer):
    part = slice(130, 230), slice(40, 180)

    known = trainer.known_of(CAMERA, part, (H, W))

    assert np.isnan(known[:2]).all()
    assert np.exp(known[2]) == pytest.approx(_table_between(40, 180, 180.0))


def test_another_camera_at_the_same_place_sees_the_table_where_it_says(trainer):
    """A black dot on a white table: found again in the turned picture, projected by the turned camera."""
    camera = camera_above((H, W), PITCH_RAD, FOV_RAD, HEIGHT_M)
    spots = camera.on_plane(np.array([[160.0, 120.0], [130.0, 135.0]]))
    picture = np.full((H, W, 3), 255, np.uint8)
    labels = np.zeros((H, W), np.uint8)
    for x, y in camera.project(spots):
        picture[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = 0
        labels[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = 1
    apart = []
    for seed in range(6):
        (seen,), classes, known = trainer.turned(
            [picture], labels, CAMERA, np.random.default_rng(seed)
        )
        pitch, fov = float(known[0]), float(2 * np.arctan(0.5 / np.exp(known[1])))
        new = camera_above((H, W), pitch, fov, HEIGHT_M)
        count, _, _, middles = cv2.connectedComponentsWithStats(
            (seen[..., 0] < 128).astype(np.uint8)
        )
        assert count == 3
        on_table = new.on_plane(middles[1:] + 0.5)
        apart.append(np.linalg.norm(on_table[0] - on_table[1]))
        assert known[1] > CAMERA[1]
        assert (seen[classes == 1] < 200).mean() > 0.9
    np.testing.assert_allclose(apart, np.linalg.norm(spots[0] - spots[1]), rtol=0.06)


def test_the_camera_s_part_of_the_weights_says_the_same_camera(trainer, tmp_path):
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(3)
        whole = trainer.SceneNetwork().eval()
    trainer.write(whole, tmp_path / "whole.safetensors")
    trainer.only_camera(tmp_path / "whole.safetensors", tmp_path / "camera.safetensors")

    part = trainer.CameraNetwork().eval()
    part.load_state_dict(
        {k: v.float() for k, v in load_file(tmp_path / "camera.safetensors").items()}
    )

    x = torch.linspace(-1, 1, 15 * 32 * 48).reshape(1, 15, 32, 48)
    with torch.inference_mode():
        torch.testing.assert_close(part.camera_of(x), whole(x)[1], atol=0.01, rtol=0.01)
    sizes = [(tmp_path / f"{n}.safetensors").stat().st_size for n in ("whole", "camera")]
    assert sizes[1] < 0.8 * sizes[0]
