"""SAM 2 as a stream tracker: the clicked pixel prompts it, each picture is seen once, memory stays bounded.

Slower than the tracker without weights: it needs a GPU for 20 Hz. Tested with a tiny random
    checkpoint of the same class;
real weights were not run.

Source: Ravi et al. 2024 (SAM 2), arXiv:2408.00714.
"""

import numpy as np
from jaxtyping import Bool, UInt8

from v2p_data.deployment.segmentation import Tracked
from v2p_data.errors import V2PError
from v2p_data.scene.backends.checkpoint import load_checkpoint
from v2p_data.scene.backends.config import SegmentConfig
from v2p_data.scene.backends.segment import Stream


class Sam2Tracker:
    """Follows one object with SAM 2.

    Args:
        cfg: checkpoint and device.

    Raises:
        V2PError: the checkpoint cannot be loaded.
    """

    def __init__(self, cfg: SegmentConfig) -> None:
        self._cfg = cfg
        self._checkpoint = load_checkpoint("sam2", cfg.model, cfg.device, cfg.dtype)
        self._stream: Stream | None = None

    def start(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        click_px: tuple[float, float],
        robot: Bool[np.ndarray, "h w"],
    ) -> Bool[np.ndarray, "h w"]:
        """Return the mask of what was clicked.

        Raises:
            V2PError: the click is outside the picture or on the robot, or the model sees nothing there.
        """
        h, w = picture.shape[:2]
        u, v = click_px
        if not (0 <= u < w and 0 <= v < h):
            raise V2PError(
                f"the click at ({u:g}, {v:g}) lies outside the picture, which has {w} x {h} pixels"
            )
        if robot[int(v), int(u)]:
            raise V2PError(f"the click at ({u:g}, {v:g}) is on the robot; click on the object")
        self._stream = Stream(self._checkpoint, [np.array([[u, v]])], self._cfg)
        found = self.track(picture, robot)
        if not found.mask.any():
            raise V2PError(
                f"SAM 2 sees no object at the click ({u:g}, {v:g}); click on its middle"
            )
        return found.mask

    def track(
        self, picture: UInt8[np.ndarray, "h w 3"], robot: Bool[np.ndarray, "h w"]
    ) -> Tracked:
        """Return the object in the next picture."""
        assert self._stream is not None, "start comes first"
        logits, sure = self._stream.next(picture)
        mask = logits[0] > self._cfg.mask_threshold
        seen = bool(mask.any()) and float(sure[0]) > 0.5
        return Tracked(
            mask=mask if seen else np.zeros_like(mask),
            score=logits[0].astype(np.float32),
            confidence=float(sure[0]) if seen else 0.0,
            is_hidden=False,
        )
