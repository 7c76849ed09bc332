"""The tracker without weights on pictures of the simulated arm, and what it does when the object is hidden or gone."""

import time

import numpy as np
import pytest

from v2p_data.deployment.rig import Rig
from v2p_data.deployment.segmentation import ColourTracker
from v2p_data.deployment.sight import LOST_AFTER, Sight, clicks_from
from v2p_data.errors import V2PError
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.sim.render.masks import rgb_to_labels


@pytest.fixture(scope="module")
def course(make_robot, two_objects):
    """Return a robot's readings while the arm comes down and pushes both objects about, with the true labels."""
    robot = make_robot(two_objects, pictures="rgb")
    rig = Rig(robot)
    rows = []
    box = robot.arm.env.world.objects[0].qpos_adr
    for step in range(44):
        rows.append((rig.read(), rgb_to_labels(robot.arm.mask())))
        at = robot.arm.env.moment().qpos[0, box : box + 3]
        tool = rows[-1][0].tool_pos
        goal = at + (
            [-0.08, 0, 0.05] if step < 12 else [0.0, 0, 0.0] if step < 30 else [0, 0.1, 0.1]
        )
        rig.act(np.r_[np.clip((goal - tool) / 0.03, -0.8, 0.8), 0, 0, 0, 1.0])
    camera = robot.calibration()
    robot.disconnect()
    return rows, camera


def middle(mask):
    y, x = np.nonzero(mask)
    k = int(np.argmin((x - np.median(x)) ** 2 + (y - np.median(y)) ** 2))
    return float(x[k]) + 0.5, float(y[k]) + 0.5


def test_both_objects_are_followed_while_the_arm_pushes_them(course):
    rows, camera = course
    first = rows[0][1]
    sight = Sight(camera, [middle(first == 2), middle(first == 3)])
    seen = [sight.start(rows[0][0])] + [sight.see(reading) for reading, _ in rows[1:]]

    moved = np.hypot(*np.subtract(middle(rows[0][1] == 2), middle(rows[-1][1] == 2)))
    assert moved > 10  # the push was real
    for label in (2, 3):
        overlaps = [
            iou(s.labels == label, true == label)
            for s, (_, true) in zip(seen, rows, strict=True)
            if (true == label).sum() > 150
        ]
        assert np.mean(overlaps) > 0.88
        assert np.percentile(overlaps, 5) > 0.7
    robots = [iou(s.labels == 1, t == 1) for s, (_, t) in zip(seen, rows, strict=True)]
    assert np.mean(robots) > 0.97
    assert max(max(s.missed) for s in seen) < LOST_AFTER


def test_a_picture_takes_less_than_25_milliseconds_of_processor_time(course):
    rows, camera = course
    sight = Sight(camera, [middle(rows[0][1] == 2)])
    sight.start(rows[0][0])
    took = []
    for reading, _ in rows[1:]:
        began = time.thread_time()
        sight.see(reading)
        took.append(time.thread_time() - began)

    assert np.median(took) < 0.025


def test_clicks_that_are_on_no_object_are_refused(course):
    rows, camera = course
    reading, labels = rows[0]

    def told(*clicks):
        with pytest.raises(V2PError) as error:
            Sight(camera, clicks).start(reading)
        return str(error.value)

    box = middle(labels == 2)
    assert "on the robot" in told(middle(labels == 1))
    assert "on the table or the background" in told((200.0, 230.0))
    assert "outside the picture" in told((256.0, 10.0))
    assert "same thing as click 1" in told(box, (box[0] + 2, box[1]))
    with pytest.raises(V2PError, match="0 objects are clicked"):
        Sight(camera, [])


def still(course):
    rows, _ = course
    reading, labels = rows[0]
    robot = labels == 1
    tracker = ColourTracker()
    tracker.start(reading.picture, middle(labels == 2), robot)
    return tracker, reading.picture, labels


def test_a_hand_over_half_of_the_object_leaves_the_rest(course):
    tracker, picture, labels = still(course)
    true = labels == 2
    x = int(middle(true)[0])
    half = picture.copy()
    half[:, x:][true[:, x:]] = (201, 150, 120)  # skin

    found = tracker.track(half, labels == 1)

    visible = true.copy()
    visible[:, x:] = False
    assert iou(found.mask, visible) > 0.8
    assert found.confidence > 0.3


def test_an_object_behind_the_robot_is_hidden_and_found_again(course):
    tracker, picture, labels = still(course)
    true, robot = labels == 2, labels == 1
    y, x = np.nonzero(true)
    arm = np.zeros_like(true)
    arm[max(0, y.min() - 6) : y.max() + 7, max(0, x.min() - 6) : x.max() + 7] = True
    covered = picture.copy()
    covered[arm] = picture[robot][:1]

    behind = [tracker.track(covered, robot | arm) for _ in range(6)]
    again = tracker.track(picture, robot)

    assert all(f.confidence == 0 and f.is_hidden for f in behind[1:])
    assert iou(again.mask, true) > 0.9


def test_an_object_that_is_taken_away_is_lost_after_five_pictures(course):
    rows, camera = course
    reading, labels = rows[0]
    sight = Sight(camera, [middle(labels == 2)])
    sight.start(reading)
    bare = reading.picture.copy()
    bare[labels == 2] = np.median(reading.picture[labels == 0], axis=0)
    gone = type(reading)(**{**vars(reading), "picture": bare})

    missed = [sight.see(gone).missed[0] for _ in range(6)]

    assert missed[3] < LOST_AFTER <= missed[5]
    assert not (sight.see(gone).labels == 2).any()


def test_clicks_are_read_as_they_are_typed():
    assert clicks_from(["120,80", "3.5,7"]) == ((120.0, 80.0), (3.5, 7.0))
    with pytest.raises(V2PError, match="'120;80'"):
        clicks_from(["120;80"])


def table_with_box(
    shadow_at: int, box_at: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return a grained grey table with a dark red box, and a hard shadow over 80 columns; and the box's mask."""
    grain = np.add.outer(np.arange(256) // 9 % 3, np.arange(256) // 40 % 2)
    picture = 110.0 + 8 * grain[..., None] + np.zeros(3)
    mask = np.zeros((256, 256), bool)
    mask[120:156, box_at : box_at + 28] = True
    picture[mask] = (120, 45, 40)
    picture[130:156, box_at : box_at + 9] = (70, 28, 26)  # its side is darker
    picture[40:240, shadow_at : shadow_at + 80] *= 0.45
    noisy = picture + rng.normal(0, 2.0, picture.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), mask


def test_a_hard_shadow_that_passes_over_the_object_is_not_taken_for_it():
    rng = np.random.default_rng(0)
    nobody = np.zeros((256, 256), bool)
    frames = [table_with_box(10 + 4 * k, 110 + k // 2, rng) for k in range(50)]
    tracker = ColourTracker()
    picture, mask = frames[0]
    tracker.start(picture, middle(mask), nobody)

    overlaps = [iou(tracker.track(p, nobody).mask, m) for p, m in frames[1:]]

    assert np.min(overlaps) > 0.7
    assert np.mean(overlaps) > 0.85
