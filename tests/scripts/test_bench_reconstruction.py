"""The benchmark of reconstruction counts as it says: seeds apart, a stage judged where the ones before were right."""

import numpy as np
import pytest
import trimesh

from drawn_clips.score_types import TrueClip, TrueThing
from v2p_data.geometry.camera import Camera, intrinsics


@pytest.fixture(scope="module")
def bench(load_script):
    return load_script("bench_reconstruction")


def row(*failures: str, slug: str | None = None, accepted: bool = False, size_m: float = 0.01):
    thing = {
        "size_error_m": size_m,
        "size_error_share": 0.1,
        "iou_first": 0.9,
        "iou_last": 0.8,
        "iou_mean": 0.9,
        "position_first_m": 0.0,
        "position_last_m": 0.02,
        "position_first_cam_m": 0.05,
        "position_last_cam_m": 0.06,
        "turn_first_rad": 0.1,
        "turn_last_rad": 0.2,
        "shape_iou": 0.9,
        "volume_iou": 0.8,
    }
    usable = slug is None and not failures
    return {
        "name": "push_left_0000",
        "kind": "push_left",
        "kind_found": None if slug else "push_left",
        "caption": "Pushing red box from right to left",
        "failures": dict.fromkeys(failures, "why"),
        "slug": slug,
        "gate_slug": None,
        "accepted": accepted,
        "usable": usable,
        "trouble": None if usable else ("rejected" if slug else failures[0], slug or "why"),
        "confidence": 0.7,
        "things": [thing],
        "frames_per_s": 12.0,
        "frames_per_cpu_s": 8.0,
        "peak_mb": 500.0,
    }


ALL = ("grounding", "segmentation", "mesh", "pose")
ROWS = [
    row(*ALL, slug="object_not_found"),
    row("grounding", "segmentation", "pose", accepted=True, size_m=0.04),
    row("segmentation", size_m=0.03),
    row("pose", accepted=True, size_m=0.02),
    row(accepted=True, size_m=0.01),
    row(accepted=True, size_m=0.01),
]


def test_a_stage_is_judged_on_clips_that_reached_it_and_on_all(bench):
    stages = bench.summarised(ROWS)["stages"]

    counted = {
        name: [(s[k]["successes"], s[k]["trials"]) for k in ("conditional", "all")]
        for name, s in stages.items()
    }
    assert counted == {
        "grounding": [(2, 6), (2, 6)],
        "segmentation": [(1, 4), (3, 6)],
        "mesh": [(0, 3), (1, 6)],
        "pose": [(1, 3), (3, 6)],
    }


def test_the_kept_half_shares_no_seed_with_the_other(bench):
    tune, final = (bench.planned(split, 60, list(bench.KINDS)) for split in ("tune", "final"))

    assert not {job.seed for job in tune} & {job.seed for job in final}
    assert {job.kind for job in tune} == {job.kind for job in final} == set(bench.KINDS)


def test_a_hint_is_a_box_in_the_files_pixels_where_the_object_shows(bench):
    hidden, shown, leaving = np.zeros((3, 240, 320), bool)
    shown[100:140, 50:90] = True
    leaving[100:140, 50:60] = True
    things = tuple(
        TrueThing(
            phrase=phrase,
            manipulated=phrase == "box",
            size_m=(0.1, 0.1, 0.1),
            hollow=False,
            symmetry="box",
            mesh=trimesh.creation.box((0.1, 0.1, 0.1)),
            T_world_objs=np.tile(np.eye(4), (60, 1, 1)),
            masks={0: first, 30: shown, 59: last},
        )
        for phrase, first, last in (
            ("box", shown, shown),
            ("ball", hidden, shown),
            ("stick", hidden, leaving),
        )
    )
    camera = Camera(
        width_px=640, height_px=480, K=intrinsics(640, 480, 0.7), T_world_cam=np.eye(4)
    )
    true = TrueClip(kind="uncover", things=things, T_world_cam=np.eye(4))
    hints = bench.boxes_of(true, camera, np.random.default_rng(0))

    assert [hints[phrase]["frame"] for phrase in ("box", "ball", "stick")] == [0, 59, 30]
    for hint in hints.values():
        assert np.abs(np.array(hint["box"]) - [100, 200, 180, 280]).max() < 4 * bench.JITTER_PX
