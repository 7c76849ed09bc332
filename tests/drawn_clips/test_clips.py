"""Drawn clips of every kind: the truth beside them is the truth in them."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from drawn_clips.clips import (
    LABEL_HAND,
    LABEL_THING,
    MOTION_KINDS,
    motion_of,
    random_spec,
    render,
)
from drawn_clips.props import NOUNS, prop_called, shape_of
from drawn_clips.truth import load_truth, write
from v2p_data.errors import V2PError
from v2p_data.geometry.pose import apply, transform_from_pose
from v2p_data.seeds import rng_for
from v2p_data.video.captions import find_videos, parse_caption
from v2p_data.video.decode import read_clip


def corners(size_m):
    return np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * np.asarray(size_m)


def drawn(spec, **chosen):
    try:
        return render(spec, **chosen)
    except V2PError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def specs():
    return {kind: random_spec(kind, kind, rng_for(5, kind)) for kind in MOTION_KINDS}


@pytest.fixture(scope="module")
def pushed():
    spec = random_spec("pushed", "push_left", rng_for(11, "pushed"), others=0)
    view = replace(spec.view, width_px=320, height_px=240)
    return drawn(replace(spec, view=view, fps=4, sensor=replace(spec.sensor, crf=18, noise=0.5)))


def test_every_shape_is_closed_and_as_large_as_its_product():
    for noun in NOUNS:
        prop = prop_called(noun, rng_for(0, *noun.words))
        shape = shape_of(prop)
        mesh = trimesh.Trimesh(shape.vertices, shape.faces)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)

        assert mesh.is_watertight, noun
        assert mesh.volume > 0, noun
        # handles and spouts stick out; nothing is smaller than the product by more than its spread
        ratio = shape.extents[[0, 2]] * 100 / np.array(noun.size_cm)[[0, 2]]
        assert ratio.min() > 1 - 3 * noun.spread - 0.03, noun


@pytest.mark.parametrize("kind", MOTION_KINDS)
def test_the_caption_says_the_kind_and_names_the_things(kind, specs):
    spec = specs[kind]
    meaning = parse_caption(spec.caption)

    assert meaning.kind == kind
    assert meaning.phrases == spec.objects


@pytest.mark.parametrize("kind", MOTION_KINDS)
def test_nothing_sinks_into_the_table_or_jumps(kind, specs):
    spec = specs[kind]
    motion = motion_of(spec)

    for actor, track in zip(spec.story.actors, motion.T_world_things, strict=True):
        box = shape_of(actor.prop).vertices
        assert min(float((box @ T[2, :3]).min() + T[2, 3]) for T in track) > -0.003
        if actor.role != "tool":
            steps = np.linalg.norm(np.diff(track[:, :3, 3], axis=0), axis=1) * spec.fps
            assert steps.max() < 4.0  # metres a second
    assert motion.T_world_things[0, 0, :2, 3] == pytest.approx([0, 0], abs=1e-9)


@pytest.mark.parametrize("kind", MOTION_KINDS)
def test_what_the_caption_names_is_in_the_picture_at_first_and_at_last(kind, specs):
    spec = specs[kind]
    camera, motion = spec.view.camera(), motion_of(spec)

    for actor, track in zip(spec.story.actors, motion.T_world_things, strict=True):
        if actor.role in ("bystander", "tool"):
            continue
        for T in (track[0], track[-1]):
            uv = camera.project(apply(T, corners(actor.extents_m)))
            assert uv.min() > 0
            assert (uv < (camera.width_px, camera.height_px)).all()


def test_each_kind_ends_as_it_says(specs):
    ends = {kind: motion_of(spec).T_world_things[:, -1] for kind, spec in specs.items()}

    assert ends["push_left"][0, 1, 3] > 0.05
    assert ends["push_right"][0, 1, 3] < -0.05
    lifted = motion_of(specs["lift_up"]).T_world_things[0]
    assert lifted[-1, 2, 3] - lifted[0, 2, 3] > 0.05
    assert abs(ends["tip_over"][0, 2, 2]) < 1e-6  # its upright lies level
    assert np.linalg.norm(ends["uncover"][0, :2, 3] - ends["uncover"][1, :2, 3]) > 0.05
    assert ends["drop_in_front_of"][0, 0, 3] < ends["drop_in_front_of"][1, 0, 3]
    for kind in ("insert", "throw_into", "place_onto", "cover"):
        assert np.linalg.norm(ends[kind][0, :2, 3] - ends[kind][1, :2, 3]) < 0.05


def test_masks_lie_where_the_true_shape_projects(pushed):
    camera = pushed.camera
    actor = pushed.spec.story.actors[0]
    for k in (0, -1):
        pose = pushed.poses_world[0, pushed.mask_idx[k]]
        uv = camera.project(apply(transform_from_pose(pose), shape_of(actor.prop).vertices))
        rows, columns = np.nonzero(pushed.masks[k] == LABEL_THING)
        low, high = uv.min(0), uv.max(0)
        if (pushed.masks[k] == LABEL_HAND).any():
            continue
        assert np.abs([columns.min() - low[0], rows.min() - low[1]]).max() < 1.6
        assert np.abs([columns.max() + 1 - high[0], rows.max() + 1 - high[1]]).max() < 1.6


def test_a_written_clip_is_read_back_with_its_truth(pushed, tmp_path):
    path = write(pushed, tmp_path)

    (item,) = find_videos(tmp_path)
    clip, truth = read_clip(item), load_truth(tmp_path, "pushed")
    assert item.path == path == truth.video
    assert len(clip.frames) == truth.num_frames == len(truth.hand_in_view)
    assert clip.fps == pytest.approx(4)
    assert np.abs(clip.frames[0].astype(int) - pushed.frames[0]).mean() < 6
    assert truth.things[0].role == "manipulated"
    assert truth.things[0].poses_world.shape == (truth.num_frames, 7)
    assert truth.mask_idx[[0, -1]].tolist() == [0, truth.num_frames - 1]
    assert np.array_equal(truth.masks, pushed.masks)
    mesh = trimesh.load_mesh(truth.things[0].mesh, process=False)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(truth.things[0].size_m, abs=1e-5)
