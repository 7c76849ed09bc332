"""Whether a policy suits a robot, found out before anything moves: one sentence names the first thing that does not.

Files first (whole, with statistics), then what the policy sees and does (features, size, palette, names, scale, rate).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.deployment.facts import Facts, read_facts
from v2p_data.deployment.limits import STEP_S
from v2p_data.deployment.robot import ActionScale
from v2p_data.episodes.features import (
    ACTION_KEY,
    ACTION_NAMES,
    MASK_KEY,
    RGB_KEY,
    STATE_KEY,
    STATE_NAMES,
)
from v2p_data.errors import V2PError
from v2p_data.json_files import read_object
from v2p_data.sim.masks import PALETTE

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
PROCESSOR_FILES = ("policy_preprocessor.json", "policy_postprocessor.json")
HZ = round(1 / STEP_S)
STATISTICS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""What each of LeRobot's modes normalises by."""
LEAST_MOTION = 0.1
"""An action that never goes beyond this is one in metres."""


@dataclass(frozen=True, kw_only=True)
class Offer:
    """What a robot gives and takes."""

    size_px: tuple[int, int]
    """Height and width of its pictures."""
    scale: ActionScale
    camera: str = "mask"
    """What the policy would see: `mask` or `rgb`."""


def check_policy(folder: Path, offer: Offer, task: str = "") -> Facts:
    """Demand that a policy suits a robot; return what is known of its training.

    Raises:
        V2PError: it does not, or its checkpoint is damaged.
    """
    config = _policy_file(folder, CONFIG_FILE, "it is no LeRobot policy")
    _check_whole(folder / WEIGHTS_FILE)
    _check_features(folder, config, offer)
    return check_meaning(folder, offer.scale, task)


def check_meaning(folder: Path, scale: ActionScale, task: str = "") -> Facts:
    """Demand that a policy's masks, states and actions mean what a robot's do; return what is known of its training.

    LeRobot's own tools compare shapes, and no more.

    Args:
        folder: the policy.
        scale: what an action of 1 means on the robot.
        task: in words; decides where the policy knows several scales.

    Raises:
        V2PError: they do not, or the policy's files are damaged.
    """
    config = _policy_file(folder, CONFIG_FILE, "it is no LeRobot policy")
    facts = read_facts(folder)
    _check_palette(folder, config, facts)
    _check_statistics(folder, config)
    _check_names(folder, facts)
    _check_scale(folder, facts, scale, task)
    if facts.fps is not None and abs(facts.fps - HZ) > 0.01:
        raise V2PError(
            f"the policy in {folder} was trained at {facts.fps:g} frames per second, and the loop runs at {HZ} Hz: its"
            f" motions would be {HZ / facts.fps:.2g} times as fast; train it on a dataset of {HZ} frames per second"
        )
    return facts


def unknowns(facts: Facts) -> str:
    """Return in words what could not be checked; empty where all was."""
    missing = [
        words
        for words, value in (
            (f"its rate (taken to be {HZ} Hz)", facts.fps),
            ("the names of its actions", facts.action),
            ("its action scale", facts.position_steps_m),
        )
        if not value
    ]
    return ", ".join(missing)


def _check_whole(path: Path) -> None:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise V2PError(f"{path.parent} holds no {path.name}: it is no LeRobot policy")
    try:
        with safe_open(path, framework="np") as file:
            if not list(file.keys()):
                raise V2PError(f"{path} holds no weights; copy the policy anew")
    except (SafetensorError, OSError) as error:
        raise V2PError(f"{path} is damaged or cut off ({error}); copy the policy anew") from error


def _check_features(folder: Path, config: dict[str, Any], offer: Offer) -> None:
    sees, does = (
        _shapes(folder, config, "input_features"),
        _shapes(folder, config, "output_features"),
    )
    picture_key = MASK_KEY if offer.camera == "mask" else RGB_KEY
    given = {picture_key: (3, *offer.size_px), STATE_KEY: (len(STATE_NAMES),)}
    names = ", ".join(f"'{key}' {shape}" for key, shape in given.items())
    for key, shape in sees.items():
        if key not in given and "empty_camera" not in key:
            raise V2PError(
                f"the policy in {folder} wants '{key}' {shape}, which the robot does not give; it gives {names}"
            )
    if picture_key not in sees:
        raise V2PError(
            f"the policy in {folder} does not look at '{picture_key}'; it wants {', '.join(sees) or 'nothing'}"
        )
    if sees[picture_key] != given[picture_key]:
        _, height, width = (*sees[picture_key], 0, 0, 0)[:3]
        raise V2PError(
            f"the policy in {folder} was trained on pictures of {width} x {height} pixels, and the robot gives"
            f" {offer.size_px[1]} x {offer.size_px[0]}; train it on a dataset of that size"
        )
    if sees.get(STATE_KEY, given[STATE_KEY]) != given[STATE_KEY]:
        raise V2PError(
            f"the policy in {folder} wants '{STATE_KEY}' of shape {sees[STATE_KEY]}, and the robot gives"
            f" {given[STATE_KEY]}: it was trained on a dataset of another version or another robot"
        )
    if does.get(ACTION_KEY) != (len(ACTION_NAMES),):
        raise V2PError(
            f"the policy in {folder} gives '{ACTION_KEY}' of shape {does.get(ACTION_KEY)}, and the robot takes"
            f" ({len(ACTION_NAMES)},): {', '.join(ACTION_NAMES)}"
        )


def _check_palette(folder: Path, config: dict[str, Any], facts: Facts) -> None:
    greys = config.get("mask_greys") or facts.palette
    if not greys:
        return
    theirs = np.asarray(greys, float)
    for label, grey in enumerate(PALETTE[: len(theirs)]):
        nearest = int(np.abs(theirs - grey).argmin())
        if nearest != label:
            raise V2PError(
                f"the policy in {folder} knows another palette: grey {grey} is label {label} here and {nearest} there"
                f" (its greys are {list(map(int, theirs))}); train it on masks of this version"
            )


def _check_statistics(folder: Path, config: dict[str, Any]) -> None:
    modes: dict[str, str] = config.get("normalization_mapping") or {}
    for name in PROCESSOR_FILES:
        said = _policy_file(
            folder, name, "LeRobot's processors are part of a policy; copy it anew"
        )
        for step in said.get("steps", []):
            if "normalizer" not in str(step.get("registry_name", "")):
                continue
            settings = step.get("config") or {}
            state = folder / str(step.get("state_file", ""))
            stats = _statistics(state) if step.get("state_file") else {}
            is_before = name == PROCESSOR_FILES[0]
            for key, feature in (settings.get("features") or {}).items():
                mode = (settings.get("norm_map") or modes).get(feature.get("type"), "IDENTITY")
                if is_before and key == ACTION_KEY:
                    continue  # nobody gives it actions
                shape = tuple(feature.get("shape") or ())
                for statistic in STATISTICS.get(mode, ()):
                    _check_statistic(state, stats, key, statistic, shape)
            _check_range(folder, stats)


def _check_statistic(
    state: Path, stats: dict[str, np.ndarray], key: str, statistic: str, shape: tuple[int, ...]
) -> None:
    value = stats.get(f"{key}.{statistic}")
    if value is None:
        raise V2PError(
            f"{state} lacks the statistic '{statistic}' of '{key}', which the policy normalises by; train it on a dataset"
            " with statistics"
        )
    if not np.isfinite(value).all():
        raise V2PError(
            f"the statistic '{statistic}' of '{key}' in {state} is not finite; train anew"
        )
    if len(shape) == 1 and value.shape != shape:
        raise V2PError(
            f"the statistic '{statistic}' of '{key}' in {state} has shape {value.shape}, and the policy's feature {shape}"
        )


def _check_range(folder: Path, stats: dict[str, np.ndarray]) -> None:
    low, high = stats.get(f"{ACTION_KEY}.min"), stats.get(f"{ACTION_KEY}.max")
    if low is None or high is None or low.shape != (len(ACTION_NAMES),):
        return
    farthest = np.maximum(np.abs(low), np.abs(high))
    if farthest.max() > 1.001:
        k = int(farthest.argmax())
        raise V2PError(
            f"the policy in {folder} was trained with another action scale: its '{ACTION_NAMES[k]}' reaches"
            f" {farthest[k]:.3g}, and the robot takes -1 to 1"
        )
    if 0 < farthest[:3].max() < LEAST_MOTION:
        raise V2PError(
            f"the policy in {folder} was trained with another action scale: its displacements never exceed"
            f" {farthest[:3].max():.3g}, as ones in metres do, and the robot takes -1 to 1"
        )


def _statistics(path: Path) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise V2PError(
            f"{path} is missing, damaged or cut off ({error}); copy the policy anew"
        ) from error


def _check_names(folder: Path, facts: Facts) -> None:
    for what, theirs, ours in (
        ("states", facts.state, STATE_NAMES),
        ("actions", facts.action, ACTION_NAMES),
    ):
        if theirs and tuple(theirs) != tuple(ours):
            strange = [name for name in theirs if name not in ours] or [
                "the same in another order"
            ]
            raise V2PError(
                f"the policy in {folder} was trained on {what} named {', '.join(strange)}, and the robot's are"
                f" {', '.join(ours)}: it is another robot's policy"
            )


def _check_scale(folder: Path, facts: Facts, scale: ActionScale, task: str) -> None:
    steps = facts.position_steps_m
    of_task = {steps[task]} if task in steps else set(steps.values())
    wanted: Sequence[tuple[str, set[float], float]] = (
        ("displacement [m]", of_task, scale.position_step_m),
        ("rotation [rad]", {facts.rotation_step_rad} - {None}, scale.rotation_step_rad),  # type: ignore[arg-type]
        ("finger travel [m]", {facts.finger_step_m} - {None}, scale.finger_step_m),  # type: ignore[arg-type]
    )
    for what, theirs, ours in wanted:
        if theirs and not any(abs(value - ours) <= 0.01 * ours for value in theirs):
            numbers = ", ".join(f"{value:g}" for value in sorted(theirs))
            raise V2PError(
                f"the policy in {folder} was trained with another action scale: an action of 1 was a {what} of {numbers}"
                f" a step, and on this robot it is {ours:g}"
            )


def _shapes(folder: Path, config: dict[str, Any], name: str) -> dict[str, tuple[int, ...]]:
    try:
        return {
            str(key): tuple(int(n) for n in feature["shape"])
            for key, feature in (config.get(name) or {}).items()
        }
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise V2PError(
            f"'{name}' in {folder / CONFIG_FILE} cannot be understood ({error})"
        ) from error


def _policy_file(folder: Path, name: str, otherwise: str) -> dict[str, Any]:
    path = folder / name
    if not path.is_file():
        raise V2PError(f"{folder} holds no {name}: {otherwise}")
    return read_object(path, "copy the policy anew")
