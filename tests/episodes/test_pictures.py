"""What is drawn beside the task: distractors that nothing comes near, looks, RGB, faults; each noted."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from toy_task import act, bundle, collect_toys, lesson

from v2p_data.episodes.collect import CutConfig, EpisodesConfig, roll_out
from v2p_data.episodes.dataset.encoding import decode_rgb
from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.errors import V2PError
from v2p_data.play import StateActor
from v2p_data.seeds import rng_for
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.render.appearance import DistractorConfig, LookConfig, furnish
from v2p_data.sim.render.masks import MaskRenderer

PLAIN = EpisodesConfig(num_episodes=2, batch_worlds=3, max_batches=2, size_px=64)
SOME = DistractorConfig(count=(3, 5), size_m=(0.05, 0.1))


def episodes(folder: Path, cfg: EpisodesConfig) -> list[Episode]:
    collect_toys(folder, cfg)
    return [Episode.load(path) for path in staged_episodes(folder)]


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> list[Episode]:
    return episodes(tmp_path_factory.mktemp("plain"), PLAIN)


@pytest.fixture(scope="module")
def rollouts():
    toy = lesson(StateActor(act))
    return roll_out(toy, SimConfig(fine=True), num_worlds=3, seed=4, cut=CutConfig())


def needs_opengl(rollouts) -> None:
    with MaskRenderer(bundle(), 64) as renderer:
        try:
            renderer.draw_rgb(rollouts.snapshots[0], 0)
        except V2PError as error:
            pytest.skip(str(error))


def test_distractors_hide_and_are_never_a_label(plain: list[Episode], tmp_path: Path):
    cluttered = episodes(tmp_path, replace(PLAIN, distractors=SOME))

    for before, after in zip(plain, cluttered, strict=True):
        changed = before.labels != after.labels
        assert (after.labels[changed] == 0).all()
        assert (before.action == after.action).all()
        assert 3 <= len(after.params["distractors"]) <= 5
        assert "distractors" not in before.params


def test_nothing_comes_near_a_distractor_in_the_whole_episode(rollouts):
    world = int(rollouts.num_frames.argmax())
    course = list(rollouts.snapshots[: rollouts.num_frames[world]])

    scene = furnish(bundle(), course, world, SOME, LookConfig(), rng_for(5, "furnish"))

    model = scene.world.model
    data = mujoco.MjData(model)
    placed = [t for t in scene.drawn["distractors"] if t["pos_m"]]
    things = [model.geom(t["name"]).id for t in placed]
    solid = [g for g in range(model.ngeom) if model.geom_contype[g] and g not in things]
    table = model.geom("table").id
    assert placed
    for moment in course[::4]:
        scene.moment(moment, world).write(model, data, 0)
        for thing in things:
            gaps = [
                mujoco.mj_geomDistance(model, data, thing, g, 0.02, None)
                for g in solid
                if g != table
            ]
            assert min(gaps) > 0.009
            # It stands on the table.
            assert abs(mujoco.mj_geomDistance(model, data, thing, table, 0.02, None)) < 1e-4


def test_the_same_episode_gets_the_same_distractors(rollouts):
    course = list(rollouts.snapshots[:10])

    one, again, other = (
        furnish(bundle(), course, 0, SOME, LookConfig(), rng_for(seed, "furnish")).drawn
        for seed in (1, 1, 2)
    )

    assert one == again != other


@pytest.mark.slow  # video means LeRobot's import
def test_pictures_in_colour_come_beside_exact_masks(
    plain: list[Episode], rollouts, tmp_path: Path
):
    needs_opengl(rollouts)
    look = LookConfig(light=0.3, colour=0.3, texture=1.0)

    both = episodes(tmp_path, replace(PLAIN, render="both", look=look))

    for masks, coloured in zip(plain, both, strict=True):
        pictures = decode_rgb(coloured.rgb_mp4)
        assert coloured.cameras == ("mask", "rgb")
        assert (coloured.labels == masks.labels).all()
        assert pictures.shape == (*masks.labels.shape, 3)
        assert pictures.std() > 10
    one, other = (e.params["look"]["rgb"]["table"] for e in both)
    assert np.shape(one) == (2, 3)  # the pattern's two colours
    assert one != other


def test_a_look_without_colours_to_see_it_is_refused():
    with pytest.raises(ValueError, match="set render to rgb or both"):
        EpisodesConfig(look=LookConfig(light=0.1))


def test_odd_pictures_are_refused():
    with pytest.raises(ValueError, match="even"):
        EpisodesConfig(size_px=65)
