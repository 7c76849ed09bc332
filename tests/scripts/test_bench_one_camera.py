"""The benchmark of clips that share a camera: what they share, and whose word counts."""

from dataclasses import asdict

import pytest

from v2p_data.scene.scale.shared_camera import Filmed


@pytest.fixture(scope="module")
def bench(load_script):
    return load_script("bench_one_camera")


def test_clips_of_one_stand_share_person_room_and_camera_and_differ_in_the_rest(bench):
    specs = [bench.StandJob(stand=2, place=place, clips=3).spec() for place in range(3)]

    views = [spec.view for spec in specs]
    for same in ("height_m", "pitch_rad", "roll_rad", "fovy_rad", "width_px", "height_px"):
        assert len({getattr(view, same) for view in views}) == 1, same
    assert len({spec.hand.skin for spec in specs}) == len({spec.room.table for spec in specs}) == 1
    assert len({spec.hand.scale for spec in specs}) == 1
    assert len({spec.kind for spec in specs}) == len({spec.caption for spec in specs}) == 3
    assert len({view.back_m for view in views}) == 3
    assert len({spec.name for spec in specs}) == 3


def test_stands_differ(bench):
    one, other = (bench.StandJob(stand=stand, place=0, clips=3).spec().view for stand in (0, 2))

    assert one.height_m != other.height_m


def row(width_m, *, accepted):
    says = Filmed(
        item="a", table_width_m=width_m, width_sd=0.1, pitch_rad=0.6, focal_widths=0.9, aspect=1.3
    )
    return {"accepted": accepted, "camera": asdict(says)}


def test_only_accepted_scenes_say_what_the_camera_is(bench):
    agreed = bench.camera_of([row(0.8, accepted=True), row(0.8, accepted=True)])
    with_others = bench.camera_of(
        [row(0.8, accepted=True), row(0.8, accepted=True), row(1.4, accepted=False)]
    )

    assert agreed == with_others
    assert bench.camera_of([row(0.8, accepted=True), row(0.8, accepted=False)]) is None
