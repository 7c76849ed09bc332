"""A LeRobot policy that anybody may have made is looked at here before LeRobot opens it, and refused in one sentence.

LeRobot imports and calls what a processor file names, fetches other models that a setting names,
and makes a network as large as the settings say before it looks at the weights. Hence: plain
files, known steps, bounded settings, finite numbers. That the weights are those of the network is
for `policies.evaluation.rollout`, which makes it without memory first.
"""

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Len
from pydantic import AfterValidator, ConfigDict, Field, model_validator

from v2p_data.errors import V2PError
from v2p_data.scene.files import own_file, read_own
from v2p_data.scene.schema import FileModel, Slug, Words, parsed

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
PROCESSOR_FILES = ("policy_preprocessor.json", "policy_postprocessor.json")
OTHER_FILES = ("v2p.json", "train_config.json")
"""Need not be there."""
MAX_JSON_BYTES = 1_000_000
MAX_STATE_BYTES = 50_000_000
"""Largest file of a processor's statistics."""
MAX_WEIGHTS_BYTES = 40_000_000_000
MAX_HEADER_BYTES = 16_000_000
"""Largest header of a file of tensors: names and shapes."""
CHECKED_AT_ONCE = 2**24
"""Numbers of a tensor."""
MAX_SEEN = 32_000_000
"""Numbers of an observation, past steps included: five colour pictures of 1920 x 1080 pixels."""
ANEW = "copy the policy anew"
Type = Literal[
    "v2p_bc", "act", "diffusion", "vqbet", "tdmpc", "multi_task_dit", "smolvla", "pi0", "pi05"
]
"""LeRobot's other types run code of repositories that a setting names, or have not been looked at."""
StepName = Literal[
    "rename_observations_processor",
    "to_batch_processor",
    "device_processor",
    "normalizer_processor",
    "unnormalizer_processor",
    "tokenizer_processor",
    "smolvla_new_line_processor",
    "pi0_new_line_processor",
    "pi05_prepare_state_tokenizer_processor_step",
    "relative_actions_processor",
    "absolute_actions_processor",
]
"""What LeRobot writes for these types. `action_tokenizer_processor` is none: it runs code of a repository."""
OTHER_MODELS = (
    "HuggingFaceTB/SmolVLM2-500M-Video-Instruct",
    "google/paligemma-3b-pt-224",
    "openai/clip-vit-base-patch16",
)
"""Repositories that LeRobot's own defaults name: the only ones that are fetched."""
NOT_FOLLOWED = ("pretrained_path", "repo_id")
"""Settings with a path or a name that nothing here opens."""
LIMITS = (
    (r"^(optimizer|scheduler)_|training_steps$", 1e12),  # of a training that is over
    (r"layer|depth|camera|ensemble|iterations", 128),
    (r"_ratio$|multiplier", 16),
    (r"horizon|chunk|action_steps|repeats|pred_token", 1024),
    (r"shape|size_px|resolution|resize", 2048),
    ("", 8192),
)
"""Largest number, by a setting's name; the first that fits. A million where it is no whole number
and the last one fits."""
LARGEST_FRACTION = 1e6
MAX_ENTRIES = 256
"""Most entries of a list or an object."""


def bounded(value: Any, name: str) -> None:
    """Demand that a setting asks for no more than a policy can need, and names no other model or place.

    Raises:
        ValueError: it does; the message is part of a sentence.
    """
    match value:
        case bool() | None:
            return
        case int() | float():
            pattern, most = next((p, m) for p, m in LIMITS if re.search(p, name))
            if not pattern and isinstance(value, float):
                most = LARGEST_FRACTION
            if not math.isfinite(value) or abs(value) > most:
                raise ValueError(f"'{name}' is {value:.6g}; at most {most:g} is taken")
        case str():
            if len(value) > 1000:
                raise ValueError(f"'{name}' has {len(value)} characters")
            names_another = (
                "/" in value
                or "\\" in value
                or re.search(r"(model|encoder|tokenizer)_name$", name)
            )
            if names_another and name not in NOT_FOLLOWED and value not in OTHER_MODELS:
                raise ValueError(
                    f"'{name}' is {value[:100]!a}; of other models and places, a policy may name"
                    f" {', '.join(OTHER_MODELS)} only"
                )
        case list() | tuple():
            _few(value, name)
            for entry in value:
                bounded(entry, name)
        case dict():
            _few(value, name)
            for key, entry in value.items():
                bounded(entry, ascii(str(key)[:100])[1:-1])
        case _:
            raise ValueError(f"'{name}' is of another type")


def _few(value: Any, name: str) -> None:
    if len(value) > MAX_ENTRIES:
        raise ValueError(f"'{name}' has {len(value)} entries; at most {MAX_ENTRIES} are taken")


class FeatureEntry(FileModel):
    type: Literal["STATE", "VISUAL", "ENV", "ACTION", "REWARD", "LANGUAGE"]
    shape: Annotated[tuple[Annotated[int, Ge(1), Le(2048)], ...], Len(1, 4)]


Features = Annotated[dict[Words, FeatureEntry], Len(0, 64)]


class ConfigFile(FileModel):
    """What all types have; LeRobot knows what else each type has, and refuses what it does not know."""

    model_config = ConfigDict(extra="allow")

    type: Type
    n_obs_steps: Annotated[int, Ge(1), Le(64)] = 1
    input_features: Features | None = None
    output_features: Features | None = None
    normalization_mapping: Annotated[dict[Words, Words], Len(0, 64)] = Field(
        default_factory=dict[str, str]
    )
    mask_greys: Annotated[tuple[Annotated[int, Ge(0), Le(255)], ...], Len(0, MAX_ENTRIES)] = ()
    use_peft: Literal[False] = False
    """Adapters name the policy below them, which nobody has looked at."""

    @model_validator(mode="after")
    def _is_bounded(self) -> "ConfigFile":
        bounded(self.model_extra, "settings")
        seen = sum(math.prod(feature.shape) for feature in (self.input_features or {}).values())
        if self.n_obs_steps * seen > MAX_SEEN:
            raise ValueError(
                f"an observation of {self.n_obs_steps} steps holds {self.n_obs_steps * seen:.3g} "
                f"numbers; at most {MAX_SEEN:g}"
                " are taken"
            )
        return self


class StepConfig(FileModel):
    """What normalises needs to say; the rest is the step's own."""

    model_config = ConfigDict(extra="allow")

    features: Features = Field(default_factory=dict[str, FeatureEntry])
    norm_map: Annotated[dict[Words, Words], Len(0, 64)] = Field(default_factory=dict[str, str])

    @model_validator(mode="after")
    def _is_bounded(self) -> "StepConfig":
        bounded(self.model_extra, "config")
        return self


def _no_class(name: Any) -> None:
    raise ValueError(
        f"names {str(name)[:100]!a}, which LeRobot would import and call; only LeRobot's own steps are taken, by"
        " 'registry_name'"
    )


class StepEntry(FileModel):
    class_name: Annotated[Any, AfterValidator(_no_class)] = Field(default=None, alias="class")
    registry_name: StepName
    config: StepConfig = StepConfig()
    state_file: Slug | None = None

    @model_validator(mode="after")
    def _has_a_file_of_tensors(self) -> "StepEntry":
        if self.state_file and not self.state_file.endswith(".safetensors"):
            raise ValueError(f"'{self.state_file}' is no .safetensors file")
        return self


class ProcessorFile(FileModel):
    name: Words = ""
    steps: Annotated[tuple[StepEntry, ...], Len(0, 32)]


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """What the small files of a policy say."""

    config: ConfigFile
    steps: dict[str, tuple[StepEntry, ...]]
    """Per processor file."""


def check_checkpoint(folder: Path) -> Checkpoint:
    """Demand that opening a policy runs nothing and takes no more memory than its weights do; return what it says.

    Reads all weights once.

    Raises:
        V2PError: names the file and what is wrong in it.
    """
    for name, otherwise in (
        (CONFIG_FILE, "it is no LeRobot policy"),
        *(
            (name, f"LeRobot's processors are part of a policy; {ANEW}")
            for name in PROCESSOR_FILES
        ),
        (WEIGHTS_FILE, "it is no LeRobot policy"),
    ):
        if not os.path.lexists(folder / name):
            raise V2PError(f"{folder} holds no {name}: {otherwise}")
    for name in OTHER_FILES:
        if os.path.lexists(folder / name):
            own_file(folder, name, MAX_JSON_BYTES)
    config = _read(folder, CONFIG_FILE, ConfigFile)
    steps = {name: _read(folder, name, ProcessorFile).steps for name in PROCESSOR_FILES}
    for name in (name for processor in PROCESSOR_FILES for name in state_files(folder, processor)):
        _check_tensors(own_file(folder, name, MAX_STATE_BYTES))
    _check_tensors(own_file(folder, WEIGHTS_FILE, MAX_WEIGHTS_BYTES))
    return Checkpoint(config=config, steps=steps)


def state_files(folder: Path, processor: str) -> list[str]:
    """Return the names of the files of tensors that a processor of a policy reads."""
    steps = _read(folder, processor, ProcessorFile).steps
    return [step.state_file for step in steps if step.state_file]


def _read[T: FileModel](folder: Path, name: str, kind: type[T]) -> T:
    return parsed(read_own(folder, name, MAX_JSON_BYTES), kind, folder / name, ANEW)


def _check_tensors(path: Path) -> None:
    """Demand a file of tensors that is whole and holds finite numbers only."""
    from safetensors import SafetensorError, safe_open

    try:
        with path.open("rb") as stream:
            header_bytes = int.from_bytes(stream.read(8), "little")
        if header_bytes > MAX_HEADER_BYTES:
            raise V2PError(
                f"{path} is damaged: its list of tensors has {header_bytes} bytes; {ANEW}"
            )
        with safe_open(path, framework="pt") as file:
            names = list(file.keys())
            if not names:
                raise V2PError(f"{path} holds no numbers; {ANEW}")
            for name in names:
                for part in file.get_tensor(name).flatten().split(CHECKED_AT_ONCE):
                    if not part.isfinite().all():
                        raise V2PError(f"{name[:100]!a} in {path} is not finite; train anew")
    except (SafetensorError, OSError, RuntimeError) as error:
        reason = re.sub(r"\s+", " ", str(error))[:200]
        raise V2PError(f"{path} is damaged or cut off ({reason}); {ANEW}") from error
