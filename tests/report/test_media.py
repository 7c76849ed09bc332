"""What goes into the page comes out of it again."""

import base64
import io

import av
import cv2
import numpy as np
import trimesh

from v2p_data.report.media import (
    MediaBudget,
    Medium,
    draw_mesh,
    film_uri,
    frames_uri,
    jpeg_uri,
    picture_uri,
    png_uri,
)


def payload(uri: str) -> bytes:
    return base64.b64decode(uri.split(",", 1)[1])


def decoded(uri: str) -> tuple[np.ndarray, float]:
    with av.open(io.BytesIO(payload(uri))) as container:
        frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        return np.stack(frames), float(container.streams.video[0].average_rate)


def grey_steps(count: int, h=48, w=64) -> np.ndarray:
    return np.broadcast_to(
        np.linspace(20, 230, count).astype(np.uint8)[:, None, None, None], (count, h, w, 3)
    ).copy()


def test_a_film_keeps_its_frames_size_and_rate():
    frames = grey_steps(12)

    seen, fps = decoded(frames_uri(frames, 20.0))

    assert seen.shape == frames.shape
    assert fps == 20
    assert np.abs(seen.astype(int) - frames).max() < 12  # lossy


def test_a_film_of_odd_size_loses_one_row_and_column():
    seen, _ = decoded(frames_uri(grey_steps(3, 49, 65), 20.0))

    assert seen.shape == (3, 48, 64, 3)


def test_a_long_film_is_thinned_and_keeps_its_duration(tmp_path):
    path = tmp_path / "long.mp4"
    path.write_bytes(payload(frames_uri(grey_steps(90, 64, 128), 30.0)))

    uri = film_uri(path, max_width_px=64, max_frames=40)

    assert uri is not None
    seen, fps = decoded(uri)
    assert seen.shape == (30, 32, 64, 3)
    assert len(seen) / fps == 90 / 30


def test_what_is_no_picture_or_film_is_none(tmp_path):
    text = tmp_path / "notes.mp4"
    text.write_text("not a film")
    (tmp_path / "empty.png").touch()

    assert film_uri(text, 100, 10) is None
    assert film_uri(tmp_path / "missing.mp4", 100, 10) is None
    assert picture_uri(text, 100) is None
    assert picture_uri(tmp_path / "empty.png", 100) is None
    assert picture_uri(tmp_path, 100) is None


def test_pictures_keep_their_colours_and_get_narrower(tmp_path):
    image = np.zeros((40, 80, 3), np.uint8)
    image[:, :40] = (200, 30, 10)
    cv2.imwrite(str(tmp_path / "a.png"), image[..., ::-1])

    uri = picture_uri(tmp_path / "a.png", 40)

    assert uri is not None
    seen = cv2.imdecode(np.frombuffer(payload(uri), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert seen.shape == (20, 40, 3)
    assert np.abs(seen[10, 8].astype(int) - (200, 30, 10)).max() < 12
    assert jpeg_uri(image, 40) == uri


def test_a_png_is_exact():
    image = np.random.default_rng(0).integers(0, 256, (9, 7, 4), np.uint8)

    seen = cv2.imdecode(np.frombuffer(payload(png_uri(image)), np.uint8), cv2.IMREAD_UNCHANGED)

    np.testing.assert_array_equal(seen[..., [2, 1, 0, 3]], image)


def test_a_tall_mesh_is_drawn_tall_in_its_own_colour():
    mesh = trimesh.creation.box((0.02, 0.02, 0.2))

    image = draw_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), (0.0, 0.8, 0.0))

    rows, columns = np.nonzero(image[..., 3] > 128)
    assert np.ptp(rows) > 4 * np.ptp(columns)
    solid = image[image[..., 3] == 255]
    assert (solid[:, 1] > 60).all()
    assert (solid[:, [0, 2]] == 0).all()
    assert (image[0, 0] == 0).all()


def test_the_top_of_a_box_is_lighter_than_its_sides():
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))

    image = draw_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), (0.7, 0.7, 0.7), 100)

    assert image[25, 50, 0] > image[70, 30, 0] + 20
    assert image[25, 50, 0] > image[70, 70, 0] + 20


def test_the_budget_refuses_what_does_not_fit_and_names_it():
    budget = MediaBudget(max_bytes=10)

    assert budget.admit("123456", "one", "a box") == Medium(uri="123456", alt="a box")
    assert budget.admit("123456", "two", "a box") is None
    assert budget.admit("1234", "three", "a film", is_film=True) is not None
    assert budget.admit(None, "none", "a box") is None
    assert budget.left_out == ["two"]
