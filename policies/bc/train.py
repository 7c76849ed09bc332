"""Train `v2p_bc` with `lerobot-train`, in a process of its own, going on from its last checkpoint."""

import csv
import os
import re
import shutil
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

POLICY_FOLDER = "policy"
CURVE_FILE = "curve.csv"
LOG_FILE = "lerobot-train.log"
WORK_FOLDER = "train"
LOGS_A_RUN = 50
SAVES_A_RUN = 5


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What a training left behind."""

    policy: Path
    final_loss: float


class TrainingFailedError(RuntimeError):
    """`lerobot-train` ended with an error; the message holds its last lines."""


def train(
    *,
    dataset: Path,
    repo_id: str,
    out: Path,
    steps: int,
    batch_size: int,
    input_size_px: int,
    num_workers: int,
    seed: int,
    num_threads: int,
    device: str = "cpu",
    extra_args: tuple[str, ...] = (),
    on_progress: Callable[[float, str], None] | None = None,
) -> Trained:
    """Train on a LeRobot dataset; leave the policy in `out/policy`, the loss curve in `out/curve.csv`.

    Args:
        dataset: the dataset's folder.
        repo_id: its name.
        out: where to work; a half-finished training in it is continued.
        steps: gradient steps in all.
        batch_size: frames a step.
        input_size_px: size of the images the backbone sees.
        num_workers: processes that decode video; 0 decodes in the training process.
        seed: of the batches' order and the weights.
        num_threads: threads of the linear algebra.
        device: cpu, cuda or mps.
        extra_args: more flags for `lerobot-train`.
        on_progress: called with the share that is done and a few words.

    Raises:
        TrainingFailedError: `lerobot-train` failed.
    """
    work = out / WORK_FOLDER
    log_every = max(1, steps // LOGS_A_RUN)
    last = work / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    first_step = 0
    if last.is_file():
        first_step = int(last.resolve().parents[1].name)
        arguments = [f"--config_path={last}", "--resume=true"]
    else:
        shutil.rmtree(work, ignore_errors=True)
        arguments = [
            f"--dataset.repo_id={repo_id}",
            f"--dataset.root={dataset}",
            "--dataset.use_imagenet_stats=false",
            "--policy.type=v2p_bc",
            f"--policy.device={device}",
            "--policy.push_to_hub=false",
            f"--policy.input_size_px={input_size_px}",
            f"--output_dir={work}",
            f"--steps={steps}",
            f"--batch_size={batch_size}",
            f"--num_workers={num_workers}",
            *(["--persistent_workers=false"] if num_workers == 0 else []),
            f"--seed={seed}",
            f"--log_freq={log_every}",
            f"--save_freq={max(1, steps // SAVES_A_RUN)}",
            "--env_eval_freq=0",
            "--wandb.enable=false",
            *extra_args,
        ]
    rows = _run(
        [sys.executable, "-m", "lerobot.scripts.lerobot_train", *arguments],
        log=out / LOG_FILE,
        num_threads=num_threads,
        on_loss=lambda index, loss: (
            on_progress((first_step + index * log_every) / steps, f"loss {loss:.3f}")
            if on_progress
            else None
        ),
    )
    _append_curve(out / CURVE_FILE, first_step, log_every, rows)
    policy = out / POLICY_FOLDER
    shutil.rmtree(policy, ignore_errors=True)
    shutil.copytree(last.parent, policy)
    shutil.rmtree(work)
    losses = _losses(out / CURVE_FILE)
    return Trained(policy=policy, final_loss=losses[-1] if losses else float("nan"))


def _run(
    command: list[str],
    *,
    log: Path,
    num_threads: int,
    on_loss: Callable[[int, float], None],
) -> list[float]:
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": str(num_threads),
        "MKL_NUM_THREADS": str(num_threads),
        "HF_HUB_OFFLINE": os.environ.get("HF_HUB_OFFLINE", "1"),
        "TOKENIZERS_PARALLELISM": "false",
        "PYTHONUNBUFFERED": "1",
    }
    losses: list[float] = []
    tail: deque[str] = deque(maxlen=12)
    with (
        log.open("a") as kept,
        subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process,
    ):
        assert process.stdout is not None
        try:
            for line in process.stdout:
                kept.write(line)
                kept.flush()
                tail.append(line.strip())
                found = re.search(r"\bloss:([-+\d.einf]+)", line)
                if found and "smpl:" in line:
                    losses.append(float(found.group(1)))
                    on_loss(len(losses), losses[-1])
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        raise TrainingFailedError(
            f"lerobot-train ended with code {process.returncode}; its last lines: {' | '.join(tail)}"
        )
    return losses


def _append_curve(path: Path, first_step: int, log_every: int, losses: list[float]) -> None:
    new = not path.is_file()
    with path.open("a", newline="") as stream:
        writer = csv.writer(stream)
        if new:
            writer.writerow(["step", "loss"])
        writer.writerows(
            (first_step + (index + 1) * log_every, loss) for index, loss in enumerate(losses)
        )


def _losses(path: Path) -> list[float]:
    with path.open() as stream:
        return [float(row["loss"]) for row in csv.DictReader(stream)]
