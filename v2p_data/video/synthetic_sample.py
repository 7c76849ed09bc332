"""The sample clips: a hand lifts, pushes or tips a box or a can on a table, drawn with MuJoCo and simple in all else.

A `VideoSpec` says everything about a clip; the same spec gives the same pictures on the same machine. The world
frame is that of a scene from video (origin under the object's first position, +x away, +y left, +z up), so truth
and reconstruction compare number by number. Clips of every kind,
with household things in any room, are drawn by `synthetic.py`.
"""

# mujoco's classes come from a compiled module that declares none of them.
# pyright: reportAttributeAccessIssue=false

import json
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import cv2
import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt8

from v2p_data.geometry.camera import CV_FROM_GL, Camera, intrinsics
from v2p_data.geometry.pose import (
    apply,
    pose_from_transform,
    quat_from_matrix,
    transform,
)
from v2p_data.seeds import rng_for
from v2p_data.video.synthetic_camera import Drawer
from v2p_data.video.synthetic_scene import (
    LABEL_HAND,
    LABEL_OBJECT,
    PALM_HALF_M,
    Hand,
    Placed,
    Rgb,
    Room,
    Thing,
    build,
    knuckles_past_centre_m,
    labels_of,
)

MotionKind = Literal["lift_up", "push_left", "push_right", "tip_over"]


@dataclass(frozen=True, kw_only=True)
class View:
    """The camera: level, heading along +x, as a person sitting at the table sees."""

    height_m: float = 0.45
    pitch_rad: float = 0.61
    """Below the horizon."""
    back_m: float = 0.58
    """From the object's first position to the point under the camera."""
    side_m: float = 0.0
    """How far the camera stands to the left of the object's first position."""
    fovy_rad: float = 0.70
    width_px: int = 640
    height_px: int = 480

    def camera(self) -> Camera:
        """Return the camera that this describes."""
        c, s = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        right, down, forward = [0, -1.0, 0], [-s, 0, -c], [c, 0, -s]
        T_world_cam = transform(
            np.array([right, down, forward]).T,
            np.array([-self.back_m, self.side_m, self.height_m]),
        )
        K = intrinsics(self.width_px, self.height_px, self.fovy_rad)
        return Camera(
            width_px=self.width_px, height_px=self.height_px, K=K, T_world_cam=T_world_cam
        )


@dataclass(frozen=True, kw_only=True)
class VideoSpec:
    """One clip, completely."""

    name: str
    """File name without its ending."""
    kind: MotionKind
    thing: Thing
    distance_m: float = 0.15
    """How far it is lifted or pushed; no meaning for tipping."""
    yaw_rad: float = 0.15
    """How the object stands at first, from +x towards +y."""
    others: tuple[Placed, ...] = ()
    """Objects that stay where they are."""
    view: View = field(default_factory=View)
    room: Room = field(default_factory=Room)
    hand: Hand = field(default_factory=Hand)
    seconds: float = 3.6
    fps: int = 30
    noise: float = 1.5
    """Standard deviation of the sensor's noise, of 255."""
    seed: int = 0
    """For textures, noise and the hand's trembling."""

    def __post_init__(self) -> None:
        if not 2.0 <= self.seconds <= 20:
            raise ValueError(f"seconds must lie in 2..20, got {self.seconds}")
        if self.kind == "push_right" and self.hand.side != "left":
            raise ValueError("push_right needs a hand on the left side of the object")
        if self.kind == "push_left" and self.hand.side != "right":
            raise ValueError("push_left needs a hand on the right side of the object")

    @property
    def caption(self) -> str:
        words = {
            "lift_up": "Lifting {} up",
            "push_left": "Pushing {} from right to left",
            "push_right": "Pushing {} from left to right",
            "tip_over": "Tipping {} over",
        }
        return words[self.kind].format(self.thing.label)


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Where everything is in every frame."""

    T_world_obj: Float[np.ndarray, "time 4 4"]
    T_world_hand: Float[np.ndarray, "time 4 4"]
    grip: Float[np.ndarray, "time"]
    """0 flat hand, 1 fingers and thumb closed on the object."""


@dataclass(frozen=True, kw_only=True)
class SyntheticVideo:
    """A drawn clip with its truth."""

    spec: VideoSpec
    frames: UInt8[np.ndarray, "time h w 3"] = field(repr=False)
    camera: Camera
    poses_world: Float[np.ndarray, "time 7"] = field(repr=False)
    """`[x, y, z, qw, qx, qy, qz]` of the manipulated object's centre."""
    mask_first: UInt8[np.ndarray, "h w"] = field(repr=False)
    """Labels: 0 background, 1 hand, 2 manipulated object, then the others in their order."""
    mask_last: UInt8[np.ndarray, "h w"] = field(repr=False)
    hand_in_view: Bool[np.ndarray, "time"] = field(repr=False)


def animate(spec: VideoSpec) -> Motion:
    """Return the motion: the hand comes, acts, and (but for lifting) leaves again."""
    n = round(spec.seconds * spec.fps)
    t = np.arange(n) / (n - 1)
    thing, s = spec.thing, spec.hand.sign
    half = np.array(thing.size_m) / 2
    c, si = np.cos(spec.yaw_rad), np.sin(spec.yaw_rad)
    R0 = np.array([[c, -si, 0], [si, c, 0], [0, 0, 1.0]])
    left = np.array([0, 1.0, 0])
    away = spec.hand.arm_direction
    lifts = spec.kind == "lift_up"

    comes, closes = _ease(t, 0.08, 0.30), _ease(t, 0.29, 0.37)
    goes = np.zeros(n) if lifts else _ease(t, 0.70, 0.90)
    acts = _ease(t, 0.40, 0.72) if lifts else _ease(t, 0.36, 0.64)

    T_obj = np.tile(np.eye(4), (n, 1, 1))
    T_obj[:, :3, :3] = R0
    T_obj[:, 2, 3] = half[2]
    # where the palm touches, in the object's frame: the face that looks to the hand
    low = PALM_HALF_M[2] + 0.008 - half[2]
    touch = np.array([knuckles_past_centre_m(thing), -s * (half[1] + 0.001), max(0.0, low)])
    if lifts:
        T_obj[:, 2, 3] += spec.distance_m * acts
        T_obj[:, 0, 3] -= 0.03 * acts
        tilt = 0.10 * acts * np.sin(2.2 * t)
        T_obj[:, :3, :3] = np.stack([_about_x(s * a) @ R0 for a in tilt])
        hand_at = T_obj[:, :3, 3] + np.einsum("tij,j->ti", T_obj[:, :3, :3], touch)
        R_hand = T_obj[:, :3, :3].copy()
    elif spec.kind == "tip_over":
        touch[0], touch[2] = -0.02, 0.62 * half[2]
        angle = _fall(t, 0.36, 0.62)
        edge = R0 @ np.array([0, s * half[1], 0]) + np.array([0, 0, half[2]])
        axis_turn = np.stack([R0 @ _about_x(-s * a) @ R0.T for a in angle])
        corner = edge - np.array([0, 0, half[2]])
        centre = np.array([0, 0, half[2]]) - corner
        T_obj[:, :3, 3] = corner + np.einsum("tij,j->ti", axis_turn, centre)
        T_obj[:, :3, :3] = axis_turn @ R0
        followed = np.minimum(angle, 0.60)
        turn = np.stack([R0 @ _about_x(-s * a) for a in followed])
        hand_at = corner + np.einsum("tij,j->ti", turn, R0.T @ centre + touch)
        R_hand = np.stack([R0 @ _about_x(-0.4 * s * a) for a in followed])
    else:
        T_obj[:, :3, 3] += spec.distance_m * s * acts[:, None] * left
        touch[0] = -0.02
        hand_at = T_obj[:, :3, 3] + R0 @ touch
        R_hand = np.tile(R0, (n, 1, 1))

    # the hand comes along the arm, a little aside so that it does not brush the object
    aside = (1 - _ease(t, 0.22, 0.33)) + goes
    hand_at = (
        hand_at - 0.055 * s * aside[:, None] * (R0 @ left) + 0.01 * aside[:, None] * [0, 0, 1]
    )
    hidden = _hidden_m(spec, hand_at[0])
    hand_at = hand_at + hidden * ((1 - comes) + goes)[:, None] * away
    tremble = rng_for(spec.seed, "tremble").normal(0, 1, (8, 3))
    waves = np.sin(2 * np.pi * (np.arange(8)[:, None] * 0.6 + 1) * t + tremble[:, :1])
    shake = 0.0005 * waves.T @ tremble
    free = (1 - closes if lifts else np.ones(n))[:, None]
    hand_at = hand_at + shake * free
    T_hand = np.stack([transform(R, p) for R, p in zip(R_hand, hand_at, strict=True)])
    return Motion(T_world_obj=T_obj, T_world_hand=T_hand, grip=closes if lifts else np.zeros(n))


def render(spec: VideoSpec) -> SyntheticVideo:
    """Draw the clip.

    Raises:
        V2PError: there is no OpenGL.
    """
    view, camera, motion = spec.view, spec.view.camera(), animate(spec)
    model = build(
        spec.thing,
        spec.others,
        spec.room,
        spec.hand,
        view.fovy_rad,
        (view.width_px, view.height_px),
        rng_for(spec.seed, "textures"),
    )
    data = mujoco.MjData(model)
    noise = rng_for(spec.seed, "noise")
    frames, masks, seen = [], [], []
    with Drawer(model, labels_of(model)) as drawer:
        for i in range(len(motion.grip)):
            _pose(model, data, motion, i, camera)
            image = drawer.picture(data).astype(np.float32)
            if spec.noise:
                image += noise.normal(0, spec.noise, image.shape).astype(np.float32)
            frames.append(image.round().clip(0, 255).astype(np.uint8))
            mask = drawer.mask(data)
            seen.append(bool((mask == LABEL_HAND).any()))
            masks = [*masks[:1], mask]
    return SyntheticVideo(
        spec=spec,
        frames=np.stack(frames),
        camera=camera,
        poses_world=np.stack([pose_from_transform(T) for T in motion.T_world_obj]),
        mask_first=masks[0],
        mask_last=masks[-1],
        hand_in_view=np.array(seen),
    )


def write(video: SyntheticVideo, folder: Path) -> Path:
    """Write `<name>.mp4`, and `truth/<name>.json` with `truth/<name>_{first,last}.png` beside it."""
    spec = video.spec
    truth = folder / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    path = folder / f"{spec.name}.mp4"
    with av.open(str(path), "w", options={"movflags": "faststart"}) as out:
        # one thread and no tool version in the stream: the same pictures give the same bytes
        options = {"crf": "21", "preset": "slow", "x264-params": "threads=1:no-info=1"}
        stream = out.add_stream("libx264", rate=Fraction(spec.fps), options=options)
        stream.width, stream.height = spec.view.width_px, spec.view.height_px
        stream.pix_fmt = "yuv420p"
        for pixels in video.frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode(None))
    for when, mask in (("first", video.mask_first), ("last", video.mask_last)):
        cv2.imwrite(str(truth / f"{spec.name}_{when}.png"), mask)
    (truth / f"{spec.name}.json").write_text(json.dumps(_truth(video), indent=1) + "\n")
    return path


COLOURS: dict[str, Rgb] = {
    "red": (0.78, 0.10, 0.10),
    "blue": (0.10, 0.25, 0.72),
    "green": (0.12, 0.55, 0.22),
    "yellow": (0.90, 0.76, 0.10),
    "orange": (0.93, 0.45, 0.06),
    "purple": (0.45, 0.16, 0.60),
    "white": (0.88, 0.88, 0.86),
    "black": (0.09, 0.09, 0.10),
}


def _ease(t: Float[np.ndarray, "time"], start: float, end: float) -> Float[np.ndarray, "time"]:
    """Return 0 before `start`, 1 after `end`, and a minimum-jerk step between."""
    x = ((t - start) / (end - start)).clip(0, 1)
    return x**3 * (10 - 15 * x + 6 * x * x)


def _fall(t: Float[np.ndarray, "time"], start: float, end: float) -> Float[np.ndarray, "time"]:
    """Return an angle from 0 to a quarter turn: slowly while pushed, then faster and faster, and at rest."""
    x = ((t - start) / (end - start)).clip(0, 1)
    return np.pi / 2 * (0.30 * x + 0.70 * x**4)


def _about_x(angle: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def _hidden_m(spec: VideoSpec, hand_at: Float[np.ndarray, "3"]) -> float:
    """Return how far along the arm the hand must be drawn back to leave the picture."""
    camera, away = spec.view.camera(), spec.hand.arm_direction
    reach = np.linspace(-0.13, 0.7, 24)[:, None] * away
    around = np.array([[0, 0, 0], [0, 0, 0.07], [0, 0.07, 0], [0, -0.07, 0], [0.07, 0, 0]])
    shape = (reach[:, None] + around).reshape(-1, 3)
    for distance in np.arange(0.2, 1.6, 0.02):
        points = hand_at + distance * away + shape
        in_camera = apply(np.linalg.inv(camera.T_world_cam), points)
        uv = camera.project(points)
        inside = (uv > 0).all(1) & (uv < (camera.width_px, camera.height_px)).all(1)
        # what is behind the camera, or so close that it would fill the picture, cannot be judged by a pixel
        if not (inside & (in_camera[:, 2] > 0.05)).any():
            return float(distance) + 0.12
    raise ValueError(f"no way out of the picture for the hand of '{spec.name}'")


def _pose(
    model: mujoco.MjModel, data: mujoco.MjData, motion: Motion, i: int, camera: Camera
) -> None:
    R_gl = camera.T_world_cam[:3, :3] @ CV_FROM_GL
    T_cam = transform(R_gl, camera.T_world_cam[:3, 3])
    for name, T in (
        ("thing", motion.T_world_obj[i]),
        ("hand", motion.T_world_hand[i]),
        ("camera", T_cam),
    ):
        mocap = model.body(name).mocapid[0]
        data.mocap_pos[mocap] = T[:3, 3]
        data.mocap_quat[mocap] = quat_from_matrix(T[:3, :3])
    grip = motion.grip[i]
    flat, closed = (0.12, 0.16, 0.10), (1.35, 0.30, 0.50)
    for finger in range(4):
        for joint in range(3):
            spread = 0.05 * (finger - 1.5)
            angle = flat[joint] * (1 + spread) * (1 - grip) + closed[joint] * (1 + spread) * grip
            data.joint(f"finger{finger}_{joint}").qpos = angle
    data.joint("thumb_0").qpos = -0.05 * grip - 1.0 * (1 - grip) + 1.9 * (1 - grip)
    data.joint("thumb_1").qpos = -0.25 * grip
    mujoco.mj_forward(model, data)


def _truth(video: SyntheticVideo) -> dict[str, Any]:
    spec, camera = video.spec, video.camera
    still = [
        {
            "label": p.thing.label,
            "role": "bystander",
            "shape": p.thing.shape,
            "size_m": p.thing.size_m,
            "mask_label": LABEL_OBJECT + 1 + i,
            "pose_world": [
                *p.xy_m,
                p.thing.size_m[2] / 2,
                float(np.cos(p.yaw_rad / 2)),
                0.0,
                0.0,
                float(np.sin(p.yaw_rad / 2)),
            ],
        }
        for i, p in enumerate(spec.others)
    ]
    return {
        "video": f"{spec.name}.mp4",
        "caption": spec.caption,
        "kind": spec.kind,
        "fps": spec.fps,
        "num_frames": len(video.frames),
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "K": camera.K.round(6).tolist(),
            "T_world_cam": camera.T_world_cam.round(9).tolist(),
        },
        "object": {
            "label": spec.thing.label,
            "shape": spec.thing.shape,
            "size_m": spec.thing.size_m,
            "mask_label": LABEL_OBJECT,
            "poses_world": video.poses_world.round(6).tolist(),
        },
        "others": still,
        "hand_in_view": video.hand_in_view.tolist(),
        "masks": {"first": f"{spec.name}_first.png", "last": f"{spec.name}_last.png"},
        "mask_labels": {"background": 0, "hand": LABEL_HAND, "object": LABEL_OBJECT},
    }
