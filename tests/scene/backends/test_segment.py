import numpy as np
import pytest
import torch

from v2p_data.scene.backends.checkpoint import load_checkpoint
from v2p_data.scene.backends.config import SegmentConfig
from v2p_data.scene.backends.segment import Prompt, points_inside, segment_video

LENGTH = 9
"""More frames than the tiny tracker remembers (4)."""
BOXES = ((20, 6), (22, 40))
"""First row and column of two objects of 16 pixels a side."""


def outlined(corner: tuple[int, int], frame_idx: int = 0) -> Prompt:
    mask = np.zeros((64, 64), bool)
    mask[corner[0] : corner[0] + 16, corner[1] : corner[1] + 16] = True
    return Prompt(frame_idx=frame_idx, mask=mask)


@pytest.fixture
def clip(picture) -> np.ndarray:
    """The red box slides to the right under a little noise, at the model's own size."""
    rng = np.random.default_rng(0)
    frames = []
    for t in range(LENGTH):
        frame = np.full((64, 64, 3), 180, np.uint8)
        frame[22:38, 40:58] = (120, 70, 30)
        frame[20:36, 6 + 2 * t : 22 + 2 * t] = (200, 30, 30)
        frames.append(np.clip(frame + rng.normal(0, 4, frame.shape), 0, 255).astype(np.uint8))
    return np.stack(frames)


def config(checkpoint, **more) -> SegmentConfig:
    return SegmentConfig(
        backend="sam2", model=checkpoint("sam2"), device=checkpoint.device, **more
    )


def tracked_by_transformers(checkpoint, clip, start: int) -> np.ndarray:
    """Return logits [object time h w] of the library's own tracker, which holds the whole clip."""
    loaded = load_checkpoint("sam2", checkpoint("sam2"), "cpu", "float32")
    logits = np.full((2, LENGTH, *clip.shape[1:3]), np.nan)
    points = [points_inside(outlined(box).mask, 5).tolist() for box in BOXES]
    for reverse in (False, True):
        session = loaded.processor.init_video_session(video=list(clip))
        loaded.processor.add_inputs_to_inference_session(
            session,
            start,
            [0, 1],
            input_points=[points],
            input_labels=[[[1] * 5] * 2],
        )
        with torch.inference_mode():
            for out in loaded.model.propagate_in_video_iterator(
                session, start_frame_idx=start, reverse=reverse
            ):
                full = torch.nn.functional.interpolate(
                    out.pred_masks, clip.shape[1:3], mode="bilinear", align_corners=False
                )
                logits[:, out.frame_idx] = full[:, 0].numpy()
    return logits


@pytest.mark.parametrize("start", [0, 5])
def test_frame_by_frame_and_forgetting_gives_what_the_library_gives_with_the_whole_clip(
    checkpoint, clip, start
):
    prompts = [outlined(box, start) for box in BOXES]

    found = segment_video(clip, prompts, config(checkpoint))

    theirs = tracked_by_transformers(checkpoint, clip, start)
    expected = (theirs > 0) & (theirs == theirs.max(0))
    assert found.masks.shape == (2, LENGTH, 64, 64)
    assert (found.masks == expected).mean() > 0.999


def test_a_pixel_belongs_to_one_object_and_scores_are_shares(checkpoint, clip):
    prompts = [outlined(box) for box in BOXES]

    found = segment_video(clip, prompts, config(checkpoint))

    assert found.masks.sum(0).max() <= 1
    assert found.scores.shape == (2, LENGTH)
    assert ((found.scores >= 0) & (found.scores <= 1)).all()


def test_masks_in_different_frames_prompt_one_clip(checkpoint, clip):
    prompts = [outlined(BOXES[0], 3), outlined(BOXES[1], LENGTH - 1)]

    found = segment_video(clip, prompts, config(checkpoint, offload=True))

    assert (found.scores > 0).all()


def test_frames_are_read_one_at_a_time_and_the_tracker_forgets(checkpoint, clip, monkeypatch):
    loaded = load_checkpoint("sam2", checkpoint("sam2"), "cpu", "float32")
    sessions = []
    make = loaded.processor.init_video_session
    monkeypatch.setattr(
        loaded.processor,
        "init_video_session",
        lambda **given: sessions.append(make(**given)) or sessions[-1],
    )

    segment_video(list(clip), [outlined(BOXES[0])], config(checkpoint))

    (session,) = sessions
    assert not session.processed_frames
    assert len(session.output_dict_per_obj[0]["non_cond_frame_outputs"]) <= 4


def test_points_are_deep_inside_and_far_apart():
    mask = np.zeros((40, 60), bool)
    mask[10:31, 10:51] = True  # 41 x 21, its middle at (30.5, 20.5)

    points = points_inside(mask, 5)

    assert abs(points[0][1] - 20.5) < 0.01
    assert len({tuple(p) for p in points}) == 5
    # A third of the depth of 11 is kept from the border.
    assert ((points >= (13, 13)) & (points <= (48, 28))).all()
    assert np.ptp(points[:, 0]) > 25


def test_points_in_a_ring_avoid_its_hole_and_a_tiny_mask_repeats_its_own():
    y, x = np.mgrid[:50, :50]
    ring = (np.hypot(x - 25, y - 25) < 20) & (np.hypot(x - 25, y - 25) > 10)
    dot = np.zeros((50, 50), bool)
    dot[7, 9] = True

    assert all(ring[int(v), int(u)] for u, v in points_inside(ring, 5))
    np.testing.assert_array_equal(points_inside(dot, 3), [(9.5, 7.5)] * 3)
