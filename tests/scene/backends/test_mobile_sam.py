"""MobileSAM: published names load, prompts come out in working pixels, and nothing wrong is taken for its weights."""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from v2p_data.errors import V2PError
from v2p_data.scene.backends import mobile_sam_setup
from v2p_data.scene.backends.config import OutlineConfig
from v2p_data.scene.backends.mobile_sam import MobileSam
from v2p_data.scene.backends.outlines import EncodedPicture, Outlines, Spots
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.frames.outliner import Outliner
from v2p_data.scene.reconstruct import prepared_for

PUBLISHED = json.loads((Path(__file__).parent / "mobile_sam_tensors.json").read_text())
"""Name and shape of each tensor of the published checkpoint."""
IOU_HEAD = "mask_decoder.iou_prediction_head.layers"
BOX = (20.0, 30.0, 120.0, 200.0)
CLICKS = (
    Spots(on=((40.0, 60.0),)),
    Spots(on=((40.0, 60.0), (200.0, 20.5)), off=((300.0, 230.0),)),
    Spots(on=((160.5, 120.0),), off=((10.0, 10.0), (310.0, 10.0), (10.0, 230.0))),
)
"""In pixels of 320 x 240."""


def tensors() -> dict[str, torch.Tensor]:
    """Return random tensors with the published names and shapes, scaled such that prompts still tell at the end."""
    source = torch.Generator().manual_seed(0)
    made: dict[str, torch.Tensor] = {}
    for name, shape in PUBLISHED.items():
        values = torch.randn(shape, generator=source)
        if not shape:
            made[name] = torch.tensor(0)
        elif len(shape) == 1:
            about = 1.0 if name.endswith(("weight", "running_var")) else 0.0
            made[name] = about + 0.05 * values.clamp(-2, 2)
        elif "embed" in name or "token" in name.split(".")[-2] or "gaussian" in name:
            made[name] = values
        else:
            made[name] = values / values[0].numel() ** 0.5
    made[f"{IOU_HEAD}.1.weight"] *= 0  # its answer is then known without the rest
    return made


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("mobile_sam") / "mobile_sam.safetensors"
    save_file(tensors(), path)
    return path


@pytest.fixture(scope="module")
def model(weights) -> MobileSam:
    return MobileSam(weights)


@pytest.fixture(scope="module")
def encoded(model) -> EncodedPicture:
    return model.encode(np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8))


def test_a_picture_becomes_the_features_that_the_decoder_takes(encoded):
    assert encoded.features.shape == (1, 256, 64, 64)
    assert bool(torch.isfinite(encoded.features).all())
    # What lies below the picture is padding; the picture itself is not.
    assert float(encoded.features[0, :, :40].std()) > 0


def test_estimated_overlaps_come_from_the_published_perceptron(model, encoded):
    given = tensors()
    hidden = given[f"{IOU_HEAD}.1.bias"].clamp(min=0)
    expected = given[f"{IOU_HEAD}.2.weight"] @ hidden + given[f"{IOU_HEAD}.2.bias"]

    out = model.outlines(encoded, CLICKS, (240, 320))

    # The first of four is for prompts with one answer.
    np.testing.assert_allclose(out.ious, np.tile(expected[1:], (3, 1)), atol=1e-5)


def test_outlines_come_at_the_size_whose_pixels_the_prompts_are_in(model, encoded):
    twice = [
        Spots(
            on=tuple((2 * u, 2 * v) for u, v in p.on), off=tuple((2 * u, 2 * v) for u, v in p.off)
        )
        for p in CLICKS
    ]

    small = model.outlines(encoded, CLICKS, (240, 320))
    large = model.outlines(encoded, twice, (480, 640))

    assert small.logits.shape == (3, 3, 240, 320)
    assert large.masks.shape == (3, 3, 480, 640)
    assert small.logits.std() > 0
    pooled = large.logits.reshape(3, 3, 240, 2, 320, 2).mean((3, 5))
    # The decoder's planes have 256 columns, so that both sizes interpolate them.
    assert np.corrcoef(pooled.ravel(), small.logits.ravel())[0, 1] > 0.99


def test_prompts_with_more_and_fewer_points_are_answered_together_as_one_by_one(model, encoded):
    prompts = [*CLICKS, Spots(box_xyxy=BOX), Spots(box_xyxy=BOX, on=((60.0, 100.0),))]
    together = model.outlines(encoded, prompts, (240, 320)).logits

    alone = [model.outlines(encoded, [p], (240, 320)).logits[0] for p in prompts]

    spread = float(together.std())
    for one, other in itertools.pairwise(alone):
        assert np.abs(one - other).mean() > 0.01 * spread
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-3 * spread)


def test_the_published_file_of_torch_is_read_too(weights, model, encoded, tmp_path):
    path = tmp_path / "mobile_sam.pt"
    torch.save(tensors(), path)

    again = MobileSam(path).outlines(encoded, CLICKS, (240, 320))

    np.testing.assert_array_equal(again.logits, model.outlines(encoded, CLICKS, (240, 320)).logits)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("mobile_sam.safetensors", "cut off"),
        ("mobile_sam.safetensors", b""),
        ("mobile_sam.pt", b"not a model"),
        ("mobile_sam.pt", b""),
        ("mobile_sam.safetensors", {"other": torch.zeros(3)}),
        ("mobile_sam.safetensors", "one tensor less"),
        ("mobile_sam.safetensors", "not finite"),
        ("mobile_sam.safetensors", None),
    ],
)
def test_a_file_that_is_not_mobile_sam_is_one_sentence(weights, tmp_path, name: str, content):
    path = tmp_path / name
    if content == "cut off":
        content = weights.read_bytes()[:100_000]
    if content == "one tensor less":
        content = tensors()
        del content["image_encoder.neck.0.weight"]
    if content == "not finite":
        content = {name: tensor * torch.nan for name, tensor in tensors().items()}
    if isinstance(content, dict):
        save_file(content, path)
    elif content is not None:
        path.write_bytes(content)

    with pytest.raises(
        V2PError, match=r"does not hold MobileSAM's weights .* run 'v2p setup outlines'"
    ):
        MobileSam(path)


class Asked:
    """A model that keeps what it is asked."""

    def __init__(self) -> None:
        self.pictures: list[np.ndarray] = []

    def encode(self, picture: np.ndarray) -> EncodedPicture:
        self.pictures.append(picture)
        return EncodedPicture(features=torch.zeros(1, 256, 64, 64))

    def outlines(
        self, picture: EncodedPicture, prompts: Sequence[Spots], size_px: tuple[int, int]
    ) -> Outlines:
        n = len(prompts)
        return Outlines(
            logits=np.zeros((n, 3, *size_px), np.float32), ious=np.zeros((n, 3), np.float32)
        )


def test_the_model_sees_each_frame_of_the_clip_once_and_at_full_size():
    model = Asked()
    frames = np.arange(10, dtype=np.uint8)[:, None, None, None].repeat(48, 1).repeat(64, 2)
    frames = frames.repeat(3, 3)
    outliner = Outliner(model, frames, np.array([0, 4, 9]), (24, 32))

    outliner.at(1, CLICKS)
    outliner.at(1, CLICKS[:1])
    last = outliner.at(-1, CLICKS)
    outliner.at(2, CLICKS)

    assert [int(p[0, 0, 0]) for p in model.pictures] == [4, 9]
    assert model.pictures[0].shape == (48, 64, 3)
    assert last.masks.shape == (3, 3, 24, 32)


def test_a_prepared_clip_has_the_model_where_it_is_asked_for(weights, draw):
    clip = draw(num_frames=12)
    outline = OutlineConfig(backend="mobile_sam", weights=weights)
    cfg = SceneConfig(outline=outline)

    working = prepared_for(clip, cfg).working

    assert working.outliner is not None
    out = working.outliner.at(0, [Spots(on=((100.0, 100.0),))])
    assert out.masks.shape == (1, 3, *working.shape)


def test_the_real_model_outlines_a_box_on_a_table(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("V2P_CACHE")
    weights = mobile_sam_setup.installed_weights()
    if weights is None:
        pytest.skip("MobileSAM is not set up here: v2p setup outlines")
    model = MobileSam(weights)
    image = np.full((240, 320, 3), 190, np.uint8)
    truth = np.zeros((240, 320), bool)
    truth[90:150, 100:190] = True
    image[truth] = (200, 40, 40)

    prompts = [Spots(on=((145.0, 120.0),)), Spots(on=((145.0, 120.0),), off=((20.0, 20.0),))]
    out = model.outlines(model.encode(image), prompts, (240, 320))

    for masks, ious in zip(out.masks, out.ious, strict=True):
        best = masks[ious.argmax()]
        assert (best & truth).sum() / (best | truth).sum() > 0.95
