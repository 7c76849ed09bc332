"""What is known of the camera before outlines are fitted: measured, or seen by the network."""

from dataclasses import replace

import numpy as np

from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import CameraGuess
from v2p_data.scene.scale.camera_height import SeenCamera

_FOCAL_SD = 0.15
"""Standard deviation of the logarithm of a guessed focal length; measured on drawn clips."""
_WIDTH_DOUBT = 1.4
"""Factor on the network's own standard deviation of the table's width; measured on clips that it was not trained on."""


def camera_guess(seen: SeenCamera, cfg: SceneConfig) -> CameraGuess:
    """Return the camera before any outline is fitted: the user's numbers, else the network's (`seen`)."""
    guess = CameraGuess(
        pitch_rad=seen.pitch_rad,
        pitch_sd_rad=float(np.clip(seen.pitch_sd_rad, 0.05, cfg.pitch_spread_rad)),
        fov_rad=float(2 * np.arctan(0.5 / seen.focal_widths)),
        table_width_m=seen.table_width_m,
        table_width_sd=_WIDTH_DOUBT * seen.table_width_sd,
    )
    return with_measured_camera(guess, cfg)


def with_measured_camera(guess: CameraGuess, cfg: SceneConfig) -> CameraGuess:
    """Return a guess of the camera with what the user measured in place of what was guessed.

    How large things are that one sees follows from the height together with pitch and focal
        length: where these are guessed,
    a measured height says no more than they do.
    """
    spread = cfg.camera_spread
    if cfg.pitch_rad is not None:
        guess = replace(guess, pitch_rad=cfg.pitch_rad, pitch_sd_rad=cfg.camera_spread)
    else:
        spread = float(np.hypot(spread, guess.pitch_sd_rad / np.tan(guess.pitch_rad)))
    if cfg.fov_rad is not None:
        guess = replace(guess, fov_rad=cfg.fov_rad)
    else:
        spread = float(np.hypot(spread, _FOCAL_SD))
    if cfg.camera_height_m is not None:
        guess = replace(guess, height_m=cfg.camera_height_m, height_sd=spread)
    return guess
