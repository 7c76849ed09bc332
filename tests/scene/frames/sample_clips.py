"""Sample clips with other frames: edited videos are put together of them."""

from dataclasses import replace

import numpy as np

from v2p_data.video.clip import Clip


def with_frames(clip: Clip, frames: np.ndarray) -> Clip:
    """Return a clip with other frames, as if its file had held them at twice the size."""
    n, h, w = frames.shape[:3]
    return replace(
        clip,
        frames=frames,
        source_size_px=(2 * w, 2 * h),
        source_frame=np.arange(n),
        times_s=np.arange(n) / clip.fps,
        total_frames=n,
        source_fps=clip.fps,
    )
