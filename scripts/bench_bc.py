"""How fast policies train: the whole loop against the bare network on one batch in memory, and LeRobot's loader.

The ratio of the first two says how much the loader costs; it is measured in one run, so it stands a noisy machine.
On a GPU a second loop takes every batch from the computer's memory, although the GPU could hold all frames.

    python scripts/bench_bc.py --dataset outputs/demo/dataset/demo-1a2b3c4d --threads 2
    python scripts/bench_bc.py --dataset outputs/demo/dataset/demo-1a2b3c4d --device cuda
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import torch

from policies.bc import trainer
from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import moved
from policies.bc.student import Student
from policies.bc.trainer import TrainerConfig, autocast_for, normalised
from v2p_data.pipeline.artifact import read_record

NETWORKS: dict[str, tuple[int, dict[str, Any]]] = {
    "small (moments)": (256, {"preset": "small"}),
    "conv at 64 px": (128, {"encoder": "conv", "input_size_px": 64, "mask_moments": False}),
    "ResNet18 at 64 px": (64, {"encoder": "resnet18", "input_size_px": 64, "mask_moments": False, "pretrained_backbone_weights": None}),
}  # fmt: skip
"""Batch size and settings."""
GPU_NETWORKS: dict[str, tuple[int, dict[str, Any]]] = {
    "small (moments)": NETWORKS["small (moments)"],
    "ResNet18 at 256 px (paper)": (1024, {"preset": "paper", "pretrained_backbone_weights": None}),
}  # fmt: skip
TURNS = 5
"""Loop and bare network take turns, so that a noisy moment meets both."""
SECONDS_A_TURN = 4.0


def main() -> None:
    """Read the command line, measure, print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--dataset", type=Path, required=True, help="of v2p generate")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--cache", type=Path, default=Path("outputs/bench_bc"))
    parser.add_argument("--lerobot", action="store_true", help="LeRobot's loader as well; slow")
    args = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    record = read_record(args.dataset)
    if record is None:
        parser.error(f"{args.dataset} is no dataset of v2p generate")
    networks = NETWORKS if args.device == "cpu" else GPU_NETWORKS
    rows = []
    for name, (batch_size, network) in networks.items():
        student = Student.of_dataset(
            args.dataset,
            str(record.counts["repo_id"]),
            V2PBCConfig(device=args.device, num_labels=3, **network),
            args.cache / name.replace(" ", "_"),
            seed=0,
            device=args.device,
            num_threads=args.threads,
        )
        row = {"network": name, "batch_size": batch_size, **_measured(student, batch_size, args)}
        if args.lerobot:
            row["lerobot_loader"] = _lerobots_loader(args.dataset, str(record.counts["repo_id"]), batch_size)  # fmt: skip
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
    steps = max(3, round(SECONDS_A_TURN / _seconds(bare, device)))
    rates: dict[str, list[float]] = {"loop": [], "bare": []}

    def loop(name: str) -> None:
        trained = student.train(
            TrainerConfig(steps=steps, batch_size=batch_size), args.cache / "loop", seed=0
        )
        rates.setdefault(name, []).append(trained.samples_per_s)

    share = trainer.GPU_SHARE_FOR_FRAMES
    for _ in range(TURNS):
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

    deltas = {"observation.images.mask": [-0.05, 0.0], "observation.state": [-0.05, 0.0]}
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
