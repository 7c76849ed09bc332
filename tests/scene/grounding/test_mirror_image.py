"""A second search in the mirror image of a clip: what it finds is where it was filmed."""

from dataclasses import replace

import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene import reconstruct as steps
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.grounding.ground_objects import ground_objects
from v2p_data.scene.grounding.mirror_image import (
    as_filmed,
    has_marks,
    mirrored_clip,
    mirrored_meaning,
)
from v2p_data.scene.reconstruct import prepared_for, reconstruct_prepared
from v2p_data.video.meaning import parse_caption

CFG = SceneConfig(min_confidence=0.3)


@pytest.fixture(scope="module")
def prepared(draw):
    return prepared_for(draw(num_frames=24), CFG)


@pytest.fixture
def searches(monkeypatch):
    """Let the search in the clip as filmed fail, and count all searches."""
    seen = []

    def search(prepared, meaning, cfg):
        seen.append(meaning.kind)
        if len(seen) == 1:
            raise ItemRejectedError("object_not_found", "not found as filmed", 0.1)
        return original(prepared, meaning, cfg)

    original = steps._grounded
    monkeypatch.setattr(steps, "_grounded", search)
    return seen


def rebuilt(prepared, cfg=CFG):
    return reconstruct_prepared(prepared, cfg, np.random.default_rng(0))


def test_objects_table_and_probabilities_of_the_mirror_image_are_turned_back(prepared):
    meaning = parse_caption(prepared.clip.caption, prepared.clip.objects)
    mirrored = mirrored_clip(prepared)

    def found_in(there, told):
        return ground_objects(there.clip, there.working, told, there.segmentation, 0.0)

    straight = found_in(prepared, meaning)
    turned = as_filmed(found_in(mirrored, mirrored_meaning(meaning)), prepared.working)

    for end in ("first", "last"):
        masks = [getattr(seen.objects[0], end) for seen in (straight, turned)]
        assert iou(*masks) > 0.8
    assert iou(straight.table.hull, turned.table.hull) > 0.9
    assert np.abs(straight.segmentation.shares - turned.segmentation.shares).mean() < 0.05
    np.testing.assert_array_equal(turned.working.rgb, prepared.working.rgb)


def test_what_was_not_found_as_filmed_is_searched_in_the_mirror_image(prepared, searches):
    scene = rebuilt(prepared)
    box = scene.objects[0]

    assert searches == ["push_left", "push_right"]
    assert scene.kind == "push_left"
    move = box.T_world_objs[-1][:3, 3] - box.T_world_objs[0][:3, 3]
    np.testing.assert_allclose(move[:2] / box.size_m[0], [0, 0.16 / 0.09], atol=0.5)


def test_where_both_searches_fail_the_first_one_says_why(prepared, searches):
    with pytest.raises(ItemRejectedError, match="not found as filmed"):
        rebuilt(prepared, replace(CFG, min_found=0.999))
    assert len(searches) == 2


def test_what_somebody_clicked_is_searched_once(prepared, searches):
    hints = {"blue box": {"click": [120.0, 150.0]}}
    marked = replace(prepared, clip=replace(prepared.clip, hints=hints))

    with pytest.raises(ItemRejectedError, match="not found as filmed"):
        rebuilt(marked)

    assert len(searches) == 1


@pytest.mark.parametrize(
    ("hint", "is_mark"), [({"stroke": [[1.0, 2.0]]}, True), ({"size_m": [0.1, 0.1, 0.1]}, False)]
)
def test_only_what_tells_a_place_is_a_mark(prepared, hint, is_mark):
    assert has_marks(replace(prepared.clip, hints={"blue box": hint})) == is_mark
