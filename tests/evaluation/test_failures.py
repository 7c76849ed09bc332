"""What went wrong, told from motions made by hand: 40 moments (2 s), one thing, one other thing, one tool."""

from dataclasses import replace

import numpy as np
import pytest

from v2p_data.evaluation.failures import failure_kinds
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

TIME = 40
UPRIGHT, ON_ITS_SIDE = (1.0, 0.0, 0.0, 0.0), (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)


class Story:
    """One episode; the tool moves all the time, and nothing else happens unless told."""

    def __init__(self, kind: str) -> None:
        self.bundle: TaskBundle = replace(load_benchmark("insert"), kind=kind)
        names = [o.name for o in self.bundle.scene.objects]
        self.thing, self.other = names[:2]
        self.history = {"eef_pos": np.linspace([0.4, 0, 0.2], [0.6, 0, 0.2], TIME)[:, None]}
        for name, x in ((self.thing, 0.4), (self.other, 0.7)):
            self.history |= {
                f"{name}_pos": np.tile([x, 0.0, 0.02], (TIME, 1, 1)),
                f"{name}_quat": np.tile(UPRIGHT, (TIME, 1, 1)),
                f"{name}_size": np.full((TIME, 1, 3), 0.04),
                f"{name}_touched": np.zeros((TIME, 1)),
                f"{name}_grasped": np.zeros((TIME, 1)),
            }

    def touched(self, name: str, *when: int) -> "Story":
        self.history[f"{name}_touched"][slice(*when)] = 1
        return self

    def held(self, *when: int) -> "Story":
        self.history[f"{self.thing}_grasped"][slice(*when)] = 1
        return self.touched(self.thing, *when)

    def thing_at(self, x: float, *when: int) -> "Story":
        self.history[f"{self.thing}_pos"][slice(*when), :, 0] = x
        return self

    def tool_stands(self, *when: int) -> "Story":
        self.history["eef_pos"][slice(*when)] = self.history["eef_pos"][when[0]]
        return self

    def falls(self, when: int) -> "Story":
        self.history[f"{self.thing}_quat"][when:] = ON_ITS_SIDE
        return self

    def ends(self, *, broke: bool = False) -> str:
        return failure_kinds(self.bundle, self.history, np.array([broke]))[0]


def test_what_no_pad_touched_was_never_reached():
    assert Story("lift_up").ends() == "never_reached"
    assert Story("push_left").tool_stands(5, TIME).ends() == "never_reached"


def test_of_a_push_with_a_tool_it_is_the_tool_that_must_be_reached():
    story = Story("push_with")

    assert story.touched(story.thing, 5, 10).ends() == "never_reached"
    assert story.touched(story.other, 5, 10).ends() == "wrong_place"


def test_a_touch_in_passing_is_no_grasp():
    assert Story("lift_up").held(10, 12).ends() == "not_grasped"
    story = Story("insert")
    assert story.touched(story.thing, 5, 30).ends() == "not_grasped"


def test_what_was_held_and_is_not_at_the_end_was_dropped():
    assert Story("lift_up").held(10, 25).ends() == "dropped"
    assert Story("lift_up").held(10, TIME).ends() == "wrong_place"


@pytest.mark.parametrize(
    # Half widths are 2 cm each, so centres 0.15 m apart leave a gap of 0.11 m, and 0.13 m one of 0.09 m.
    ("x", "kind"),
    [(0.55, "dropped"), (0.57, "wrong_place")],
)
def test_what_is_let_go_on_the_way_is_dropped_and_at_the_other_object_misplaced(x, kind):
    assert Story("insert").held(10, 25).thing_at(x, 20, TIME).tool_stands(10, TIME).ends() == kind


def test_a_throw_that_misses_is_not_dropped():
    assert Story("throw_into").held(10, 25).ends() == "wrong_place"


@pytest.mark.parametrize(("since", "kind"), [(19, "stopped_halfway"), (21, "wrong_place")])
def test_a_tool_that_stands_for_the_last_second_stopped_halfway(since, kind):
    story = Story("push_left").tool_stands(since, TIME)

    assert story.touched(story.thing, 5, 10).ends() == kind


def test_what_should_stay_upright_toppled_and_what_should_not_did_not():
    assert Story("push_left").falls(20).ends() == "toppled"
    story = Story("tip_over")
    assert story.touched(story.thing, 5, 10).falls(20).ends() == "wrong_place"


def test_a_broken_simulation_is_named_and_not_looked_at():
    story = Story("push_left")
    story.history[f"{story.thing}_quat"][:] = np.nan

    assert story.ends(broke=True) == "simulation_broke"
