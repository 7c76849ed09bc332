import numpy as np
import pytest

from v2p_data.geometry.raster import fill, in_parts


@pytest.mark.parametrize("off", [-0.3, 0.0, 0.3])
def test_a_polygon_covers_the_pixels_whose_centres_lie_in_it_and_none_beside_its_edge(
    off: float,
) -> None:
    picture = np.zeros((8, 9), np.uint8)
    low, high = np.array([2.6, 1.6]) + off, np.array([6.4, 4.4]) + off
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    fill(picture, in_parts(corners))
    y, x = np.mgrid[:8, :9] + 0.5
    inside = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
    covered = picture > 0
    assert covered[inside].all()
    reach = (x > low[0] - 0.6) & (x < high[0] + 0.6) & (y > low[1] - 0.6) & (y < high[1] + 0.6)
    assert not covered[~reach].any()


def test_parts_count_from_the_first_pixels_centre() -> None:
    assert in_parts(np.array([[0.5, 0.5], [1.5, 0.75]])).tolist() == [[0, 0], [16, 4]]
