"""Episodes of a dataset come back from their seeds and actions, and a changed one does not."""

import json
import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import toy_run

from v2p_data.episodes.dataset.features import ACTION_KEY, METADATA_FILE
from v2p_data.episodes.replay import replay
from v2p_data.errors import V2PError

pytestmark = pytest.mark.slow


@pytest.fixture
def dataset(agreeing_referee, finished):
    return toy_run.dataset_of(finished)


@pytest.fixture
def copied(dataset, tmp_path):
    return shutil.copytree(dataset, tmp_path / "dataset")


def test_every_episode_comes_back_with_the_same_states_on_any_number_of_threads(dataset):
    once, again = replay(dataset), replay(dataset, num_threads=3)

    assert len(once.episodes) == toy_run.EPISODES.num_episodes
    assert once.is_same
    assert max(e.state_error for e in once.episodes) == 0
    assert again == once


def test_an_episode_whose_rewards_were_changed_does_not_come_back(copied):
    (path,) = copied.glob("data/*/*.parquet")
    table = pq.read_table(path)
    k = table.column_names.index("next.reward")
    rewards = table["next.reward"].to_numpy().copy()
    rewards[0] += 0.5
    pq.write_table(table.set_column(k, table.schema.field(k), pa.array(rewards)), path)

    report = replay(copied)

    assert [e.is_same for e in report.episodes] == [False, True, True]
    assert report.episodes[0].reward_error == pytest.approx(0.5)
    assert report.episodes[0].state_error == 0


def test_an_episode_whose_actions_were_changed_does_not_come_back(copied):
    (path,) = copied.glob("data/*/*.parquet")
    table = pq.read_table(path)
    actions = [[-x for x in row] for row in table[ACTION_KEY].to_pylist()]
    first = table["episode_index"].to_pylist().count(0)
    changed = actions[:first] + table[ACTION_KEY].to_pylist()[first:]
    column = pa.array(changed, table.schema.field(ACTION_KEY).type)
    k = table.column_names.index(ACTION_KEY)
    pq.write_table(table.set_column(k, table.schema.field(k), column), path)

    report = replay(copied)

    assert [e.is_same for e in report.episodes] == [False, True, True]
    assert report.lines()[0].startswith("episode 0 (toy): states differ by up to 0.")
    assert report.lines()[-1].startswith("2 of 3 episodes came back")


def test_an_episode_that_outlasts_its_task_does_not_come_back(copied):
    task = json.loads((copied / "v2p/tasks/toy/task.json").read_text())
    (copied / "v2p/tasks/toy/task.json").write_text(json.dumps({**task, "horizon_steps": 3}))

    report = replay(copied)

    assert not any(e.same_success for e in report.episodes)


def test_another_version_of_mujoco_is_named_with_file_and_field(copied):
    about = json.loads((copied / METADATA_FILE).read_text())
    about["provenance"]["packages"]["mujoco"] = "2.0.0"
    (copied / METADATA_FILE).write_text(json.dumps(about))

    note = replay(copied, num_episodes=1).note

    assert note.startswith("meta/v2p.json:provenance.packages.mujoco is 2.0.0, this is ")


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda about: about["provenance"]["items"].clear(), "does not say under what 'toy' was"),
        (
            lambda about: about["provenance"]["items"]["toy"]["recipe"]["config"]["config"].update(
                new=1
            ),
            "setting 'new' is not in meta/v2p.json",
        ),
        (lambda about: [e.update(source="handover") for e in about["episodes"]], "handovers only"),
        (
            lambda about: about["provenance"]["items"]["toy"]["recipe"]["config"]["config"].update(
                batch_worlds=10**9
            ),
            "batch_worlds is 1000000000; at most 4096",
        ),
        *(
            (
                lambda about, new=new: about["provenance"]["items"]["toy"]["recipe"]["config"][
                    "config"
                ].update(randomization=new),
                f"{next(iter(new))} is",
            )
            for new in (
                {"arm_pos_m": [1e9, 0.0, 0.0]},
                {"arm_pos_m": [0.0, -0.1, 0.0]},
                {"delay_s": [0.02, 0.01]},
                {"object_pos_m": 1e9},
                {"action_noise": 1e300},
                {"size_scale": [float("nan"), 1.0]},
                {"mass_scale": [1.0, 1e9]},
            )
        ),
        (
            lambda about: about["provenance"]["items"]["toy"]["recipe"]["config"]["config"].update(
                randomization={"arm_pos_m": [0.9, 0.9, 0.9]}
            ),
            "out of the arm's reach",
        ),
        (
            lambda about: [e.update(item="../toy") for e in about["episodes"]],
            "'item', the plain name of a folder, of episode 0",
        ),
    ],
)
def test_what_cannot_be_replayed_is_refused_in_a_sentence(copied, spoil, sentence):
    about = json.loads((copied / METADATA_FILE).read_text())
    spoil(about)
    (copied / METADATA_FILE).write_text(json.dumps(about))

    with pytest.raises(V2PError, match=sentence):
        replay(copied)


def test_a_dataset_of_somebody_else_is_refused(copied):
    (copied / METADATA_FILE).unlink()

    with pytest.raises(V2PError, match="v2p did not make this dataset"):
        replay(copied)
