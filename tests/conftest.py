"""What holds for all tests."""

import os
from pathlib import Path

import pytest

# What a user has set up on this machine, such as the model that finds hands, changes no test.
os.environ["V2P_CACHE"] = str(Path(__file__).parent / "no_cache")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest first, so that two processes end at about the same time."""
    items.sort(key=lambda item: item.get_closest_marker("e2e") is None)
