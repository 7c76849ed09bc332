"""A model that knows everyday things by sight, asked about the frames of one clip; what it saw in a frame is kept."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int, UInt8

from v2p_data.scene.backends.nanodet import Boxes


@runtime_checkable
class ThingModel(Protocol):
    """What `backends/nanodet.py` offers."""

    def boxes(self, picture: UInt8[np.ndarray, "h w 3"]) -> Boxes:
        """Return what may be things in an RGB picture."""
        ...


class Sightings:
    """Boxes at working size in the frames of one clip.

    Args:
        model: asked once per frame.
        frames: the clip's frames, larger than the working ones.
        frame_idx: each working frame's index among them.
        px_scale: working pixels per pixel of `frames`.
    """

    def __init__(
        self,
        model: ThingModel,
        frames: UInt8[np.ndarray, "clip_time h w 3"],
        frame_idx: Int[np.ndarray, "time"],
        px_scale: float,
    ) -> None:
        self._model, self._frames, self._idx, self._scale = model, frames, frame_idx, px_scale
        self._seen: dict[int, Boxes] = {}

    def at(self, i: int) -> Boxes:
        """Return what may be things in working frame `i`, in working pixels."""
        i %= len(self._idx)
        if i not in self._seen:
            seen = self._model.boxes(self._frames[self._idx[i]])
            self._seen[i] = replace(seen, xyxy=seen.xyxy * np.float32(self._scale))
        return self._seen[i]
