"""Draw the sample clips of `datasets/sample_videos`, with captions and ground truth beside them."""

import argparse
import json
from pathlib import Path

from v2p_data.video.synthetic_sample import COLOURS, VideoSpec, View, render, write
from v2p_data.video.synthetic_scene import Hand, Room, Thing

SAMPLES = (
    VideoSpec(
        name="lift_red_box",
        kind="lift_up",
        thing=Thing(
            label="red box",
            shape="box",
            size_m=(0.05, 0.06, 0.09),
            base=COLOURS["red"],
            accent=(0.93, 0.88, 0.76),
        ),
        distance_m=0.15,
        yaw_rad=0.22,
        seed=1,
    ),
    VideoSpec(
        name="push_blue_box_left",
        kind="push_left",
        thing=Thing(
            label="blue box",
            shape="box",
            size_m=(0.06, 0.09, 0.05),
            base=COLOURS["blue"],
            accent=COLOURS["yellow"],
            print="stripes",
        ),
        distance_m=0.15,
        yaw_rad=0.10,
        view=View(side_m=0.07),
        hand=Hand(skin=(0.72, 0.50, 0.38), sleeve=(0.46, 0.46, 0.44), arm=(-0.62, -0.76, 0.18)),
        seed=2,
    ),
    VideoSpec(
        name="tip_green_carton",
        kind="tip_over",
        thing=Thing(
            label="green carton",
            shape="box",
            size_m=(0.05, 0.05, 0.14),
            base=COLOURS["green"],
            accent=(0.92, 0.92, 0.86),
        ),
        yaw_rad=-0.12,
        view=View(side_m=0.05, back_m=0.62),
        hand=Hand(skin=(0.84, 0.62, 0.50), sleeve=(0.55, 0.28, 0.30), arm=(-0.66, -0.72, 0.16)),
        seed=3,
    ),
)
UNSEEN = (
    VideoSpec(
        name="lift_orange_can",
        kind="lift_up",
        thing=Thing(
            label="orange can",
            shape="cylinder",
            size_m=(0.06, 0.06, 0.10),
            base=COLOURS["orange"],
            accent=(0.95, 0.93, 0.85),
        ),
        distance_m=0.14,
        view=View(height_m=0.50, pitch_rad=0.68, back_m=0.56, side_m=-0.03, fovy_rad=0.74),
        room=Room(
            wood=(0.46, 0.31, 0.20),
            table_far_m=0.8,
            light_azimuth_rad=-1.9,
            light_elevation_rad=1.15,
            light=0.7,
            ambient=0.3,
        ),
        hand=Hand(skin=(0.62, 0.43, 0.33), sleeve=(0.20, 0.36, 0.34)),
        seed=4,
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    home = Path(__file__).parents[1] / "datasets" / "sample_videos"
    parser.add_argument("--out", type=Path, default=home, help="folder to write to")
    out: Path = parser.parse_args().out
    for folder, specs in ((out, SAMPLES), (out / "unseen", UNSEEN)):
        folder.mkdir(parents=True, exist_ok=True)
        captions = {}
        for spec in specs:
            path = write(render(spec), folder)
            captions[path.name] = {"caption": spec.caption, "objects": [spec.thing.label]}
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
        (folder / "captions.json").write_text(json.dumps(captions, indent=1) + "\n")


if __name__ == "__main__":
    main()
