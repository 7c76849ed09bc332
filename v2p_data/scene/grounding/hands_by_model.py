"""A model that knows hands is asked where they are in a clip; it runs in an environment of its own."""

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.scene.backends.config import HandsConfig
from v2p_data.scene.backends.hands_setup import installed_worker
from v2p_data.scene.backends.worker import WorkerRequest, run_worker
from v2p_data.scene.frames.hand_track import HandTrack
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip

MOST_FRAMES = 75
"""Frames of a clip that the model sees: at 40 ms each it takes 3 s."""


def track_hands(clip: Clip, working: WorkingClip, cfg: HandsConfig) -> HandTrack | None:
    """Return the clip's hands; None without a model.

    Raises:
        V2PError: `mediapipe` is asked for but was not set up, or the worker fails.
    """
    command = cfg.worker
    if cfg.backend in ("auto", "mediapipe"):
        command = installed_worker()
        if not command and cfg.backend == "mediapipe":
            raise V2PError(
                "scene.hands.backend is 'mediapipe', which was not set up here; run 'v2p setup hands', or leave the option out"
            )
    if cfg.backend == "none" or not command:
        return None
    n = len(working.rgb)
    picks = np.unique(np.linspace(0, n - 1, min(n, MOST_FRAMES)).round().astype(int))
    images = clip.frames[working.frame_idx[picks]]
    answer = run_worker(
        command, WorkerRequest(kind="hands", arrays={"images": images}), cfg.worker_timeout_s
    ).arrays
    order = np.argsort(answer["image_idx"], kind="stable")
    return HandTrack(
        at=picks[answer["image_idx"][order]],
        px=answer["landmarks_px"][order].astype(float) * working.px_scale,
        metres=answer["landmarks_m"][order].astype(float),
        num_sampled=len(picks),
    )
