"""From a scene to its task: samples of task code, each tried and audited; one that the audit accepts becomes the task.

Offline samples come from `templates`. The first one is taken where the audit accepts it: in the
twelve tasks of the paper it does as well as the best of eight by the audit's score
(`docs/lab/pick.md`). A model writes all its samples (`llm`), and one is picked. Whoever else
writes code passes it in as `sources`.
"""

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from v2p_data.errors import ItemRejectedError
from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for
from v2p_data.task.audit.audit import Audit, audit
from v2p_data.task.audit.moments import build_probes
from v2p_data.task.llm.config import VlmConfig
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.sandbox.smoke import SmokeResult, smoke_run_all
from v2p_data.task.sandbox.trial import note_passed
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples

AUDIT_FILE = "audit.json"
SAMPLES_FOLDER = "samples"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """How a task is made from a scene."""

    writer: Literal["templates", "vlm"] = "templates"
    """Who writes the codes: our templates, offline and free, or a model that is asked over the network."""
    num_samples: int = 8
    """Codes to choose from (the paper's number). Of templates the later ones are tried only where the audit refuses the
    first."""
    horizon_steps: int = 100
    """Control steps (20 Hz) per episode, for kinds that need more than a push or a lift."""
    seconds_each: float = 10.0
    """Limit for the trial run of one sample."""
    timeout_s: float = 180.0
    """Limit for the trial run of all samples."""
    vlm: VlmConfig = field(default_factory=VlmConfig)
    """Which model, where `writer` is `vlm`."""

    def recipe(self) -> "TaskConfig":
        """Return the settings that decide what is written, without those of how it is asked for.

        Replaying stored calls, or waiting longer for an answer, makes the same task.
        """
        if self.writer == "templates":
            return replace(self, vlm=VlmConfig())
        return replace(self, vlm=self.vlm.recipe())

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
    first: tuple[Sample, ...] = field(default=(), repr=False)
    """The samples as they were before any was sent back; empty where none was."""
    about: dict[str, Any] = field(default_factory=dict[str, Any])
    """Who wrote and who picked, and what it took."""

    def rates(self) -> dict[str, Any]:
        """Return how many samples are of no use, before and after sending back (the paper's table 8).

        What is picked has passed the same audit: asking it again measures nothing. What a pick gains is measured
        against the referee (`docs/lab/pick.md`).
        """
        return {
            "first_answers": hallucination(self.first or self.samples),
            "before_pick": hallucination(self.samples),
        }

    def save(self, folder: Path) -> None:
        """Write the bundle, `samples/<i>.py` and `audit.json`."""
        self.bundle.save(folder)
        samples = folder / SAMPLES_FOLDER
        samples.mkdir()
        for i, sample in enumerate(self.samples):
            (samples / f"{i}.py").write_text(sample.code, encoding="utf-8")
        table = {
            "picked": self.picked,
            **self.about,
            "rates": self.rates(),
            "samples": [s.as_dict() for s in self.samples],
        }
        (folder / AUDIT_FILE).write_text(json.dumps(table, indent=1), encoding="utf-8")


def hallucination(samples: Sequence[Sample]) -> dict[str, int | float]:
    """Return the share of samples that do not run, that run but score zero, and of both together."""
    broken = sum(not s.runnable for s in samples) / len(samples)
    zero = sum(s.runnable and s.score == 0 for s in samples) / len(samples)
    return {
        "samples": len(samples),
        "non_runnable": round(broken, 4),
        "zero_score": round(zero, 4),
        "hallucination": round(broken + zero, 4),
    }


class CodeJudge:
    """Tries task codes of one scene in the sandbox and audits them.

    Args:
        scene: what was understood of the video.
        cfg: limits of the trial runs.
        seed: of the audit's random probes.
        reference: a trusted code, which others are held to; see `Audit.held_to`.
    """

    def __init__(self, scene: Scene, cfg: TaskConfig, seed: int, reference: str = "") -> None:
        self._scene, self._cfg = scene, cfg
        self._probes = build_probes(scene, rng_for(seed, "audit", scene.title))
        self._reference = Audit()
        if reference:
            self._reference = self.tried([reference])[0].audit

    def try_all(self, codes: list[str]) -> list[SmokeResult]:
        """Return each code's trial run."""
        return smoke_run_all(
            codes,
            self._scene,
            probes=self._probes.states,
            starts=self._probes.starts,
            seconds_each=self._cfg.seconds_each,
            timeout_s=self._cfg.timeout_s,
        )

    def judged(self, written: Sequence[tuple[str, SmokeResult]]) -> tuple[Sample, ...]:
        """Return codes that were tried, with their audits."""
        return tuple(
            _sample(
                code, result, audit(self._scene, self._probes, result).held_to(self._reference)
            )
            for code, result in written
        )

    def tried(self, codes: list[str]) -> tuple[Sample, ...]:
        """Return codes with their trial runs and audits."""
        return self.judged(list(zip(codes, self.try_all(codes), strict=True)))


def generate_task(
    scene: Scene,
    cfg: TaskConfig,
    seed: int,
    *,
    sources: list[str] | None = None,
    calls: Path = Path("vlm"),
    pool: Path | None = None,
) -> GeneratedTask:
    """Return the scene's task.

    Args:
        scene: what was understood of the video.
        cfg: who writes, how many samples, and limits.
        seed: of the audit's random probes; with a model, another one asks anew instead of taking stored answers.
        sources: task codes to choose from, instead of the templates' or the model's.
        calls: folder in which calls to a model are stored.
        pool: folder of tasks solved so far, which a model is shown as examples.

    Raises:
        ItemRejectedError: `no_acceptable_task`: no sample runs and passes the audit.
        V2PError: the model cannot be asked, or its budget is used up.
    """
    if sources is None and cfg.writer == "vlm":
        # Templates are sure of the words, a model is sure of nothing.
        judge = CodeJudge(scene, cfg, seed, reference=write_samples(scene, 1)[0])
        return _by_model(scene, cfg, seed, judge, calls, pool)
    judge = CodeJudge(scene, cfg, seed)
    codes = write_samples(scene, cfg.num_samples) if sources is None else sources
    samples = judge.tried(codes[:1])
    if not samples[0].audit.is_acceptable:
        samples += judge.tried(codes[1:])
    picked = _pick(scene, samples)
    return GeneratedTask(
        bundle=_bundle(scene, cfg, samples[picked]),
        samples=samples,
        picked=picked,
        about={"writer": "templates" if sources is None else "given"},
    )


def _by_model(
    scene: Scene,
    cfg: TaskConfig,
    seed: int,
    judge: CodeJudge,
    calls: Path,
    pool: Path | None,
) -> GeneratedTask:
    """Let a model write the samples and choose among those that the audit accepts."""
    from v2p_data.task.llm import writer as vlm_writer
    from v2p_data.task.llm.client import VlmClient
    from v2p_data.task.llm.pool import examples_for, read_pool
    from v2p_data.task.llm.prompts import audit_table

    def objections(written: Sequence[tuple[str, SmokeResult]]) -> list[str]:
        audits = [s.audit for s in judge.judged(written)]
        return ["" if a.is_acceptable else audit_table(a) for a in audits]

    pools = [p for p in (pool, cfg.vlm.pool) if p is not None]
    examples = examples_for(scene, read_pool(*pools), cfg.vlm.num_examples)
    client = VlmClient(cfg.vlm, calls, seed)
    written = vlm_writer.write_samples(
        client, scene, cfg.num_samples, examples, judge.try_all, objections
    )
    samples = judge.judged(written.final)
    audits_pick = _pick(scene, samples)
    pick = vlm_writer.pick_sample(
        client, scene, [(s.code, s.audit) for s in samples], audits_pick=audits_pick
    )
    return GeneratedTask(
        bundle=_bundle(scene, cfg, samples[pick.index]),
        samples=samples,
        picked=pick.index,
        first=judge.judged(written.first),
        about={
            "writer": "vlm",
            "pick": {**pick.as_dict(), "audits_pick": audits_pick},
            "model": cfg.vlm.model,
            "examples": [e.source for e in examples],
            "codes_asked_for": written.answers,
            "spent": client.spent.as_dict(),
        },
    )


def _bundle(scene: Scene, cfg: TaskConfig, chosen: Sample) -> TaskBundle:
    note_passed(chosen.code, scene)
    return TaskBundle(
        title=scene.title,
        description=scene.description,
        kind=scene.kind,
        class_name=class_name(chosen.code),
        code=chosen.code,
        scene=scene,
        horizon_steps=KINDS[scene.kind].horizon_steps or cfg.horizon_steps,
        motion_scale=KINDS[scene.kind].motion_scale,
        audit=chosen.audit.as_dict(),
    )


def _sample(code: str, result: SmokeResult, verdict: Audit) -> Sample:
    return Sample(
        code=code,
        runnable=result.runnable,
        error=result.error,
        audit=verdict,
        score=verdict.score if result.runnable and not verdict.vetoed else 0.0,
    )


def best_acceptable(samples: Sequence[Sample]) -> int | None:
    """Return the index of the best acceptable sample, the first among equals; None where none is acceptable."""
    acceptable = [i for i, s in enumerate(samples) if s.audit.is_acceptable]
    return max(acceptable, key=lambda i: (samples[i].score, -i)) if acceptable else None


def _pick(scene: Scene, samples: tuple[Sample, ...]) -> int:
    if (index := best_acceptable(samples)) is not None:
        return index
    best = max(samples, key=lambda s: (s.runnable, s.audit.score))
    asked = ", ".join(f"'{c.asks}'" for c in best.audit.checks if not c.passed)
    why = best.audit.vetoed or f"the answer is no to {asked}"
    raise ItemRejectedError(
        "no_acceptable_task",
        f"none of {len(samples)} task codes for '{scene.description}' ({scene.kind}) is acceptable; "
        f"the best one's fault is that {why}. Look at the scene's overlay: was the motion understood?",
        best.score,
    )
