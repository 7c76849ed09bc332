"""A worker that finds hands and their landmarks with MediaPipe, in an environment of its own.

    python hands_worker.py --request DIR --result DIR

It answers requests of kind `hands` (`docs/workers.md`). The models come with MediaPipe's wheel,
and nothing is downloaded. `v2p setup hands` makes the environment. This file imports nothing of
`v2p_data`, which is not installed there.
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("GLOG_minloglevel", "2")  # before MediaPipe is imported

import mediapipe  # pyright: ignore[reportMissingImports]
import numpy as np

mp: Any = mediapipe
SCHEMA, VERSION, KIND = "v2p-worker", 1, "hands"
BAD_REQUEST = 2
MOST_HANDS = 2
LEAST_SCORE = 0.5
"""Least score of a palm's detection, and of its tracking from one picture to the next: MediaPipe's own default."""


def main() -> int:
    """Answer one request; the exit code is that of the workers' contract."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--request", type=Path, required=True)
    parser.add_argument("--result", type=Path, required=True)
    args = parser.parse_args()
    request = json.loads((args.request / "request.json").read_text(encoding="utf-8"))
    if (request["schema"], request["version"], request["kind"]) != (SCHEMA, VERSION, KIND):
        sys.stderr.write(f"this worker does '{KIND}' of version {VERSION}\n")
        return BAD_REQUEST
    with np.load(args.request / "arrays.npz", allow_pickle=False) as file:
        images = file["images"]
    np.savez(args.result / "result.npz", **hands_in(images))
    head = {"schema": SCHEMA, "version": VERSION, "kind": KIND, "fields": {}}
    (args.result / "result.json").write_text(json.dumps(head), encoding="utf-8")
    return 0


def hands_in(images: np.ndarray) -> dict[str, Any]:
    """Return the hands of pictures in their order in time.

    Args:
        images: (n, h, w, 3) uint8 RGB.

    Returns:
        Per hand k its picture `image_idx` (k), `landmarks_px` (k, 21, 2), `landmarks_m` (k, 21, 3) about the hand's own
        middle, `scores` (k) of being the hand that `is_right` (k) says.
    """
    h, w = images.shape[1:3]
    idx, pixels, metres, scores, right = [], [], [], [], []
    finder = mp.solutions.hands.Hands(
        static_image_mode=False,
        max_num_hands=MOST_HANDS,
        min_detection_confidence=LEAST_SCORE,
        min_tracking_confidence=LEAST_SCORE,
    )
    with finder:
        for number, image in enumerate(images):
            found = finder.process(image)
            if not found.multi_hand_landmarks:
                continue
            for on_picture, in_world, side in zip(
                found.multi_hand_landmarks,
                found.multi_hand_world_landmarks,
                found.multi_handedness,
                strict=True,
            ):
                idx.append(number)
                pixels.append([(p.x * w, p.y * h) for p in on_picture.landmark])
                metres.append([(p.x, p.y, p.z) for p in in_world.landmark])
                scores.append(side.classification[0].score)
                # MediaPipe says it of mirrored pictures.
                right.append(side.classification[0].label == "Left")
    return {
        "image_idx": np.array(idx, np.int64),
        "landmarks_px": np.array(pixels, np.float32).reshape(-1, 21, 2),
        "landmarks_m": np.array(metres, np.float32).reshape(-1, 21, 3),
        "scores": np.clip(np.array(scores, np.float32), 0, 1),
        "is_right": np.array(right, bool),
    }


if __name__ == "__main__":
    sys.exit(main())
