"""What holds for all tests."""

import contextlib
import inspect
import itertools
import operator
import os
import sys
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np
import pytest
import torch
from beartype import beartype
from jaxtyping import install_import_hook

ROOT = Path(__file__).parents[1]
UNCHECKED = (
    "v2p_data.pipeline.ray_engine",
    "v2p_data.geometry.raster",
    "v2p_data.scene.fitting.cuboid_network",
    "v2p_data.scene.fitting.shape_fit",
    "v2p_data.scene.fitting.silhouette",
    "v2p_data.task.sandbox.reader",
)
"""Called ten thousand times and more a clip or a reward: checking their arguments takes as long as
their work. The first sends a function to nodes that may not have the checker."""
CHECKED_CALLS = 300
"""Arguments of a function are checked on so many calls; some are called a million times by one test."""


def _modules_of(folder: Path) -> list[str]:
    files = (p for p in folder.rglob("*.py") if p.stem != "__init__")
    return [".".join(p.relative_to(folder.parent).with_suffix("").parts) for p in files]


def checked_at_first(stub: Callable[..., object]) -> Callable[..., object]:
    """Return the check of a function's arguments, which ends itself after `CHECKED_CALLS`.

    Args:
        stub: jaxtyping's empty function with the name, place and signature of the one to check.
    """
    check, calls = beartype(stub), itertools.count(1)

    def counted(*args: object, **kwargs: object) -> object:
        if next(calls) == CHECKED_CALLS:
            with contextlib.suppress(AttributeError):  # of a function inside a function
                found = operator.attrgetter(stub.__qualname__)(sys.modules[stub.__module__])
                found = getattr(found, "fget", getattr(found, "__func__", found))
                inspect.unwrap(found).__no_type_check__ = True
        return check(*args, **kwargs)

    return counted


# Shapes and types of arguments are checked in every module that is imported from here on.
_PACKAGES = (ROOT / "v2p_data", ROOT / "policies", ROOT / "scripts/drawn_clips")
install_import_hook(
    [n for package in _PACKAGES for n in _modules_of(package) if not n.startswith(UNCHECKED)],
    f"{__name__}.{checked_at_first.__name__}",
)

# What a user has set up on this machine, such as the model that finds hands, changes no test.
os.environ["V2P_CACHE"] = str(Path(__file__).parent / "no_cache")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add where tests run that can run on a GPU."""
    parser.addoption("--device", help="of tests that can run on a GPU: cpu, cuda")


@pytest.fixture(scope="session")
def device(pytestconfig: pytest.Config) -> str:
    """Where a test runs that can run anywhere; the CPU unless `--device` says otherwise."""
    return pytestconfig.getoption("--device") or "cpu"


@pytest.fixture
def agreeing_referee(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the referee agree with every success of a task: for tests of the loops around both."""

    def agree(_: object, history: dict[str, np.ndarray]) -> np.ndarray:
        return np.ones(history["eef_pos"].shape[1], bool)

    monkeypatch.setattr("v2p_data.sim.env.verdict.referee_verdict", agree)


@pytest.fixture
def gpu(pytestconfig: pytest.Config) -> str:
    """What a test marked `gpu` compares with the CPU; `--device=cpu` tries such a test without a GPU."""
    wanted = pytestconfig.getoption("--device") or "cuda"
    if wanted.startswith("cuda") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return wanted


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest first, so that two processes end at about the same time."""
    items.sort(key=lambda item: item.get_closest_marker("e2e") is None)


if hasattr(os, "sched_getscheduler"):  # Linux
    ORDINARY = (os.sched_getscheduler(0), os.sched_getparam(0))
    """The scheduling class and priority in which the tests were started."""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(item: pytest.Item) -> Generator[None]:
        """Fail a test that leaves its process in another scheduling class, and restore the class.

        A real-time process takes the cores from the tests that run beside it, which then reach their time limit.
        """
        yield
        found = os.sched_getscheduler(0)
        if found != ORDINARY[0]:
            os.sched_setscheduler(0, *ORDINARY)
            pytest.fail(
                f"{item.name} left the process in scheduling class {found} instead of {ORDINARY[0]}. LeRobot's default"
                " codec does that as root: its encoder SVT-AV1 makes the calling thread real-time. Encode in a thread"
                " of its own, or with another codec.",
                pytrace=False,
            )
