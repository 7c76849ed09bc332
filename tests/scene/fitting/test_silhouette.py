from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform, transform_from_pose
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.fitting.shape_fit import (
    fit_lifted,
    fit_pose,
    fit_shape,
    orientations,
)
from v2p_data.scene.fitting.silhouette import Silhouette, camera_above
from v2p_data.scene.fitting.trajectory import Trajectory, carried_by_hand, peak, trajectory_in_hand
from v2p_data.scene.frames.classes import CLASSES, HAND
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.scale.camera_height import (
    SeenCamera,
    SizeVote,
    camera_height_m,
)
from v2p_data.scene.scale.nouns import noun_for

PITCH, FOV = 0.61, 1.01


def silhouette_of(points, camera):
    """Return the mask that the points' hull casts, drawn by OpenCV at eight times the size."""
    mask = np.zeros((camera.height_px * 8, camera.width_px * 8), np.uint8)
    hull = cv2.convexHull((camera.project(points) * 8).astype(np.int32))
    cv2.fillConvexPoly(mask, hull, 1)
    return cv2.resize(mask, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA) > 0


def test_the_middle_pixel_meets_the_table_where_trigonometry_says():
    camera = camera_above((240, 320), PITCH, FOV, height=0.5)

    spot = camera.on_plane(np.array([[160.0, 120.0]]))[0]

    np.testing.assert_allclose(spot, [0.5 / np.tan(PITCH), 0, 0], atol=1e-9)


def test_a_box_is_found_again_from_its_silhouette():
    camera, noun = camera_above((240, 320), PITCH, FOV), noun_for("book")
    size = np.array(noun.size_m) * 1.7  # camera heights: any unit will do
    T = transform_from_pose(
        np.r_[1.2, 0.2, size[2] / 2, Rotation.from_euler("z", 0.5).as_quat(scalar_first=True)]
    )
    points = outline_points("box", tuple(size)) @ T[:3, :3].T + T[:3, 3]
    silhouette = Silhouette(silhouette_of(points, camera), None, camera)

    fit = fit_shape(silhouette, noun, np.eye(3))

    assert fit.iou > 0.95
    np.testing.assert_allclose(fit.T_world_obj[:2, 3], [1.2, 0.2], atol=0.04)
    np.testing.assert_allclose(np.sort(fit.size)[1:], np.sort(size)[1:], rtol=0.12)


def test_a_known_shape_is_placed_to_a_hundredth_of_the_camera_height():
    camera, noun = camera_above((240, 320), PITCH, FOV), noun_for("can")
    size = (0.14, 0.14, 0.25)
    points = outline_points("cylinder", size) + np.array([1.3, -0.3, 0.125])
    silhouette = Silhouette(silhouette_of(points, camera), None, camera)

    fit = fit_pose(silhouette, noun, size, np.eye(3))

    np.testing.assert_allclose(fit.T_world_obj[:3, 3], [1.3, -0.3, 0.125], atol=0.01)


def test_what_a_hand_hides_does_not_shift_the_pose():
    camera, noun = camera_above((240, 320), PITCH, FOV), noun_for("can")
    size = (0.14, 0.14, 0.25)
    points = outline_points("cylinder", size) + np.array([1.3, -0.3, 0.125])
    whole = silhouette_of(points, camera)
    hand = np.zeros_like(whole)
    x, y, _, h = cv2.boundingRect(whole.astype(np.uint8))
    hand[y - 4 : y + h // 3, x - 10 :] = True

    fit = fit_pose(Silhouette(whole & ~hand, hand, camera), noun, size, np.eye(3))

    np.testing.assert_allclose(fit.T_world_obj[:2, 3], [1.3, -0.3], atol=0.05)


def test_a_thing_lifted_straight_up_is_found_at_its_height():
    camera, noun = camera_above((240, 320), PITCH, FOV), noun_for("apple")
    size = (0.16, 0.16, 0.16)
    T_first = transform(np.eye(3), np.array([1.4, 0.1, 0.08]))
    points = outline_points("sphere", size) + np.array([1.4, 0.1, 0.42])
    silhouette = Silhouette(silhouette_of(points, camera), None, camera)

    fit = fit_lifted(silhouette, noun, size, T_first)

    np.testing.assert_allclose(fit.T_world_obj[:3, 3], [1.4, 0.1, 0.42], atol=0.02)


def test_a_size_that_the_user_gives_decides_the_scale():
    noun = noun_for("box")
    known = SizeVote(size=(0.1, 0.2, 0.3), noun=noun, known_m=(0.06, 0.04, 0.02))

    height, spread = camera_height_m([known])

    assert height == pytest.approx(0.2, rel=0.02)
    assert spread < 0.05


def test_a_tray_stands_with_its_mouth_up_and_an_eraser_seldom_on_its_edge():
    tray, eraser, carton = (orientations(noun_for(w)) for w in ("tray", "eraser", "cereal box"))

    assert len(tray) == 1
    np.testing.assert_allclose(tray[0][0], np.eye(3))
    assert eraser[0][1] == carton[0][1] == 0
    assert min(cost for _, cost in eraser[1:]) > max(cost for _, cost in carton[1:]) > 0


def test_a_ring_s_hole_says_nothing_against_its_outline():
    camera, noun = camera_above((240, 320), PITCH, FOV), noun_for("tape")
    size = np.array(noun.size_m) * 2
    T = transform(np.eye(3), np.array([1.2, 0.1, size[2] / 2]))
    outside, hole = (
        silhouette_of(outline_points("cylinder", tuple(size * s)) @ T[:3, :3].T + T[:3, 3], camera)
        for s in (np.ones(3), np.array([0.5, 0.5, 0.1]))
    )

    fit = fit_shape(Silhouette(outside & ~hole, None, camera), noun, np.eye(3))

    assert (outside & hole).sum() > 20
    np.testing.assert_allclose(fit.size[0], size[0], rtol=0.04)
    np.testing.assert_allclose(fit.T_world_obj[:3, 3], T[:3, 3], atol=0.02)


@pytest.mark.parametrize("yaw_deg", [38, 50, 65])
def test_the_edges_between_its_faces_tell_how_a_cube_is_turned(yaw_deg):
    """Its outline with some shadow hardly does: one that is turned otherwise and wider covers that as well."""
    camera, noun = camera_above((240, 320), PITCH, FOV), noun_for("cube")
    side = 0.13
    turn = Rotation.from_euler("z", yaw_deg, degrees=True)
    T = transform_from_pose(np.r_[1.3, 0.1, side / 2, turn.as_quat(scalar_first=True)])
    image = np.full((240, 320, 3), 150, np.uint8)
    mask = np.zeros((240, 320), np.uint8)
    eye = camera.T_world_cam[:3, 3]
    for axis, shade in enumerate((70, 110, 190)):
        for sign in (-1, 1):
            normal = sign * T[:3, axis]
            middle = T[:3, 3] + normal * side / 2
            if (eye - middle) @ normal > 0:
                u, v = T[:3, :3].T[axis - 1] * side / 2, T[:3, :3].T[axis - 2] * side / 2
                corners = camera.project(middle + np.array([u + v, u - v, -u - v, v - u]))
                for canvas, paint in ((image, (shade, shade // 2, 40)), (mask, 1)):
                    cv2.fillConvexPoly(canvas, corners.round().astype(np.int32), paint)
    y, x = np.nonzero(mask)
    cv2.ellipse(mask, (int(x.max()) - 4, int(y.max()) - 6), (12, 6), 0, 0, 360, 1, -1)

    fit = fit_shape(Silhouette(mask > 0, None, camera, image), noun, np.eye(3))

    found = np.degrees(np.arctan2(fit.T_world_obj[1, 0], fit.T_world_obj[0, 0]))
    off = (found - yaw_deg + 45) % 90 - 45
    assert abs(off) < 5


@pytest.mark.parametrize(("believed", "ends_at"), [(8, 8), (3, 3)])
def test_a_lift_ends_where_the_thing_was_last_seen_highest(believed, ends_at):
    """It rises from frame 4 on; what is not believed is not seen, be it drawn as high as you like."""
    masks = np.zeros((9, 40, 40), bool)
    for i in range(9):
        top = 30 - 3 * max(0, i - 3)
        masks[i, top : top + 6, 10:16] = True
    quality = np.where(np.arange(9) <= believed, 1.0, 0.3)
    thing = ObjectTrack(
        phrase="red cube",
        role="manipulated",
        noun=noun_for("cube"),
        masks=masks,
        quality=quality,
        moves=True,
        at=0,
        known_m=None,
        sure=0.9,
        why="",
    )

    assert peak(thing) == ends_at


def lifted_in_a_fist(
    rises_px: int, *, seen_rising: bool = False
) -> tuple[ObjectTrack, Segmentation]:
    """Ten frames: a hand comes from the right, takes hold of a cube at (40, 90), stays, and goes up.

    It hides the cube.
    """
    tips = [(110, 90), (70, 96), (40, 90), (40, 90), (40, 90)]
    tips += [(40, 90 - rises_px * k // 5) for k in range(1, 6)]
    masks, shares = (
        np.zeros((10, 120, 160), bool),
        np.zeros((10, len(CLASSES), 120, 160), np.float32),
    )
    for i, tip in enumerate(tips):
        up = rises_px * max(0, i - 4) // 5 if seen_rising else 0
        masks[i, 84 - up : 96 - up, 34:46] = True
        shares[i, HAND] = cv2.line(np.zeros((120, 160), np.uint8), (159, tip[1]), tip, 1, 16)
    quality = np.where((np.arange(10) < 2) | seen_rising, 1.0, 0.2)
    thing = ObjectTrack(
        phrase="red cube",
        role="manipulated",
        noun=noun_for("cube"),
        masks=masks,
        quality=quality,
        moves=True,
        at=0,
        known_m=None,
        sure=0.9,
        why="",
    )
    seen = SeenCamera(
        pitch_rad=PITCH, pitch_sd_rad=0.1, focal_widths=1.0, table_width_m=0.8, table_width_sd=0.2
    )
    none = shares[0]
    return thing, Segmentation(
        idx=np.arange(10), shares=shares, early=none, late=none, camera=seen
    )


def test_what_a_fist_hides_goes_up_with_it():
    thing, segmentation = lifted_in_a_fist(50)
    camera = camera_above((120, 160), PITCH, FOV)
    start = transform(np.eye(3), np.array([*camera.on_plane(np.array([[40.0, 90.0]]), 0.05)[0]]))

    carried = carried_by_hand(thing, segmentation)
    trajectory = trajectory_in_hand(Trajectory([0], [start], [0.9], ["full"]), carried, camera)

    assert carried[-1][0] == 9
    np.testing.assert_allclose(carried[-1][1], (0, -50), atol=2)
    assert trajectory.frames[0] == 0
    assert trajectory.frames[-1] == 9
    assert set(trajectory.observed[1:]) == {"no_depth"}
    heights = [T[2, 3] for T in trajectory.poses]
    assert heights == sorted(heights)
    pixel = camera.project(trajectory.poses[-1][None, :3, 3])[0]
    np.testing.assert_allclose(pixel, (40, 40), atol=2)
    assert trajectory.poses[-1][0, 3] == pytest.approx(start[0, 3])


def test_a_hand_that_is_not_recognised_for_a_moment_takes_nothing_elsewhere():
    """A striped sleeve: what the network takes for a hand there ends far from the hand's own end."""
    thing, segmentation = lifted_in_a_fist(50)
    shares = segmentation.shares.copy()
    shares[6, HAND] = cv2.line(np.zeros((120, 160), np.uint8), (159, 10), (120, 10), 1, 16)

    carried = dict(carried_by_hand(thing, replace(segmentation, shares=shares)))

    assert 6 not in carried
    np.testing.assert_allclose(carried[9], (0, -50), atol=2)
