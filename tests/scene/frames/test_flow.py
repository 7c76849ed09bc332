"""Dense optical flow, also of parts that are a few pixels high."""

import cv2
import numpy as np
import pytest

from v2p_data.scene.frames.flow import flow_to


@pytest.mark.parametrize("shape", [(180, 320), (31, 91), (6, 320), (90, 5)])
def test_flow_says_where_a_shifted_pattern_went_whatever_the_size(shape):
    noise = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    here = cv2.GaussianBlur(noise, (0, 0), 2)

    flow = flow_to(here, np.roll(here, 1, axis=0))

    assert flow.shape == (*shape, 2)
    assert np.isfinite(flow).all()
    if min(shape) > 100:
        assert np.median(flow[20:-20, 20:-20, 1]) == pytest.approx(1, abs=0.2)
        assert np.median(flow[20:-20, 20:-20, 0]) == pytest.approx(0, abs=0.2)
