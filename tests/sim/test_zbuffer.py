"""The z-buffer against rays, against sizes computed by hand, and against what must not matter."""

# pyright: reportAttributeAccessIssue=false

import multiprocessing

import mujoco
import numpy as np
import pytest
import trimesh

from v2p_data.errors import V2PError
from v2p_data.sim.render.zbuffer import FRAMES_AT_ONCE, Views, ZBuffer

HEIGHT, WIDTH = 96, 144
FOVY_DEG = 50.0
FOCAL_PX = HEIGHT / 2 / np.tan(np.radians(FOVY_DEG) / 2)
# The camera stands at the origin and looks along -z, right is +x, up is +y.
SCENE = """
<mujoco>
  <statistic extent="1"/>
  <visual><map znear="{near}"/><quality numslices="128" numstacks="64"/></visual>
  <asset>{asset}</asset>
  <worldbody><camera name="view" fovy="50"/>{geoms}</worldbody>
</mujoco>
"""


def compiled(geoms: str, asset: str = "", near: float = 0.01) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SCENE.format(geoms=geoms, asset=asset, near=near))


def views_of(model: mujoco.MjModel, count: int = 1) -> Views:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    views = Views.empty(model, count)
    for k in range(count):
        views.note(k, model, data, model.camera("view").id)
    return views


def painted(model: mujoco.MjModel, labels: list[int], **more) -> np.ndarray:
    zbuffer = ZBuffer(model, np.array(labels, np.uint8), HEIGHT, WIDTH, **more)
    return zbuffer.draw(views_of(model))[0]


def cast(model: mujoco.MjModel, labels: list[int]) -> np.ndarray:
    """Return what rays through the pixels' centres hit."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    beams = np.stack([columns - WIDTH / 2, HEIGHT / 2 - rows, np.full_like(rows, -FOCAL_PX)], -1)
    beams = np.ascontiguousarray(beams.reshape(-1, 3))
    geoms, distances = np.full(len(beams), -1, np.int32), np.zeros(len(beams))
    mujoco.mj_multiRay(
        model,
        data,
        np.zeros(3),
        beams.ravel(),
        None,
        1,
        -1,
        geoms,
        distances,
        None,
        len(beams),
        1e9,
    )
    return np.append(np.array(labels, np.uint8), np.uint8(0))[geoms].reshape(HEIGHT, WIDTH)


def overlap(a: np.ndarray, b: np.ndarray, label: int) -> float:
    return ((a == label) & (b == label)).sum() / ((a == label) | (b == label)).sum()


def pixels_across(half_m: float, distance_m: float) -> int:
    """Return how many pixels' centres lie within `half_m` of the middle of an image with an even number of them."""
    return 2 * round(half_m * FOCAL_PX / distance_m)


def test_a_face_covers_as_many_pixels_as_the_pinhole_says():
    # The front is 1 m away, 0.4 m wide and 0.2 m high.
    image = painted(compiled('<geom type="box" size="0.2 0.1 0.05" pos="0 0 -1.05"/>'), [3])

    rows, columns = np.nonzero(image == 3)

    assert np.ptp(columns) + 1 == pixels_across(0.2, 1.0)
    assert np.ptp(rows) + 1 == pixels_across(0.1, 1.0)
    assert len(rows) == (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
    assert columns.mean() + 0.5 == WIDTH / 2
    assert rows.mean() + 0.5 == HEIGHT / 2


def test_up_and_right_are_up_and_right():
    image = painted(compiled('<geom type="sphere" size="0.05" pos="0.3 0.2 -1"/>'), [1])

    rows, columns = np.nonzero(image)

    assert columns.mean() + 0.5 == pytest.approx(WIDTH / 2 + 0.3 * FOCAL_PX, abs=0.5)
    assert rows.mean() + 0.5 == pytest.approx(HEIGHT / 2 - 0.2 * FOCAL_PX, abs=0.5)


def random_geoms(rng: np.random.Generator) -> str:
    """Return one of each kind, turned at random and overlapping, some of them beyond the image's edge."""
    sizes = {
        "box": "0.1 0.06 0.14",
        "sphere": "0.11",
        "ellipsoid": "0.06 0.1 0.16",
        "capsule": "0.06 0.12",
        "cylinder": "0.09 0.1",
        "mesh": "",
    }
    geoms = ""
    for kind, size in sizes.items():
        x, y, z = rng.uniform((-0.6, -0.4, -1.6), (0.6, 0.4, -0.7))
        quat = " ".join(map(str, rng.normal(size=4)))
        form = 'mesh="ring"' if kind == "mesh" else f'size="{size}"'
        geoms += f'<geom type="{kind}" {form} pos="{x} {y} {z}" quat="{quat}"/>'
    return geoms + '<geom type="plane" size="2 2 0.1" pos="0 -0.3 0" zaxis="0 1 0.1"/>'


@pytest.mark.parametrize("seed", range(4))
def test_every_kind_of_geom_is_seen_where_rays_hit_it(tmp_path, seed):
    trimesh.creation.torus(0.12, 0.04).export(tmp_path / "ring.obj")
    asset = f'<mesh name="ring" file="{tmp_path / "ring.obj"}"/>'
    model = compiled(random_geoms(np.random.default_rng(seed)), asset)
    labels = [1, 2, 3, 4, 5, 6, 0]

    image, hits = painted(model, labels), cast(model, labels)

    assert (image != hits).mean() < 0.002
    for label in np.unique(hits):
        assert overlap(image, hits, label) >= 0.97 if (hits == label).sum() > 300 else True


def test_what_reaches_past_the_camera_is_cut_at_the_near_plane():
    # A beam from behind the camera to far in front of it, and a floor without end.
    model = compiled(
        '<geom type="box" size="0.05 0.05 3" pos="0.2 0.1 0" euler="5 10 0"/>'
        '<geom type="plane" size="0 0 1" pos="0 -0.5 0" zaxis="0 1 0"/>'
    )

    image, hits = painted(model, [1, 2]), cast(model, [1, 2])

    assert (image == 1).sum() > 300
    assert (image == 2).sum() > 3000
    assert (image != hits).mean() < 0.002


def test_the_inside_of_a_box_is_not_seen_from_within():
    assert not painted(compiled('<geom type="box" size="1 1 1"/>'), [1]).any()


def test_what_mujoco_does_not_show_is_not_drawn():
    model = compiled(
        '<geom type="box" size="0.2 0.2 0.05" pos="0 0 -2" group="3"/>'
        '<geom type="box" size="0.2 0.2 0.05" pos="0 0 -2" rgba="1 1 1 0"/>'
    )

    assert not painted(model, [1, 2]).any()


def test_sizes_and_places_are_those_of_the_frame_and_not_of_the_model():
    model = compiled('<geom type="box" size="0.1 0.1 0.05" pos="0 0 -1"/>')
    views = views_of(model, 3)
    views.geom_size[1] *= 2
    views.geom_pos[2] = (9, 0, -1)

    areas = ZBuffer(model, np.array([1], np.uint8), HEIGHT, WIDTH).draw(views).sum((1, 2))

    assert areas.tolist() == [pixels_across(0.1, 0.95) ** 2, pixels_across(0.2, 0.9) ** 2, 0]


def test_a_state_that_is_not_finite_shows_nothing():
    model = compiled('<geom type="box" size="0.1 0.1 0.05" pos="0 0 -1"/>')
    views = views_of(model, 2)
    views.geom_pos[0] = np.nan
    views.geom_pos[1] = np.inf

    assert not ZBuffer(model, np.array([1], np.uint8), HEIGHT, WIDTH).draw(views).any()


def test_the_number_of_threads_changes_nothing():
    model = compiled(
        '<geom type="sphere" size="0.2" pos="0 0 -1"/><geom type="box" size=".2 .2 .2" pos=".1 0 -1"/>'
    )
    count = 3 * FRAMES_AT_ONCE + 1
    views = views_of(model, count)
    views.geom_pos[:, 0] += np.random.default_rng(1).uniform(-0.4, 0.4, (count, 3))

    one, three = (
        ZBuffer(model, np.array([1, 2], np.uint8), HEIGHT, WIDTH, num_threads=n).draw(views)
        for n in (1, 3)
    )

    assert len(np.unique(one, axis=0)) == count
    assert (one == three).all()


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="cannot fork")
def test_a_forked_process_draws_what_its_parent_drew():
    model = compiled('<geom type="sphere" size="0.2" pos="0 0 -1"/>')
    views = views_of(model, 8)
    zbuffer = ZBuffer(model, np.array([1], np.uint8), HEIGHT, WIDTH, num_threads=2)
    images = zbuffer.draw(views)
    end, far_end = multiprocessing.Pipe()

    def draw_again() -> None:
        far_end.send(zbuffer.draw(views))

    child = multiprocessing.get_context("fork").Process(target=draw_again)
    child.start()
    again = end.recv() if end.poll(60) else None
    child.kill()
    child.join()

    assert again is not None
    assert (again == images).all()


def test_a_height_field_is_refused_with_the_way_out():
    asset = '<hfield name="hills" nrow="3" ncol="3" size="1 1 1 1" elevation="0 0 0 0 1 0 0 0 0"/>'
    model = compiled('<geom type="hfield" hfield="hills" pos="0 0 -5"/>', asset)

    with pytest.raises(V2PError, match="cannot show geoms of type HFIELD"):
        ZBuffer(model, np.array([1], np.uint8), HEIGHT, WIDTH)


def test_a_label_for_which_a_pixel_has_no_room_is_refused():
    model = compiled('<geom type="sphere" size="0.2"/>')

    with pytest.raises(V2PError, match="label 16 is too large"):
        ZBuffer(model, np.array([16], np.uint8), HEIGHT, WIDTH)
