import contextlib
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.backends.config import (
    DepthConfig,
    GroundConfig,
    MeshConfig,
    SegmentConfig,
)
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import CameraGuess, ObjectTrack
from v2p_data.scene.fitting.by_model import camera_from_depth
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.by_model import segmented
from v2p_data.scene.grounding.methods.base import Seen
from v2p_data.scene.grounding.methods.detector import Detector
from v2p_data.scene.reconstruct import reconstruct
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.scene.shapes.by_worker import mesh_by_worker

WORKER = Path(__file__).parents[3] / "scripts" / "example_worker.py"
COMMAND = f"{shlex.quote(sys.executable)} {shlex.quote(str(WORKER))}"
GUESS = CameraGuess(pitch_rad=0.3, pitch_sd_rad=0.2, fov_rad=0.8)


@pytest.fixture(scope="module")
def clip(draw):
    return draw(num_frames=12)


@pytest.fixture(scope="module")
def working(clip):
    return working_clip_of(clip)


@pytest.fixture(scope="module")
def box(working):
    red, _, blue = np.moveaxis(working.rgb.astype(int), -1, 0)
    masks = blue > red + 60
    return ObjectTrack(
        phrase="blue box",
        role="manipulated",
        noun=noun_for("blue box"),
        masks=masks,
        quality=np.ones(len(masks)),
        moves=True,
        at=0,
        known_m=None,
        sure=1.0,
        why="",
    )


def test_a_worker_s_mesh_is_brought_to_the_fitted_size(clip, working, box):
    size_m = (0.09, 0.07, 0.05)

    mesh, repair = mesh_by_worker(clip, working, box, size_m, MeshConfig(worker=COMMAND))

    assert mesh.is_watertight
    assert repair == "none"
    assert np.linalg.norm(mesh.extents) == pytest.approx(np.linalg.norm(size_m))
    np.testing.assert_allclose(mesh.bounds.mean(0), 0, atol=1e-9)


def test_a_depth_worker_s_table_sets_the_camera(clip, working, box):
    cfg = DepthConfig(backend="worker", worker=COMMAND)

    guess = camera_from_depth(clip, working, [box], GUESS, cfg, np.random.default_rng(0))

    # what scripts/example_worker.py says of its camera
    assert guess.height_m == pytest.approx(0.5, rel=0.02)
    assert guess.pitch_rad == pytest.approx(0.61, abs=0.02)
    assert guess.fov_rad == pytest.approx(1.01, abs=1e-6)


def test_a_detector_marks_each_phrase_once_at_an_end_of_the_clip(
    clip, working, segmentation_of, checkpoint
):
    cfg = GroundConfig(
        backend="grounding_dino",
        model=checkpoint("grounding_dino"),
        box_threshold=0.0,
        text_threshold=0.0,
    )

    seen = Seen(
        clip=clip, working=working, segmentation=segmentation_of([[]] * len(working.rgb))[1]
    )

    marks = Detector(cfg).marks(seen, ("blue box", "red cup"))

    assert set(marks) <= {"blue box", "red cup"}
    for mark in marks.values():
        assert mark.box.any()
        assert mark.frame in (0, len(working.rgb) - 1)


def test_a_video_model_s_masks_replace_the_track_and_keep_the_found_mask_where_it_sees_nothing(
    clip, working, box, checkpoint
):
    cfg = SegmentConfig(backend="sam2", model=checkpoint("sam2"))

    (seen,) = segmented(clip, working, [box], cfg)

    assert seen.masks.shape == box.masks.shape
    assert seen.masks[0].any()
    assert ((seen.quality >= 0) & (seen.quality <= 1)).all()
    assert (seen.quality[~seen.masks.any((1, 2))] == 0).all()


def test_a_whole_scene_is_made_with_learned_models_or_turned_away_with_a_reason(clip, checkpoint):
    cfg = SceneConfig(
        ground=GroundConfig(
            backend="grounding_dino",
            model=checkpoint("grounding_dino"),
            box_threshold=0.0,
            text_threshold=0.0,
        ),
        segment=SegmentConfig(backend="sam2", model=checkpoint("sam2")),
        depth=DepthConfig(backend="depth_anything", model=checkpoint("depth_anything")),
        mesh=MeshConfig(worker=COMMAND),
    ).without_gate()

    with contextlib.suppress(ItemRejectedError):
        made = reconstruct(clip, cfg, np.random.default_rng(0))
        assert made.objects[0].mesh is not None


def test_a_hinted_scene_takes_the_worker_s_mesh(clip):
    hints = {"blue box": {"size_m": [0.09, 0.07, 0.05]}}

    made = reconstruct(
        replace(clip, hints=hints),
        SceneConfig(mesh=MeshConfig(worker=COMMAND)).without_gate(),
        np.random.default_rng(0),
    )

    assert "worker" in made.objects[0].source["shape"]
    assert made.objects[0].size_m == pytest.approx(tuple(made.objects[0].mesh.extents))
