"""A page on which a person judges a run's scenes and marks what was not found.

One HTML file: stills lie in it, overlay videos beside it in the run. Judgements and hints stay in the browser until they
are downloaded as `review.json` and `captions.json`; `v2p_data.video.save_hints.merge_captions` reads both.
Text from users reaches the page only as JSON and through the template's escaping, and a content policy keeps any other
script than the page's own from running.
"""

import base64
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import cv2
import jinja2
import numpy as np
from jaxtyping import UInt8

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.scene.scene import SCENE_FILE
from v2p_data.video.captions import VideoItem
from v2p_data.video.clip import Hint
from v2p_data.video.decode import VideoConfig, read_clip

SCHEMA = 1
STILL_SIDE_PX = 640
"""The longer side, where few clips leave room for so large stills; 320 for a hundred clips."""
NUM_STILLS = 5
MAX_STILL_BYTES = 8_500_000
"""Size of all stills together in the page, which so stays below 10 MB."""
_LEAST_BYTES = 4_000
"""For less a still shows nothing, and only the first and last are kept."""
_QUALITIES = (
    (1.0, 75), (1.0, 60), (0.75, 60), (0.5, 75), (0.5, 60), (0.5, 45), (0.35, 45), (0.25, 40),
)  # fmt: skip
"""Scale and JPEG quality, tried in order until a still is small enough."""

Status = Literal["accepted", "rejected", "failed"]


@dataclass(frozen=True, kw_only=True)
class Stills:
    """Moments of a video as JPEGs, the first and the last frame among them."""

    frames: tuple[int, ...]
    """The file's frame numbers."""
    jpegs: tuple[bytes, ...] = field(repr=False)
    size_px: tuple[int, int]
    """Width and height of the video as a player shows it: hints count in these."""
    num_frames: int


@dataclass(frozen=True, kw_only=True)
class ReviewClip:
    """What became of one video, and what the page needs to show it."""

    item: str
    key: str
    """Changes when the scene is made anew, so that an old judgement does not stick to it."""
    status: Status
    caption: str
    objects: tuple[str, ...]
    """Phrases that hints can be given for."""
    used_hints: tuple[str, ...] = ()
    """Phrases that had a hint when the scene was made."""
    folder: Path | None = None
    """Folder of the accepted scene."""
    reason: str = ""
    """Slug of a rejection."""
    detail: str = ""
    value: float | None = None
    video: str = ""
    """File name beside `captions.json`; empty where the video is not at hand, and then no hints can be given."""
    hints: Mapping[str, Hint] = field(default_factory=dict[str, Hint])
    """What the caption file says now, in the file's pixels and frames."""
    stills: Stills | None = None
    trouble: str = ""
    """Why there are no stills or no hints, in a sentence."""


def stills_of(video: VideoItem, num_clips: int) -> Stills:
    """Return stills of a video, small enough that those of `num_clips` videos fit into one page.

    Frames that have a hint are among them.

    Raises:
        ItemRejectedError: the video cannot be decoded.
    """
    cfg = VideoConfig(max_side_px=STILL_SIDE_PX, min_frames=2, min_side_px=16)
    bare = VideoItem(item=video.item, path=video.path, caption=video.caption)
    clip = read_clip(bare, cfg)
    budget = MAX_STILL_BYTES * 3 // 4 // max(1, num_clips)
    count = NUM_STILLS if budget >= NUM_STILLS * _LEAST_BYTES else 2
    even = np.linspace(0, len(clip.frames) - 1, count).round().astype(int)
    hinted = [
        int(np.abs(clip.source_frame - hint.get("frame", 0)).argmin())
        for hint in video.hints.values()
    ]
    chosen = np.unique([*even, *hinted])
    return Stills(
        frames=tuple(int(clip.source_frame[i]) for i in chosen),
        jpegs=tuple(_jpeg(clip.frames[i], budget // len(chosen)) for i in chosen),
        size_px=clip.source_size_px,
        num_frames=clip.total_frames,
    )


def write_review(
    clips: Sequence[ReviewClip],
    out: Path,
    *,
    title: str,
    store: str,
    captions: Mapping[str, Any],
    commands: Mapping[str, str],
) -> Path:
    """Write the page and return its path.

    Args:
        clips: in the order in which they are shown.
        out: the page; overlay videos are linked relative to it.
        title: name of the run.
        store: under what the browser keeps what is judged; another run's page must not read it.
        captions: content of the caption file beside the videos, `{}` if there is none.
        commands: what to type with the downloaded `review.json` and `captions.json`, by these names.

    Raises:
        V2PError: the page cannot be written.
    """
    data = {
        "schema": SCHEMA,
        "run": title,
        "store": store,
        "captions": dict(captions),
        "commands": dict(commands),
        "clips": [clip_json(clip, out.parent) for clip in clips],
    }
    page = rendered("review.html", title, data)
    temporary = out.with_name(out.name + ".tmp")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(page)
        temporary.replace(out)
    except OSError as error:
        raise V2PError(f"cannot write the page {out}: {error.strerror}") from error
    return out


def rendered(template: str, title: str, data: Mapping[str, Any]) -> bytes:
    """Return a page of this folder with its data; no script but its own may run."""
    folder = Path(__file__).parent
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}
    script = re.search(r'<script id="app">(.*?)</script>', (folder / template).read_text(), re.S)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    page = environment.get_template(template).render(title=title, data=data, script_hash=digest)
    # File names may hold bytes that are no text; they must not keep the page from being made.
    return page.encode("utf-8", "replace")


def clip_json(clip: ReviewClip, home: Path) -> dict[str, Any]:
    """Return what a page in the folder `home` shows of a clip."""
    scene = _scene_json(clip.folder)
    stills = clip.stills
    return {
        "item": clip.item,
        "key": clip.key,
        "status": clip.status,
        "caption": clip.caption,
        "video": clip.video,
        "objects": list(clip.objects),
        "hints": {name: dict(hint) for name, hint in clip.hints.items()},
        "used_hints": list(clip.used_hints),
        "kind": str(scene.get("kind", "")),
        "confidence": scene.get("confidence"),
        "stages": _stages(scene),
        "things": _things(scene),
        "warnings": [str(w) for w in _list(scene.get("warnings"))],
        "overlay": _link(clip.folder, "overlay.mp4", home),
        "pictures": [
            link
            for name in ("overlay_first.png", "overlay_last.png")
            if (link := _link(clip.folder, name, home))
        ],
        "reason": clip.reason,
        "detail": clip.detail,
        "value": clip.value,
        "trouble": clip.trouble,
        "size_px": list(stills.size_px) if stills else None,
        "num_frames": stills.num_frames if stills else 0,
        "stills": [
            {"frame": frame, "uri": "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()}
            for frame, jpeg in zip(stills.frames, stills.jpegs, strict=True)
        ]
        if stills
        else [],
    }


def _scene_json(folder: Path | None) -> dict[str, Any]:
    """Return what `scene.json` says, `{}` where it cannot be read: a page for people shows what there is."""
    if folder is None:
        return {}
    data = json_or_none(folder / SCENE_FILE)
    return data if isinstance(data, dict) else {}


def _stages(scene: dict[str, Any]) -> list[dict[str, Any]]:
    """Return each stage's name, confidence and the reason for a low one."""
    stages = scene.get("confidences")
    return [
        {"name": str(name), "value": sure["value"], "reason": str(sure.get("reason", ""))}
        for name, sure in (stages.items() if isinstance(stages, dict) else ())
        if isinstance(sure, dict) and isinstance(sure.get("value"), int | float)
    ]


def _things(scene: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "name": str(o.get("name", "")),
            "label": str(o.get("label", "")),
            "role": str(o.get("role", "")),
            "size_cm": [100 * s for s in _list(o.get("size_m")) if isinstance(s, int | float)],
            "mass_kg": o.get("mass_kg"),
            "source": str((o.get("source") or {}).get("size", "")),
            "hollow": bool(o.get("hollow")),
            "shape": str(o.get("shape", "")),
        }
        for o in _list(scene.get("objects"))
        if isinstance(o, dict)
    ]


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _link(folder: Path | None, name: str, home: Path) -> str:
    """Return a file's address relative to the page, empty where there is no such file."""
    if folder is None or not (folder / name).is_file():
        return ""
    relative = os.path.relpath((folder / name).resolve(), home.resolve())
    return quote(Path(relative).as_posix())


def _jpeg(image: UInt8[np.ndarray, "h w 3"], max_bytes: int) -> bytes:
    """Return the image as a JPEG that is as good as `max_bytes` allow."""
    data = b""
    for scale, quality in _QUALITIES:
        h, w = image.shape[:2]
        size = (max(2, round(w * scale)), max(2, round(h * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        how = [cv2.IMWRITE_JPEG_QUALITY, quality]
        data = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), how)[1].tobytes()
        if len(data) <= max_bytes:
            break
    return data
