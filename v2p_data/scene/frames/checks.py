"""A clip in which nothing moves, or the camera does, is turned away before anything else is asked."""

import numpy as np

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.colour import lab_distance
from v2p_data.scene.frames.segmentation import Segmentation, passers_by
from v2p_data.scene.frames.working_clip import WorkingClip, camera_shift_px

_CHANGED_LAB = 15.0
"""Distance in Lab from the first frame, from which a pixel has changed: noise and flicker stay below."""
_LEAST_CHANGE = 0.003
"""Share of the picture, 0 to 1, that changes where something is manipulated."""


def check_change(working: WorkingClip) -> None:
    """Turn away a clip whose picture does not change.

    Raises:
        ItemRejectedError: `nothing_moves`, with the share of the picture that changes.
    """
    change = np.zeros(working.shape, np.float32)
    for lab in working.lab[1:]:
        np.maximum(change, lab_distance(lab, working.lab[0]), out=change)
    share = float((change > _CHANGED_LAB).mean())
    if share < _LEAST_CHANGE:
        raise ItemRejectedError(
            "nothing_moves",
            f"only {share:.2%} of the picture changes; the clip shows no manipulation",
            round(share, 5),
        )


def check_still(working: WorkingClip, segmentation: Segmentation, max_shift_px: float) -> None:
    """Turn away a clip whose camera still moves; what passes in front of it does not count.

    Raises:
        ItemRejectedError: `camera_moves`, with the shift [px] of a picture 320 px wide.
    """
    shift = camera_shift_px(working, passers_by(segmentation))
    if shift > max_shift_px:
        raise ItemRejectedError(
            "camera_moves",
            f"the camera moves by {shift:.1f} px of 320, at most {max_shift_px:.0f} px can be understood, and its "
            "frames could not be aligned: film from a stand, or hold it stiller",
            round(shift, 2),
        )
