"""Episodes on disk: whole or absent, and the same bytes every time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.errors import V2PError


def test_an_episode_is_read_back_as_it_was_written(tmp_path: Path, make_episode):
    episode = make_episode(1)

    again = Episode.load(episode.save(tmp_path))

    for name in Episode.__dataclass_fields__.keys() - {"simulated"}:
        assert np.array_equal(getattr(again, name), getattr(episode, name)), name
    for name, values in episode.simulated.items():
        assert np.array_equal(again.simulated[name], values), name


def test_the_same_episode_has_the_same_bytes(tmp_path: Path, make_episode):
    first = make_episode(0).save(tmp_path / "a").read_bytes()

    assert make_episode(0).save(tmp_path / "b").read_bytes() == first


def test_nothing_but_the_finished_file_remains(tmp_path: Path, make_episode):
    make_episode(0).save(tmp_path)

    assert [p.name for p in tmp_path.iterdir()] == ["toy_00000.npz"]


def test_columns_of_different_lengths_are_refused(make_episode):
    episode = make_episode(0)

    with pytest.raises((ValueError, TypeError), match=r"(?i)differ in length|type-check error"):
        replace(episode, state=episode.state[:-1])


def test_a_damaged_file_is_named_with_what_to_do(tmp_path: Path, make_episode):
    path = make_episode(0).save(tmp_path)
    path.write_bytes(path.read_bytes()[:500])

    with pytest.raises(V2PError, match=r"toy_00000.npz cannot be read .* delete it"):
        Episode.load(path)


def test_staged_episodes_come_in_the_order_of_their_ids(tmp_path: Path, make_episode):
    for number in (2, 0, 1):
        make_episode(number).save(tmp_path / "episodes")
    (tmp_path / "episodes/toy_00009.npz.tmp").write_bytes(b"half")

    assert [p.stem for p in staged_episodes(tmp_path)] == ["toy_00000", "toy_00001", "toy_00002"]
