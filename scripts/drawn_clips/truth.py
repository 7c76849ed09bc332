"""A drawn clip on disk: the video, what is true of it, its masks and its things' meshes; and the way back."""

import json
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from drawn_clips.clips import LABEL_HAND, LABEL_TABLE, LABEL_THING, SyntheticVideo
from drawn_clips.props import shape_of
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera


@dataclass(frozen=True, kw_only=True)
class TrueThing:
    """What is true of one thing."""

    mask_label: int
    phrase: str | None
    """As the caption calls it; None where it does not."""
    noun: str
    role: str
    """manipulated, reference, tool, container, cover or bystander."""
    form: str
    """The plain form that is nearest: box, cylinder, sphere, or mesh where none is near."""
    size_m: tuple[float, float, float]
    """Full extents in its own frame, handles and all."""
    hollow: bool
    symmetry: str
    """none, box (half turns), round (any turn about its z) or sphere."""
    mesh: Path
    """OBJ of the true shape, the bounding box's middle at the origin."""
    poses_world: Float[np.ndarray, "time 7"] = field(repr=False)
    """`[x, y, z, qw, qx, qy, qz]` of the bounding box's middle."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What is true of a drawn clip."""

    video: Path
    caption: str
    objects: tuple[str, ...]
    """Phrases: the one that moves first, then the others of the caption."""
    kind: str
    fps: float
    num_frames: int
    camera: Camera
    hand_in_view: Bool[np.ndarray, "time"] = field(repr=False)
    things: tuple[TrueThing, ...]
    mask_idx: Int[np.ndarray, "some_time"]
    """The frames that have masks, the first and the last among them."""
    masks: UInt8[np.ndarray, "some_time h w"] = field(repr=False)
    """0 background, 1 hand and arm, 2 and on the things in their order, 255 the bare table; seen
    from the first frame's camera."""


def write(video: SyntheticVideo, folder: Path) -> Path:
    """Write `<name>.mp4`, and under `truth/` its `<name>.json`, `<name>_masks.npz` and `<name>_<i>.obj`.

    Return the mp4.
    """
    spec, camera = video.spec, video.camera
    truth = folder / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    path = folder / f"{spec.name}.mp4"
    with av.open(str(path), "w", options={"movflags": "faststart"}) as out:
        # one thread and no tool version in the stream: the same pictures give the same bytes
        options = {
            "crf": str(spec.sensor.crf),
            "preset": "veryfast",
            "x264-params": "threads=1:no-info=1",
        }
        stream = out.add_stream("libx264", rate=Fraction(spec.fps), options=options)
        stream.width, stream.height = spec.view.width_px, spec.view.height_px
        stream.pix_fmt = "yuv420p"
        for pixels in video.frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode(None))
    things: list[dict[str, Any]] = []
    for i, actor in enumerate(spec.story.actors):
        shape = shape_of(actor.prop)
        lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in shape.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in shape.faces + 1]
        mesh = f"{spec.name}_{i}.obj"
        (truth / mesh).write_text("\n".join(lines) + "\n", encoding="utf-8")
        things.append(
            {
                "label": actor.prop.noun,
                "phrase": actor.phrase,
                "noun": actor.prop.noun,
                "role": actor.role,
                "form": actor.prop.form,
                "size_m": shape.extents.round(6).tolist(),
                "hollow": actor.prop.hollow,
                "symmetry": actor.prop.symmetry,
                "mesh": mesh,
                "mask_label": LABEL_THING + i,
                "poses_world": video.poses_world[i].round(6).tolist(),
            }
        )
    np.savez_compressed(
        truth / f"{spec.name}_masks.npz", masks=video.masks, frame_idx=np.array(video.mask_idx)
    )
    said = {
        "video": path.name,
        "caption": spec.caption,
        "objects": list(spec.objects),
        "kind": spec.kind,
        "fps": spec.fps,
        "num_frames": len(video.frames),
        "camera": _said(camera),
        "table": {"normal": [0.0, 0.0, 1.0], "height_m": 0.0},
        "hand_in_view": video.hand_in_view.tolist(),
        "masks": f"{spec.name}_masks.npz",
        "mask_labels": {"background": 0, "hand": LABEL_HAND, "table": LABEL_TABLE},
        "things": things,
    }
    (truth / f"{spec.name}.json").write_text(json.dumps(said) + "\n", encoding="utf-8")
    return path


def load_truth(folder: Path, name: str) -> Truth:
    """Return what `write` wrote of the clip `name` into `folder`.

    Raises:
        V2PError: there is no such truth.
    """
    path = folder / "truth" / f"{name}.json"
    if not path.is_file():
        known = sorted(p.stem for p in (folder / "truth").glob("*.json"))[:10]
        raise V2PError(f"no truth for clip '{name}' in {path.parent}; there are {known}")
    said = json.loads(path.read_text(encoding="utf-8"))
    with np.load(path.parent / said["masks"]) as saved:
        masks, mask_idx = saved["masks"], saved["frame_idx"]
    things = tuple(
        TrueThing(
            mask_label=t["mask_label"],
            phrase=t["phrase"],
            noun=t["noun"],
            role=t["role"],
            form=t["form"],
            size_m=tuple(t["size_m"]),
            hollow=t["hollow"],
            symmetry=t["symmetry"],
            mesh=path.parent / t["mesh"],
            poses_world=np.array(t["poses_world"]),
        )
        for t in said["things"]
    )
    return Truth(
        video=folder / said["video"],
        caption=said["caption"],
        objects=tuple(said["objects"]),
        kind=said["kind"],
        fps=float(said["fps"]),
        num_frames=said["num_frames"],
        camera=_camera(said["camera"]),
        hand_in_view=np.array(said["hand_in_view"]),
        things=things,
        mask_idx=mask_idx,
        masks=masks,
    )


def _said(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "K": camera.K.round(6).tolist(),
        "T_world_cam": camera.T_world_cam.round(9).tolist(),
    }


def _camera(said: dict[str, Any]) -> Camera:
    return Camera(
        width_px=said["width_px"],
        height_px=said["height_px"],
        K=np.array(said["K"]),
        T_world_cam=np.array(said["T_world_cam"]),
    )
