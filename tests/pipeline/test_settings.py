from dataclasses import dataclass, field
from typing import Literal

import pytest

from v2p_data.errors import V2PError
from v2p_data.pipeline.settings import load_settings


@dataclass(frozen=True, kw_only=True)
class Depth:
    max_depth_m: float = 3.0
    mode: Literal["near", "far"] = "near"


@dataclass(frozen=True, kw_only=True)
class All:
    depth: Depth = field(default_factory=Depth)
    size: tuple[int, int] = (1, 2)
    name: str | None = None


def written(tmp_path, text):
    path = tmp_path / "quick.yaml"
    path.write_text(text)
    return path


def test_a_file_overrides_only_what_it_names(tmp_path):
    settings = load_settings(written(tmp_path, "depth: {max_depth_m: 2}\nsize: [3, 4]"), All)

    assert settings == All(depth=Depth(max_depth_m=2.0), size=(3, 4))
    assert isinstance(settings.depth.max_depth_m, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "depth: {max_deph_m: 2}",
            r"'max_deph_m' is not in .*:depth\. Did you mean 'max_depth_m'",
        ),
        ("depth: {max_depth_m: 3e-4}", "write 3.0e-4"),
        ("depth: {mode: farr}", "Did you mean 'far'"),
        ("size: [1]", "must have 2 entries"),
        ("size: {", "not valid YAML"),
        ("- 1", "must hold settings"),
        ("name: 3", "must be str"),
    ],
)
def test_a_mistake_is_named_with_its_place(tmp_path, text, message):
    with pytest.raises(V2PError, match=message):
        load_settings(written(tmp_path, text), All)
