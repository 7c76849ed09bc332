"""Clips with ground truth over all kinds of task: a hand acts on household things on a table, drawn with MuJoCo.

A `VideoSpec` says everything about a clip; the same spec gives the same pictures on the same machine. The world
frame is that of a scene from video (origin under the moving thing's first position, +x away along the camera's
heading, +y left, +z up), so truth and reconstruction compare number by number.
"""

# mujoco's classes come from a compiled module that declares none of them.
# pyright: reportAttributeAccessIssue=false

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt8

from drawn_clips.camera import Drawer, Sensor, View, developed, random_sensor
from drawn_clips.hand import WRIST, Hand
from drawn_clips.motion import Motion, Timing, animate
from drawn_clips.room import LABEL_HAND, Room, build, labels_of, random_room
from drawn_clips.room import LABEL_TABLE as LABEL_TABLE
from drawn_clips.room import LABEL_THING as LABEL_THING
from drawn_clips.story import MOTION_KINDS as MOTION_KINDS
from drawn_clips.story import MotionKind, Story, random_story
from drawn_clips.textures import Rgb, any_colour
from v2p_data.geometry.camera import CV_FROM_GL, Camera
from v2p_data.geometry.pose import apply, inverse, pose_from_transform, quat_from_matrix
from v2p_data.seeds import rng_for

NUM_MASKS = 16
"""Evenly spaced frames whose masks are kept."""
_NOT_DRAWING = ("__init__.py", "score.py", "score_types.py", "shape_overlap.py")
"""Files of this package that change no clip."""


@dataclass(frozen=True, kw_only=True)
class VideoSpec:
    """One clip, completely."""

    name: str
    """File name without its ending."""
    story: Story
    hand: Hand = field(default_factory=Hand)
    timing: Timing = field(default_factory=Timing)
    view: View = field(default_factory=View)
    room: Room = field(default_factory=Room)
    sensor: Sensor = field(default_factory=Sensor)
    seconds: float = 3.6
    fps: int = 30
    hide_m: float = 0.8
    """How far the hand draws back along its arm to leave the picture."""
    seed: int = 0
    """For textures, noise and the trunk's swaying."""

    @property
    def kind(self) -> MotionKind:
        return self.story.kind

    @property
    def caption(self) -> str:
        return self.story.caption

    @property
    def objects(self) -> tuple[str, ...]:
        """Phrases of the caption's things: the one that moves, then the others."""
        first, *others = self.story.actors
        return (first.phrase or "cover", *(a.phrase for a in others if a.phrase))


@dataclass(frozen=True, kw_only=True)
class SyntheticVideo:
    """A drawn clip with its truth."""

    spec: VideoSpec
    frame_idx: tuple[int, ...]
    """Which of the clip's frames these are."""
    frames: UInt8[np.ndarray, "time h w 3"] = field(repr=False)
    camera: Camera
    poses_world: Float[np.ndarray, "thing all_time 7"] = field(repr=False)
    """`[x, y, z, qw, qx, qy, qz]` of the bounding boxes' middles in every frame of the clip."""
    mask_idx: tuple[int, ...]
    """The clip's frames that have masks."""
    masks: UInt8[np.ndarray, "some_time h w"] = field(repr=False)
    """Labels: 0 background, 1 hand and arm, 2 and on the things in their order, 255 the bare table."""
    hand_in_view: Bool[np.ndarray, "all_time"] = field(repr=False)


@cache
def drawing_code() -> str:
    """Return a digest of the code that draws clips: with other code the same seed may give another clip."""
    sources = sorted(p for p in Path(__file__).parent.glob("*.py") if p.name not in _NOT_DRAWING)
    return hashlib.sha256(b"".join(p.read_bytes() for p in sources)).hexdigest()[:8]


def motion_of(spec: VideoSpec) -> Motion:
    """Return where everything is in every frame."""
    return animate(spec.story, spec.hand, spec.timing, spec.seconds, spec.fps, spec.hide_m)


def render(spec: VideoSpec, *, frames: Sequence[int] | None = None) -> SyntheticVideo:
    """Draw the clip, or only some of its frames.

    Raises:
        V2PError: there is no OpenGL.
    """
    motion, camera = motion_of(spec), spec.view.camera()
    n = len(motion.gesture)
    chosen = tuple(range(n)) if frames is None else tuple(frames)
    masked = tuple(sorted({chosen[round(k)] for k in np.linspace(0, len(chosen) - 1, NUM_MASKS)}))
    pictures, masks = [], []
    with _stage(spec, motion) as stage:
        for i in chosen:
            pictures.append(stage.shot(i))
            if i in masked:
                masks.append(stage.mask(i))
    seen = _hand_in_view(motion, spec.hand, camera)
    for i, mask in zip(masked, masks, strict=True):
        seen[i] = bool((mask == LABEL_HAND).any())
    return SyntheticVideo(
        spec=spec,
        frame_idx=chosen,
        frames=np.stack(pictures),
        camera=camera,
        poses_world=np.stack(
            [[pose_from_transform(T) for T in track] for track in motion.T_world_things]
        ),
        mask_idx=masked,
        masks=np.stack(masks),
        hand_in_view=seen,
    )


def render_views(
    spec: VideoSpec,
    frames: Sequence[int],
    *,
    with_hand: bool,
    views: Sequence[View] | None = None,
) -> tuple[UInt8[np.ndarray, "n h w 3"], UInt8[np.ndarray, "n h w"]]:
    """Draw only these frames, and their labels.

    Args:
        spec: the clip.
        frames: which frames.
        with_hand: without it hand and arm are not drawn, as in a still picture of the same moment.
        views: from where each is seen, with the size and the field of view of the clip's; the clip's own if not given.

    Raises:
        V2PError: there is no OpenGL.
    """
    pictures, labels = [], []
    with _stage(spec, motion_of(spec), with_hand=with_hand) as stage:
        for i, view in zip(frames, views or [spec.view] * len(frames), strict=True):
            stage.camera = view.camera()
            pictures.append(stage.shot(i))
            labels.append(stage.mask(i))
    return np.stack(pictures), np.stack(labels)


def random_spec(
    name: str,
    kind: MotionKind,
    rng: np.random.Generator,
    others: int | None = None,
    beside: VideoSpec | None = None,
    *,
    brings: bool = False,
) -> VideoSpec:
    """Return a clip of this kind with everything else drawn at random.

    Args:
        name: file name without its ending.
        kind: what happens.
        rng: where the draws come from.
        others: things that stand around, at most; 0 to 4 by chance where None.
        beside: a clip of the same folder: the same person filmed this one too, in the same room
            with the same camera on the same stand, and things lie anywhere on the table that it
            sees.
        brings: whether the hand comes with the thing that it puts down; of kinds in which a thing is carried.

    Raises:
        ValueError: no camera sees all of what was drawn, or that one does not.
    """
    for _ in range(60):
        hand, across = _random_hand(rng, kind)
        arm = np.array(hand.shoulder_m)
        count = int(rng.integers(0, 5)) if others is None else others
        try:
            story = random_story(
                kind, rng, count, arm_azimuth_rad=float(np.arctan2(arm[1], arm[0]))
            )
        except ValueError:  # nothing of the drawn size fits the part: another cast
            continue
        timing = replace(_random_timing(rng, kind), brings=brings)
        fps = int(rng.choice([12, 15, 24, 30], p=[0.15, 0.1, 0.35, 0.4]))
        spec = VideoSpec(
            name=name,
            story=story,
            hand=hand,
            timing=timing,
            room=random_room(rng, across or bool(rng.random() < 0.15)),
            sensor=random_sensor(rng),
            seconds=float(rng.uniform(2.5, 5.0)),
            fps=fps,
            hide_m=0.0,
            seed=int(rng.integers(2**31)),
        )
        if beside is not None:
            same = beside.hand
            hand = replace(
                hand,
                scale=same.scale,
                skin=same.skin,
                sleeve=same.sleeve,
                sleeve_print=same.sleeve_print,
            )
            spec = replace(spec, hand=hand, room=beside.room, sensor=beside.sensor)
        framed = _framed(spec, rng, None if beside is None else beside.view)
        if framed is not None:
            return framed
    raise ValueError(f"no camera sees all of a '{kind}' clip; draw again with another stream")


def _random_hand(rng: np.random.Generator, kind: MotionKind) -> tuple[Hand, bool]:
    where = str(rng.choice(["camera", "side", "across"], p=[0.55, 0.27, 0.18]))
    side = float(rng.choice([-1.0, 1.0]))
    if kind in ("push_left", "push_right") and rng.random() < 0.8:
        side = -1.0 if kind == "push_left" else 1.0
    shoulder = {
        "camera": (
            -rng.uniform(0.35, 0.7),
            side * rng.uniform(0.12, 0.5),
            rng.uniform(0.22, 0.45),
        ),
        "side": (rng.uniform(-0.3, 0.3), side * rng.uniform(0.5, 0.8), rng.uniform(0.18, 0.4)),
        "across": (rng.uniform(0.4, 0.7), side * rng.uniform(0.15, 0.55), rng.uniform(0.2, 0.4)),
    }[where]
    tone = rng.uniform(0, 1)
    # from deep brown to pale pink, redder or yellower by chance
    deep, pale = np.array((0.23, 0.14, 0.10)), np.array((0.90, 0.70, 0.60))
    r, g, b = ((1 - tone) * deep + tone * pale + rng.normal(0, 0.02, 3)).clip(0.05, 0.98).tolist()
    from_left = shoulder[1] > 0 if where != "across" else shoulder[1] < 0
    sleeve: Rgb | None = any_colour(rng) if rng.random() < 0.6 else None
    return Hand(
        left=bool(from_left if rng.random() < 0.85 else not from_left),
        scale=float(rng.uniform(0.9, 1.1)),
        skin=(r, g, b),
        sleeve=sleeve,
        sleeve_print=rng.choice(["plain", "plain", "plain", "stripes", "checker"]).item(),
        cuff_m=float(rng.choice([rng.uniform(0.01, 0.06), rng.uniform(0.06, 0.3)])),
        shoulder_m=(float(shoulder[0]), float(shoulder[1]), float(shoulder[2])),
    ), where == "across"


def _random_timing(rng: np.random.Generator, kind: MotionKind) -> Timing:
    late = float(rng.uniform(-0.05, 0.05))
    act_end = float(rng.uniform(0.6, 0.70)) + late
    if kind == "lift_up":
        act_end += 0.1
    leave = act_end + float(rng.uniform(0.05, 0.10))
    return Timing(
        come=(0.08 + late, 0.26 + late),
        close=(0.27 + late, 0.33 + late),
        act=(0.35 + late, act_end),
        leave=(leave, min(0.97, leave + float(rng.uniform(0.12, 0.2)))),
        starts_in_view=bool(rng.random() < (0.4 if kind == "push_with" else 0.15)),
        stays_in_view=bool(rng.random() < 0.25),
        from_side=bool(rng.random() < 0.65),
        push=str(rng.choice(["palm", "fingers"])),
    )


_SIZES = ((640, 480), (854, 480), (480, 640), (426, 240), (640, 360), (320, 240), (360, 640))
_SHARES = (0.36, 0.18, 0.14, 0.14, 0.08, 0.05, 0.05)


_ANYWHERE_M = 0.12
"""Standard deviation of where on the table things lie under a camera that nobody moves for them."""


def _framed(spec: VideoSpec, rng: np.random.Generator, stand: View | None) -> VideoSpec | None:
    """Return the clip with a camera that sees every thing of the caption at first and at last; None where none does.

    With a `stand`, the camera is as high as that one, looks the same way, and is moved beside the things alone.
    """
    story = spec.story
    motion = motion_of(spec)
    named = [k for k, a in enumerate(story.actors) if a.role not in ("bystander", "tool")]
    boxes = [_corners(story.actors[k].extents_m) for k in named]
    ends = [0, -1]
    points = np.concatenate(
        [
            apply(motion.T_world_things[k, i], box)
            for i in ends
            for k, box in zip(named, boxes, strict=True)
        ]
    )
    middle = (points.min(0) + points.max(0)) / 2
    for _ in range(60):
        view, aside = (
            _random_view(rng) if stand is None else (stand, rng.normal(0, _ANYWHERE_M, 2))
        )
        aim = middle[:2] + aside
        view = replace(
            view,
            back_m=float((view.height_m - middle[2]) / np.tan(view.pitch_rad) - aim[0]),
            side_m=float(aim[1]),
        )
        width, height = view.width_px, view.height_px
        camera = view.camera()
        uv = camera.project(points)
        margin = 0.015 * width
        fits = (
            not np.isnan(uv).any()
            and (uv > margin).all()
            and (uv < (width - margin, height - margin)).all()
        )
        if not fits:
            continue
        spread = [np.ptp(uv[8 * j : 8 * j + 8], axis=0) for j in range(2 * len(named))]
        if min(float(s.max()) for s in spread) < 0.065 * max(width, height):
            continue
        if _hides(story, uv, len(named)):
            continue
        hide = _hide_m(motion, spec, camera)
        if hide is None:
            continue
        far = max(float(points[:, 0].max()) + 0.12, spec.room.table_far_m)
        side = max(float(np.abs(points[:, 1]).max()) + 0.15, spec.room.table_side_m)
        room = replace(
            spec.room,
            table_far_m=far + 0.3 * abs(spec.room.yaw_rad),
            table_side_m=side + 0.3 * abs(spec.room.yaw_rad),
        )
        return replace(spec, view=view, hide_m=hide, room=room)
    return None


def _random_view(rng: np.random.Generator) -> tuple[View, Float[np.ndarray, "2"]]:
    """Return a camera, and how far beside the things' middle it looks [m]."""
    width, height = _SIZES[int(rng.choice(len(_SIZES), p=_SHARES))]
    camera_height, pitch = float(rng.uniform(0.25, 0.8)), float(np.radians(rng.uniform(20, 60)))
    aside = rng.normal(0, 0.04, 2)
    roll = float(np.radians(rng.normal(0, 0.9)))
    fovy = float(np.radians(rng.uniform(35, 60)))
    view = View(
        height_m=camera_height,
        pitch_rad=pitch,
        roll_rad=roll,
        fovy_rad=fovy,
        width_px=width,
        height_px=height,
    )
    return view, aside


def _hides(story: Story, uv: Float[np.ndarray, "n 2"], num: int) -> bool:
    """Return whether one thing of the caption hides much of another at first."""
    if story.kind == "uncover" or num < 2:
        return False
    one, two = ((uv[8 * j : 8 * j + 8].min(0), uv[8 * j : 8 * j + 8].max(0)) for j in (0, 1))
    both = (np.minimum(one[1], two[1]) - np.maximum(one[0], two[0])).clip(0).prod()
    return float(both) > 0.35 * min(
        float((one[1] - one[0]).prod()), float((two[1] - two[0]).prod())
    )


def _corners(extents: Float[np.ndarray, "3"]) -> Float[np.ndarray, "8 3"]:
    return np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * extents


def _hand_points(motion: Motion, hand: Hand, i: int) -> Float[np.ndarray, "n 3"]:
    """Return points about hand and arm in one frame."""
    T = motion.T_world_hand[i]
    bones = motion.gestures[motion.gesture[i]].bones
    mirror = np.array([1.0, -1.0 if hand.left else 1.0, 1.0])
    inner = np.array(
        [p for b in bones for p in (b[0], b[1])] + [WRIST, (0, 0.035, 0.02), (0, -0.035, 0.02)]
    )
    wrist = apply(T, (WRIST * hand.scale)[None])[0]
    side = np.cross(motion.arm[i], [0, 0, 1.0])
    reach = np.linspace(0.0, 0.75, 16)[:, None] * motion.arm[i]
    arm = np.concatenate([wrist + reach + k * 0.045 * side for k in (-1, 0, 1)])
    return np.concatenate(
        [apply(T, inner * mirror * hand.scale), arm, arm + np.array([0, 0, 0.045])]
    )


def _seen(points: Float[np.ndarray, "n 3"], camera: Camera, margin_px: float) -> bool:
    ahead = apply(inverse(camera.T_world_cam), points)[:, 2] > 0.05
    uv = np.nan_to_num(camera.project(points), nan=-1e9)
    inside = (uv > -margin_px).all(1) & (
        uv < (camera.width_px + margin_px, camera.height_px + margin_px)
    ).all(1)
    return bool((ahead & inside).any())


def _hand_in_view(motion: Motion, hand: Hand, camera: Camera) -> Bool[np.ndarray, "time"]:
    return np.array(
        [_seen(_hand_points(motion, hand, i), camera, 0.0) for i in range(len(motion.gesture))]
    )


def _hide_m(motion: Motion, spec: VideoSpec, camera: Camera) -> float | None:
    """Return how far the hand must draw back along its arm to leave the picture; None where two metres do not do."""
    away = np.array(spec.hand.shoulder_m) - motion.T_world_things[0, 0, :3, 3]
    away /= np.linalg.norm(away)
    worst = 0.0
    for i in (0, len(motion.gesture) - 1):
        points = _hand_points(motion, spec.hand, i)
        held = [1] * (spec.kind == "push_with") + [0] * (spec.timing.brings and i == 0)
        for k in held:
            corners = _corners(spec.story.actors[k].extents_m)
            points = np.concatenate([points, apply(motion.T_world_things[k, i], corners)])
        far = next(
            (d for d in np.arange(0.1, 1.9, 0.05) if not _seen(points + d * away, camera, 8.0)),
            None,
        )
        if far is None:
            return None
        worst = max(worst, float(far))
    return worst + 0.06


class _Stage:
    """A built scene in which any moment of the clip can be drawn."""

    def __init__(self, spec: VideoSpec, motion: Motion, with_hand: bool) -> None:
        view = spec.view
        props = [a.prop for a in spec.story.actors]
        self.spec, self.motion, self.with_hand = spec, motion, with_hand
        self.model = build(
            props,
            spec.room,
            spec.hand,
            motion.gestures,
            view.fovy_rad,
            (view.width_px, view.height_px),
            rng_for(spec.seed, "textures"),
        )
        self.data = mujoco.MjData(self.model)
        self.camera = view.camera()
        self.drawer = Drawer(self.model, labels_of(self.model))
        names = [self.model.geom(k).name for k in range(self.model.ngeom)]
        self.hands = [names.index(f"hand{k}") for k in range(len(motion.gestures))]
        self.arms = [names.index(n) for n in ("forearm", "sleeve") if n in names]
        self.sway = rng_for(spec.seed, "sway").normal(0, 1, 4)
        self.speed_px = self._speeds()

    def shot(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return frame i as the sensor sees it."""
        sensor, n = self.spec.sensor, len(self.motion.gesture)
        blur_px = float(self.speed_px[i]) * sensor.exposure
        parts = 1 if blur_px < 2.5 else 3 if blur_px < 14 else 4
        total = np.zeros((self.spec.view.height_px, self.spec.view.width_px, 3), np.float32)
        for k in range(parts):
            at = i + sensor.exposure * ((k + 0.5) / parts - 0.5)
            self._pose(at)
            total += self.drawer.picture(self.data)
        return developed(
            total / parts, sensor, i / max(n - 1, 1), rng_for(self.spec.seed, "noise", i)
        )

    def mask(self, i: int) -> UInt8[np.ndarray, "h w"]:
        """Return the labels of frame i."""
        self._pose(float(i))
        return self.drawer.mask(self.data)

    def _speeds(self) -> Float[np.ndarray, "time"]:
        m = self.motion
        tracks = [
            *m.T_world_things[:2, :, :3, 3],
            *((m.T_world_hand[:, :3, 3],) if self.with_hand else ()),
        ]
        uv = np.stack([np.nan_to_num(self.camera.project(track)) for track in tracks])
        uv = uv.clip(-200, 1200)
        return np.linalg.norm(np.gradient(uv, axis=1), axis=2).max(0)

    def _pose(self, at: float) -> None:
        m, n = self.motion, len(self.motion.gesture)
        at = float(np.clip(at, 0, n - 1))
        i, f = int(at), at - int(at)
        j = min(i + 1, n - 1)
        for k in range(len(m.T_world_things)):
            self._put(f"thing{k}", m.T_world_things[k, i], m.T_world_things[k, j], f)
        self._put("hand", m.T_world_hand[i], m.T_world_hand[j], f)
        arm = (1 - f) * m.arm[i] + f * m.arm[j]
        wrist = np.stack(
            [
                T[:3, 3] + T[:3, :3] @ (WRIST * self.spec.hand.scale)
                for T in (m.T_world_hand[i], m.T_world_hand[j])
            ]
        )
        self._put_at(
            "arm",
            (1 - f) * wrist[0] + f * wrist[1],
            _along_z(arm / np.linalg.norm(arm), m.T_world_hand[i, :3, 2]),
        )
        self._put_camera(self.camera)
        for k, geom in enumerate(self.hands):
            self.model.geom_group[geom] = 0 if self.with_hand and k == m.gesture[i] else 5
        for geom in self.arms:
            self.model.geom_group[geom] = 0 if self.with_hand else 5
        if self.spec.room.person:
            s = self.sway
            shoulder = np.array(self.spec.hand.shoulder_m)
            across = shoulder[0] > 0.3
            x = max(self.spec.room.table_far_m + 0.16, shoulder[0]) + 0.01 * np.sin(
                4 * at / n + s[0]
            )
            y = (shoulder[1] * 0.6 if across else 0.45 * np.sign(s[1])) + 0.012 * np.sin(
                3 * at / n + s[2]
            )
            self._put_at("trunk", np.array([x, y, 0.12]), np.eye(3))
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def _put_camera(self, camera: Camera) -> None:
        T = camera.T_world_cam
        self._put_at("camera", T[:3, 3], T[:3, :3] @ CV_FROM_GL)
        fovy = 2 * np.arctan(camera.height_px / 2 / camera.K[1, 1])
        self.model.cam_fovy[self.model.camera("view").id] = np.degrees(fovy)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def _put(
        self, name: str, a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"], f: float
    ) -> None:
        if f < 1e-6:
            self._put_at(name, a[:3, 3], a[:3, :3])
            return
        p, q = quat_from_matrix(a[:3, :3]), quat_from_matrix(b[:3, :3])
        q = (1 - f) * p + f * q * (1 if p @ q > 0 else -1)
        mocap = self.model.body(name).mocapid[0]
        self.data.mocap_pos[mocap] = (1 - f) * a[:3, 3] + f * b[:3, 3]
        self.data.mocap_quat[mocap] = q / np.linalg.norm(q)

    def _put_at(
        self, name: str, place: Float[np.ndarray, "3"], R: Float[np.ndarray, "3 3"]
    ) -> None:
        mocap = self.model.body(name).mocapid[0]
        self.data.mocap_pos[mocap] = place
        self.data.mocap_quat[mocap] = quat_from_matrix(R)


@contextmanager
def _stage(spec: VideoSpec, motion: Motion, *, with_hand: bool = True) -> Iterator[_Stage]:
    stage = _Stage(spec, motion, with_hand)
    with stage.drawer:
        yield stage


def _along_z(z: Float[np.ndarray, "3"], back: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation with z along the arm and x out of the hand's back."""
    x = back - (back @ z) * z
    x /= max(float(np.linalg.norm(x)), 1e-9)
    return np.stack([x, np.cross(z, x), z], 1)
