import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.confidence import by_stage, check_confidence
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import Cue
from v2p_data.scene.reconstruct import reconstruct

CUES = (
    Cue(stage="grounding", what="finding 'cup'", value=0.8),
    Cue(stage="grounding", what="colour of 'cup'", value=0.95),
    Cue(stage="pose", what="'cup' seen at the end", value=1.0),
)


def rebuild(clip, **settings):
    return reconstruct(clip, SceneConfig(**settings), np.random.default_rng(0))


def test_a_scene_is_as_sure_as_the_product_of_its_cues():
    assert check_confidence(CUES, 0.5) == pytest.approx(0.76)


def test_each_stage_says_what_made_it_unsure():
    stages = by_stage(CUES)

    assert stages["grounding"] == (pytest.approx(0.76), "finding 'cup': 0.80")
    assert stages["pose"] == (1.0, "")


def test_an_unsure_scene_is_turned_away_with_its_weakest_cue():
    with pytest.raises(
        ItemRejectedError, match=r"0\.760, below 0\.9; weakest is finding 'cup'"
    ) as caught:
        check_confidence(CUES, 0.9)

    assert caught.value.reason == "low_confidence"


def test_an_unsure_scene_says_what_a_person_can_do_about_the_weakest_cues_that_suffice():
    """0.8 * 0.7 * 0.9 = 0.504; without the weakest it is 0.72, without the two weakest 0.9."""
    cues = (
        Cue(stage="grounding", what="finding 'cup'", value=0.8, advice="mark 'cup' with a box"),
        Cue(stage="shape", what="'cup' is clear", value=0.7),
        Cue(stage="size", what="size of 'cup'", value=0.9, advice="give its size_m"),
    )

    for least, helps in (
        (0.6, "what helps: mark 'cup' with a box$"),
        (0.68, "with a box; give its size_m$"),
        (0.75, "give its size_m; even so"),
    ):
        with pytest.raises(ItemRejectedError, match=helps):
            check_confidence(cues, least)
    with pytest.raises(ItemRejectedError, match="no mark or measure"):
        check_confidence(cues[1:2], 0.75)


def test_a_caption_that_names_another_colour_than_what_moves_is_turned_away(draw):
    clip = draw(caption="Pushing red mug from right to left", objects=("red mug",))

    with pytest.raises(ItemRejectedError) as caught:
        rebuild(clip)

    assert caught.value.reason in ("object_not_found", "low_confidence")


@pytest.mark.long
def test_without_the_gate_the_same_clip_goes_through(draw):
    clip = draw(caption="Pushing red mug from right to left", objects=("red mug",))

    made = reconstruct(clip, SceneConfig().without_gate(), np.random.default_rng(0))

    assert made.confidence < 0.6
    assert "colour" in made.stages["grounding"][1]
