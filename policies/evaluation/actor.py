"""A LeRobot policy as something that acts on batches of label pictures, colour pictures and robot states.

Each step is `lerobot-eval`'s: observation, environment's processor, policy's processor, policy, and back; in inference
mode, at the policy's own precision. Whoever makes the pictures says which grey stands for a label.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from policies.evaluation.rollout import (
    LoadedPolicy,
    UnsuitablePolicyError,
    env_config,
    load_policy,
)

MASK_KEY, WRIST_KEY = "observation.images.mask", "observation.images.mask_wrist"
RGB_KEY = "observation.images.rgb"
STATE_KEY = "observation.state"
ACTION_KEY = "action"
GREY_TYPE = "v2p_bc"
"""The policy type that takes masks as one channel of greys, 0 to 255."""


@dataclass(frozen=True, kw_only=True)
class PolicyActor:
    """A loaded policy that acts in a task; see `load_actor`."""

    loaded: LoadedPolicy
    before: Any
    """The environment's processors, around those of the policy."""
    after: Any
    values: UInt8[np.ndarray, "label"] | Float32[np.ndarray, "label"]
    """What the policy sees for each label."""
    channels: int
    task: str
    """The task in words."""
    size_px: tuple[int, int]
    """Height and width of the pictures that the policy was trained on, of each camera."""
    cameras: tuple[str, ...] = (MASK_KEY,)
    """Whose pictures it is given: label pictures below each other, then the colour picture."""

    def for_task(self, words: str) -> "PolicyActor":
        """Return the same policy, told another task."""
        return replace(self, task=words)

    def reset(self, n: int) -> None:
        """Forget the last episodes; `n` new ones begin."""
        del n
        self.loaded.policy.eval()
        self.loaded.policy.reset()

    def act(
        self,
        labels: UInt8[np.ndarray, "n h w"],
        state: Float32[np.ndarray, "n state"],
        rgb: UInt8[np.ndarray, "n h2 w 3"] | None = None,
    ) -> Float32[np.ndarray, "n act"]:
        """Return the next action of every world."""
        observation: dict[str, Any] = {
            **self._label_pictures(labels),
            STATE_KEY: torch.from_numpy(state.copy()),
            "task": [self.task] * len(state),
        }
        if RGB_KEY in self.cameras:
            if rgb is None:
                raise UnsuitablePolicyError(
                    f"the policy sees '{RGB_KEY}' and is given label pictures only"
                )
            observation[RGB_KEY] = torch.from_numpy(rgb).permute(0, 3, 1, 2).float() / 255
        with torch.inference_mode():
            action = self.loaded.policy.select_action(
                self.loaded.preprocessor(self.before(observation))
            )
            action = self.after({ACTION_KEY: self.loaded.postprocessor(action)})[ACTION_KEY]
        return action.to("cpu").numpy()

    def _label_pictures(self, labels: UInt8[np.ndarray, "n h w"]) -> dict[str, torch.Tensor]:
        cameras = [key for key in self.cameras if key != RGB_KEY]
        if not cameras:
            return {}
        height = self.size_px[0] * len(cameras)
        if labels.shape[1] != height:
            raise UnsuitablePolicyError(
                f"the policy sees {' and '.join(cameras)}, {height} rows of labels, and is "
                f"given {labels.shape[1]} rows"
            )
        picture = torch.from_numpy(self.values[labels])[:, None]  # numpy's indexing is the faster
        if self.channels > 1:
            picture = picture.expand(-1, self.channels, -1, -1).contiguous()
        return dict(zip(cameras, picture.chunk(len(cameras), dim=-2), strict=True))


def load_actor(
    folder: Path,
    *,
    greys: Sequence[int],
    task: str = "",
    device: str | None = None,
    num_states: int = 11,
    num_actions: int = 7,
) -> PolicyActor:
    """Read a checkpoint of any policy type LeRobot knows.

    Args:
        folder: the checkpoint.
        greys: grey (0 to 255) of each label of a picture.
        task: the task in words; see `PolicyActor.for_task`.
        device: where the policy runs; by default, where its settings say.
        num_states: entries of the state that the simulator gives.
        num_actions: entries of an action that it is given.

    Raises:
        UnsuitablePolicyError: it cannot be opened, or wants to see or do what the simulator does not have.
    """
    from lerobot.envs.factory import make_env_pre_post_processors

    config = env_config(rgb=True)
    for key, count in (("agent_pos", num_states), (ACTION_KEY, num_actions)):
        config.features[key] = replace(config.features[key], shape=(count,))
    try:
        height, width, cameras = check_features(folder, config)
        loaded = load_policy(folder, config, device)
    except UnsuitablePolicyError:
        raise
    except Exception as error:  # of LeRobot, of any kind
        reason = re.sub(r"\s+", " ", str(error)).strip()[:200]
        raise UnsuitablePolicyError(
            f"the policy in {folder} cannot be loaded ({type(error).__name__}: {reason}); its "
            "network is of another version,"
            " or it is damaged: train it anew"
        ) from error
    before, after = make_env_pre_post_processors(config, loaded.policy.config)
    is_grey = loaded.policy.config.type == GREY_TYPE
    values = np.asarray(greys, np.uint8)
    if not is_grey:
        values = values.astype(np.float32) / np.float32(255)
    return PolicyActor(
        loaded=loaded,
        before=before,
        after=after,
        values=values,
        channels=1 if is_grey else 3,
        task=task,
        size_px=(height, width),
        cameras=cameras,
    )


def check_features(folder: Path, config: Any) -> tuple[int, int, tuple[str, ...]]:
    """Demand that a checkpoint sees and does what the simulator has; return its pictures' height, width and cameras.

    Raises:
        UnsuitablePolicyError: it does not.
    """
    from lerobot.configs import FeatureType, PreTrainedConfig
    from lerobot.envs.utils import env_to_policy_features

    given = env_to_policy_features(config)
    policy = PreTrainedConfig.from_pretrained(folder)
    wanted = {**(policy.input_features or {}), **(policy.output_features or {})}
    for key, feature in wanted.items():
        shape = tuple(feature.shape)
        if key not in given:
            if "empty_camera" in key:  # LeRobot's placeholder for a camera that need not be there
                continue
            names = ", ".join(f"'{name}' {tuple(f.shape)}" for name, f in given.items())
            raise UnsuitablePolicyError(
                f"the policy in {folder} wants '{key}' {shape}, which the simulator does not give; it gives {names}"
            )
        if feature.type is not FeatureType.VISUAL and shape != tuple(given[key].shape):
            raise UnsuitablePolicyError(
                f"the policy in {folder} wants '{key}' of shape {shape}, and the simulator gives"
                f" {tuple(given[key].shape)}: it was trained on a dataset of another version"
            )
    if WRIST_KEY in wanted:  # comes below the table's, whether that is looked at or not
        wanted.setdefault(MASK_KEY, wanted[WRIST_KEY])
    cameras = tuple(key for key in (MASK_KEY, WRIST_KEY, RGB_KEY) if key in wanted)
    if not cameras:
        raise UnsuitablePolicyError(
            f"the policy in {folder} has no camera; it wants {', '.join(wanted) or 'nothing'}, and the simulator gives"
            f" {MASK_KEY}, {WRIST_KEY} and {RGB_KEY}"
        )
    sizes = {key: tuple(map(int, wanted[key].shape[1:])) for key in cameras}
    if len(set(sizes.values())) > 1:
        raise UnsuitablePolicyError(
            f"the policy in {folder} wants pictures of several sizes, {sizes}; the simulator draws all alike"
        )
    height, width = sizes[cameras[0]]
    return height, width, cameras
