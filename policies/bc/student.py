"""A `v2p_bc` policy that learns between roll-outs: it acts in many worlds at once, takes episodes in, and trains on.

It knows arrays only: label images, robot states, actions. Who simulates and who labels is the caller's.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import FrameTable, frames_of, read_frames
from policies.bc.modeling_v2p_bc import V2PBCPolicy
from policies.bc.trainer import (
    Judge,
    Processors,
    Progress,
    Trained,
    TrainerConfig,
    check_features,
    load_policy,
    make_policy,
    normalised,
    save_policy,
    train,
)
from policies.threads import torch_threads

STATE = "observation.state"
RGB = "observation.images.rgb"
STATE_STD_FLOOR = 0.01
"""Least standard deviation of a state's entry [m, rad or share]: students visit states that no demonstration shows."""


@dataclass(frozen=True, kw_only=True)
class DatasetPlace:
    """Where the frames of a LeRobot dataset are read from."""

    folder: Path
    repo_id: str
    """The dataset's name."""
    cache: Path
    """Folder for decoded pictures."""


@dataclass(kw_only=True)
class Student:
    """A policy, its processors and the frames that it learns from."""

    policy: V2PBCPolicy
    processors: Processors
    table: FrameTable
    num_threads: int = 1
    task: str = ""

    @staticmethod
    def of_dataset(
        place: DatasetPlace,
        cfg: V2PBCConfig,
        *,
        seed: int,
        device: str = "cpu",
        start_from: Path | None = None,
        num_threads: int = 1,
        action_limit: float | None = None,
    ) -> "Student":
        """Return a student that knows a dataset's frames and has not learned yet.

        Args:
            place: the dataset and its cache.
            cfg: the policy's settings; its features and number of labels are filled in from the dataset.
            seed: of the weights.
            device: where the network trains.
            start_from: a policy to go on from, with its own settings.
            num_threads: of the linear algebra.
            action_limit: actions lie within this of zero whatever the dataset's extremes; None: as the dataset says.
        """
        if start_from is not None:
            policy, processors = load_policy(start_from, device=device)
        else:
            stats = fill_in_features(cfg, place.folder, place.repo_id)
            check_features(cfg, stats)
            policy, processors = make_policy(
                cfg, widened(stats, cfg, action_limit), seed=seed, device=device
            )
        table = read_frames(place.folder, place.repo_id, policy.net, place.cache)
        return Student(policy=policy, processors=processors, table=table, num_threads=num_threads)

    # -- acting

    def for_task(self, words: str) -> "Student":
        """Return the same student, told a task."""
        return replace(self, task=words)

    def reset(self, n: int) -> None:
        """Forget the last episodes; `n` new ones begin."""
        del n
        self.policy.reset()

    @torch.inference_mode()
    def act(
        self,
        labels: UInt8[np.ndarray, "n h w"],
        state: Float32[np.ndarray, "n dim"],
        rgb: UInt8[np.ndarray, "n h2 w 3"] | None = None,
    ) -> Float32[np.ndarray, "n act"]:
        """Return the worlds' next actions; the same worlds in the same order at every call until `reset`."""
        device = next(self.policy.parameters()).device
        batch = self.processors.before({STATE: torch.from_numpy(state)})
        for camera, greys in self._pictures(labels).items():
            batch[camera] = torch.from_numpy(greys)[:, None].to(device)
        if rgb is not None:
            batch[RGB] = torch.from_numpy(rgb).permute(0, 3, 1, 2).to(device)
        batch["task"] = [self.task] * len(state)
        with torch_threads(self.num_threads):
            action = self.policy.select_action(batch)
        return self.processors.after(action).numpy()

    # -- learning

    def add(
        self,
        labels: UInt8[np.ndarray, "frame h w"],
        state: Float32[np.ndarray, "frame dim"],
        action: Float32[np.ndarray, "frame act"],
        task: str,
        lengths: Sequence[int],
    ) -> None:
        """Take in episodes, one after the other, of these lengths."""
        more = frames_of(
            net=self.policy.net,
            pictures=self._pictures(labels),
            vectors={STATE: state},
            action=action,
            task=task,
            lengths=lengths,
        )
        self.table = self.table.extended(more)

    def train(
        self,
        cfg: TrainerConfig,
        out: Path,
        *,
        seed: int,
        judge: Judge | None = None,
        on_progress: Progress = lambda share, words: None,
    ) -> Trained:
        """Train on all frames; see `trainer.train`."""
        with torch_threads(self.num_threads):
            frames = normalised(self.table, self.processors)
            return train(
                self.policy, frames, cfg, out, seed=seed, judge=judge, on_progress=on_progress
            )

    def save(self, folder: Path) -> None:
        """Write the policy so that it is whole or absent."""
        temporary = folder.with_name(folder.name + ".tmp")
        shutil.rmtree(temporary, ignore_errors=True)
        save_policy(temporary, self.policy, self.processors)
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)

    def load(self, folder: Path) -> None:
        """Go on from what `save` wrote."""
        device = str(next(self.policy.parameters()).device)
        self.policy, self.processors = load_policy(folder, device=device)

    @property
    def cameras(self) -> list[str]:
        """Whose pictures it is given: label pictures below each other, and the colour picture."""
        return sorted(self.policy.net.camera_keys)

    def _pictures(
        self, labels: UInt8[np.ndarray, "n h w"]
    ) -> dict[str, UInt8[np.ndarray, "n h2 w"]]:
        greys = np.asarray(self.policy.config.mask_greys, np.uint8)[labels]
        masks = [camera for camera in self.cameras if camera != RGB]
        return dict(zip(masks, np.split(greys, len(masks) or 1, axis=1), strict=bool(masks)))


def fill_in_features(cfg: V2PBCConfig, dataset: Path, repo_id: str) -> dict[str, dict[str, Any]]:
    """Write a dataset's features into the settings, as LeRobot does, and return its statistics."""
    from lerobot.configs.types import FeatureType
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.utils.feature_utils import dataset_to_policy_features

    meta: Any = LeRobotDatasetMetadata(repo_id, root=dataset)
    features = dataset_to_policy_features(meta.features)
    cfg.output_features = {
        k: f for k, f in features.items() if f.type is FeatureType.ACTION and k == "action"
    }
    cfg.input_features = {
        k: f
        for k, f in features.items()
        if f.type in (FeatureType.VISUAL, FeatureType.STATE, FeatureType.ENV)
    }
    return meta.stats or {}


def widened(
    stats: dict[str, dict[str, Any]], cfg: V2PBCConfig, action_limit: float | None
) -> dict[str, dict[str, Any]]:
    """Return the statistics with room for what demonstrations do not show."""
    out = {key: dict(values) for key, values in stats.items()}
    for key, feature in (cfg.input_features or {}).items():
        if feature.type.value in ("STATE", "ENV") and key in out:
            out[key]["std"] = np.maximum(np.asarray(out[key]["std"]), STATE_STD_FLOOR)
    if action_limit is not None:
        shape = np.asarray(out["action"]["max"]).shape
        out["action"]["min"] = np.full(shape, -action_limit, np.float32)
        out["action"]["max"] = np.full(shape, action_limit, np.float32)
    return out
