"""Rounds of training and collecting: what is staged, and that a kill at any moment changes nothing."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_run
from toy_run import DISTILLATION, EPISODES, Pupil, contents
from toy_task import act

from v2p_data.distillation import rounds
from v2p_data.distillation.rounds import Course, distill, handover_episodes, take_in
from v2p_data.episodes import rollouts
from v2p_data.episodes.staging import Episode
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.play import StateActor


class Killed(Exception):  # noqa: N818 - it stands for a kill
    pass


def run(
    out: Path,
    pupil: Pupil | None = None,
    *,
    train=None,
    episodes=EPISODES,
    num_threads=1,
    cfg=DISTILLATION,
):
    pupil = pupil or Pupil()
    lessons = {"toy": rollouts.Lesson(bundle=toy_run.bundle(), expert=StateActor(act))}
    course = Course(lessons=lessons, cfg=cfg, episodes=episodes, seed=7, num_threads=num_threads)
    return distill(course, pupil, train or pupil.train, out)


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an undisturbed distillation leaves; do not write into it."""
    out = tmp_path_factory.mktemp("calm")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollouts, "referee_verdict", toy_run.agree)
        told = run(out)
    (out / "told.json").write_text(json.dumps(told.counts()))
    return out


def undisturbed(calm: Path) -> dict[str, bytes]:
    return {name: data for name, data in contents(calm).items() if name != "told.json"}


def test_successful_episodes_are_staged_with_who_acted(calm: Path):
    paths = handover_episodes(calm)
    told = json.loads((calm / "told.json").read_text())

    assert {path.parts[-3:-1] for path in paths} == {("toy", "episodes")}
    assert {path.parts[-4] for path in paths} == {"00", "01"}
    assert len({path.name for path in paths}) == len(paths) == told["episodes"]
    assert told["rollouts"] == 2 * 2 * DISTILLATION.worlds
    frames = 0
    for path in paths:
        episode = Episode.load(path)
        assert episode.is_handover
        assert episode.intervention is not None
        at = (
            int(np.argmax(episode.intervention))
            if episode.intervention.any()
            else episode.num_frames
        )
        assert episode.intervention.tolist() == [t >= at for t in range(episode.num_frames)]
        assert 3 <= at <= 15
        assert (episode.action[:, 1] > 0).all()  # the expert's, also where the student went right
        assert episode.success[-1]
        assert episode.referee
        assert episode.labels.shape[1:] == (toy_run.SIZE_PX, toy_run.SIZE_PX)
        frames += episode.num_frames
    assert frames == told["frames"]


def test_episodes_of_a_batch_are_as_many_as_succeeded(calm: Path):
    ledgers = [json.loads(p.read_text()) for p in sorted(calm.glob("rounds/*/toy/batches/*.json"))]

    assert len(ledgers) == 4
    assert all(ledger["rollouts"] == 3 for ledger in ledgers)
    assert all(len(ledger["episodes"]) == ledger["successes"] for ledger in ledgers)
    named = {name for ledger in ledgers for name in ledger["episodes"]}
    assert named == {path.stem for path in handover_episodes(calm)}
    told = json.loads((calm / "told.json").read_text())
    assert told["recovered"] == [
        round(sum(b["successes"] for b in ledgers[k : k + 2]) / 6, 4) for k in (0, 2)
    ]


def test_what_the_referee_denies_is_not_staged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rollouts, "referee_verdict", lambda b, c: np.arange(3) == 1)

    pupil = Pupil()

    told = run(tmp_path, pupil, cfg=replace(DISTILLATION, rounds=1))

    assert {int(path.stem[-5:]) % 3 for path in told.paths} <= {1}
    assert told.num_rollouts == 6
    assert {*pupil.tasks} == {"push the cube to the left"}


def test_the_number_of_threads_changes_no_byte(agreeing_referee, calm: Path, tmp_path: Path):
    run(tmp_path, num_threads=2)

    assert contents(tmp_path) == undisturbed(calm)


def test_running_again_changes_nothing_and_tells_the_same(
    agreeing_referee, calm: Path, tmp_path: Path
):
    first = run(tmp_path)
    idle = Pupil()

    again = run(tmp_path, idle)

    assert again == first
    assert idle.num_acts == 0
    assert contents(tmp_path) == undisturbed(calm)


class Clock:
    """Counts what a distillation does and kills it at one of these moments."""

    def __init__(self, patch: pytest.MonkeyPatch, kill_at: int = -1) -> None:
        self.moments: list[str] = []
        self.kill_at = kill_at
        patch.setattr(rounds, "hand_over", self.watched("hand over", rounds.hand_over))
        patch.setattr(
            rounds, "write_json_atomically", self.watched("ledger", write_json_atomically)
        )
        patch.setattr(Episode, "save", self.watched("stage", Episode.save))
        for name in ("train", "save", "load", "add"):
            patch.setattr(Pupil, name, self.watched(name, getattr(Pupil, name)))

    def watched(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **keywords: Any) -> Any:
            if len(self.moments) == self.kill_at:
                raise Killed(name)
            self.moments.append(name)
            return work(*args, **keywords)

        return wrapped


@pytest.mark.parametrize(
    ("name", "which"),
    [
        ("train", 0),  # before anything is there
        ("save", 0),
        ("hand over", 1),  # between batches
        ("stage", 1),  # in the middle of a batch
        ("ledger", 1),  # all is staged and nothing says so
        ("train", 1),  # between rounds
        ("save", 1),
        ("hand over", 3),
        ("add", 1),
    ],
)
def test_a_killed_distillation_ends_like_an_undisturbed_one(
    agreeing_referee, calm: Path, tmp_path: Path, name: str, which: int
):
    expected = undisturbed(calm)
    with pytest.MonkeyPatch.context() as patch:
        moments = Clock(patch).moments
        # The order of the moments is the same in every run, so those of one tell where to kill another.
        run(tmp_path / "watched")
    at = [k for k, moment in enumerate(moments) if moment == name][which]

    with pytest.MonkeyPatch.context() as patch:
        Clock(patch, at)
        with pytest.raises(Killed, match=name):
            run(tmp_path / "killed")
    for file in (tmp_path / "killed").glob("rounds/*/*/episodes/*.npz"):
        assert expected[str(file.relative_to(tmp_path / "killed"))] == file.read_bytes()
    run(tmp_path / "killed")

    assert contents(tmp_path / "killed") == expected


def test_half_an_episode_is_no_episode(agreeing_referee, calm: Path, tmp_path: Path):
    left = tmp_path / "rounds/00/toy/episodes/toy_handover0_00000.npz.tmp"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")

    run(tmp_path)

    assert contents(tmp_path) == undisturbed(calm)


def test_what_a_student_takes_in_is_what_was_staged(calm: Path):
    pupil = Pupil()
    paths = handover_episodes(calm)

    take_in(pupil, paths)
    take_in(pupil, [])

    (told,) = pupil.told
    loaded = [Episode.load(path) for path in paths]
    assert told.endswith(f"push the cube to the left {[e.num_frames for e in loaded]}")
