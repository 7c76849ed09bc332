"""What the encoders compute of pictures, and what the heads say, by hand numbers."""

import numpy as np
import pytest
import torch
from torch import nn

from policies.bc.encoders import (
    DIRECTIONS,
    IMAGENET_MEAN,
    IMAGENET_STD,
    Standardiser,
    label_shares,
    labels_of,
    mask_moments,
    mask_stem,
    pixel_sums,
    pixel_sums_by_products,
    shrink,
)
from policies.bc.heads import BinnedHead

GREYS = (0, 64, 128, 192, 255)


def test_each_label_becomes_a_channel_that_holds_its_share_of_the_pixel():
    image = torch.tensor([[0, 64, 128, 128], [0, 0, 128, 255]]) / 255

    shares = label_shares(labels_of(image.expand(1, 1, 3, 2, 4), GREYS)[0], 5, 2)

    assert shares.shape == (1, 5, 1, 2)
    by_hand = torch.tensor([[0.75, 0.25, 0, 0, 0], [0, 0, 0.75, 0, 0.25]])
    torch.testing.assert_close(shares[0, :, 0].T / 255, by_hand, atol=0.5 / 255, rtol=0)


def test_a_grey_slightly_off_after_compression_keeps_its_label():
    off = labels_of(torch.full((1, 1, 3, 4, 4), 131 / 255), GREYS)

    assert (off == 2).all()


def test_bytes_and_floats_give_the_same_labels():
    greys = torch.tensor(GREYS, dtype=torch.uint8)[torch.arange(20).view(1, 1, 1, 4, 5) % 5]

    assert torch.equal(labels_of(greys, GREYS), labels_of(greys.float() / 255, GREYS))


def test_small_images_are_never_enlarged_and_large_ones_keep_their_aspect():
    assert shrink(torch.zeros(1, 3, 20, 30), 64).shape == (1, 3, 20, 30)
    assert shrink(torch.zeros(1, 3, 480, 640), 64).shape == (1, 3, 48, 64)


def test_the_mask_stem_sees_labels_as_the_pretrained_one_sees_the_grey_picture():
    rng = torch.Generator().manual_seed(0)
    weight = torch.randn(8, 3, 7, 7, generator=rng)
    labels = torch.randint(0, 5, (1, 48, 64), generator=rng, dtype=torch.uint8)
    picture = (torch.tensor(GREYS) / 255)[labels.long()][:, None].expand(-1, 3, -1, -1)
    mean, std = torch.tensor(IMAGENET_MEAN), torch.tensor(IMAGENET_STD)
    normalised = (picture - mean.view(3, 1, 1)) / std.view(3, 1, 1)

    from_labels = nn.functional.conv2d(
        label_shares(labels, 5, 64) / 255, mask_stem(weight, GREYS), padding=3
    )

    expected = nn.functional.conv2d(normalised, weight, padding=3)
    torch.testing.assert_close(from_labels, expected, rtol=1e-4, atol=1e-4)


def test_moments_measure_a_rectangle():
    labels = torch.zeros(1, 64, 64, dtype=torch.uint8)
    labels[0, 10:20, 32:48] = 2  # rows 10 to 19, columns 32 to 47
    unit = 64 / 8

    cx, cy, area, sx, sy, correlation, *reach = mask_moments(labels, 3)[0, 1].tolist()

    assert (cx, cy) == pytest.approx((8 / unit, -17 / unit))
    assert area == pytest.approx(np.sqrt(160) / (unit / 4))
    # The variance of n evenly spaced pixels is (n^2 - 1) / 12.
    assert (sx, sy) == pytest.approx(
        (np.sqrt(255 / 12) / (unit / 4), np.sqrt(99 / 12) / (unit / 4))
    )
    assert correlation == pytest.approx(0, abs=1e-6)
    corner = [7.5 * abs(np.cos(a)) + 4.5 * abs(np.sin(a)) for a in np.arange(16) * np.pi / 8]
    assert reach == pytest.approx([c / (unit / 4) for c in corner], rel=2e-3)


def test_moments_tell_which_way_a_stick_leans_and_are_zero_without_it():
    labels = torch.zeros(2, 64, 64, dtype=torch.uint8)
    for k in range(20):
        labels[0, 20 + k, 20 + k] = 1
        labels[1, 40 - k, 20 + k] = 1

    falling, rising = mask_moments(labels, 3)[:, 0, 5]

    assert falling > 1.5
    assert rising < -1.5
    assert not mask_moments(labels, 3)[:, 1].any()


def test_moments_do_not_depend_on_which_frames_are_computed_together():
    labels = torch.randint(
        0, 4, (16, 256, 256), generator=torch.Generator().manual_seed(0), dtype=torch.uint8
    )

    together = mask_moments(labels, 4)

    assert torch.equal(torch.cat([mask_moments(one[None], 4) for one in labels]), together)


def test_the_compiled_sums_and_the_matrix_products_agree():
    labels = torch.randint(
        0, 5, (3, 48, 64), generator=torch.Generator().manual_seed(0), dtype=torch.uint8
    )
    labels[2][labels[2] == 2] = 0
    y, x = np.mgrid[0:48, 0:64]

    sums = pixel_sums(labels, 4)

    for n, k in ((0, 1), (1, 3)):
        mask = labels[n].numpy() == k
        px, py = x[mask], y[mask]
        by_hand = [len(px), px.sum(), py.sum(), (px**2).sum(), (py**2).sum(), (px * py).sum()]
        by_hand += [(dx * px + dy * py).max() for dx, dy in DIRECTIONS]
        assert sums[n, k - 1].tolist() == by_hand
    assert not sums[2, 1].any()
    products = pixel_sums_by_products(labels, 4)
    seen = sums[..., 0] > 0
    assert torch.equal(products[seen], sums[seen])


def test_labels_beyond_those_that_the_network_tells_apart_count_as_none():
    labels = torch.full((1, 8, 8), 4, dtype=torch.uint8)
    labels[:, :4] = 1

    assert not mask_moments(labels, 3)[0, 1].any()
    assert label_shares(labels, 3, 8)[0, :, 6].sum() == 0


def test_the_standardiser_takes_the_mean_of_training_batches_and_leaves_it_at_inference():
    rng = torch.Generator().manual_seed(0)
    batches = [3 + 2 * torch.randn(50, 4, generator=rng) for _ in range(4)]
    layer = Standardiser(4)
    for batch in batches:
        layer(batch)
    seen = torch.cat(batches)

    torch.testing.assert_close(layer.mean, seen.mean(0), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(layer.var, seen.var(0, correction=0), rtol=1e-4, atol=1e-4)
    layer.eval()
    layer(torch.full((50, 4), 100.0))
    torch.testing.assert_close(layer.mean, seen.mean(0), rtol=1e-4, atol=1e-4)


def test_a_target_between_two_bins_is_shared_in_proportion_to_nearness():
    head = BinnedHead(5)  # levels -1, -0.5, 0, 0.5, 1
    logits = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5])

    loss = head.loss(logits[None], torch.tensor([0.125]))

    log_p = logits.log_softmax(0)
    assert float(loss) == pytest.approx(float(-0.75 * log_p[2] - 0.25 * log_p[3]), rel=1e-5)
    beyond = head.loss(logits[None], torch.tensor([7.0]))
    assert float(beyond) == pytest.approx(float(-log_p[4]), rel=1e-5)


def test_bins_choose_one_of_two_opposites_where_regression_would_answer_between():
    p = torch.tensor([0.0, 0.45, 0.0, 0.0, 0.0, 0.0, 0.55, 0.0])
    p = p.clamp(min=1e-9)

    decoded = BinnedHead(8).decode(p.log()[None])

    assert float(decoded) == pytest.approx(float(torch.linspace(-1, 1, 8)[6]), abs=1e-4)
    assert float(p @ torch.linspace(-1, 1, 8)) < 0.2


def test_a_distribution_about_one_level_decodes_to_its_mean():
    p = torch.tensor([1e-9, 0.25, 0.5, 0.25, 1e-9])

    assert float(BinnedHead(5).decode(p.log()[None])) == pytest.approx(0.0, abs=1e-5)
