"""SAM 2 picture by picture: the same masks as over a whole clip, by a tiny random checkpoint of the real class."""

import numpy as np
import pytest

from v2p_data.deployment.sam2_stream import Sam2Tracker
from v2p_data.deployment.segmentation import StreamTracker
from v2p_data.errors import V2PError
from v2p_data.scene.backends.config import SegmentConfig
from v2p_data.scene.backends.segment import Prompt, segment_video


@pytest.fixture
def cfg(checkpoint):
    # Random weights draw no outline: the threshold is what decides, and half of the pixels pass this one.
    return SegmentConfig(
        backend="sam2", model=checkpoint("sam2"), device=checkpoint.device, num_points=1
    )


@pytest.fixture
def clip(picture):
    return np.stack([np.roll(picture, 2 * t, axis=1) for t in range(5)])


def test_a_stream_gives_the_masks_that_the_whole_clip_gives(cfg, clip):
    tracker = Sam2Tracker(cfg)
    assert isinstance(tracker, StreamTracker)
    click, clicked = (14.5, 28.5), np.zeros(clip.shape[1:3], bool)
    clicked[28, 14] = True
    whole = segment_video(clip, [Prompt(frame_idx=0, mask=clicked)], cfg)
    nothing = np.zeros(clip.shape[1:3], bool)
    if not whole.masks[0, 0].any() or whole.scores[0, 0] <= 0.5:
        with pytest.raises(V2PError, match="sees no object"):
            tracker.start(clip[0], click, nothing)
        found = [tracker.track(picture, nothing) for picture in clip[1:]]
    else:
        np.testing.assert_array_equal(tracker.start(clip[0], click, nothing), whole.masks[0, 0])
        found = [tracker.track(picture, nothing) for picture in clip[1:]]

    for t, tracked in enumerate(found, start=1):
        sure = whole.scores[0, t] > 0.5
        np.testing.assert_array_equal(tracked.score > 0, whole.masks[0, t])
        assert tracked.confidence == pytest.approx(
            whole.scores[0, t] if sure and whole.masks[0, t].any() else 0.0
        )


def test_clicks_on_the_robot_or_outside_are_refused(cfg, clip):
    tracker = Sam2Tracker(cfg)
    robot = np.zeros(clip.shape[1:3], bool)
    robot[10, 10] = True

    with pytest.raises(V2PError, match="on the robot"):
        tracker.start(clip[0], (10.0, 10.5), robot)
    with pytest.raises(V2PError, match="outside the picture"):
        tracker.start(clip[0], (64.0, 5.0), robot)


def test_a_checkpoint_that_is_not_there_is_named(tmp_path):
    with pytest.raises(V2PError, match="cannot be loaded"):
        Sam2Tracker(SegmentConfig(backend="sam2", model=str(tmp_path), device="cpu"))
