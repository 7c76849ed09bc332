"""The scenes of the tests of tasks, and the code printed in the paper."""

import runpy
from pathlib import Path

import pytest

from v2p_data.task.templates.write import write_samples

TASK_TESTS = Path(__file__).parents[1] / "task"
_scenes = runpy.run_path(str(TASK_TESTS / "conftest.py"))
scene_of = _scenes["scene_of"]
make_thing = _scenes["make_thing"]
OBJECTS = _scenes["OBJECTS"]
PAPER = runpy.run_path(str(TASK_TESTS / "test_paper_code.py"))["CODES"]


@pytest.fixture(scope="session")
def scenes(scene_of, make_thing):
    """A scene of every kind."""
    tool = make_thing("rod", (0.03, 0.2, 0.03), (0, -0.2, 0.015), role="tool")
    bowl = make_thing("bowl", (0.16, 0.16, 0.06), (0.2, 0.2, 0.03), role="container")
    more = {
        "slide_to": OBJECTS["push_next_to"],
        "push_with": (make_thing("can", (0.06, 0.06, 0.06), (0, 0, 0.03), (0, 0.12, 0.03)), tool),
        "throw_into": (make_thing("garlic", (0.05, 0.05, 0.05), (0, 0, 0.025)), bowl),
    }
    return {kind: scene_of(kind, *things) for kind, things in (OBJECTS | more).items()}


@pytest.fixture(scope="session")
def paper_scenes(scene_of, make_thing, scenes):
    box = make_thing("storage_box", (0.3, 0.2, 0.1), (0.0, 0.3, 0.05), role="container")
    card = scene_of("lift_up", make_thing("card", (0.06, 0.09, 0.01), (0, 0, 0.005)))
    fork = make_thing("fork", (0.02, 0.18, 0.02), (0, 0, 0.01))
    return {
        "figure 7": scene_of("insert", fork, box),
        "figure 8": scenes["throw_into"],
        "figure 11.1": card,
        "figure 11.2": card,
    }


@pytest.fixture(scope="session")
def codes(scenes, paper_scenes):
    """Task codes of every kind and of the paper, each with its scene."""
    templates = {
        f"{kind} {i}": (code, scene)
        for kind, scene in scenes.items()
        for i, code in enumerate(write_samples(scene))
    }
    return templates | {name: (code, paper_scenes[name]) for name, code in PAPER.items()}
