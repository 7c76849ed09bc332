"""Clips made ready before anybody asks: decoded, aligned and looked at by the network, which no hint changes.

A few are kept in memory, the last ones that were asked for.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from v2p_data.report.review_page import STILL_SIDE_PX, Stills
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.scene.grounding.hint_masks import hint_masks_of
from v2p_data.scene.reconstruct import prepared_for
from v2p_data.video.captions import VideoItem
from v2p_data.video.clip import Clip
from v2p_data.video.decode import VideoConfig, read_clip
from v2p_data.video.hints import CROP

KEPT = 4
"""Clips in memory: one of 150 frames takes 0.4 GB."""
NUM_STILLS = 9
_QUALITY = 80
_AT_ONCE = 2
_POLL_S = 0.1

Prepare = Callable[[Clip, SceneConfig], PreparedClip]


class PreparedClips:
    """Makes clips ready in threads of its own.

    Args:
        prepare: what is done with a decoded clip.
    """

    def __init__(self, prepare: Prepare) -> None:
        self._prepare = prepare
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="prepare")
        self.quiet = threading.Event()
        """Set while nothing is rebuilt for somebody who waits."""
        self.quiet.set()
        self._wanted: set[str] = set()
        self._lock = threading.Lock()
        self._ready: OrderedDict[str, Future[PreparedClip]] = OrderedDict()
        self._stills: dict[str, Future[Stills]] = {}

    def close(self) -> None:
        """Begin nothing new; what is being made is left to end."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def ask(
        self,
        video: VideoItem,
        video_cfg: VideoConfig,
        scene_cfg: SceneConfig,
        *,
        is_ahead: bool = False,
    ) -> Future[PreparedClip]:
        """Return the clip, without hints, or the promise of it; it counts as the one asked for last.

        A clip that is prepared ahead of time (`is_ahead`) waits until the machine is `quiet`.

        The future's error is the `ItemRejectedError` of a clip that cannot be used.
        """
        with self._lock:
            if not is_ahead:
                self._wanted.add(video.item)
            if (ready := self._ready.get(video.item)) is None:
                self._stills.setdefault(video.item, Future())
                ready = self._pool.submit(self._make, video, video_cfg, scene_cfg, is_ahead)
                self._ready[video.item] = ready
            self._ready.move_to_end(video.item)
            for item in list(self._ready)[:-KEPT]:
                if self._ready[item].done() or self._ready[item].cancel():
                    del self._ready[item]
                    if not self._stills[item].done():
                        del self._stills[item]
            return ready

    def stills(self, item: str) -> Future[Stills]:
        """Return stills of a clip that was asked for; they are there before it is ready.

        Raises:
            KeyError: nobody asked for it.
        """
        return self._stills[item]

    def _make(
        self, video: VideoItem, video_cfg: VideoConfig, scene_cfg: SceneConfig, is_ahead: bool
    ) -> PreparedClip:
        while is_ahead and video.item not in self._wanted and not self.quiet.wait(_POLL_S):
            pass
        stills = self._stills[video.item]
        try:
            crop = {p: hint for p, hint in video.hints.items() if p == CROP}
            clip = read_clip(replace(video, hints=crop), video_cfg)
            if not stills.done():
                stills.set_result(_stills_of(clip))
        except BaseException as error:
            if not stills.done():
                stills.set_exception(error)
            raise
        return self._prepare(clip, scene_cfg)


def prepared_ahead(clip: Clip, cfg: SceneConfig) -> PreparedClip:
    """Return the clip prepared, with its ends encoded where a model outlines objects: no mark changes that."""
    prepared = prepared_for(clip, cfg)
    if prepared.working.outliner is not None:
        prepared.working.outliner.encode_ends()
    return prepared


def outlines_of(prepared: PreparedClip) -> dict[str, list[list[list[float]]]]:
    """Return what the clip's hints stand for, by phrase: polygons in the file's pixels, in the frame that was marked.

    Raises:
        ItemRejectedError: `bad_hint`: a click or a stroke is on no object.
    """
    clip, working = prepared.clip, prepared.working
    to_clip = 1 / working.px_scale
    x0, y0, x1, _ = clip.in_file_px
    to_file = (x1 - x0) / clip.width_px
    out: dict[str, list[list[list[float]]]] = {}
    for phrase, marked in hint_masks_of(clip, working, prepared.segmentation, {}).items():
        found, _ = cv2.findContours(
            marked.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
        )
        out[phrase] = []
        for polygon in found:
            spots = (polygon[:, 0].astype(np.float64) + 0.5) * to_clip
            if clip.to_filmed is not None:
                H = clip.to_filmed[clip.hints[phrase].get("frame", 0)]
                spots = cv2.perspectiveTransform(spots[None], H)[0]
            out[phrase].append((spots * to_file + (x0, y0)).round(1).tolist())
    return out


def _stills_of(clip: Clip) -> Stills:
    chosen = np.unique(np.linspace(0, len(clip.frames) - 1, NUM_STILLS).round().astype(int))
    jpegs: list[bytes] = []
    for i in chosen:
        h, w = clip.frames[i].shape[:2]
        scale = min(1.0, STILL_SIDE_PX / max(h, w))
        small = cv2.resize(
            clip.frames[i], (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA
        )
        done, data = cv2.imencode(
            ".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        assert done
        jpegs.append(data.tobytes())
    return Stills(
        frames=tuple(int(clip.source_frame[i]) for i in chosen),
        jpegs=tuple(jpegs),
        size_px=clip.source_size_px,
        num_frames=clip.total_frames,
    )
