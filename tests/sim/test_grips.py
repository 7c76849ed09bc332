import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.sim.robot.grips import GRIPS_UP_TO_M, grip_features, turn_to_grip

RNG_SEED = 7
BAR = (0.12, 0.03, 0.05)
"""Fits between the pads along its own y axis only."""


def turned(yaw_deg: float | np.ndarray) -> np.ndarray:
    """Rotations about the vertical as the functions take them: worlds last."""
    yaw = np.atleast_1d(np.radians(yaw_deg))
    return np.moveaxis(Rotation.from_euler("z", yaw[:, None]).as_matrix().reshape(-1, 3, 3), 0, -1)


def closing_at(yaw_deg: float | np.ndarray) -> np.ndarray:
    yaw = np.atleast_1d(np.radians(yaw_deg))
    return np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])


def turn_deg(
    closing_deg: float | np.ndarray,
    rotation: np.ndarray,
    size: tuple[float, float, float],
    *,
    is_round: bool = False,
) -> np.ndarray:
    sizes = np.tile(np.array(size)[:, None], (1, rotation.shape[-1]))
    closing = np.broadcast_to(closing_at(closing_deg), (3, rotation.shape[-1]))
    return np.degrees(turn_to_grip(closing, rotation, sizes, is_round=is_round))


@pytest.mark.parametrize(
    ("closing_deg", "yaw_deg", "expected_deg"),
    [
        (90, 0, 0),  # the pads close along the bar's width already
        (90, 30, 30),  # anticlockwise is positive
        (90, -30, -30),
        (90, 80, 80),
        (90, 100, -80),  # shorter the other way round
        (90, 210, 30),  # a bar turned by 180 degrees is the same bar
        (-90, 30, 30),  # so is a gripper whose pads have changed places
        (135, 0, -45),
        (0, 20, -70),  # its width lies at 110 degrees, which is -70 for the pads
    ],
)
def test_a_bar_is_gripped_across(closing_deg: float, yaw_deg: float, expected_deg: float):
    turn = turn_deg(closing_deg, turned(yaw_deg), BAR)

    assert turn == pytest.approx([expected_deg], abs=1e-9)


def test_of_two_sides_that_fit_the_nearer_one_is_gripped():
    yaws = np.array([0.0, 40.0, 50.0, 90.0, 130.0])

    turns = turn_deg(90, turned(yaws), (0.05, 0.05, 0.05))

    assert turns == pytest.approx([0, 40, -40, 0, 40], abs=1e-9)


def test_a_side_that_does_not_fit_is_avoided_at_the_price_of_a_quarter_turn():
    fits, too_wide = GRIPS_UP_TO_M - 0.002, GRIPS_UP_TO_M + 0.05

    assert turn_deg(90, turned(10), (0.07, fits, 0.05)) == pytest.approx([10], abs=1e-9)
    assert turn_deg(90, turned(10), (0.07, too_wide, 0.05)) == pytest.approx([-80], abs=1e-9)
    assert turn_deg(90, turned(0), (0.057, 0.087, 0.05)) == pytest.approx([-90], abs=1e-9)


def test_a_box_lying_on_its_side_is_gripped_by_the_axes_that_are_level():
    # Its own x axis points up, y along the world's y, z along the world's -x.
    on_its_side = Rotation.from_euler("y", -90, degrees=True)
    lying = (Rotation.from_euler("z", 25, degrees=True) * on_its_side).as_matrix()[..., None]

    # The own z axis is the narrow one and lies at 180 + 25 degrees: 25 - 90 from pads at 90.
    turn = turn_deg(90, lying, (0.05, 0.15, 0.03))

    assert turn == pytest.approx([-65], abs=1e-6)


def test_something_round_needs_no_turn_while_it_stands_and_is_gripped_across_its_axis_lying():
    lying = Rotation.from_euler("y", 90, degrees=True)  # its axis along the world's x
    stack = np.stack(
        [
            Rotation.from_euler("z", 33, degrees=True).as_matrix(),
            lying.as_matrix(),
            (Rotation.from_euler("z", 20, degrees=True) * lying).as_matrix(),
        ],
        axis=-1,
    )

    turns = turn_deg(90, stack, (0.06, 0.06, 0.15), is_round=True)

    assert turns == pytest.approx([0, 0, 20], abs=1e-6)


def test_after_the_turn_the_pads_close_along_an_own_axis_and_it_is_a_quarter_turn_at_most():
    rng = np.random.default_rng(RNG_SEED)
    yaws, closing = rng.uniform(-360, 360, (2, 200))
    rotation = turned(yaws)

    turns = turn_deg(closing, rotation, (0.06, 0.04, 0.05))

    after = closing_at(closing + turns)
    along = np.abs(np.einsum("ie,ike->ke", after, rotation)).max(0)
    assert along == pytest.approx(np.ones(200), abs=1e-9)
    assert np.abs(turns).max() <= 90 + 1e-9


def test_the_turn_is_about_what_lies_between_gripper_and_object_only():
    rng = np.random.default_rng(RNG_SEED)
    yaws, closing, both = rng.uniform(-180, 180, (3, 100))

    here = turn_deg(closing, turned(yaws), BAR)
    there = turn_deg(closing + both, turned(yaws + both), BAR)

    # At a quarter turn either way is as good.
    assert (here - there + 90) % 180 - 90 == pytest.approx(np.zeros(100), abs=1e-6)


def test_the_extents_are_those_of_the_box_s_corners_in_the_gripper_s_axes():
    rng = np.random.default_rng(RNG_SEED)
    tools = Rotation.random(50, random_state=rng).as_matrix()
    objects = Rotation.random(50, random_state=rng).as_matrix()
    sizes = rng.uniform(0.02, 0.2, (50, 3))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2

    features = grip_features(
        np.moveaxis(tools, 0, -1), np.moveaxis(objects, 0, -1), sizes.T, is_round=False
    )

    for k in range(50):
        seen = (corners * sizes[k]) @ objects[k].T @ tools[k]
        assert features[1:, k] == pytest.approx(np.ptp(seen, axis=0), rel=1e-9)


def test_the_turn_is_shown_in_quarter_turns():
    down = Rotation.from_euler("x", 180, degrees=True).as_matrix()[..., None]

    features = grip_features(down, turned(30), np.array(BAR)[:, None], is_round=False)

    # Extents of a bar at 30 degrees: 0.12 cos 30 + 0.03 sin 30, 0.12 sin 30 + 0.03 cos 30, its height.
    assert features[:, 0] == pytest.approx([1 / 3, 0.118923, 0.085981, 0.05], abs=1e-6)
