"""What is drawn over the video, read back from the pixels."""

from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import mesh_for, outline_points, parts_for, revolution
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Estimate, Reconstruction
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.overlay import draw as draw_over
from v2p_data.scene.overlay import write_overlay
from v2p_data.scene.scale.nouns import noun_for

SIZE = (640, 480)
HEAD_PX = 24
MAGENTA = np.array([255, 60, 200])
"""The first object's colour."""
BOX_M = (0.09, 0.07, 0.05)
NUM_FRAMES = 20


def position(frame):
    """Return where `conftest.make_clip` has the box: it goes 16 cm to the left between 35 % and 65 % of the clip."""
    share = np.clip((frame / (NUM_FRAMES - 1) - 0.35) / 0.3, 0, 1)
    return np.array([0.72, -0.06 + 0.16 * share, 0.025])


@pytest.fixture(scope="module")
def pushed(draw):
    """What a perfect reconstruction of the drawn clip would say."""
    frames = tuple(range(NUM_FRAMES))
    camera = camera_above((240, 320), 0.61, 1.01, 0.5)
    masks = np.zeros((NUM_FRAMES, 240, 320), np.uint8)
    for i in frames:
        corners = camera.project(outline_points("box", BOX_M) + position(i))
        cv2.fillConvexPoly(masks[i], cv2.convexHull(corners.astype(np.float32)).astype(int), 1)
    box = Estimate(
        name="blue_box",
        label="blue box",
        role="manipulated",
        noun=noun_for("box"),
        size_m=BOX_M,
        rgba=(0.1, 0.2, 0.8, 1.0),
        frames=frames,
        T_world_objs=np.stack([transform(np.eye(3), position(i)) for i in frames]),
        confidences=(0.9,) * NUM_FRAMES,
        masks={i: masks[i] > 0 for i in frames},
        source={},
        mass_kg=0.1,
        shape="box",
        mesh=mesh_for("box", BOX_M),
        parts=parts_for("box", BOX_M),
    )
    return Reconstruction(
        clip=draw(num_frames=NUM_FRAMES),
        kind="push_left",
        objects=(box,),
        camera=camera,
        confidence=0.9,
        warnings=(),
        stages={"pose": (0.9, "")},
    )


def picture(reconstruction, frame):
    """Return the part of the drawing that is the video's picture."""
    return draw_over(reconstruction, frame, SIZE)[HEAD_PX : HEAD_PX + SIZE[1]]


def drawn_over(reconstruction, frame):
    """Return the pixels that carry the first object's own colour."""
    return np.abs(picture(reconstruction, frame).astype(int) - MAGENTA).sum(-1) < 60


@pytest.mark.parametrize("frame", [0, 9, 19])
def test_mask_and_shape_are_drawn_around_the_object(pushed, frame):
    y, x = np.nonzero(drawn_over(pushed, frame))
    corners = 2 * pushed.camera.project(outline_points("box", BOX_M) + position(frame))

    np.testing.assert_allclose(
        [x.min(), x.max()], [corners[:, 0].min(), corners[:, 0].max()], atol=3
    )
    assert y.max() == pytest.approx(corners[:, 1].max(), abs=3)


def test_a_mesh_is_drawn_instead_of_the_usual_shape(pushed):
    bowl = revolution(0.2, 0.05, taper=0.5, hollow=True)
    scene = replace(pushed, objects=(replace(pushed.objects[0], mesh=bowl, masks={}),))

    _, x = np.nonzero(drawn_over(scene, 0))
    pixels = 2 * pushed.camera.project(np.asarray(bowl.vertices) + position(0))
    np.testing.assert_allclose(
        [x.min(), x.max()], [pixels[:, 0].min(), pixels[:, 0].max()], atol=3
    )


def test_a_mask_track_is_drawn_where_it_says_and_nowhere_between_its_gaps(pushed):
    box = pushed.objects[0]
    corner = np.zeros((240, 320), bool)
    corner[200:230, 10:60] = True
    followed = {f: corner for f in (0, 1, 2, 3)}
    scene = replace(pushed, objects=(replace(box, masks=followed),))

    def marked(frame):
        seen = picture(scene, frame)[395:465, 15:125].astype(int)
        return (np.abs(seen - picture(scene, 15)[395:465, 15:125]).sum(-1) > 60).sum()

    plain = pushed.clip.frames[3][203:227, 13:57].mean((0, 1))
    filled = picture(scene, 3)[2 * 203 : 2 * 227, 2 * 13 : 2 * 57].mean((0, 1))
    assert marked(3) > 4000
    assert marked(5) > 4000
    assert marked(12) == 0
    np.testing.assert_allclose(filled - plain, 0.32 * (MAGENTA - plain), atol=6)


def test_a_tool_is_drawn_only_while_the_hand_holds_it(pushed):
    box = pushed.objects[0]
    some = slice(5, 10)
    held = replace(
        box,
        frames=box.frames[some],
        T_world_objs=box.T_world_objs[some],
        masks={},
        confidences=box.confidences[some],
        observed=("no_depth",) * 5,
    )
    unheld = replace(held, observed=("full",) * 5)

    drawn = {
        name: [
            drawn_over(replace(pushed, objects=(thing,) * 2), frame).any() for frame in (0, 7, 19)
        ]
        for name, thing in (("held", held), ("unheld", unheld))
    }

    assert drawn == {"held": [False, True, False], "unheld": [True, True, True]}


def test_the_video_has_every_frame_and_its_first_and_last_as_pictures(pushed, tmp_path):
    write_overlay(pushed, tmp_path)

    with av.open(str(tmp_path / "overlay.mp4")) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 20
    assert frames[0].shape == (524, 640, 3)
    for name, frame in (("first", frames[0]), ("last", frames[-1])):
        image = cv2.imread(str(tmp_path / f"overlay_{name}.png"))[..., ::-1]
        assert np.abs(image.astype(int) - frame).mean() < 6


@pytest.mark.parametrize(("h", "w"), [(240, 134), (90, 320)])
def test_narrow_and_flat_videos_are_drawn_with_an_even_size(pushed, tmp_path, h, w):
    frames = np.stack([cv2.resize(f, (w, h)) for f in pushed.clip.frames])
    write_overlay(replace(pushed, clip=replace(pushed.clip, frames=frames)), tmp_path)

    with av.open(str(tmp_path / "overlay.mp4")) as film:
        stream = film.streams.video[0]
        assert (stream.width % 2, stream.height % 2) == (0, 0)
        assert max(stream.width, stream.height - 44) == 640
