"""Policies and decoded caches that are damaged or malicious: each case spoils a good one.

`POLICIES` maps a name to a function that spoils the folder of `good_policy`. Opening it must end
in a `V2PError` that names the folder, within seconds; the program of `canary` must not run.
`CACHES` spoils a camera's folder of decoded pictures, which must then be made anew.
"""

import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

sys.path.insert(0, str(Path(__file__).parents[1] / "task"))
from strangers import (
    OUTSIDE,
    Spoil,
    as_folder,
    as_pipe,
    changed,
    linked,
    removed,
    with_value,
    without,
    written,
)

POLICIES: dict[str, Spoil] = {}
CACHES: dict[str, Spoil] = {}
CONFIG, WEIGHTS = "config.json", "model.safetensors"
BEFORE, AFTER = "policy_preprocessor.json", "policy_postprocessor.json"
STATE = "policy_preprocessor_step_3_normalizer_processor.safetensors"
MASK = "observation.images.mask"


def good_policy(folder: Path, **settings: Any) -> Path:
    """Write an untrained policy that the simulator can open, and return it."""
    from lerobot.configs import FeatureType, PolicyFeature

    from policies.bc.configuration_v2p_bc import V2PBCConfig
    from policies.bc.trainer import make_policy, save_policy

    small = {"preset": "small", "head_dim": 16, "state_dim": 16, "num_labels": 4}
    cfg = V2PBCConfig(device="cpu", **small | settings)
    cfg.input_features = {
        MASK: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
        "observation.state": PolicyFeature(FeatureType.STATE, (11,)),
    }
    cfg.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    one = {"mean": np.zeros(11), "std": np.ones(11)}
    span = {"min": -np.ones(7), "max": np.ones(7), "mean": np.zeros(7), "std": np.ones(7)}
    save_policy(folder, *make_policy(cfg, {"observation.state": one, "action": span}, seed=0))
    return folder


def canary(folder: Path) -> Path:
    """Return what exists if a program of a spoiled policy has run."""
    return folder.with_name(folder.name + "_canary")


def case(name: str) -> Callable[[Spoil], Spoil]:
    def keep(spoil: Spoil) -> Spoil:
        assert name not in POLICIES
        POLICIES[name] = spoil
        return spoil

    return keep


# --- files ---------------------------------------------------------------------------------------------------

for _file in (CONFIG, BEFORE, AFTER, WEIGHTS, STATE):
    POLICIES[f"{_file} missing"] = removed(_file)
    POLICIES[f"{_file} is empty"] = written(_file, b"")
    POLICIES[f"{_file} is a folder"] = as_folder(_file)
    POLICIES[f"{_file} is a pipe"] = as_pipe(_file)
    POLICIES[f"{_file} links to /dev/zero"] = linked(_file, "/dev/zero")
    POLICIES[f"{_file} links to /etc/passwd"] = linked(_file, OUTSIDE)
    POLICIES[f"{_file} links to itself"] = linked(_file, _file)
for _file in ("v2p.json", "train_config.json"):
    POLICIES[f"{_file} links to /dev/zero"] = linked(_file, "/dev/zero")
for _file in (CONFIG, BEFORE):
    for _name, _content in {
        "is cut off": b'{"type": "v2p_bc", "n_obs_',
        "is nested 100,000 deep": b'{"type":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        "is UTF-16": '{"type": "v2p_bc"}'.encode("utf-16"),
        "is of noise": bytes(range(256)) * 8,
        "has 2 MB": b'{"type": "' + b"x" * 2_000_000 + b'"}',
        "is a list": b"[]",
        "is a number of 10,000 digits": b"1" * 10_000,
        "is null": b"null",
    }.items():
        POLICIES[f"{_file} {_name}"] = written(_file, _content)

# --- settings ------------------------------------------------------------------------------------------------

for _path, _values in {
    "type": (None, "groot", "subprocess.Popen", 7, ["v2p_bc"], "../v2p_bc"),
    "n_obs_steps": (10**9, 0, -1, 2.5, "2", None),
    "chunk_size": (10**9, 10**30, "x"),
    "num_bins": (10**9, 1, None, 8000),
    "head_dim": (10**9, -1, 0, 8000),
    "input_size_px": (10**6,),
    "task_words_dim": (10**9,),
    "use_peft": (True,),
    "device": ("/dev/zero", 7),
    "mask_greys": ([0] * 10**4, [300], "grey", [[0, 64]]),
    "optimizer_lr": (float("nan"), float("inf")),
    "head": ("../../x", "os.system"),
    "normalization_mapping": ({"ACTION": "x"}, [], {"STATE": {"a": 1}}),
    "input_features": (
        {MASK: {"type": "VISUAL", "shape": [3, 10**6, 10**6]}},
        {MASK: {"type": "VISUAL", "shape": []}},
        {MASK: {"type": "VISUAL", "shape": [3, -64, 64]}},
        {MASK: {"type": "PICKLE", "shape": [3, 64, 64]}},
        {f"camera_{k}": {"type": "VISUAL", "shape": [3, 64, 64]} for k in range(1000)},
        "all",
        {},
    ),
    "output_features": ({"action": {"type": "ACTION", "shape": [10**9]}}, None),
}.items():
    for _value in _values:
        POLICIES[f"{_path} = {str(_value)[:40]}"] = with_value(CONFIG, _path, _value)
for _name, _value in {
    "vision_encoder_name": "evil/model",
    "text_encoder_name": "/tmp/evil",
    "any_setting": "x",
    "nested": {"a": {"b": [1e300]}},
}.items():
    POLICIES[f"another setting {_name}"] = with_value(CONFIG, _name, _value)
POLICIES["pictures of 2,000 px, 64 at once"] = changed(
    CONFIG,
    lambda data: data.update(
        n_obs_steps=64, input_features={MASK: {"type": "VISUAL", "shape": [3, 2000, 2000]}}
    ),
)
POLICIES["no type"] = without(CONFIG, "type")
POLICIES["1,000 more settings"] = changed(
    CONFIG, lambda data: data.update({f"x{k}": k for k in range(1000)})
)
for _type, _setting in {
    "pi0_fast": "action_tokenizer_name",
    "gaussian_actor": "vision_encoder_name",
    "smolvla": "vlm_model_name",
}.items():
    POLICIES[f"{_type} whose {_setting} is somebody's"] = changed(
        CONFIG,
        lambda data, t=_type, s=_setting: {
            "type": t,
            s: "evil/model",
            **{k: data[k] for k in ("input_features", "output_features")},
        },
    )

# --- processors ----------------------------------------------------------------------------------------------


def with_step(file: str, step: Any) -> Spoil:
    """Return what puts a step before all others; `CANARY` in it becomes the canary's path."""

    def spoil(folder: Path) -> None:
        said = json.loads(json.dumps(step).replace("CANARY", str(canary(folder))))
        changed(file, lambda data: data["steps"].insert(0, said))(folder)

    return spoil


POPEN = {"class": "subprocess.Popen", "config": {"args": ["touch", "CANARY"]}}
for _file in (BEFORE, AFTER):
    for _name, _step in {
        "that is a program": POPEN,
        "that is a program beside a name": {**POPEN, "registry_name": "to_batch_processor"},
        "whose name is a program": {
            "registry_name": "subprocess.Popen",
            "config": POPEN["config"],
        },
        "that writes a file": {
            "class": "pathlib.Path.write_text",
            "config": {"self": "CANARY", "data": ""},
        },
        "of somebody's repository": {
            "registry_name": "action_tokenizer_processor",
            "config": {"action_tokenizer_name": "evil/tokenizer", "trust_remote_code": True},
        },
        "whose tokenizer is somebody's": {
            "registry_name": "tokenizer_processor",
            "config": {"tokenizer_name": "evil"},
        },
        "whose tokenizer is a folder": {
            "registry_name": "tokenizer_processor",
            "config": {"tokenizer_name": "./here"},
        },
        "of a reward model": {
            "registry_name": "reward_classifier_processor",
            "config": {"pretrained_path": "evil/model"},
        },
        "without a name": {"config": {}},
        "that is a number": 7,
        "that is empty": {},
        "with an unknown setting": {"registry_name": "to_batch_processor", "config": {"x": 1}},
        "whose settings are a list": {"registry_name": "to_batch_processor", "config": []},
        "whose file is outside": {"registry_name": "to_batch_processor", "state_file": OUTSIDE},
        "whose file is above": {
            "registry_name": "normalizer_processor",
            "state_file": "../x.safetensors",
        },
        "whose file is a pickle": {"registry_name": "normalizer_processor", "state_file": "x.pkl"},
        "whose file is missing": {
            "registry_name": "normalizer_processor",
            "state_file": "x.safetensors",
        },
        "with a number of 10**9": {
            "registry_name": "tokenizer_processor",
            "config": {"max_length": 10**9},
        },
        "whose features are a list": {
            "registry_name": "normalizer_processor",
            "config": {"features": [1]},
        },
    }.items():
        POLICIES[f"{_file}: a step {_name}"] = with_step(_file, _step)
POLICIES["100 steps"] = with_value(
    BEFORE, "steps", [{"registry_name": "to_batch_processor"}] * 100
)
POLICIES["no list of steps"] = without(BEFORE, "steps")

# --- numbers -------------------------------------------------------------------------------------------------


def with_tensors(file: str, change: Callable[[dict[str, torch.Tensor]], Any]) -> Spoil:
    """Return what changes the tensors of a file, or puts others in their place."""

    def spoil(folder: Path) -> None:
        tensors = {name: value.clone() for name, value in load_file(folder / file).items()}
        made = change(tensors)
        save_file(made if isinstance(made, dict) else tensors, folder / file)

    return spoil


def _spoil_one(tensors: dict[str, torch.Tensor], value: float) -> None:
    next(t for t in tensors.values() if t.is_floating_point()).flatten()[:1].fill_(value)


def header(said: Any, size: int | None = None) -> bytes:
    """Return a file of tensors with this header, which says that it has `size` bytes."""
    text = said if isinstance(said, bytes) else json.dumps(said).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text + b"\x00" * 64


for _file in (WEIGHTS, STATE):
    for _value in (float("nan"), float("inf"), -float("inf")):
        POLICIES[f"{_file} holds {_value}"] = with_tensors(
            _file, lambda tensors, v=_value: _spoil_one(tensors, v)
        )
    POLICIES[f"{_file} is cut off"] = lambda folder, f=_file: written(
        f, (folder / f).read_bytes()[:-40]
    )(folder)
    POLICIES[f"{_file} has bytes to spare"] = lambda folder, f=_file: written(
        f, (folder / f).read_bytes() + b"\x00" * 40
    )(folder)
    for _name, _content in {
        "is a pickle": b"\x80\x04cos\nsystem\n(S'touch x'\ntR.",
        "has a header of 2**60 bytes": header({}, 2**60),
        "has a header of no JSON": header(b"{" * 30),
        "holds no tensors": header({}),
        "says 10**12 numbers": header(
            {"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4 * 10**12]}}
        ),
        "says what overlaps": header(
            {k: {"dtype": "F32", "shape": [8], "data_offsets": [0, 32]} for k in "ab"}
        ),
        "says negative sizes": header(
            {"a": {"dtype": "F32", "shape": [-8], "data_offsets": [0, 32]}}
        ),
        "is of another number format": header(
            {"a": {"dtype": "X7", "shape": [8], "data_offsets": [0, 32]}}
        ),
    }.items():
        POLICIES[f"{_file} {_name}"] = written(_file, _content)
POLICIES["weights lack one"] = with_tensors(
    WEIGHTS, lambda tensors: tensors.pop("net.head.0.bias")
)
POLICIES["weights of another network"] = with_tensors(WEIGHTS, lambda _: {"a": torch.zeros(3)})
POLICIES["weights of another shape"] = with_tensors(
    WEIGHTS, lambda tensors: tensors.update({"net.head.0.bias": torch.zeros(8)})
)

# --- statistics ----------------------------------------------------------------------------------------------

STATES = (STATE, "policy_postprocessor_step_0_unnormalizer_processor.safetensors")
_STD, _LOW = "observation.state.std", "action.min"


def under(prefix: str, *, feature: str = "", twice: float = 0.0) -> Spoil:
    """Return what puts a prefix before all statistics, and writes the points of `feature` as underscores."""

    def change(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        old = feature.replace(".", "_")
        named = {name.replace(feature, old): value for name, value in tensors.items()}
        more = {f"other.buffer.{name}": value + twice for name, value in named.items() if twice}
        return {f"{prefix}{name}": value for name, value in named.items()} | more

    return lambda folder: [with_tensors(file, change)(folder) for file in STATES] and None


def normalising(file: str, **settings: Any) -> Spoil:
    """Return what changes the settings of the step that normalises; `None` takes the step out."""

    def change(data: dict[str, Any]) -> None:
        step = next(
            s for s in data["steps"] if s["registry_name"].endswith("normalizer_processor")
        )
        step["config"].update(settings)
        if not settings:
            data["steps"].remove(step)

    return changed(file, change)


def _set(name: str, value: Any) -> Spoil:
    file = STATES[name.startswith("action")]
    return with_tensors(file, lambda tensors: tensors.update({name: torch.tensor(value)}))


def _lacking(file: str, start: str) -> Spoil:
    return with_tensors(file, lambda t: {k: v for k, v in t.items() if not k.startswith(start)})


for _name, _spoil in {
    "under another name": under("other."),
    "with a letter too many": under("x"),
    "of two robots": under("one.buffer.", twice=1.0),
    "without the state's": _lacking(STATE, "observation.state."),
    "without the spread": _lacking(STATE, _STD),
    "without the action's least": _lacking(STATES[1], _LOW),
    "with std 0": _set(_STD, [0.0] * 11),
    "with one std 0": _set(_STD, [0.0] + [1.0] * 10),
    "with std below 0": _set(_STD, [-1.0] * 11),
    "with std of one number": _set(_STD, [1.0]),
    "with std of 7 numbers": _set(_STD, [1.0] * 7),
    "with actions of one value": _set(_LOW, [1.0] * 7),
    "upside down": _set(_LOW, [2.0] * 7),
    "with no step": normalising(BEFORE),
    "with no step for actions": normalising(AFTER),
    "twice": changed(BEFORE, lambda data: data["steps"].append(data["steps"][3])),
    "by another mode": normalising(BEFORE, norm_map={"STATE": "MIN_MAX"}),
    "of actions by another mode": normalising(AFTER, norm_map={"ACTION": "MEAN_STD"}),
    "by no mode": normalising(BEFORE, norm_map={}),
    "left out": normalising(AFTER, norm_map={"ACTION": "IDENTITY"}),
    "of no features": normalising(BEFORE, features={}),
    "of other keys": normalising(BEFORE, normalize_observation_keys=["observation.images.mask"]),
    "drowned": normalising(BEFORE, eps=10.0),
    "of no file": changed(BEFORE, lambda data: data["steps"][3].pop("state_file") and None),
}.items():
    POLICIES[f"statistics {_name}"] = _spoil


def renamed_weights(change: Callable[[str], str]) -> Spoil:
    return with_tensors(WEIGHTS, lambda t: {change(name): value for name, value in t.items()})


SAME: dict[str, Spoil] = {
    "torch.compile": under("_orig_mod."),
    "parallel training": under("module."),
    "both": under("module._orig_mod."),
    "older LeRobot": under("so100.buffer."),
    "LeRobot of 2024": under("normalize_inputs.buffer_", feature="observation.state"),
    "an older robot": under("normalize_inputs.so100.buffer_", feature="observation.state"),
    "two alike": under("one.buffer.", twice=-0.0),
    "weights of torch.compile": renamed_weights(lambda name: f"_orig_mod.{name}"),
    "weights of parallel training": renamed_weights(lambda name: f"module.{name}"),
    "weights of a compiled part": renamed_weights(lambda n: n.replace("net.", "net._orig_mod.")),
    "an entry that never changes": lambda folder: (
        [
            _set(f"observation.state.{name}", [0.0] + [value] * 10)(folder)
            for name, value in {"std": 1.0, "min": -1.0, "max": 1.0}.items()
        ]
        and None
    ),
}
"""What writes a good policy as other versions do, so that it acts as before."""

# --- caches --------------------------------------------------------------------------------------------------


def flipped(name: str, share: float) -> Spoil:
    """Return what changes some bytes of an array, none of its header."""

    def spoil(cache: Path) -> None:
        array = np.load(cache / f"{name}.npy", mmap_mode="r+")
        flat = array.reshape(-1).view(np.uint8)
        flat[:: max(1, int(1 / share))] ^= 1
        array.flush()

    return spoil


def swapped(cache: Path) -> None:
    array = np.load(cache / "picture.npy", mmap_mode="r+")
    array[[0, 1]] = array[[1, 0]]
    array.flush()


def replaced(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda cache: np.save(cache / f"{name}.npy", change(np.load(cache / f"{name}.npy")))


def shortened(cache: Path) -> None:
    with (cache / "picture.npy").open("r+b") as stream:
        stream.truncate(stream.seek(0, 2) // 2)


for _name in ("picture", "moments"):
    for _share in (1e-9, 0.1, 1.0):
        CACHES[f"{_name}: bytes flipped, a share of {_share}"] = flipped(_name, _share)
    CACHES[f"{_name} of zeros"] = replaced(_name, np.zeros_like)
    CACHES[f"{_name} of another type"] = replaced(_name, lambda a: a.astype(np.float64))
    CACHES[f"{_name} backwards"] = replaced(_name, lambda a: a[::-1].copy())
    CACHES[f"{_name} in another shape"] = replaced(_name, lambda a: a.reshape(len(a), -1))
    CACHES[f"{_name} of fewer frames"] = replaced(_name, lambda a: a[:-1])
    CACHES[f"{_name} of nonsense"] = written(f"{_name}.npy", b"\x93NUMPY nonsense")
    CACHES[f"{_name} of objects"] = lambda cache, n=_name: np.save(
        cache / f"{n}.npy", np.array([print] * 18, object), allow_pickle=True
    )
    CACHES[f"{_name} gone"] = removed(f"{_name}.npy")
CACHES["two frames swapped"] = swapped
CACHES["half of the picture"] = shortened
CACHES["no description"] = removed("cache.json")
for _name, _content in {
    "a brace": b"{",
    "a list": b"[]",
    "bytes": b"\xff\x00",
    "other keys": b'{"identity": 1}',
    "100,000 brackets": b"[" * 100_000,
}.items():
    CACHES[f"description of {_name}"] = written("cache.json", _content)
for _field, _value in {
    "crc32": {},
    "identity": "0" * 64,
}.items():
    CACHES[f"description with another '{_field}'"] = with_value("cache.json", _field, _value)
CACHES["checksums as a list"] = with_value("cache.json", "crc32", ["picture", "moments"])
