"""Known bodies are seen by a known camera, drawn by a rasteriser of the test's own; what is recovered is compared with
the formulas that made them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import lathe
from v2p_data.geometry.pillow import pillow
from v2p_data.geometry.pose import transform
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.shapes.shape import MARGINS, ShapeChoice, SilhouetteView, best_shape

CAMERA = camera_above((240, 320), 0.6, 1.01, 0.5)
AT = np.array([0.7, 0.05, 0.0])
BOTTLE = np.array(
    [(0.03, 0.0), (0.034, 0.005), (0.034, 0.13), (0.026, 0.15), (0.014, 0.17), (0.014, 0.21)]
)
BOWL = np.array([(0.03, 0.0), (0.055, 0.012), (0.07, 0.03), (0.078, 0.06)])
MUG = np.array([(0.04, 0.0), (0.041, 0.095)])


def noun(form: str, **given) -> Noun:
    base = Noun(word="thing", form="box", size_m=(0.1, 0.1, 0.1), mass_kg=0.1, friction=0.5)
    return replace(base, form=form, **given)


def seen(meshes: list[trimesh.Trimesh], camera: Camera = CAMERA) -> np.ndarray:
    """Draw the meshes at four times the resolution and shrink the picture."""
    large = np.zeros((camera.height_px * 4, camera.width_px * 4), np.uint8)
    for mesh in meshes:
        pixels = ((camera.project(np.asarray(mesh.vertices)) * 4 - 0.5) * 16).astype(np.int32)
        for triangle in pixels[mesh.faces]:
            cv2.fillConvexPoly(large, triangle, 1, cv2.LINE_8, 4)
    size = (camera.width_px, camera.height_px)
    return cv2.resize(large.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5


def placed(mesh: trimesh.Trimesh, at: np.ndarray = AT) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + at, mesh.faces, process=False)


def ball(radii, centre) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return trimesh.Trimesh(mesh.vertices * radii + centre, mesh.faces, process=False)


def fit(size, yaw_deg: float = 0.0, at: np.ndarray = AT) -> np.ndarray:
    R = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return transform(R, at + np.array([0.0, 0.0, size[2] / 2]))


def in_parts(points: np.ndarray, parts, slack_m: float = 1e-9) -> np.ndarray:
    out = np.zeros(len(points), bool)
    for part in parts:
        normals = part.face_normals
        offsets = np.einsum("fk,fk->f", normals, part.triangles[:, 0])
        out |= (points @ normals.T <= offsets + slack_m).all(axis=1)
    return out


def winding(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How often the surface winds around each point: 1 inside a closed one turned outwards, 0 outside."""
    a, b, c = (mesh.triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    over = np.einsum("pfk,pfk->pf", a, np.cross(b, c))
    under = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return (2 * np.arctan2(over, under)).sum(1) / (4 * np.pi)


def overlap(choice: ShapeChoice, T_world_obj: np.ndarray, truth, low, high) -> float:
    """IoU of volumes, by sampling; `truth` says which world points belong to the real thing."""
    points = np.random.default_rng(0).uniform(low, high, (4_000, 3))
    T = T_world_obj @ choice.T_obj_shape
    mine = in_parts((points - T[:3, 3]) @ T[:3, :3], choice.parts)
    real = truth(points)
    return float((mine & real).sum() / (mine | real).sum())


def turned(profile):
    """The inside of a body of revolution at `AT`."""

    def inside(points):
        x, y, z = (points - AT).T
        within = (z >= 0) & (z <= profile[-1, 1])
        return within & (np.hypot(x, y) <= np.interp(z, profile[:, 1], profile[:, 0]))

    return inside


def check_solid(choice: ShapeChoice, slack_m: float = 0.002) -> None:
    assert choice.mesh.is_watertight
    assert choice.mesh.is_winding_consistent
    assert choice.mesh.volume > 0
    np.testing.assert_allclose(choice.mesh.bounds.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(choice.mesh.extents, choice.size_m, rtol=0.02)
    assert all(part.is_convex for part in choice.parts)
    # The parts cover the mesh, to the accuracy of their few corners.
    assert (
        in_parts(np.asarray(choice.mesh.sample(1500, seed=0)), choice.parts, slack_m).mean() > 0.97
    )


def test_a_bottle_gets_its_neck():
    size = (0.064, 0.064, 0.195)  # what a cylinder fitted to this outline comes to
    mask = seen([placed(lathe(BOTTLE))])

    choice = best_shape(
        SilhouetteView(mask=mask, T_world_obj=fit(size)),
        CAMERA,
        size,
        noun("cylinder", symmetry="round"),
    )

    check_solid(choice)
    assert choice.kind == "revolution"
    assert choice.iou > 0.95
    low, high = AT - [0.05, 0.05, 0.01], AT + np.array([0.05, 0.05, 0.25])
    assert overlap(choice, fit(size), turned(BOTTLE), low, high) > 0.85
    top = choice.mesh.vertices[choice.mesh.vertices[:, 2] > 0.4 * choice.size_m[2]]
    assert np.hypot(top[:, 0], top[:, 1]).max() < 0.02  # the neck's radius is 0.014
    assert choice.size_m[2] == pytest.approx(0.21, rel=0.05)


def test_a_bowl_bulges_and_can_be_filled():
    size = (0.158, 0.158, 0.06)
    mask = seen([placed(lathe(BOWL, 0.004))])

    choice = best_shape(
        SilhouetteView(mask=mask, T_world_obj=fit(size)),
        CAMERA,
        size,
        noun("cylinder", hollow=True, taper=0.5, symmetry="round"),
    )

    check_solid(choice)
    assert choice.kind == "revolution"
    filled = replace(choice, parts=(choice.mesh.convex_hull,))
    low, high = AT - [0.09, 0.09, 0.01], AT + np.array([0.09, 0.09, 0.08])
    assert overlap(filled, fit(size), turned(BOWL), low, high) > 0.8
    cavity = np.array([[0, 0, 0], [0.03, 0, 0.01], [0, -0.05, 0.025]])
    np.testing.assert_allclose(winding(choice.mesh, cavity), 0, atol=1e-6)
    assert not in_parts(cavity, choice.parts).any()
    floor = np.array([[0.0, 0.0, -choice.size_m[2] / 2 + 0.002]])
    np.testing.assert_allclose(winding(choice.mesh, floor), 1, atol=1e-6)


def test_a_cup_is_open_as_wide_as_it_is_below_its_rim(monkeypatch: pytest.MonkeyPatch):
    """Outlines come out with round corners."""
    size = (0.08, 0.08, 0.1)
    whole = seen([placed(lathe(np.array([(0.032, 0.0), (0.04, 0.1)]), 0.003))])
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (21, 21))
    mask = cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
    monkeypatch.setitem(MARGINS, "revolution", -1.0)

    choice = best_shape(
        SilhouetteView(mask=mask, T_world_obj=fit(size)),
        CAMERA,
        size,
        noun("cylinder", hollow=True, taper=1.0, symmetry="round"),
    )

    assert choice.kind == "revolution"
    r, z = np.hypot(*choice.mesh.vertices[:, :2].T), choice.mesh.vertices[:, 2] / choice.size_m[2]
    assert r[z > 0.49].max() >= r[(z > 0.3) & (z < 0.38)].max() - 1e-6


def test_a_mug_stays_a_hollow_cylinder_in_spite_of_its_handle():
    size = (0.082, 0.082, 0.095)
    handle = trimesh.creation.torus(0.026, 0.005)
    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    points = handle.vertices @ turn.T + np.array([0.0, -0.041, 0.05])
    mask = seen(
        [placed(lathe(MUG, 0.005)), placed(trimesh.Trimesh(points, handle.faces, process=False))]
    )

    choice = best_shape(
        SilhouetteView(mask=mask, T_world_obj=fit(size)),
        CAMERA,
        size,
        noun("cylinder", hollow=True, taper=0.95),
    )

    check_solid(choice)
    assert choice.kind == "primitive"
    assert choice.size_m == size
    inside = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.04]])
    np.testing.assert_allclose(winding(choice.mesh, inside), 0, atol=1e-6)
    assert not in_parts(inside, choice.parts).any()
    assert "hollow cylinder" in choice.reason


def duck_like(points: np.ndarray) -> np.ndarray:
    body = (((points - AT - [0, 0, 0.03]) / [0.03, 0.042, 0.03]) ** 2).sum(axis=1) <= 1
    head = (((points - AT - [0, 0.02, 0.065]) / 0.02) ** 2).sum(axis=1) <= 1
    return body | head


def test_a_duck_is_inflated_from_its_outline():
    size, irregular = (0.07, 0.055, 0.07), noun("box", symmetry="none")
    mask = seen(
        [
            ball([0.03, 0.042, 0.03], AT + np.array([0, 0, 0.03])),
            ball(0.02, AT + np.array([0, 0.02, 0.065])),
        ]
    )

    choice = best_shape(
        SilhouetteView(mask=mask, T_world_obj=fit(size, 90)), CAMERA, size, irregular
    )

    check_solid(choice)
    assert choice.kind == "inflated"
    assert choice.iou > 0.88
    low, high = AT - [0.06, 0.06, 0.01], AT + np.array([0.06, 0.06, 0.1])
    assert overlap(choice, fit(size, 90), duck_like, low, high) > 0.5
    T = fit(size, 90) @ choice.T_obj_shape
    lowest = (choice.mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2].min()
    assert lowest == pytest.approx(0, abs=1e-6)


def test_a_box_stays_a_box_even_when_its_outline_is_nibbled():
    size = (0.09, 0.07, 0.05)
    box = trimesh.creation.box(size)
    R = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    mask = seen(
        [placed(trimesh.Trimesh(box.vertices @ R.T, box.faces), AT + np.array([0, 0, 0.025]))]
    )
    y, x = np.nonzero(mask)
    mask[y.min() : y.min() + 6, x.min() : int(x.mean())] = False

    choice = best_shape(
        SilhouetteView(mask=mask, T_world_obj=fit(size, 30)),
        CAMERA,
        size,
        noun("box", symmetry="box"),
    )

    assert choice.kind == "primitive"
    assert choice.size_m == size
    np.testing.assert_array_equal(choice.T_obj_shape, np.eye(4))


def test_where_the_hand_hides_much_nothing_fine_is_tried():
    size = (0.064, 0.064, 0.195)
    mask = seen([placed(lathe(BOTTLE))])
    hidden = np.zeros_like(mask)
    y, _ = np.nonzero(mask)
    hidden[: int(y.mean())] = True

    choice = best_shape(
        SilhouetteView(mask=mask & ~hidden, hidden=hidden, T_world_obj=fit(size)),
        CAMERA,
        size,
        noun("cylinder", symmetry="round"),
    )

    assert choice.kind == "primitive"
    assert "hidden" in choice.reason


def test_an_outline_with_a_line_one_pixel_wide_still_becomes_a_closed_mesh():
    outline = np.zeros((60, 60), np.uint8)
    cv2.circle(outline, (30, 30), 9, 1, -1)
    cv2.line(outline, (30, 30), (56, 20), 1, 1)

    mesh, parts = pillow(outline > 0, np.full(outline.shape, 0.01), 0.002)

    assert mesh.is_watertight
    assert all(part.is_watertight for part in parts)


def test_a_ball_with_its_shadow_stays_a_ball():
    size = (0.07, 0.07, 0.07)
    body = placed(ball(0.035, [0, 0, 0.035]))
    shadow = placed(ball([0.03, 0.06, 0.001], [0, -0.05, 0]))

    choice = best_shape(
        SilhouetteView(mask=seen([body, shadow]), T_world_obj=fit(size)),
        CAMERA,
        size,
        noun("sphere", size_m=size, symmetry="sphere"),
    )

    assert choice.kind == "primitive"
    assert choice.size_m == size


def test_what_is_low_is_not_inflated_to_any_depth_that_its_outline_allows(
    monkeypatch: pytest.MonkeyPatch,
):
    """Were it only for the outline, the block would come out twice as deep as it is."""
    size, yaw_deg = (0.10, 0.07, 0.03), 60.0
    low = camera_above((240, 320), 0.25, 1.01, 0.25)
    body = trimesh.creation.box(size).apply_transform(fit(size, yaw_deg))
    monkeypatch.setitem(MARGINS, "irregular", -1.0)

    choice = best_shape(
        SilhouetteView(mask=seen([body], low), T_world_obj=fit(size, yaw_deg)),
        low,
        size,
        noun("box", size_m=size),
    )

    assert choice.kind == "primitive"
    assert choice.size_m == size
