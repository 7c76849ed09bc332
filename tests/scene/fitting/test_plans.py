"""What each kind of task says of the fit, written out by hand."""

import pytest

from v2p_data.kinds import KINDS
from v2p_data.scene.fitting.plans import FitPlan, plan_of

PUSH = FitPlan(slides=True)
BY_HAND = {
    "lift_up": FitPlan(end="in_air"),
    "tip_over": FitPlan(end="tipped"),
    "push_left": PUSH,
    "push_right": PUSH,
    "push_next_to": PUSH,
    "slide_to": PUSH,
    "push_with": PUSH,
    "drop_in_front_of": FitPlan(may_end_held=True),
    "insert": FitPlan(goal="inside", may_be_hidden=True),
    "throw_into": FitPlan(goal="inside", may_be_hidden=True),
    "place_onto": FitPlan(goal="inside"),
    "cover": FitPlan(goal="on_top", mouth_first="down_or_up", mouth_last="down"),
    "uncover": FitPlan(
        may_end_held=True, starts_on_other=True, mouth_first="down", mouth_last="down_or_up"
    ),
    "generic": FitPlan(may_end_held=True),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_fitted_as_its_row_says(kind):
    assert plan_of(kind) == BY_HAND[kind]
