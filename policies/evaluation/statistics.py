"""The statistics that a policy's processors normalise with: found under the names of other versions, and complete.

LeRobot leaves numbers as they are where it finds no statistics by the name that it expects. The policy then acts on
numbers of another scale, and fails without a word.
"""

import re
from itertools import product
from typing import Any

import numpy as np

PAIRS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""What each mode of LeRobot normalises with."""
PREFIXES = re.compile(
    r"((_orig_mod|module|(un)?normalizer?(_inputs|_outputs|_targets)?|(in|out)put_normalizer"
    r"|[\w-]+(?=[._]buffer)|buffer)[._])*"
)
"""What `torch.compile`, parallel training and older versions of LeRobot put before a feature's name."""
MAX_EPS = 1e-3
"""Most that may be added to a standard deviation."""


def statistics_fault(policy: Any, before: Any, after: Any) -> str:
    """Return why a policy's numbers would not be normalised as its settings say; empty where they are.

    Statistics under a name of another version get the feature's name.

    Args:
        policy: settings of a LeRobot policy.
        before: its preprocessor.
        after: its postprocessor.
    """
    for file, pipeline, kind, features in (
        ("policy_preprocessor.json", before, "normalizer", policy.input_features or {}),
        ("policy_postprocessor.json", after, "unnormalizer", policy.output_features or {}),
    ):
        modes = {
            key: policy.normalization_mapping.get(f.type.value) for key, f in features.items()
        }
        wanted = {key: mode.value for key, mode in modes.items() if mode and mode.value in PAIRS}
        steps = [step for step in pipeline.steps if hasattr(step, "norm_map")]
        kinds = [type(step).__name__.removesuffix("ProcessorStep").lower() for step in steps]
        if kinds != [kind] and (wanted or steps):
            there = " and ".join(f"'{found}_processor'" for found in kinds) or "none"
            return f"{file} needs one step '{kind}_processor' for {', '.join(wanted)}, and has {there}"
        for key, mode in wanted.items():
            if fault := _renamed(steps[0]) or _fault(steps[0], key, features[key], mode):
                return f"'{key}' in {file} {fault}"
    return ""


def _renamed(step: Any) -> str:
    """Give statistics under a name of another version the feature's name; return a fault where two fit one name."""
    found = {key: dict(values) for key, values in step.stats.items() if key in step.features}
    for key, feature in product(step.stats.keys() - step.features.keys(), step.features):
        match = re.search(feature.replace(".", "[._]") + "$", key)
        if feature in step.stats or not match or not PREFIXES.fullmatch(key[: match.start()]):
            continue
        for name, value in step.stats[key].items():
            if not np.array_equal(found.setdefault(feature, {}).setdefault(name, value), value):
                return f"has two statistics '{name}' of '{feature}', one of them under '{key}'"
    if found.keys() - step.stats.keys():
        step.stats = found
        step.to()
    return ""


def _fault(step: Any, key: str, feature: Any, mode: str) -> str:
    """Return what is wrong with a feature's statistics; empty where nothing is."""
    said, only, stats = (
        step.norm_map.get(feature.type),
        step.normalize_observation_keys,
        step.stats,
    )
    if key not in step.features or (only is not None and key not in only) or step.eps > MAX_EPS:
        return f"is not normalised: the step names {', '.join(only or step.features)}, eps {step.eps:g}"
    if said is None or said.value != mode:
        return f"is normalised by {said and said.value}, and the policy's settings say {mode}"
    low, high = PAIRS[mode]
    values = {name: np.asarray(v, np.float64) for name, v in stats.get(key, {}).items()}
    if not {low, high} <= values.keys():
        there = ", ".join(f"{k}.{name}" for k, found in stats.items() for name in found)
        return f"lacks {low} or {high} for {mode}; there are {there[:300] or 'no statistics'}"
    shape = tuple(feature.shape)
    fitting = (shape, shape[:1], shape[:1] + (1,) * (len(shape) - 1))
    if odd := [name for name in (low, high) if values[name].shape not in fitting]:
        return f"has {odd[0]} of shape {values[odd[0]].shape} for values of shape {shape}"
    spreads = {m: _spread(values, m) for m, pair in PAIRS.items() if set(pair) <= values.keys()}
    spread = spreads.pop(mode)
    # An entry that never changes has no spread, and then none of the other statistics has one.
    constant = np.any([other == 0 for other in spreads.values()], axis=0)
    if (spread < 0).any() or (
        mode in ("MEAN_STD", "MIN_MAX") and ((spread == 0) & ~constant).any()
    ):
        return f"has no spread in {low} and {high}, though its values change"
    return ""


def _spread(values: dict[str, np.ndarray], mode: str) -> np.ndarray:
    low, high = (values[name] for name in PAIRS[mode])
    return high if mode == "MEAN_STD" else high - low
