import cv2
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


def drawn(corners: np.ndarray, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    picture = np.zeros(shape, np.uint8)
    fill(picture, in_parts(corners))
    return picture


def convex(rng: np.random.Generator) -> np.ndarray:
    """Return the hull of points well inside the picture."""
    points = rng.uniform([20, 15], [100, 80], (6, 2)).astype(np.float32)
    return cv2.convexHull(points)[:, 0].astype(float)


def area(corners: np.ndarray) -> float:
    x, y = corners.T
    return abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1))) / 2


def test_a_polygon_covers_its_area_and_at_most_half_a_pixel_along_its_edge(rng):
    corners = convex(rng)
    edge_px = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()

    covered = int(drawn(corners).sum())

    assert area(corners) - 2 <= covered <= area(corners) + 0.6 * edge_px


def test_a_polygon_moved_by_whole_pixels_covers_the_same_pixels_moved(rng):
    corners = convex(rng)

    moved = drawn(corners + np.array([7, -5]))

    np.testing.assert_array_equal(moved, np.roll(drawn(corners), (-5, 7), axis=(0, 1)))


def test_two_halves_cover_the_whole_and_leave_no_gap(rng):
    corners = convex(rng)
    whole, picture = drawn(corners), np.zeros((96, 128), np.uint8)

    for half in (
        corners[: len(corners) // 2 + 1],
        np.r_[corners[len(corners) // 2 :], corners[:1]],
    ):
        fill(picture, in_parts(half))

    np.testing.assert_array_equal(picture, whole)


def test_what_was_drawn_stays_and_only_ones_are_added(rng):
    picture = np.full((96, 128), 7, np.uint8)
    corners = convex(rng)

    fill(picture, in_parts(corners))

    assert set(np.unique(picture)) == {1, 7}
    np.testing.assert_array_equal(picture == 1, drawn(corners) == 1)


@pytest.mark.parametrize("corner_px", [-3.0, 126.0])
def test_a_polygon_across_the_border_is_cut_there(corner_px: float):
    corners = np.array(
        [[corner_px, 10.0], [corner_px + 6, 10], [corner_px + 6, 20], [corner_px, 20]]
    )

    covered = drawn(corners)

    columns = np.flatnonzero(covered.any(axis=0))
    assert columns.min() == max(0, int(corner_px))
    assert columns.max() <= min(127, corner_px + 6)
