"""Clips made ready before anybody asks: decoded, aligned and seen by the network, which no mark changes.

The clips that were asked for last are kept in memory.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int

from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.scene.grounding.methods.base import Seen
from v2p_data.scene.grounding.methods.hint import Hints
from v2p_data.scene.reconstruct import prepared_for
from v2p_data.video.captions import VideoItem
from v2p_data.video.clip import Clip
from v2p_data.video.decode import read_clip
from v2p_data.video.hints import CROP

KEPT = 4
"""Clips in memory: one of 150 frames takes 0.4 GB."""
NUM_STILLS = 9
_AT_ONCE = 2

Polygons = list[list[list[float]]]
"""Corners x, y [px of the file] of each polygon."""


@dataclass(frozen=True, kw_only=True)
class Promise:
    """A clip that is being made ready; the futures' error is the `ItemRejectedError` of a clip that cannot be used."""

    decoded: Future[Clip]
    """Ready first: a person sees pictures while the network works."""
    prepared: Future[PreparedClip]
    """Without hints."""


class PreparedClips:
    """Makes clips ready in threads of its own."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="prepare")
        self._lock = threading.Lock()
        self._promises: OrderedDict[str, Promise] = OrderedDict()

    def close(self) -> None:
        """Begin nothing new; what is being made is left to end."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def ask(self, video: VideoItem, recipe_of: Callable[[], Mapping[str, Any]]) -> Promise:
        """Return the promise of a clip, which counts as the one asked for last.

        Args:
            video: the file.
            recipe_of: gives the recipe of its scene's stage, with the settings `video` and `scene`.
        """
        crop = {phrase: hint for phrase, hint in video.hints.items() if phrase == CROP}
        with self._lock:
            if video.item not in self._promises:
                recipe = recipe_of()
                decoded = self._pool.submit(read_clip, replace(video, hints=crop), recipe["video"])
                prepared = self._pool.submit(lambda: _prepared(decoded.result(), recipe["scene"]))
                self._promises[video.item] = Promise(decoded=decoded, prepared=prepared)
            self._promises.move_to_end(video.item)
            while len(self._promises) > KEPT:
                _, oldest = self._promises.popitem(last=False)
                oldest.prepared.cancel()
            return self._promises[video.item]

    def decoded(self, item: str) -> Future[Clip]:
        """Return the pictures of a clip that was asked for.

        Raises:
            KeyError: nobody asked for it, or it was long ago.
        """
        return self._promises[item].decoded


def stills_of(clip: Clip) -> Int[np.ndarray, " n"]:
    """Return which of a clip's frames are shown as stills, the first and the last among them."""
    return np.unique(np.linspace(0, len(clip.frames) - 1, NUM_STILLS).round().astype(int))


def outlines_of(prepared: PreparedClip) -> dict[str, Polygons]:
    """Return what the clip's hints stand for, by phrase, in the frame that was marked.

    Raises:
        ItemRejectedError: `bad_hint`: a click or a stroke is on no object.
    """
    clip, working = prepared.clip, prepared.working
    x0, y0, x1, _ = clip.in_file_px
    to_file = (x1 - x0) / clip.width_px
    outlines: dict[str, Polygons] = {}
    seen = Seen(clip=clip, working=working, segmentation=prepared.segmentation)
    for phrase, marked in Hints().marks(seen).items():
        polygons, _ = cv2.findContours(
            marked.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
        )
        outlines[phrase] = []
        for polygon in polygons:
            corners = (polygon[:, 0].astype(np.float64) + 0.5) / working.px_scale
            if clip.to_filmed is not None:
                H = clip.to_filmed[clip.hints[phrase].get("frame", 0)]
                corners = cv2.perspectiveTransform(corners[None], H)[0]
            outlines[phrase].append((corners * to_file + (x0, y0)).round(1).tolist())
    return outlines


def _prepared(clip: Clip, cfg: Any) -> PreparedClip:
    """Return the clip prepared, with its ends encoded where a model outlines objects: no mark changes that."""
    prepared = prepared_for(clip, cfg)
    if prepared.working.outliner is not None:
        prepared.working.outliner.encode_ends()
    return prepared
