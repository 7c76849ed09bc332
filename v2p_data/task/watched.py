"""Holds loaded task code to what the smoke run saw of it: it may add to `states` and change nothing else.

A task that wrote into a state, or into the actions, would change what success is judged by and what the policy
learns from. Every call of a loaded task is looked at, by the counter that torch keeps of writes into a tensor.

What the observation adds to `states` may be used by success and reward (as in the paper's figure 8); where these are
asked for first, the observation is made first.
"""

import functools
from collections.abc import Callable
from typing import Any

import torch

from v2p_data.errors import V2PError

OBSERVE = "compute_observation_key"
METHODS = (OBSERVE, "compute_success", "compute_reward")


class StatesChangedError(V2PError):
    """Task code has written into what it was only shown."""


def watch(kind: type) -> None:
    """Make the methods of a task class raise `StatesChangedError` when they write into what they are given."""
    for name in METHODS:
        if name in vars(kind):
            setattr(kind, name, _watched(name, vars(kind)[name]))


def _watched(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def call(self: Any, *given: Any) -> Any:
        own: dict[str, str] = self.__dict__.setdefault("_own_keys", {})
        states = given[-1]
        if name != OBSERVE and any(k not in states for k, by in own.items() if by == OBSERVE):
            self.compute_observation_key(states)
        before = [_writes(part) for part in given]
        result = method(self, *given)
        for part, was in zip(given, before, strict=True):
            changed = _changed(part, was, own)
            if changed:
                raise StatesChangedError(f"{name} changes {changed} in place; work on a copy")
        own |= {key: name for key in states if key not in before[-1] and key not in own}
        return result

    return call


def _writes(part: Any) -> Any:
    """Return the tensors of an argument with the number of writes into each."""
    if isinstance(part, dict):
        return {key: (value, _count(value)) for key, value in part.items()}
    return _count(part)


def _count(value: Any) -> int:
    is_counted = isinstance(value, torch.Tensor) and not value.is_inference()
    return value._version if is_counted else 0  # pyright: ignore[reportAttributeAccessIssue]


def _changed(part: Any, was: Any, own: dict[str, str]) -> str:
    """Return what has been written into, '' for nothing; keys that the task has added are its own."""
    if not isinstance(part, dict):
        return "its argument" if _count(part) != was else ""
    for key, (value, count) in was.items():
        if key in own:
            continue
        if _count(value) != count:
            return f"states['{key}']"
        now = part.get(key)
        if now is not value and not (
            isinstance(now, torch.Tensor)
            and isinstance(value, torch.Tensor)
            and torch.equal(now, value)
        ):
            return f"states['{key}']"
    return ""
