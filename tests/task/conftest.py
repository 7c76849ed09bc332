"""Scenes as a video would give them, made by hand."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from v2p_data.geometry.camera import Camera, intrinsics, look_at
from v2p_data.scene.scene import Scene, SceneObject

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ON_ITS_SIDE = (float(np.sqrt(0.5)), float(-np.sqrt(0.5)), 0.0, 0.0)


def thing(name, size, start, end=None, quat_end=UPRIGHT, role="manipulated", shape="box"):
    """An object that moves in a straight line for twelve frames."""
    end = start if end is None else end
    turn = Slerp([0, 1], Rotation.from_quat(np.array([UPRIGHT, quat_end]), scalar_first=True))
    poses = tuple(
        tuple(
            float(x)
            for x in (
                *(np.array(start) + t * (np.array(end) - np.array(start))),
                *turn(t).as_quat(scalar_first=True),
            )
        )
        for t in np.linspace(0, 1, 12)
    )
    return SceneObject(
        name=name,
        label=name.replace("_", " "),
        role=role,
        shape=shape,
        size_m=size,
        mass_kg=0.1,
        friction=0.8,
        frames=tuple(range(12)),
        poses_world=poses,
        confidences=(1.0,) * 12,
    )


OBJECTS = {
    "lift_up": (thing("box", (0.05, 0.05, 0.05), (0, 0, 0.025), (0.02, 0.01, 0.2)),),
    "push_left": (thing("book", (0.15, 0.2, 0.03), (0, 0, 0.015), (0.01, 0.18, 0.02)),),
    "push_right": (
        thing("can", (0.06, 0.06, 0.12), (0, 0, 0.06), (0.02, -0.2, 0.05), shape="cylinder"),
    ),
    "tip_over": (
        thing(
            "bottle",
            (0.06, 0.06, 0.2),
            (0, 0, 0.1),
            (0, 0.12, 0.03),
            ON_ITS_SIDE,
            shape="cylinder",
        ),
    ),
    "push_next_to": (
        thing("can", (0.06, 0.06, 0.12), (0, 0, 0.06), (0, 0.14, 0.06)),
        thing("bowl", (0.1, 0.1, 0.06), (0, 0.23, 0.03), role="reference"),
    ),
    "insert": (
        thing("apple", (0.05, 0.05, 0.05), (0, 0, 0.025), (0, 0.2, 0.035), shape="sphere"),
        thing("bowl", (0.14, 0.14, 0.06), (0, 0.2, 0.03), role="container"),
    ),
    "place_onto": (
        thing("mug", (0.08, 0.08, 0.1), (0, 0, 0.05), (0, 0.2, 0.07)),
        thing("coaster", (0.1, 0.1, 0.02), (0, 0.2, 0.01), role="reference"),
    ),
    "drop_in_front_of": (
        thing("card", (0.05, 0.05, 0.02), (0, 0, 0.01), (0, 0.2, 0.01)),
        thing("box", (0.06, 0.06, 0.06), (0.09, 0.2, 0.03), role="reference"),
    ),
    "uncover": (
        thing("cup", (0.08, 0.08, 0.1), (0, 0, 0.05), (0, 0.2, 0.05)),
        thing("cube", (0.03, 0.03, 0.03), (0, 0, 0.015), role="reference"),
    ),
    "cover": (
        thing("cup", (0.08, 0.08, 0.1), (0, 0, 0.05), (0, 0.2, 0.05)),
        thing("cube", (0.03, 0.03, 0.03), (0, 0.2, 0.015), role="reference"),
    ),
    "generic": (thing("box", (0.05, 0.05, 0.05), (0, 0, 0.025), (0.1, 0.1, 0.03)),),
}


@pytest.fixture(scope="session")
def scene_of() -> Callable[..., Scene]:
    """Return a scene of a kind; other objects, if given, take the place of its own."""

    def make(kind: str, *objects: SceneObject, description: str = "") -> Scene:
        camera = Camera(
            width_px=64,
            height_px=48,
            K=intrinsics(64, 48, 1.0),
            T_world_cam=look_at(np.array([-0.5, 0.0, 0.5]), np.zeros(3)),
        )
        return Scene(
            title=f"clip_{kind}",
            video="clip.mp4",
            description=description or kind.replace("_", " "),
            kind=kind,
            objects=objects or OBJECTS[kind],
            camera=camera,
            fps=20.0,
            num_frames=12,
            confidence=1.0,
        )

    return make


@pytest.fixture(scope="session")
def make_thing() -> Callable[..., SceneObject]:
    return thing
