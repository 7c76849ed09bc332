from dataclasses import dataclass
from pathlib import Path

import pytest

from v2p_data.pipeline.fingerprint import canonical_json, fingerprint


@dataclass(frozen=True)
class Recipe:
    steps: int = 1
    names: tuple[str, ...] = ("a", "b")


def test_equal_recipes_have_one_fingerprint_whatever_the_order_of_their_keys():
    assert fingerprint({"a": 1, "b": (2, 3)}) == fingerprint({"b": [2, 3], "a": 1})


def test_a_changed_value_changes_the_fingerprint():
    assert fingerprint(Recipe()) != fingerprint(Recipe(steps=2))


def test_paths_are_written_the_same_on_every_system():
    assert canonical_json(Path("a") / "b") == '"a/b"'


@pytest.mark.parametrize("value", [lambda: 1, object(), float("nan"), {1: 2}, {1}])
def test_values_without_a_stable_form_are_refused(value):
    with pytest.raises(TypeError):
        canonical_json(value)


def test_a_known_recipe_keeps_its_name_over_releases():
    # sha256 of {"a":1} begins with 015abd7f
    assert fingerprint({"a": 1}) == "015abd7f"
