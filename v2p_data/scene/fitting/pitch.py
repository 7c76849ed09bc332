"""The camera's pitch is the one at which all outlines together fit best."""

from dataclasses import replace

import numpy as np

from v2p_data.scene.data_types import CameraGuess, Fit
from v2p_data.scene.fitting.end_poses import fits_at_first
from v2p_data.scene.fitting.object_view import ObjectView
from v2p_data.scene.fitting.silhouette import camera_above

_TURN_COST = 0.007
"""Cost of a pitch one standard deviation off the expected one, in units of IoU of all outlines together."""
_PITCH_RANGE_RAD = (0.15, 1.4)
"""From nearly level to nearly straight down: beyond, outlines on the table say nothing of places on it."""


def best_pitch(shown: list[ObjectView], guess: CameraGuess) -> tuple[float, list[Fit]]:
    """Try pitches around the guess; the silhouettes decide, as far as the guess lets them."""
    best: tuple[float, float, list[Fit]] | None = None
    tried: list[float] = []

    def fits_at(pitch: float, *, thorough: bool) -> list[Fit]:
        camera = camera_above(shown[0].hidden.shape, pitch, guess.fov_rad)
        out = []
        for k, see in enumerate(shown):
            usual = see if thorough or k == 0 else replace(see, rests=see.rests[:1])
            options = fits_at_first(usual, camera, thorough=thorough)
            out.append(min(options, key=lambda fit: fit.cost))
        return out

    sd = guess.pitch_sd_rad
    for offsets in ((-1.8 * sd, -0.9 * sd, 0.0, 0.9 * sd, 1.8 * sd), (-0.4 * sd, 0.4 * sd)):
        centre = guess.pitch_rad if best is None else best[1]
        for offset in offsets:
            pitch = float(np.clip(centre + offset, *_PITCH_RANGE_RAD))
            if any(abs(pitch - other) < 0.01 for other in tried):
                continue
            tried.append(pitch)
            fits = fits_at(pitch, thorough=False)
            off = (pitch - guess.pitch_rad) / sd
            cost = sum(fit.cost for fit in fits) + _TURN_COST * off**2
            if best is None or cost < best[0]:
                best = cost, pitch, fits
    assert best is not None
    return best[1], fits_at(best[1], thorough=len(shown) > 1)
