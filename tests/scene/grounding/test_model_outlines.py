"""Outlines of a model that knows edges of objects.

A model that answers from the drawn truth stands for it: the weights are not part of the
repository.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drawn_parts import BLUE, RED, W, large, square

from v2p_data.errors import V2PError
from v2p_data.scene.backends.outlines import EncodedPicture, Outlines
from v2p_data.scene.frames.classes import HAND, MOVED, OTHER, TABLE
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.frames.outliner import Outliner
from v2p_data.scene.frames.table import find_table
from v2p_data.scene.grounding.ground_objects import EXACT_GAP_PX, seen_on_table
from v2p_data.scene.grounding.methods.base import Seen, mark_in_box
from v2p_data.scene.grounding.model_outlines import (
    outline_at_spots,
    outline_in_box,
    outlines_around,
)
from v2p_data.scene.grounding.moved_by_network import find_moved_by_network
from v2p_data.scene.grounding.spot_masks import mask_at_spots
from v2p_data.scene.grounding.static_cues import StaticSearch
from v2p_data.scene.grounding.static_objects import find_static_object
from v2p_data.scene.scale.nouns import noun_for


class TruthModel:
    """Knows which pixels belong together in each frame; half of an object is a part, and all that is drawn a group."""

    def __init__(self, objects_by_frame):
        self.objects = objects_by_frame
        self.encoded = []

    def encode(self, picture):
        self.encoded.append(picture)
        return EncodedPicture(features=torch.full((1, 256, 64, 64), float(picture[0, 0, 0])))

    def outlines(self, picture, prompts, size_px):
        objects = self.objects[int(picture.features[0, 0, 0, 0])]
        logits = np.full((len(prompts), 3, *size_px), -5.0, np.float32)
        ious = np.tile(np.array([0.9, 1.0, 0.8], np.float32), (len(prompts), 1))
        for k, prompt in enumerate(prompts):
            found = self._meant(objects, prompt)
            if found is None:
                ious[k] = 0.3
                continue
            half = found.copy()
            half[: int(np.argwhere(found)[:, 0].mean())] = False
            for plane, mask in zip(logits[k], (half, found, np.any(objects, 0)), strict=True):
                plane[mask] = 5.0
        return Outlines(logits=logits, ious=ious)

    def _meant(self, objects, prompt):
        if prompt.box_xyxy is not None:
            x0, y0, x1, y1 = (round(v) for v in prompt.box_xyxy)
            box = np.zeros_like(objects[0])
            box[y0:y1, x0:x1] = True
            best = max(objects, key=lambda mask: iou(mask, box))
            return best if (best & box).any() else None
        on = [tuple(int(v) for v in spot) for spot in prompt.on]
        return next((m for m in objects if all(m[v, u] for u, v in on)), None)


def with_model(working, parts_by_frame):
    """Return the working clip whose objects the model knows; each frame carries its number in its first pixel."""
    h, w = working.shape
    model = TruthModel([[large(mask, (h, w)) for mask, _, _ in parts] for parts in parts_by_frame])
    frames = working.rgb.copy()
    frames[:, 0, 0] = np.arange(len(frames))[:, None]
    outliner = Outliner(model, frames, np.arange(len(frames)), working.shape)
    return replace(working, outliner=outliner), model


def pushed_with_sleeve():
    """A red square goes right; the network takes the red sleeve above it along."""
    return [
        [(square(10 + 4 * i, 4, 22, 40), RED, MOVED), (square(14 + 4 * i, 44), RED, MOVED)]
        for i in range(12)
    ]


def test_a_sleeve_that_was_taken_along_is_left_out(segmentation_of):
    frames = pushed_with_sleeve()
    working, segmentation = segmentation_of(frames)
    knowing, _ = with_model(working, [[parts[1]] for parts in frames])

    alone, _ = find_moved_by_network(working, segmentation, "red box", "push_right")
    helped, _ = find_moved_by_network(knowing, segmentation, "red box", "push_right")

    truth = large(square(14, 44), working.shape)
    assert iou(helped.first, truth) > 0.95 > iou(alone.first, truth)
    assert helped.outlined == (0, 1)
    assert alone.outlined == ()


def test_a_whole_object_is_preferred_to_its_half(segmentation_of):
    frames = [[(square(14 + 4 * i, 44), RED, MOVED)] for i in range(12)]
    working, segmentation = segmentation_of(frames)
    knowing, _ = with_model(working, frames)

    found, _ = find_moved_by_network(knowing, segmentation, "red box", "push_right")

    assert iou(found.first, large(square(14, 44), working.shape)) > 0.95
    assert iou(found.last, large(square(58, 44), working.shape)) > 0.95


def test_what_is_on_the_hand_is_no_outline(segmentation_of):
    frames = [[(square(40, 40), RED, HAND)]] * 12
    knowing, _ = with_model(segmentation_of(frames)[0], frames)
    region = large(square(40, 40), knowing.shape)

    assert outlines_around(knowing, 0, region)
    assert not outlines_around(knowing, 0, region, hand=region)


def test_each_frame_is_encoded_once(segmentation_of):
    frames = pushed_with_sleeve()
    knowing, model = with_model(segmentation_of(frames)[0], frames)
    region = large(square(14, 44), knowing.shape)

    for i in (0, 0, 11, -1):
        outlines_around(knowing, i, region)

    assert len(model.encoded) == 2


def test_the_ends_can_be_encoded_before_anybody_asks(segmentation_of):
    frames = pushed_with_sleeve()
    knowing, model = with_model(segmentation_of(frames)[0], frames)

    knowing.outliner.encode_ends()
    outlines_around(knowing, 0, large(square(14, 44), knowing.shape))

    assert [int(picture[0, 0, 0]) for picture in model.encoded] == [0, 11]


def test_a_static_object_is_cut_out_of_the_things_around_it(segmentation_of):
    box, clutter = square(70, 40), square(62, 20, 30, 20)
    frames = [
        [(clutter, BLUE, OTHER), (box, BLUE, OTHER), (square(5 + 4 * i, 40), RED, MOVED)]
        for i in range(12)
    ]
    working, segmentation = segmentation_of(frames)
    knowing, _ = with_model(working, [[parts[1]] for parts in frames])

    def found(clip):
        ends = (square(5, 40), square(49, 40))
        search = StaticSearch(
            working=clip,
            table=find_table(clip.always, segmentation.early[TABLE] > 0.5),
            segmentation=segmentation,
            phrase="box",
            moved=noun_for("box"),
            kind="push_next_to",
            ends=(large(ends[0], clip.shape), large(ends[1], clip.shape)),
            taken=np.zeros(clip.shape, bool),
        )
        return find_static_object(search)[0]

    truth = large(box, working.shape)
    assert iou(found(knowing), truth) > 0.95 > iou(found(working), truth)


def test_a_box_gives_the_outline_of_what_is_in_it(segmentation_of):
    frames = [[(square(40, 40, 20, 10), RED, OTHER)]] * 12
    knowing, _ = with_model(segmentation_of(frames)[0], frames)
    scale = knowing.shape[1] / W

    near = outline_in_box(knowing, 0, (39 * scale, 38 * scale, 62 * scale, 51 * scale))
    beside = outline_in_box(knowing, 0, (56 * scale, 30 * scale, 110 * scale, 80 * scale))

    assert iou(near, large(square(40, 40, 20, 10), knowing.shape)) > 0.95
    assert beside is None


def test_a_detectors_box_becomes_the_models_outline(segmentation_of, draw):
    frames = [[(square(40, 40, 20, 10), RED, OTHER)]] * 12
    working, segmentation = segmentation_of(frames)
    knowing, _ = with_model(working, frames)
    seen = Seen(clip=draw(num_frames=12), working=knowing, segmentation=segmentation)
    scale = knowing.shape[1] / W / knowing.px_scale

    mark = mark_in_box(seen, 0, (38 * scale, 38 * scale, 62 * scale, 52 * scale), 0.9)

    assert iou(mark.mask, large(square(40, 40, 20, 10), knowing.shape)) > 0.95


def test_a_click_takes_the_whole_object_and_bare_table_is_still_refused(segmentation_of):
    frames = [[(square(40, 40, 20, 12), RED, OTHER)]] * 12
    working, segmentation = segmentation_of(frames)
    knowing, _ = with_model(working, frames)
    scale = working.shape[1] / W
    on, off = (50 * scale, 46 * scale), (100 * scale, 80 * scale)

    mask = mask_at_spots(
        working.rgb[0], [on], segmentation.at(0), outline_at_spots(knowing, 0, [on])
    )

    assert iou(mask, large(square(40, 40, 20, 12), working.shape)) > 0.95
    with pytest.raises(V2PError):
        mask_at_spots(
            working.rgb[0], [off], segmentation.at(0), outline_at_spots(knowing, 0, [off])
        )


def test_without_a_model_nothing_is_outlined(segmentation_of):
    working, _ = segmentation_of([[(square(40, 40), RED, OTHER)]] * 12)
    region = large(square(40, 40), working.shape)

    assert outlines_around(working, 0, region) == []
    assert outline_in_box(working, 0, (10.0, 10.0, 50.0, 50.0)) is None
    assert outline_at_spots(working, 0, [(20.0, 20.0)]) == []


def test_beneath_an_exact_outline_the_table_is_looked_for_a_little_lower(segmentation_of):
    """The network's object goes on for some pixels below the exact outline."""
    working, segmentation = segmentation_of([[(square(20, 40, 80, 23), RED, OTHER)]] * 12)
    seen = large(square(20, 40, 80, 23), working.shape)
    exact = seen.copy()
    exact[np.flatnonzero(seen.any(1))[-4:]] = False
    table = replace(
        find_table(working.always, segmentation.early[TABLE] > 0.5),
        hull=np.zeros(working.shape, bool),
    )

    assert seen_on_table(table, exact, segmentation) < 1
    assert seen_on_table(table, exact, segmentation, gap_px=EXACT_GAP_PX) == 1
