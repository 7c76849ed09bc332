"""What a policy's training knew that its network does not say: rate, names, palette, action scale. One file beside it.

`v2p train` writes `v2p.json` into the policy's folder. Policies that came without it are traced to
their dataset, by the record of the run or LeRobot's `train_config.json`, as long as it is there.
"""

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Gt
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors.numpy import load_file

from v2p_data.episodes.dataset.features import ACTION_KEY, METADATA_FILE, STATE_KEY, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.evaluation.checkpoint import (
    CONFIG_FILE,
    OTHER_FILES,
    PROCESSOR_FILES,
    WEIGHTS_FILE,
    state_files,
)
from v2p_data.json_files import read_object
from v2p_data.pipeline.artifact import read_record, write_json_atomically
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.robot.action_names import (
    DELTA_NAMES,
    TOOL_NAMES,
    Actions,
    action_names,
    actions_named,
)
from v2p_data.sim.robot.interface import ArmInterface
from v2p_data.sim.robot.robot import TARGET_LOW_M
from v2p_data.task.task import TASK_FILE

FACTS_FILE = "v2p.json"
INFO_FILE = "meta/info.json"
TASKS_IN_DATASET = Path("v2p/tasks")
NEAREST_M = TARGET_LOW_M[0] - 1e-3
"""No target of the tool is nearer to the arm's base."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts of one policy; None or empty where it is not known."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    fps: Annotated[float, Gt(0)] | None = None
    state: tuple[str, ...] = ()
    """Names of the state's entries, in order."""
    action: tuple[str, ...] = ()
    palette: tuple[int, ...] = ()
    """Grey of each label."""
    position_steps_m: dict[str, float] = field(default_factory=dict[str, float])
    """Per task in words: how far an action of 1 moves the target in one step."""
    rotation_step_rad: float | None = None
    finger_step_m: float | None = None


def facts_of_dataset(dataset: Path) -> Facts:
    """Return what a LeRobot dataset says of itself; parts that are missing stay unknown.

    Raises:
        V2PError: a file of it cannot be read.
    """
    info, ours = _told(dataset / INFO_FILE), _told(dataset / METADATA_FILE)
    try:
        features: dict[str, Any] = info.get("features", {})
        palette = {int(k): int(grey) for k, grey in ours.get("palette", {}).items()}
        tasks = [_told(path) for path in _task_files(dataset)]
        return Facts(
            fps=float(info["fps"]) if "fps" in info else None,
            state=_names(features.get(STATE_KEY)),
            action=_names(features.get(ACTION_KEY)),
            palette=tuple(palette[k] for k in sorted(palette)),
            position_steps_m={
                str(t["description"]): SimConfig.position_step_m
                * float(t.get("motion_scale", 1.0))
                for t in tasks
            },
            rotation_step_rad=SimConfig.rotation_step_rad if ours else None,
            finger_step_m=SimConfig.finger_step_m if ours else None,
        )
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise V2PError(
            f"the metadata of dataset {dataset} cannot be understood ({type(error).__name__}: {error}); check it with"
            " 'v2p verify'"
        ) from error


def interface_of(policy: Path) -> tuple[ArmInterface, int, int]:
    """Return what a policy sees of the arm and tells it, and how many entries its states and its actions have.

    Its dataset's names tell. Where nothing knows them the shape tells of joints, and the
    statistics of the tool's targets: all are in front of the arm, and no episode goes forward in
    every step.

    Raises:
        V2PError: its file is damaged.
    """
    config, facts = _told(policy / "config.json"), read_facts(policy)
    sees, does = config.get("input_features") or {}, config.get("output_features") or {}
    num_states = int(sees.get(STATE_KEY, {}).get("shape", [len(STATE_NAMES)])[0])
    num_actions = int(does.get(ACTION_KEY, {}).get("shape", [len(DELTA_NAMES)])[0])
    is_ours = facts.state[: len(STATE_NAMES)] in ((), STATE_NAMES)
    interface = ArmInterface(
        actions=(actions_named(facts.action) or "delta_tool")
        if facts.action
        else _guessed_actions(policy, num_actions),
        joint_state=is_ours and num_states > len(STATE_NAMES),
    )
    return interface, num_states, num_actions


def _guessed_actions(policy: Path, count: int) -> Actions:
    """Return what `count` entries of an action whose names nobody knows say."""
    if count == len(action_names("joints")):
        return "joints"
    for name in state_files(policy, PROCESSOR_FILES[1]):
        low = load_file(policy / name).get(f"{ACTION_KEY}.min")
        if low is not None and low.shape == (count,) == (len(TOOL_NAMES),) and low[0] > NEAREST_M:
            return "absolute_tool"
    return "delta_tool"


def policy_files(policy: Path) -> list[Path]:
    """Return the files that a policy is: its own, and its dataset's where none beside it tells of its training."""
    states = [name for processor in PROCESSOR_FILES for name in state_files(policy, processor)]
    names = (CONFIG_FILE, WEIGHTS_FILE, *PROCESSOR_FILES, *OTHER_FILES, *states)
    found = [policy / name for name in names]
    if not (policy / FACTS_FILE).is_file() and (dataset := _dataset_of(policy)):
        found += [dataset / INFO_FILE, dataset / METADATA_FILE, *_task_files(dataset)]
    return [path for path in found if path.is_file()]


def write_facts(policy: Path, dataset: Path) -> None:
    """Put what a policy's dataset says beside the policy."""
    write_json_atomically(policy / FACTS_FILE, {"schema": 1, **asdict(facts_of_dataset(dataset))})


def read_facts(policy: Path) -> Facts:
    """Return what is known of a policy's training.

    Raises:
        V2PError: its file is damaged.
    """
    path = policy / FACTS_FILE
    if path.is_file():
        said = read_object(path, "delete it, or train anew")
        said.pop("schema", None)
        try:
            return TypeAdapter(Facts).validate_python(said)
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            where = ".".join(map(str, fault["loc"]))
            raise V2PError(
                f"{path} is of another version ({where}: {fault['msg']}); delete it, or train anew"
            ) from error
    dataset = _dataset_of(policy)
    return facts_of_dataset(dataset) if dataset is not None else Facts()


def _dataset_of(policy: Path) -> Path | None:
    home = policy.resolve().parent
    record = read_record(home)
    if record is not None:
        name = (record.recipe.get("sources") or {}).get("dataset")
        found = home.parents[1] / "dataset" / str(name)
        if name and found.is_dir():
            return found
    config = policy / "train_config.json"
    dataset = _told(config).get("dataset") or {}
    root = dataset.get("root") or "" if isinstance(dataset, dict) else None
    if not isinstance(root, str):
        raise V2PError(
            f"{config} names no dataset as LeRobot does, by a 'root' that is a text; delete it, or train anew"
        )
    return Path(root) if os.path.isdir(root) else None  # noqa: PTH112 - false for any text


def _task_files(dataset: Path) -> list[Path]:
    return sorted((dataset / TASKS_IN_DATASET).glob(f"*/{TASK_FILE}"))


def _names(feature: Any) -> tuple[str, ...]:
    names = (feature or {}).get("names")
    return tuple(map(str, names)) if isinstance(names, list) else ()


def _told(path: Path) -> dict[str, Any]:
    """Return the object in a file, an empty one where there is no file."""
    return read_object(path, "make it anew") if path.is_file() else {}
