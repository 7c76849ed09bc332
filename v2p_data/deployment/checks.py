"""Whether a policy suits a robot, found out before anything moves: one sentence names the first thing that does not.

Files first (whole, with statistics), then what the policy sees and does (features, size, palette, names, scale, rate).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from v2p_data.deployment.limits import STEP_S
from v2p_data.deployment.robot import ActionScale
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    ACTION_NAMES,
    MASK_KEY,
    STATE_KEY,
    STATE_NAMES,
    state_names,
)
from v2p_data.errors import V2PError
from v2p_data.evaluation.checkpoint import PROCESSOR_FILES, Checkpoint, check_checkpoint
from v2p_data.evaluation.facts import Facts, interface_of, read_facts
from v2p_data.sim.render.masks import PALETTE
from v2p_data.sim.robot.action_names import action_names
from v2p_data.sim.robot.interface import STEPS, ArmInterface
from v2p_data.sim.robot.robot import NUM_ARM_JOINTS

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


def check_policy(
    folder: Path,
    size_px: tuple[int, int],
    scale: ActionScale,
    task: str = "",
    *,
    gives_joints: bool = False,
) -> Facts:
    """Demand that a policy suits a robot; return what is known of its training.

    Args:
        folder: the policy.
        size_px: height and width of the robot's pictures.
        scale: what an action of 1 means on the robot.
        task: in words; decides where the policy knows several scales.
        gives_joints: whether the robot gives the angles of its arm's joints.

    Raises:
        V2PError: it does not, or its checkpoint is damaged.
    """
    found = check_checkpoint(folder)
    interface, *_ = interface_of(folder)
    if interface.joint_state and not gives_joints:
        raise V2PError(
            f"the policy in {folder} was trained with --episodes.joint-state, and this robot gives no angles of joints;"
            " one that segments by itself gives them with --robot.joint_state=true"
        )
    _check_features(folder, found, size_px, interface)
    return _check_meaning(folder, found, scale, task, interface)


def check_meaning(
    folder: Path, scale: ActionScale, task: str = "", interface: ArmInterface = STEPS
) -> Facts:
    """Demand that a policy's masks, states and actions mean what a robot's do; return what is known of its training.

    LeRobot's own tools compare shapes, and no more.

    Args:
        folder: the policy.
        scale: what an action of 1 means on the robot.
        task: in words; decides where the policy knows several scales.
        interface: what the robot gives and takes.

    Raises:
        V2PError: they do not, or the policy's files are damaged.
    """
    found = check_checkpoint(folder)
    wanted, *_ = interface_of(folder)
    if wanted != interface:
        raise V2PError(
            f"the policy in {folder} sees and says {_in_words(wanted)}, and the robot is set to {_in_words(interface)};"
            f" connect it with --robot.actions={wanted.actions} --robot.joint_state={str(wanted.joint_state).lower()}"
        )
    return _check_meaning(folder, found, scale, task, interface)


def _in_words(interface: ArmInterface) -> str:
    return (
        f"'{interface.actions}' {'with' if interface.joint_state else 'without'} angles of joints"
    )


def _check_meaning(
    folder: Path, found: Checkpoint, scale: ActionScale, task: str, interface: ArmInterface
) -> Facts:
    facts = read_facts(folder)
    _check_palette(folder, found, facts)
    _check_statistics(folder, found, is_steps=interface.actions == "delta_tool")
    _check_names(folder, facts, interface)
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


def names_of(interface: ArmInterface) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of a Franka arm's states and actions."""
    num_states = len(STATE_NAMES) + NUM_ARM_JOINTS * interface.joint_state
    return state_names(num_states), action_names(interface.actions)


def _check_features(
    folder: Path, found: Checkpoint, size_px: tuple[int, int], interface: ArmInterface
) -> None:
    states, actions = names_of(interface)
    sees, does = (
        {key: feature.shape for key, feature in (features or {}).items()}
        for features in (found.config.input_features, found.config.output_features)
    )
    given = {MASK_KEY: (3, *size_px), STATE_KEY: (len(states),)}
    names = ", ".join(f"'{key}' {shape}" for key, shape in given.items())
    for key, shape in sees.items():
        if key not in given and "empty_camera" not in key:
            raise V2PError(
                f"the policy in {folder} wants '{key}' {shape}, which the robot does not give; it gives {names}"
            )
    if MASK_KEY not in sees:
        raise V2PError(
            f"the policy in {folder} does not look at '{MASK_KEY}'; it wants {', '.join(sees) or 'nothing'}"
        )
    if sees[MASK_KEY] != given[MASK_KEY]:
        _, height, width = (*sees[MASK_KEY], 0, 0, 0)[:3]
        raise V2PError(
            f"the policy in {folder} was trained on pictures of {width} x {height} pixels, and the robot gives"
            f" {size_px[1]} x {size_px[0]}; train it on a dataset of that size"
        )
    if sees.get(STATE_KEY, given[STATE_KEY]) != given[STATE_KEY]:
        raise V2PError(
            f"the policy in {folder} wants '{STATE_KEY}' of shape {sees[STATE_KEY]}, and the robot gives"
            f" {given[STATE_KEY]}: it was trained on a dataset of another version or another robot"
        )
    if does.get(ACTION_KEY) != (len(actions),):
        raise V2PError(
            f"the policy in {folder} gives '{ACTION_KEY}' of shape {does.get(ACTION_KEY)}, and the robot takes"
            f" ({len(actions)},): {', '.join(actions)}"
        )


def _check_palette(folder: Path, found: Checkpoint, facts: Facts) -> None:
    greys = found.config.mask_greys or facts.palette
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


def _check_statistics(folder: Path, found: Checkpoint, *, is_steps: bool) -> None:
    from safetensors.numpy import load_file

    modes = found.config.normalization_mapping
    for name, steps in found.steps.items():
        for step in steps:
            if "normalizer" not in step.registry_name:
                continue
            state = folder / (step.state_file or "")
            stats = load_file(state) if step.state_file else {}
            is_before = name == PROCESSOR_FILES[0]
            for key, feature in step.config.features.items():
                mode = (step.config.norm_map or modes).get(feature.type, "IDENTITY")
                if is_before and key == ACTION_KEY:
                    continue  # nobody gives it actions
                for statistic in STATISTICS.get(mode, ()):
                    _check_statistic(state, stats, key, statistic, feature.shape)
            if is_steps:
                _check_range(folder, stats)


def _check_statistic(
    state: Path, stats: dict[str, np.ndarray], key: str, statistic: str, shape: tuple[int, ...]
) -> None:
    value = stats.get(f"{key}.{statistic}")
    if value is None:
        raise V2PError(
            f"{state} lacks the statistic '{statistic}' of '{key}', which the policy normalises "
            "by; train it on a dataset"
            " with statistics"
        )
    if len(shape) == 1 and value.shape != shape:
        raise V2PError(
            f"the statistic '{statistic}' of '{key}' in {state} has shape {value.shape}, and the "
            f"policy's feature {shape}"
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


def _check_names(folder: Path, facts: Facts, interface: ArmInterface) -> None:
    states, actions = names_of(interface)
    for what, theirs, ours in (
        ("states", facts.state, states),
        ("actions", facts.action, actions),
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
        if not all(abs(value - ours) <= 0.01 * ours for value in theirs):
            numbers = ", ".join(f"{value:g}" for value in sorted(theirs))
            raise V2PError(
                f"the policy in {folder} was trained with another action scale: an action of 1 "
                f"was a {what} of {numbers}"
                f" a step, and on this robot it is {ours:g}"
            )
