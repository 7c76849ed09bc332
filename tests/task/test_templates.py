import pytest

from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.sandbox.smoke import smoke_run_all
from v2p_data.task.task import BASE_OBSERVATION_DIM
from v2p_data.task.templates.draft import Measured
from v2p_data.task.templates.variants import NUM_VARIANTS
from v2p_data.task.templates.write import write_samples

SIX_PARTS = (
    "scene_info = {",
    "def reset_objects_states(self, env_ids):",
    "def compute_success(self, states):",
    "def compute_observation_key(self, states):",
    "def get_observation_space(self):",
    "def compute_reward(self, actions, states):",
    "def reward_function(actions, states):",
)
KINDS = [
    "lift_up",
    "push_left",
    "push_right",
    "tip_over",
    "push_next_to",
    "insert",
    "place_onto",
    "drop_in_front_of",
    "cover",
    "uncover",
    "generic",
]


@pytest.mark.parametrize("kind", KINDS)
def test_every_sample_has_the_papers_six_parts_and_passes_the_reader(kind, scene_of):
    for code in write_samples(scene_of(kind)):
        check_code(code)
        assert all(part in code for part in SIX_PARTS)
        assert "# Chain of Thoughts for reward designs:" in code


@pytest.mark.parametrize("kind", KINDS)
def test_samples_differ_in_reward_and_in_success(kind, scene_of):
    codes = write_samples(scene_of(kind))
    rewards = {c.split("def reward_function")[1] for c in codes}
    successes = {c.split("def compute_success")[1].split("def compute_reward")[0] for c in codes}

    assert len(set(codes)) == len(rewards) == NUM_VARIANTS
    assert len(successes) >= 4


@pytest.mark.slow
def test_every_sample_of_every_kind_with_two_objects_runs(scene_of):
    kinds = [
        "insert",
        "place_onto",
        "drop_in_front_of",
        "cover",
        "uncover",
        "throw_into",
        "slide_to",
        "push_with",
    ]
    objects = scene_of("insert").objects
    codes = [c for kind in kinds for c in write_samples(scene_of(kind, *objects))]

    results = smoke_run_all(codes, scene_of("insert"))

    assert {r.error for r in results} == {""}
    assert {r.observation_dim for r in results} >= {
        BASE_OBSERVATION_DIM + more for more in (0, 1, 3)
    }


def test_thresholds_follow_the_videos_motion(scene_of, make_thing):
    def way(metres):
        book = make_thing("book", (0.1, 0.1, 0.03), (0, 0, 0.015), (0, metres, 0.015))
        code = write_samples(scene_of("push_left", book))[0]
        return float(code.split("is_there = moved > ")[1].split("\n")[0])

    assert way(0.2) == pytest.approx(0.12)
    assert way(0.05) == 0.08
    assert way(0.9) == 0.15


def test_words_of_a_caption_cannot_break_out_of_the_code(scene_of):
    caption = 'Lift """ + open("x") \\ \n the "red" box: 100 % of {it}'
    code = write_samples(scene_of("lift_up", description=caption))[0]

    check_code(code)
    assert class_name(code).isidentifier()


def test_a_task_that_needs_a_second_object_falls_back_to_the_tracked_motion(scene_of, make_thing):
    alone = make_thing("box", (0.05, 0.05, 0.05), (0, 0, 0.025), (0.1, 0.1, 0.03))

    assert "goal_point" in write_samples(scene_of("insert", alone))[0]


def test_the_motion_is_measured_from_the_first_pose(scene_of):
    measured = Measured.of(scene_of("lift_up"))

    assert measured.move_m == pytest.approx((0.02, 0.01, 0.175))
    assert measured.lift_m == pytest.approx(0.175)
