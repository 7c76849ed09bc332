"""Draw the README's picture from a finished demo run: what was understood, learned and recorded."""

import argparse
from pathlib import Path

import cv2
import numpy as np

from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.sim.render.masks import labels_to_rgb

HEIGHT_PX = 220
ITEMS = ("lift_red_box", "push_blue_box_left", "tip_green_carton")
INK, PAPER = (60, 60, 60), 255


def newest(run: Path, stage: str, item: str) -> Path:
    """Return the newest complete folder of a stage."""
    found = [p.parent for p in (run / stage).glob(f"{item}-*/record.json")]
    return max(found, key=lambda p: p.stat().st_mtime)


def fitted(image: np.ndarray) -> np.ndarray:
    """Return the image at the row's height."""
    width = round(image.shape[1] * HEIGHT_PX / image.shape[0])
    return cv2.resize(image, (width, HEIGHT_PX), interpolation=cv2.INTER_AREA)


def row(run: Path, item: str) -> np.ndarray:
    """Return one video's row: first and last frame as understood, then masks of one episode."""
    scene = newest(run, "scene", item)
    pictures = [
        np.asarray(cv2.imread(str(scene / f"overlay_{end}.png"))) for end in ("first", "last")
    ]
    episode = Episode.load(staged_episodes(newest(run, "episodes", item))[0])
    pictures.extend(
        labels_to_rgb(episode.labels[moment])[..., ::-1]
        for moment in np.linspace(0, len(episode.labels) - 1, 3).round().astype(int)
    )
    return np.hstack(
        [
            cv2.copyMakeBorder(fitted(p), 3, 3, 3, 3, cv2.BORDER_CONSTANT, value=(PAPER,) * 3)
            for p in pictures
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("outputs/demo"))
    parser.add_argument("--out", type=Path, default=Path("docs/chain.png"))
    arguments = parser.parse_args()
    rows = [row(arguments.run, item) for item in ITEMS]
    width = min(r.shape[1] for r in rows)
    arguments.out.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(arguments.out), np.vstack([r[:, :width] for r in rows]))
    print(f"Made {arguments.out}")


if __name__ == "__main__":
    main()
