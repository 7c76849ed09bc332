"""A model that knows everyday things by sight, asked about the frames of one clip; what it saw in a frame is kept."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Int, UInt8

from v2p_data.scene.backends.nanodet import Boxes, Detector


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """Boxes at working size in the frames of one clip."""

    model: Detector
    """Asked once per frame."""
    frames: UInt8[np.ndarray, "clip_time h w 3"]
    """The clip's, larger than the working ones."""
    frame_idx: Int[np.ndarray, "time"]
    """Each working frame's index among them."""
    px_scale: float
    """Working pixels per pixel of `frames`."""
    _seen: dict[int, Boxes] = field(default_factory=dict[int, Boxes])

    def at(self, i: int) -> Boxes:
        """Return what may be things in working frame `i`, in working pixels."""
        if i not in self._seen:
            seen = self.model.boxes(self.frames[self.frame_idx[i]])
            self._seen[i] = replace(seen, xyxy=seen.xyxy * np.float32(self.px_scale))
        return self._seen[i]
