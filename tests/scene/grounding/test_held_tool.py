"""A block is pushed with a stick on a drawn table; all that the network says is that everything that comes is hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.classes import CLASSES, HAND, MOVED, TABLE
from v2p_data.scene.frames.mask_ops import bounding_box
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.ground_objects import ground_objects
from v2p_data.scene.grounding.held_tool import find_tool
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.video.captions import parse_caption
from v2p_data.video.clip import Clip

H, W, FRAMES = 240, 320, 24
STICK_PX = 110
"""As long as a stick of 20 cm is where the picture shows 60 cm from left to right."""
SKIN, SLEEVE, BLOCK, GREEN = (214, 160, 130), (60, 60, 150), (190, 40, 40), (40, 150, 60)


def drawn(colour=GREEN, shadow=True, with_stick=True):
    """Return clip, what the network says of it, the block's masks and the stick's.

    The block goes from x 200 to 150. Right of it comes the stick, then the hand; both come from the right and leave again.
    """
    rng = np.random.default_rng(0)
    table = np.clip(np.array([176, 166, 150]) + rng.normal(0, 3, (H, W, 1)), 0, 255).astype(
        np.uint8
    )
    frames, labels, blocks, sticks = [], [], [], []
    for i in range(FRAMES):
        away = 260 * max(0.0, (6 - i) / 6, (i - 19) / 4)
        push = 50 * float(np.clip((i - 8) / 8, 0, 1))
        block, stick, hand, arm, shade = (np.zeros((H, W), np.uint8) for _ in range(5))
        x = round(200 - push)
        cv2.rectangle(block, (x - 15, 120), (x + 15, 150), 1, -1)
        tip = np.array([x + 18 + max(0.0, away), 136.0])
        end, step = tip + STICK_PX * np.array([0.94, -0.34]), np.array([0, 34])
        cv2.line(stick, tip.astype(int), end.astype(int), 1, 7)
        cv2.line(shade, tip.astype(int), (end + step).astype(int), 1, 7)
        grip = tip + 0.72 * (end - tip)
        cv2.ellipse(hand, grip.astype(int), (22, 17), -20, 0, 360, 1, -1)
        wrist = grip + np.array([20, -6])
        elbow = grip + np.array([200, -70])
        cv2.line(arm, wrist.astype(int), elbow.astype(int), 1, 26)
        image, label = table.copy(), np.full((H, W), TABLE)
        if shadow:
            image[shade > 0] = (image[shade > 0] * 0.6).astype(np.uint8)
        image[block > 0], label[block > 0] = BLOCK, MOVED
        if with_stick:
            image[stick > 0], label[stick > 0] = colour, HAND
        for mask, paint in ((arm, SLEEVE), (hand, SKIN)):
            image[mask > 0], label[mask > 0] = paint, HAND
        frames.append(image)
        labels.append(label)
        blocks.append(block > 0)
        sticks.append((stick > 0) & (hand == 0) & (arm == 0))
    shares = [0.02 + 0.9 * (label == np.arange(len(CLASSES))[:, None, None]) for label in labels]
    clip = Clip(
        item="drawn", path=Path("drawn.mp4"), caption="Pushing red block with stick", objects=(), hints={}, frames=np.stack(frames), fps=12.0,
        total_frames=FRAMES, source_fps=12.0, source_frame=np.arange(FRAMES), times_s=np.arange(FRAMES) / 12,
        source_size_px=(W, H), warnings=(),
    )  # fmt: skip
    shares = np.stack(shares).astype(np.float32)
    camera = SeenCamera(
        pitch_rad=0.9, pitch_sd_rad=0.1, focal_widths=0.9, table_width_m=0.6, table_width_sd=0.2
    )
    segmentation = Segmentation(
        idx=np.arange(FRAMES), shares=shares, early=shares[0], late=shares[-1], camera=camera
    )
    return clip, segmentation, np.stack(blocks), np.stack(sticks)


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def test_a_stick_that_the_network_takes_for_hand_is_found_and_followed():
    clip, segmentation, blocks, sticks = drawn()

    tool = find_tool(working_clip_of(clip), segmentation, blocks, noun_for("stick"))

    assert tool.sure > 0.5
    seen = np.flatnonzero(tool.masks.any((1, 2)))
    assert set(range(8, 18)) <= set(seen)
    assert min(iou(tool.masks[i], sticks[i]) for i in range(8, 18)) > 0.6
    assert tool.quality[tool.at] > 0.6
    assert tool.at <= 8  # poses begin where it is first seen well


def test_a_bare_hand_is_no_tool():
    clip, segmentation, blocks, _ = drawn(with_stick=False, shadow=False)

    tool = find_tool(working_clip_of(clip), segmentation, blocks, noun_for("stick"))

    assert tool is None or tool.sure < 0.5


def test_nothing_that_passes_is_no_tool():
    clip, segmentation, blocks, _ = drawn()
    working = working_clip_of(clip)
    still = np.repeat(working.rgb[:1], FRAMES, 0)
    lab = np.repeat(working.lab[:1], FRAMES, 0)
    bare = type(working)(
        **{**vars(working), "rgb": still, "lab": lab, "early": still[0], "late": still[0]}
    )

    assert find_tool(bare, segmentation, blocks, noun_for("stick")) is None


@pytest.mark.parametrize("frame", [7, 12])
def test_a_box_around_the_tool_decides_which_piece_it_is(frame):
    """The sleeve is marked: nobody would take it for a stick otherwise."""
    clip, segmentation, blocks, sticks = drawn()
    y, x = np.nonzero(sticks[frame])
    box = np.zeros((H, W), bool)
    box[y.min() : y.max() + 1, x.min() : x.max() + 1] = True
    elsewhere = np.zeros((H, W), bool)
    elsewhere[200:230, 20:60] = True

    tool = find_tool(working_clip_of(clip), segmentation, blocks, noun_for("stick"), (frame, box))

    assert tool.at == frame
    assert iou(tool.masks[frame], sticks[frame]) > 0.6
    assert (
        find_tool(
            working_clip_of(clip), segmentation, blocks, noun_for("stick"), (frame, elsewhere)
        )
        is None
    )


@pytest.mark.parametrize("frame", [9, 12, 15])
def test_a_tool_of_the_colours_of_the_hand_lies_across_its_box(frame):
    clip, segmentation, blocks, sticks = drawn(colour=(208, 158, 132))
    y, x = np.nonzero(sticks[frame])
    box = np.zeros((H, W), bool)
    box[y.min() : y.max() + 1, x.min() : x.max() + 1] = True

    tool = find_tool(working_clip_of(clip), segmentation, blocks, noun_for("stick"), (frame, box))

    found = tool.masks[frame]
    assert found[sticks[frame]].mean() > 0.7
    x0, y0, w, h = bounding_box(found)
    filled = np.zeros((H, W), bool)
    filled[y0 : y0 + h, x0 : x0 + w] = True
    assert iou(filled, box) > 0.8


def test_the_picture_edge_may_cut_the_tool():
    """Cut off at the right, so that no hand is seen until late: what is seen of it grows."""
    clip, segmentation, blocks, sticks = drawn()
    working, cut = working_clip_of(clip), 260
    narrow = type(working)(
        **{
            **vars(working),
            **{name: getattr(working, name)[:, :, :cut] for name in ("rgb", "lab")},
            **{name: getattr(working, name)[:, :cut] for name in ("early", "late", "always")},
        }
    )
    seen = Segmentation(
        idx=segmentation.idx,
        shares=segmentation.shares[..., :cut],
        early=segmentation.early[..., :cut],
        late=segmentation.late[..., :cut],
        camera=segmentation.camera,
    )

    tool = find_tool(narrow, seen, blocks[..., :cut], noun_for("stick"))

    at = [i for i in range(9, 18) if tool.masks[i].any()]
    assert len(at) > 5
    assert np.median([iou(tool.masks[i], sticks[i][:, :cut]) for i in at]) > 0.6


def test_a_scene_holds_the_tool_in_the_hand_and_makes_no_sense_without_it():
    clip, segmentation, _, sticks = drawn()
    bare, seen, _, _ = drawn(with_stick=False, shadow=False)
    meaning = parse_caption(clip.caption, ())

    block, stick = ground_objects(clip, working_clip_of(clip), meaning, segmentation, 0.5).objects

    assert (block.role, block.in_hand) == ("manipulated", False)
    assert (stick.role, stick.in_hand, stick.moves) == ("tool", True, True)
    assert iou(stick.masks[12], sticks[12]) > 0.6
    assert 7 <= stick.at <= 9  # the block sets out in frame 9
    with pytest.raises(ItemRejectedError, match="the 'stick' was not found") as error:
        ground_objects(bare, working_clip_of(bare), meaning, seen, 0.5)
    assert error.value.reason == "reference_not_found"
