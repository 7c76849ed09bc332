"""A checkpoint, from the Hub or a folder, becomes a model on its device: the only place that loads transformers.

What was loaded stays loaded for the next clip. A checkpoint of another architecture is refused: transformers would
only warn and leave the missing weights random.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from v2p_data.errors import V2PError
from v2p_data.scene.backends.config import DEFAULT_MODELS, MODEL_CLASSES, DType


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A model in evaluation mode and the processor that was saved with it."""

    name: str
    """Hub id or folder."""
    model: Any
    processor: Any


@lru_cache(maxsize=4)
def load_checkpoint(backend: str, model: str, device: str, dtype: DType) -> Checkpoint:
    """Return the checkpoint of a backend, ready to run; an empty `model` is the backend's default.

    Raises:
        V2PError: transformers is not installed, the checkpoint cannot be had, it is of another architecture, or the
            device is not here.
    """
    name = model or DEFAULT_MODELS[backend]
    where = device_for(device)
    try:
        import transformers
    except ImportError:
        raise V2PError(
            f"backend '{backend}' needs transformers, which is not installed; install it with "
            "'make setup' in the repository, or take a backend without downloaded weights"
        ) from None
    model_class, processor_class = (getattr(transformers, n) for n in MODEL_CLASSES[backend])
    try:
        config = transformers.AutoConfig.from_pretrained(name)
        wanted = model_class.config_class.model_type
        if config.model_type != wanted:
            raise V2PError(
                f"checkpoint '{name}' holds a '{config.model_type}' model, but backend '{backend}' needs "
                f"'{wanted}', such as '{DEFAULT_MODELS[backend]}'"
            )
        loaded, info = model_class.from_pretrained(
            name, dtype=getattr(torch, dtype), output_loading_info=True
        )
        processor = processor_class.from_pretrained(name)
    except (OSError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise V2PError(
            f"checkpoint '{name}' of backend '{backend}' cannot be loaded ({reason}); give a folder that "
            "save_pretrained wrote, or a Hub id that this machine can reach or has in its cache"
        ) from error
    missing = sorted(info["missing_keys"])
    if missing:
        raise V2PError(
            f"checkpoint '{name}' lacks {len(missing)} weights of backend '{backend}', the first '{missing[0]}'; "
            "they would be random"
        )
    return Checkpoint(
        name=name,
        model=loaded.to(where).eval(),
        processor=processor,
    )


def device_for(device: str) -> torch.device:
    """Return the device that a setting means; `auto` takes the GPU where there is one.

    Raises:
        V2PError: that device is not here.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    found = torch.device(device)
    here = {
        "cpu": 1,
        "cuda": torch.cuda.device_count(),
        "mps": int(torch.backends.mps.is_available()),
    }
    if (found.index or 0) >= here[found.type]:
        raise V2PError(
            f"device '{device}' is not here ({here['cuda']} CUDA devices were found); use device=auto or device=cpu"
        )
    return found
