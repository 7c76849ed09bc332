"""What holds for all tests."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest first, so that two processes end at about the same time."""
    items.sort(key=lambda item: item.get_closest_marker("e2e") is None)
