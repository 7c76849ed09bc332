"""How fast policies train: the whole loop against the bare network on one batch in memory, and LeRobot's loader.

The ratio of the first two says how much the loader costs; it is measured in one run, so it stands a noisy machine.
On a GPU a second loop takes every batch from the computer's memory, although the GPU could hold all frames.

    python scripts/bench_bc.py --dataset outputs/demo/dataset/demo-1a2b3c4d --threads 2
    python scripts/bench_bc.py --frames 8192 --device cuda     # random frames, no dataset needed
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from policies.bc import trainer
from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import frames_of, moved
from policies.bc.student import DatasetPlace, Student
from policies.bc.trainer import TrainerConfig, autocast_for, make_policy, normalised
from v2p_data.pipeline.artifact import read_record

NETWORKS: dict[str, tuple[int, dict[str, Any]]] = {
    "small (moments)": (256, {"preset": "small"}),
    "ResNet18 at 64 px": (
        64,
        {
            "encoder": "resnet18",
            "input_size_px": 64,
            "mask_moments": False,
            "pretrained_backbone_weights": None,
        },
    ),
}
"""Batch size and settings."""
GPU_NETWORKS: dict[str, tuple[int, dict[str, Any]]] = {
    "small (moments)": NETWORKS["small (moments)"],
    "ResNet18 at 256 px (paper)": (1024, {"preset": "paper", "pretrained_backbone_weights": None}),
}
MASK, STATE, ACTION = "observation.images.mask", "observation.state", "action"
SIZE_PX, STATE_DIM, ACT_DIM = 256, 11, 7
"""Of random frames: those of our datasets."""
NUM_LABELS = 3
EPISODE = 64
"""Frames of a random episode."""


def main() -> None:
    """Read the command line, measure, print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--dataset", type=Path, help="of v2p generate")
    source.add_argument("--frames", type=int, help="so many random ones")
    parser.add_argument(
        "--networks", nargs="*", help="some of them, by the first word of their names"
    )
    parser.add_argument(
        "--turns",
        type=int,
        default=5,
        help="loop and bare network take turns, so that a noisy moment meets both",
    )
    parser.add_argument("--seconds", type=float, default=4.0, help="a turn")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--cache", type=Path, default=Path("outputs/bench_bc"))
    parser.add_argument("--lerobot", action="store_true", help="LeRobot's loader as well; slow")
    args = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if args.lerobot and args.dataset is None:
        parser.error("--lerobot reads a --dataset")
    networks = NETWORKS if args.device == "cpu" else GPU_NETWORKS
    if args.networks is not None:
        networks = {k: v for k, v in networks.items() if k.split()[0] in args.networks}
    rows = []
    for name, (batch_size, network) in networks.items():
        cfg = V2PBCConfig(device=args.device, num_labels=NUM_LABELS, **network)
        if args.dataset is None:
            student = _student_of_random_frames(cfg, args)
        else:
            place = DatasetPlace(
                folder=args.dataset,
                repo_id=_repo_id(args.dataset),
                cache=args.cache / name.replace(" ", "_"),
            )
            student = Student.of_dataset(
                place,
                cfg,
                seed=0,
                device=args.device,
                num_threads=args.threads,
            )
        row = {"network": name, "batch_size": batch_size, **_measured(student, batch_size, args)}
        if args.lerobot:
            row["lerobot_loader"] = _lerobots_loader(
                args.dataset, _repo_id(args.dataset), batch_size
            )
        rows.append(row)
        print(json.dumps(row), flush=True)
    print(
        "| network | loop, samples/s | fetched | bare network | loop / bare |\n|---|---|---|---|---|"
    )
    for row in rows:
        fetched = f"{row['fetched']:.0f}" if "fetched" in row else "-"
        print(
            f"| {row['network']} | {row['loop']:.0f} | {fetched} | {row['bare']:.0f} | {row['ratio']:.2f} |"
        )


def _repo_id(dataset: Path) -> str:
    record = read_record(dataset)
    if record is None:
        sys.exit(f"{dataset} is no dataset of v2p generate")
    return str(record.counts["repo_id"])


def _student_of_random_frames(cfg: V2PBCConfig, args: argparse.Namespace) -> Student:
    """Return a student whose frames are noise in the form of our datasets."""
    cfg.input_features = {
        MASK: PolicyFeature(FeatureType.VISUAL, (3, SIZE_PX, SIZE_PX)),
        STATE: PolicyFeature(FeatureType.STATE, (STATE_DIM,)),
    }
    cfg.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (ACT_DIM,))}
    one = np.ones(ACT_DIM)
    stats = {
        STATE: {"mean": np.zeros(STATE_DIM), "std": np.ones(STATE_DIM)},
        ACTION: {"min": -one, "max": one, "mean": 0 * one, "std": one},
    }
    policy, processors = make_policy(cfg, stats, seed=0, device=args.device)
    rng, frames = np.random.default_rng(0), args.frames
    greys = np.array(cfg.mask_greys[:NUM_LABELS], np.uint8)
    table = frames_of(
        net=policy.net,
        pictures={MASK: greys[rng.integers(0, NUM_LABELS, (frames, SIZE_PX, SIZE_PX))]},
        vectors={STATE: rng.normal(size=(frames, STATE_DIM)).astype(np.float32)},
        action=rng.uniform(-1, 1, (frames, ACT_DIM)).astype(np.float32),
        task="lift the box",
        lengths=[EPISODE] * (frames // EPISODE) + [frames % EPISODE] * (frames % EPISODE > 0),
    )
    return Student(policy=policy, processors=processors, table=table, num_threads=args.threads)


def _measured(student: Student, batch_size: int, args: argparse.Namespace) -> dict[str, float]:
    """Return samples per second of the trainer's loop and of forward, backward and step on one batch."""
    policy = student.policy
    device = torch.device(args.device)
    table = normalised(student.table, student.processors)
    batch = moved(
        table.batch(
            torch.arange(batch_size) % len(table),
            policy.config.observation_delta_indices,
            policy.config.action_delta_indices,
        ),
        device,
    )
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    autocast = autocast_for(device, "auto")

    def bare() -> None:
        with autocast():
            loss, _ = policy(batch)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), policy.config.grad_clip_norm)
        optimizer.step()

    torch.set_num_threads(args.threads)
    bare()
    steps = max(3, round(args.seconds / _seconds(bare, device)))
    rates: dict[str, list[float]] = {"loop": [], "bare": []}

    def loop(name: str) -> None:
        trained = student.train(
            TrainerConfig(steps=steps, batch_size=batch_size), args.cache / "loop", seed=0
        )
        rates.setdefault(name, []).append(trained.samples_per_s)

    share = trainer.GPU_SHARE_FOR_FRAMES
    for _ in range(args.turns):
        loop("loop")
        if device.type == "cuda":
            trainer.GPU_SHARE_FOR_FRAMES = 0.0
            loop("fetched")
            trainer.GPU_SHARE_FOR_FRAMES = share
        torch.set_num_threads(args.threads)
        policy.train()
        seconds = _seconds(lambda: [bare() for _ in range(steps)], device)
        rates["bare"].append(batch_size / seconds * steps)
    row = {name: median(values) for name, values in rates.items()}
    ratio = median(one / other for one, other in zip(rates["loop"], rates["bare"], strict=True))
    return row | {"ratio": ratio}


def _lerobots_loader(dataset: Path, repo_id: str, batch_size: int) -> float:
    """Return samples per second of LeRobot's dataset in a loader without workers, nothing trained."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    deltas = {MASK: [-0.05, 0.0], STATE: [-0.05, 0.0]}
    source: Any = LeRobotDataset(repo_id, root=dataset, delta_timestamps=deltas)
    loader = torch.utils.data.DataLoader(source, batch_size=batch_size, shuffle=True)
    batches = iter(loader)
    next(batches)
    return batch_size / _seconds(lambda: next(batches))


def _seconds(work: Callable[[], Any], device: torch.device | None = None) -> float:
    """Return how long a piece of work takes [s], until the GPU is done with it."""
    started = time.perf_counter()
    work()
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - started


if __name__ == "__main__":
    main()
