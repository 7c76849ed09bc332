"""A model that outlines objects, asked about the frames of one clip; what it made of a frame is kept."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int, UInt8

from v2p_data.scene.backends.outlines import EncodedPicture, Outlines, Spots


@runtime_checkable
class OutlineModel(Protocol):
    """What `backends/mobile_sam.py` offers."""

    def encode(self, picture: UInt8[np.ndarray, "h w 3"]) -> EncodedPicture:
        """Return a picture's features."""
        ...

    def outlines(
        self, picture: EncodedPicture, prompts: Sequence[Spots], size_px: tuple[int, int]
    ) -> Outlines:
        """Return three masks for each prompt."""
        ...


class Outliner:
    """Outlines at working size in the frames of one clip.

    Args:
        model: asked once per frame for its features, then for each set of prompts.
        frames: the clip's frames, larger than the working ones: outlines are finer there.
        frame_idx: each working frame's index among them.
        size_px: height and width of working frames.
    """

    def __init__(
        self,
        model: OutlineModel,
        frames: UInt8[np.ndarray, "clip_time h w 3"],
        frame_idx: Int[np.ndarray, "time"],
        size_px: tuple[int, int],
    ) -> None:
        self._model, self._frames, self._idx, self._size_px = model, frames, frame_idx, size_px
        self._encoded: dict[int, EncodedPicture] = {}

    def at(self, i: int, prompts: Sequence[Spots]) -> Outlines:
        """Return three masks for each prompt at working frame `i`, all in working pixels."""
        return self._model.outlines(self._features(i), prompts, self._size_px)

    def encode_ends(self) -> None:
        """Encode the first and the last frame, which every reconstruction asks about, before anybody waits for them."""
        for i in (0, -1):
            self._features(i)

    def _features(self, i: int) -> EncodedPicture:
        i %= len(self._idx)
        if i not in self._encoded:
            self._encoded[i] = self._model.encode(self._frames[self._idx[i]])
        return self._encoded[i]
