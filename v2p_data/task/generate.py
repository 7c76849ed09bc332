"""From a scene to its task: eight samples, each tried and audited, the best one picked.

Offline samples come from `templates`; whoever else writes code passes it in as `sources`.
"""

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for
from v2p_data.task.audit import Audit, audit, build_probes
from v2p_data.task.sandbox import class_name
from v2p_data.task.smoke import SmokeResult, smoke_run_all
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates import write_samples

AUDIT_FILE = "audit.json"
SAMPLES_FOLDER = "samples"
HORIZON_STEPS = {"lift_up": 60, "push_left": 60, "push_right": 60, "tip_over": 60}
"""Control steps (20 Hz) per episode, by kind; `TaskConfig.horizon_steps` for the others."""
MOTION_SCALE = {"throw_into": 2.0}
"""Of kinds in which the gripper must be faster than 0.6 m/s."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """How a task is made from a scene."""

    num_samples: int = 8
    """Codes to choose from (the paper's number)."""
    horizon_steps: int = 100
    """Control steps (20 Hz) per episode, for kinds that need more than a push or a lift."""
    seconds_each: float = 10.0
    """Limit for the trial run of one sample."""
    timeout_s: float = 180.0
    """Limit for the trial run of all samples."""

    def __post_init__(self) -> None:
        if self.num_samples < 1:
            raise ValueError(f"num_samples must be at least 1, got {self.num_samples}")


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One candidate."""

    code: str
    runnable: bool
    error: str
    audit: Audit
    score: float

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON, without its code."""
        return {
            "runnable": self.runnable,
            "error": self.error,
            "score": self.score,
            "audit": self.audit.as_dict(),
        }


@dataclass(frozen=True, kw_only=True)
class GeneratedTask:
    """The picked task and what it was picked from."""

    bundle: TaskBundle
    samples: tuple[Sample, ...] = field(repr=False)
    picked: int

    def save(self, folder: Path) -> None:
        """Write the bundle, `samples/<i>.py` and `audit.json`."""
        self.bundle.save(folder)
        samples = folder / SAMPLES_FOLDER
        samples.mkdir()
        for i, sample in enumerate(self.samples):
            (samples / f"{i}.py").write_text(sample.code)
        table = {"picked": self.picked, "samples": [s.as_dict() for s in self.samples]}
        (folder / AUDIT_FILE).write_text(json.dumps(table, indent=1))


def generate_task(
    scene: Scene, cfg: TaskConfig, seed: int, *, sources: list[str] | None = None
) -> GeneratedTask:
    """Return the scene's task.

    Args:
        scene: what was understood of the video.
        cfg: how many samples, and limits.
        seed: of the audit's random probes.
        sources: task codes to choose from, instead of the templates'.

    Raises:
        ItemRejectedError: `no_acceptable_task`: no sample runs and passes the audit.
    """
    codes = write_samples(scene, cfg.num_samples) if sources is None else sources
    probes = build_probes(scene, rng_for(seed, "audit", scene.title))
    results = smoke_run_all(
        codes,
        scene,
        probes=probes.states,
        seconds_each=cfg.seconds_each,
        timeout_s=cfg.timeout_s,
    )
    samples = tuple(
        _sample(code, result, audit(scene, probes, result))
        for code, result in zip(codes, results, strict=True)
    )
    picked = _pick(scene, samples)
    chosen = samples[picked]
    return GeneratedTask(
        bundle=TaskBundle(
            title=scene.title,
            description=scene.description,
            kind=scene.kind,
            class_name=class_name(chosen.code),
            code=chosen.code,
            scene=scene,
            horizon_steps=HORIZON_STEPS.get(scene.kind, cfg.horizon_steps),
            motion_scale=MOTION_SCALE.get(scene.kind, 1.0),
            audit=chosen.audit.as_dict(),
        ),
        samples=samples,
        picked=picked,
    )


def _sample(code: str, result: SmokeResult, verdict: Audit) -> Sample:
    return Sample(
        code=code,
        runnable=result.runnable,
        error=result.error,
        audit=verdict,
        score=verdict.score if result.runnable and not verdict.vetoed else 0.0,
    )


def _pick(scene: Scene, samples: tuple[Sample, ...]) -> int:
    """Return the index of the best acceptable sample, the first among equals."""
    acceptable = [i for i, s in enumerate(samples) if s.audit.is_acceptable]
    if acceptable:
        return max(acceptable, key=lambda i: (samples[i].score, -i))
    best = max(samples, key=lambda s: (s.runnable, s.audit.score))
    asked = ", ".join(f"'{c.asks}'" for c in best.audit.checks if not c.passed)
    why = best.audit.vetoed or f"the answer is no to {asked}"
    raise ItemRejectedError(
        "no_acceptable_task",
        f"none of {len(samples)} task codes for '{scene.description}' ({scene.kind}) is acceptable; "
        f"the best one's fault is that {why}. Look at the scene's overlay: was the motion understood?",
        best.score,
    )
