"""Whether the columns of two datasets mean the same: other versions of LeRobot say the same in other words.

What matters is a column's type, shape, names, rate and, of depth, its unit. How its video was encoded, where that is noted, and how the
names are wrapped (`["x"]`, `{"motors": ["x"]}`) does not.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.tables import INFO_FILE

_PICTURES = ("video", "image")
_IS_DEPTH = ("is_depth_map", "video.is_depth_map")
_DEPTH_SCALE = ("depth_unit", "video.depth_min", "video.depth_max", "video.shift", "video.use_log")
"""What turns a stored number into a distance."""


def first_difference(a: dict[str, Any], b: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first thing that differs in what two `meta/info.json` mean, and what each says; None if nothing does."""
    for name in ("fps", "robot_type"):
        if a.get(name) != b.get(name):
            return name, a.get(name), b.get(name)
    here, there = ({*info["features"]} for info in (a, b))
    if here != there:
        return (
            "the list of columns, less what both have,",
            sorted(here - there),
            sorted(there - here),
        )
    for key, feature in a["features"].items():
        ours, theirs = _meaning(feature, a), _meaning(b["features"][key], b)
        if feature.get("dtype") in _PICTURES and None in (ours["names"], theirs["names"]):
            ours["names"] = theirs["names"]  # the shape tells enough
        for part, value in ours.items():
            if value != theirs[part]:
                return f"{part} of {key}", value, theirs[part]
    return None


def common_features(infos: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the feature table of each, in the words of the first, where `first_difference` finds nothing.

    LeRobot merges tables only where all that is noted is equal, encoders aside.
    """
    if all(info["features"] == infos[0]["features"] for info in infos[1:]):
        return [info["features"] for info in infos]
    told: list[dict[str, Any]] = []
    for info in infos:
        table: dict[str, Any] = {}
        for key, first in infos[0]["features"].items():
            table[key] = {part: first.get(part) for part in ("dtype", "shape", "names")}
            if _noted(first):
                table[key]["info"] = _noted(first)
        told.append(info["features"] if info["features"] == table else table)
    return told


def write_retold(root: Path, info: dict[str, Any], out: Path) -> None:
    """Write `meta/info.json` anew at `out`, beside links to everything else of the dataset at `root`."""
    (out / INFO_FILE).parent.mkdir(parents=True)
    for path in root.resolve().iterdir():
        if path.name != "meta":
            (out / path.name).symlink_to(path)
    for path in (root.resolve() / INFO_FILE).parent.iterdir():
        if path.name != Path(INFO_FILE).name:
            (out / "meta" / path.name).symlink_to(path)
    (out / INFO_FILE).write_text(json.dumps(info, indent=4, ensure_ascii=False))


def _meaning(feature: dict[str, Any], info: dict[str, Any]) -> dict[str, Any]:
    noted = _noted(feature)
    shape = [int(n) for n in feature.get("shape") or ()]
    names = _names(feature.get("names"))
    if feature.get("dtype") in _PICTURES and names is not None:
        names = ["channels" if n == "channel" else n for n in names]
    return {
        "dtype": feature.get("dtype"),
        "shape": shape,
        "names": names if shape != [1] else None,  # one number needs none
        "fps": feature.get("fps", info.get("fps")),
        "depth": any(noted.get(key) for key in _IS_DEPTH),
        "depth scale": {k: noted.get(k) for k in _DEPTH_SCALE},
    }


def _noted(feature: dict[str, Any]) -> dict[str, Any]:
    """Return what is noted of a video; older versions of LeRobot call it otherwise."""
    return feature.get("info") or feature.get("video_info") or {}


def _names(names: Any) -> list[str] | None:
    """Return the names in a row, however they are wrapped; None where there are none."""
    if not names:
        return None
    if isinstance(names, dict):
        numbered = all(isinstance(v, int) for v in names.values())
        names = sorted(names, key=lambda name: names[name]) if numbered else list(names.values())
    flat: list[str] = []
    for name in names:
        flat += [str(n) for n in name] if isinstance(name, list | tuple) else [str(name)]
    return flat
