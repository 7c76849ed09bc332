import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.backends.config import DepthConfig
from v2p_data.scene.backends.depth import predict_depth, table_from_depth
from v2p_data.scene.fitting.silhouette import camera_above


def config(checkpoint, **more) -> DepthConfig:
    return DepthConfig(
        backend="depth_anything",
        model=checkpoint("depth_anything"),
        device=checkpoint.device,
        **more,
    )


def test_a_saved_checkpoint_gives_positive_depth_of_the_pictures_size(checkpoint, picture):
    images = np.stack([picture, picture[:, ::-1], 255 - picture])

    together = predict_depth(images, config(checkpoint, batch_size=3))
    alone = predict_depth(images, config(checkpoint, batch_size=1))

    assert together.depth_m.shape == (3, 48, 64)
    assert (together.depth_m > 0).all()
    assert together.metric
    np.testing.assert_allclose(together.depth_m, alone.depth_m, rtol=1e-3)


def test_depth_anythings_depth_stays_below_the_checkpoints_farthest(checkpoint, picture):
    assert predict_depth([picture], config(checkpoint)).depth_m.max() <= 20


def test_half_precision_gives_nearly_the_same_depth(checkpoint, picture):
    full, half = (
        predict_depth([picture], config(checkpoint, dtype=dtype)).depth_m
        for dtype in ("float32", "bfloat16")
    )

    np.testing.assert_allclose(half, full, rtol=0.05)


def test_a_checkpoint_with_relative_depth_is_refused(make_relative, picture):
    cfg = DepthConfig(backend="depth_anything", model=make_relative, device="cpu")

    with pytest.raises(V2PError, match="relative depth"):
        predict_depth([picture], cfg)


@pytest.fixture
def make_relative(checkpoint, tmp_path) -> str:
    from transformers import AutoImageProcessor, DepthAnythingForDepthEstimation

    model = DepthAnythingForDepthEstimation.from_pretrained(checkpoint("depth_anything"))
    model.config.depth_estimation_type = "relative"
    model.save_pretrained(tmp_path)
    AutoImageProcessor.from_pretrained(checkpoint("depth_anything")).save_pretrained(tmp_path)
    return str(tmp_path)


def seen(
    pitch: float, roll: float, height: float, *, clutter: bool = True
) -> tuple[np.ndarray, Camera]:
    """Return the depth of a table, a wall behind it and things on it, as rays meet them, and the camera."""
    level = camera_above((120, 160), pitch, 1.01, height)
    R = level.T_world_cam[:3, :3] @ Rotation.from_euler("z", roll).as_matrix()
    camera = Camera(
        width_px=160, height_px=120, K=level.K, T_world_cam=transform(R, np.array([0, 0, height]))
    )
    v, u = np.mgrid[:120, :160] + 0.5
    rays = camera.rays_world(np.stack([u.ravel(), v.ravel()], axis=1))
    with np.errstate(divide="ignore"):
        reach = np.where(rays[:, 2] < 0, -height / rays[:, 2], np.inf)
        if clutter:
            reach = np.minimum(reach, np.where(rays[:, 0] > 0, 3 * height / rays[:, 0], np.inf))
    depth = (reach * (rays @ R[:, 2])).reshape(120, 160)
    if clutter:
        depth[50:90, 30:70] *= 0.9
    return depth, camera


@pytest.mark.parametrize(
    ("pitch", "roll", "height"), [(0.6, 0.0, 0.5), (0.35, 0.2, 0.9), (1.2, -0.25, 0.4)]
)
def test_the_table_plane_comes_out_of_noisy_depth_with_things_and_a_wall(pitch, roll, height):
    depth, camera = seen(pitch, roll, height)
    rng = np.random.default_rng(7)
    depth = depth * rng.normal(1, 0.005, depth.shape)
    depth[rng.random(depth.shape) < 0.15] = rng.uniform(0.1, 3)
    depth[rng.random(depth.shape) < 0.02] = np.nan

    plane = table_from_depth(depth, camera.K, rng=np.random.default_rng(0))

    assert plane is not None
    assert plane.height_m == pytest.approx(height, rel=0.01)
    assert plane.pitch_rad == pytest.approx(pitch, abs=0.01)
    np.testing.assert_allclose(
        plane.normal_cam, camera.T_world_cam[:3, :3].T @ [0, 0, 1], atol=0.01
    )
    assert 0.3 < plane.inlier_share < 0.9


def test_without_noise_the_plane_is_exact_and_every_pixel_lies_on_it():
    depth, camera = seen(1.0, 0.1, 0.7, clutter=False)

    plane = table_from_depth(depth, camera.K, rng=np.random.default_rng(0))

    assert plane is not None
    assert plane.height_m == pytest.approx(0.7, abs=1e-9)
    assert plane.inlier_share == 1


def test_what_is_known_not_to_be_the_table_is_left_out():
    # A tray fills most of the picture 5 cm above the table.
    depth, camera = seen(1.2, 0.0, 0.5, clutter=False)
    tray = np.zeros(depth.shape, bool)
    tray[:, :110] = True
    depth[tray] *= 0.9

    with_tray = table_from_depth(depth, camera.K, rng=np.random.default_rng(0))
    without = table_from_depth(depth, camera.K, tray, rng=np.random.default_rng(0))

    assert with_tray is not None
    assert without is not None
    assert with_tray.height_m == pytest.approx(0.45, abs=1e-6)
    assert without.height_m == pytest.approx(0.5, abs=1e-6)


def test_a_wall_or_nothing_is_no_table():
    K = camera_above((24, 32), 0.6, 1.0).K
    rng = np.random.default_rng(0)

    # A camera that looks down at a wall 2 m ahead sees it lean towards its top edge.
    _, camera = seen(0.6, 0.0, 1.0)
    v, u = np.mgrid[:120, :160] + 0.5
    rays = camera.rays_world(np.stack([u.ravel(), v.ravel()], axis=1))
    wall = (2 / rays[:, 0] * (rays @ camera.T_world_cam[:3, 2])).reshape(120, 160)

    assert table_from_depth(wall, camera.K, rng=rng) is None
    assert table_from_depth(np.full((24, 32), np.nan), K, rng=rng) is None
