"""Random streams found by name, so that adding an item or a worker changes no other stream."""

import hashlib

import numpy as np
import torch


def seed_for(seed: int, *names: str | int) -> int:
    """Return a 63-bit seed that depends on `seed` and the names only."""
    digest = hashlib.sha256("\x1f".join([str(seed), *map(str, names)]).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Return the numpy stream called `names`, e.g. `rng_for(seed, "episodes", "mug", 17)`."""
    return np.random.default_rng(seed_for(seed, *names))


def torch_rng_for(seed: int, *names: str | int, device: str = "cpu") -> torch.Generator:
    """Return the torch stream called `names`."""
    return torch.Generator(device).manual_seed(seed_for(seed, *names))
