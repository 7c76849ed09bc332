from itertools import pairwise

import numpy as np
import pytest
import torch

from v2p_data.errors import V2PError
from v2p_data.scene.backends.checkpoint import load_checkpoint
from v2p_data.scene.backends.config import GroundConfig
from v2p_data.scene.backends.detect import assign, detect

RED, BROWN = (6.0, 20.0, 22.0, 36.0), (40.0, 22.0, 58.0, 38.0)


def config(checkpoint, model: str = "", **more) -> GroundConfig:
    settings = {"box_threshold": 0.0, "text_threshold": 0.0, "max_overlap": 0.9}
    settings |= {"device": checkpoint.device, **more}
    return GroundConfig(
        backend="grounding_dino", model=model or checkpoint("grounding_dino"), **settings
    )


def test_a_saved_checkpoint_finds_boxes_inside_the_picture_best_first(checkpoint, picture):
    found = detect([picture], ["red box", "brown box"], config(checkpoint))

    assert len(found) == 1
    assert [{d.phrase for d in ds} for ds in found[0]] == [{"red box"}, {"brown box"}]
    for detections in found[0]:
        boxes = np.array([d.box_xyxy for d in detections])
        assert (boxes >= 0).all()
        assert (boxes <= [64, 48, 64, 48]).all()
        assert all(a.score >= b.score for a, b in pairwise(detections[1:]))
        assert all(0 < d.score <= 1 for d in detections)


def test_the_batch_size_and_pictures_beside_change_nothing(checkpoint, picture):
    other = picture[::-1].copy()
    images = [picture, picture[:, ::-1].copy(), other]

    together = detect(images, ["red box", "cup"], config(checkpoint, batch_size=3))
    alone = [detect([i], ["red box", "cup"], config(checkpoint, batch_size=1))[0] for i in images]

    for a, b in zip(together, alone, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_allclose([d.box_xyxy for d in x], [d.box_xyxy for d in y], atol=1e-3)


def test_boxes_and_scores_are_those_that_transformers_itself_makes_of_the_output(
    checkpoint, picture
):
    loaded = load_checkpoint("grounding_dino", checkpoint("grounding_dino"), "cpu", "float32")
    inputs = loaded.processor(images=[picture], text=["cup."], return_tensors="pt")
    with torch.no_grad():
        out = loaded.model(**inputs)
    theirs = loaded.processor.post_process_grounded_object_detection(
        out, threshold=0.0, target_sizes=[(48, 64)]
    )[0]
    boxes = theirs["boxes"].numpy()

    found = detect([picture], ["cup"], config(checkpoint, max_overlap=1.0))[0][0]

    assert found
    for detection in found:
        clipped = np.clip(boxes, 0, [64, 48, 64, 48])
        off = np.abs(clipped - detection.box_xyxy).max(1)
        assert off.min() < 1e-3


def test_the_words_of_a_phrase_read_the_scores_of_their_own_tokens(checkpoint, picture, answering):
    # [CLS] red box . the brown box . [SEP]: tokens 1, 2 are the first phrase, 5, 6 the second's telling words.
    logits = torch.full((1, 2, 256), -torch.inf)
    logits[0, 0, [1, 2, 5, 6]] = torch.tensor([0.9, 0.7, 0.1, 0.7]).logit()
    logits[0, 1, [1, 2, 5, 6]] = torch.tensor([0.2, 0.6, 0.8, 0.6]).logit()
    boxes = torch.tensor([[[0.25, 0.5, 0.25, 0.5], [0.75, 0.5, 0.25, 0.5]]])
    answering(logits, boxes)

    red, brown = detect(
        [picture],
        ["red box", "the brown box"],
        config(checkpoint, box_threshold=0.3, text_threshold=0.25),
    )[0]

    assert red[0].box_xyxy == pytest.approx((8, 12, 24, 36))
    assert red[0].score == pytest.approx(0.8)
    assert brown[0].box_xyxy == pytest.approx((40, 12, 56, 36))
    assert brown[0].score == pytest.approx(0.7)


@pytest.fixture
def answering(checkpoint, monkeypatch):
    """Let a loaded model answer given logits and boxes: the model's weights are the outside world here."""

    def answer(logits: torch.Tensor, boxes: torch.Tensor) -> None:
        loaded = load_checkpoint("grounding_dino", checkpoint("grounding_dino"), "cpu", "float32")

        def forward(**_):
            return type("Out", (), {"logits": logits, "pred_boxes": boxes})()

        monkeypatch.setattr(loaded.model, "forward", forward)

    return answer


def test_phrases_that_want_the_same_box_share_out_the_boxes_best_for_all():
    # Both phrases prefer the red box; given to the second, the sum would be 0.7 + 0.2, to the first 0.9 + 0.5.
    boxes = np.array([RED, BROWN])
    scores = np.array([[0.9, 0.7], [0.2, 0.5]])

    red, brown = assign(boxes, scores, ["red box", "brown box"], 0.7)

    assert [d.box_xyxy for d in red] == [RED]
    assert [d.box_xyxy for d in brown] == [BROWN]


def test_boxes_that_overlap_are_one_thing():
    # The shifted box has an intersection over union of 14 * 16 / (2 * 256 - 14 * 16) = 0.78.
    shifted = (8.0, 20.0, 24.0, 36.0)
    scores = np.array([[0.9, 0.0], [0.0, 0.8]])

    red, brown = assign(np.array([RED, shifted]), scores, ["red box", "brown box"], 0.7)
    apart = assign(np.array([RED, shifted]), scores, ["red box", "brown box"], 0.8)

    assert len(red) == 1
    assert brown == []
    assert [len(d) for d in apart] == [1, 1]


def test_more_text_than_the_model_reads_is_a_clear_error(checkpoint, picture):
    with pytest.raises(V2PError, match="tokens"):
        detect([picture], ["red box"] * 90, config(checkpoint))


def test_a_checkpoint_of_another_architecture_is_refused(checkpoint, picture):
    cfg = config(checkpoint, model=checkpoint("sam2"))

    with pytest.raises(V2PError, match="'sam2_video' model, but backend 'grounding_dino'"):
        detect([picture], ["cup"], cfg)


def test_a_checkpoint_that_is_not_there_is_a_clear_error(checkpoint, tmp_path, picture):
    with pytest.raises(V2PError, match="cannot be loaded"):
        detect([picture], ["cup"], config(checkpoint, model=str(tmp_path)))


def test_a_checkpoint_without_some_weights_is_refused(checkpoint, picture, tmp_path):
    from transformers import GroundingDinoForObjectDetection, GroundingDinoProcessor

    whole = checkpoint("grounding_dino")
    model = GroundingDinoForObjectDetection.from_pretrained(whole)
    weights = {k: v for k, v in model.state_dict().items() if "enc_output." not in k}
    model.save_pretrained(tmp_path, state_dict=weights)
    GroundingDinoProcessor.from_pretrained(whole).save_pretrained(tmp_path)

    with pytest.raises(V2PError, match=r"lacks \d+ weights"):
        detect([picture], ["cup"], config(checkpoint, model=str(tmp_path)))


def test_without_transformers_the_way_to_install_it_is_named(checkpoint, picture, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    load_checkpoint.cache_clear()

    with pytest.raises(V2PError, match="install it with 'make setup'"):
        detect([picture], ["cup"], config(checkpoint))
