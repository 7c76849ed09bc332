"""Where hands and their fingertips are over a clip, as a model that knows hands says: what a hand takes and puts down.

`grounding/by_model.py` asks the model.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

_WRIST, _MIDDLE_KNUCKLE = 0, 9
_TIPS = [4, 8, 12, 16, 20]
_REACH = 0.3
"""In palm lengths: a fingertip so near to an object's mask touches it. Of 16 right objects of real
clips 14 are nearer in 78 % of the frames in which they move, and wrong ones in 0 to 16 %."""
_KNOWN_SHARE = 0.5
"""Share of the sampled frames in which a hand must be found, so that its absence elsewhere means something."""
_APART = 1.0
"""In palm lengths: two hands at one place are one hand, found twice."""
_UPRIGHT = 0.4
"""Sine of the angle at which a hand points up or down in the picture."""
_FACING_SHARE = 0.1
"""Of the sampled frames. In 32 real clips two hands face each other in one of 75 frames at most."""
_FEWEST = 5
"""Frames with a hand and a moving object, from which their share says something."""


@dataclass(frozen=True, kw_only=True)
class HandTrack:
    """All hands found in a clip, in the order of time."""

    at: Int[np.ndarray, "k"]
    """Working frame of each hand."""
    px: Float[np.ndarray, "k 21 2"]
    """Landmarks [px of the working frames]."""
    metres: Float[np.ndarray, "k 21 3"]
    """Landmarks about the hand's own middle [m]."""
    num_sampled: int
    """Frames that the model saw."""

    @property
    def is_known(self) -> bool:
        """Whether hands were found often enough to say where no hand was."""
        return len(np.unique(self.at)) >= max(_FEWEST, _KNOWN_SHARE * self.num_sampled)

    @property
    def is_seen(self) -> bool:
        """Return whether any hand was found, in more than a frame or two."""
        return len(np.unique(self.at)) >= _FEWEST

    def touches(self, k: int, mask: Bool[np.ndarray, "h w"], reach: float = _REACH) -> bool:
        """Return whether a fingertip of hand `k` is at the mask, which is not empty."""
        h, w = mask.shape
        x, y = np.floor(self.px[k][_TIPS]).astype(int).T
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        palm = float(np.linalg.norm(self.px[k][_WRIST] - self.px[k][_MIDDLE_KNUCKLE]))
        away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
        return bool(inside.any()) and float(away[y[inside], x[inside]].min()) <= reach * palm


def contact_share(
    hands: HandTrack | None, masks: Bool[np.ndarray, "time h w"], moving: Int[np.ndarray, "n"]
) -> float | None:
    """Return the share of the moving object's frames, of those with a hand, in which a fingertip is at it.

    Args:
        hands: of the clip.
        masks: of the object, by working frame.
        moving: working frames in which it moves.

    None where hands are not known, or were seen in too few of these frames.
    """
    if hands is None or not hands.is_known:
        return None
    seen = [k for k, i in enumerate(hands.at) if i in moving and masks[i].any()]
    frames = {int(hands.at[k]) for k in seen}
    if len(frames) < _FEWEST:
        return None
    return len({int(hands.at[k]) for k in seen if hands.touches(k, masks[hands.at[k]])}) / len(
        frames
    )


def people_face(hands: HandTrack | None) -> bool:
    """Return whether two people's hands are seen: one reaches up in the picture, the other down.

    One person's two hands point the same way, up or down. False where hands are not known.
    """
    if hands is None:
        return False
    facing = 0
    for i in np.unique(hands.at):
        here = np.flatnonzero(hands.at == i)
        ways = hands.px[here, _MIDDLE_KNUCKLE] - hands.px[here, _WRIST]
        palms = np.maximum(np.linalg.norm(ways, axis=1), 1e-6)
        rise, middle = ways[:, 1] / palms, hands.px[here].mean(1)
        facing += any(
            rise[a] < -_UPRIGHT
            and rise[b] > _UPRIGHT
            and np.linalg.norm(middle[a] - middle[b]) > _APART * max(palms[a], palms[b])
            for a in range(len(here))
            for b in range(len(here))
        )
    return facing >= max(_FEWEST, _FACING_SHARE * hands.num_sampled)
