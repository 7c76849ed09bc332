"""Runs unknown task code once, in a child process that cannot hurt anyone, and says whether it works.

The child forks for every sample, so that a crash, a hang or a memory bomb in one sample is that
sample's own result, and torch is imported once for all of them. See `sandbox` for what a fork may
not do.
"""

import hashlib
import json
import math
import subprocess
import tempfile
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.processes import end_group, own_python
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for
from v2p_data.task.sandbox.guarded import COMPONENT_NAME
from v2p_data.task.sandbox.probes import States, at_rest, concatenated, random_states
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.source_text import shown

CHILD = "v2p_data.task.sandbox.smoke_child"
BATCH = 16
PARTS = 3
"""Batch sizes, drawn at random, at which every program is asked again."""
MAX_ANSWER_CHARS = 20_000_000


@dataclass(frozen=True, kw_only=True)
class SmokeResult:
    """What became of one sample."""

    runnable: bool
    error: str = ""
    """One sentence, where it is not runnable."""
    observation_dim: int = 0
    components: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """What works but should not be so."""
    probe_success: tuple[bool, ...] = ()
    """The success function's answer for each row of the probes."""
    probe_reward: tuple[float, ...] = ()
    start_poses: dict[str, Float[np.ndarray, "start 7"]] = field(
        default_factory=dict, compare=False
    )
    """Where the sample's own reset put each object, reset after reset."""
    start_rows: tuple[int, ...] = ()
    """Which of the offered layouts each of these came from."""
    start_success: tuple[bool, ...] = ()

    @staticmethod
    def from_json(data: Any, num_probes: int, num_starts: int = 0) -> "SmokeResult":
        """Read a child's answer, which is data from a stranger.

        Args:
            data: the answer.
            num_probes: moments that were asked about.
            num_starts: layouts that were offered to the sample's reset.

        Raises:
            TypeError, ValueError: it is not what it should be.
        """
        if not isinstance(data, dict) or not isinstance(data.get("runnable"), bool):
            raise TypeError("no verdict")
        success = [bool(x) for x in data.get("probe_success", [])]
        reward = [float(x) for x in data.get("probe_reward", [])]
        if data["runnable"] and not len(success) == len(reward) == num_probes:
            raise ValueError(f"{len(success)} answers to {num_probes} probes")
        if not all(math.isfinite(r) for r in reward):
            raise ValueError("a reward that is no number")
        starts = {
            str(name): np.array(poses, float).reshape(-1, 7)
            for name, poses in dict(data.get("start_poses", {})).items()
        }
        start_rows = [int(row) for row in data.get("start_rows", [])]
        start_success = [bool(x) for x in data.get("start_success", [])]
        if not all(np.isfinite(poses).all() for poses in starts.values()) or not all(
            len(x) == len(start_rows) for x in [start_success, *starts.values()]
        ):
            raise ValueError("reset poses that are no numbers")
        if data["runnable"] and num_starts and set(start_rows) != set(range(num_starts)):
            raise ValueError("not every layout was reset")
        components = tuple(str(c) for c in data.get("components", []))
        if not all(COMPONENT_NAME.fullmatch(c) for c in components):
            raise ValueError("a reward component without a proper name")
        return SmokeResult(
            runnable=data["runnable"],
            error=shown(data.get("error", ""), 1000),
            observation_dim=int(data.get("observation_dim", 0)),
            components=components,
            warnings=tuple(shown(w, 300) for w in data.get("warnings", [])),
            probe_success=tuple(success),
            probe_reward=tuple(reward),
            start_poses=starts,
            start_rows=tuple(start_rows),
            start_success=tuple(start_success),
        )


def smoke_run(source: str, scene: Scene, *, timeout_s: float = 60.0) -> SmokeResult:
    """Return whether one task code runs on states of this scene."""
    return smoke_run_all([source], scene, timeout_s=timeout_s)[0]


def smoke_run_all(
    sources: list[str],
    scene: Scene,
    *,
    probes: States | None = None,
    starts: States | None = None,
    seconds_each: float = 10.0,
    timeout_s: float = 180.0,
) -> list[SmokeResult]:
    """Return per source whether it runs, what it says to the probes, and where its reset puts things.

    Args:
        sources: task codes.
        scene: whose objects the states describe.
        probes: further moments on which success and reward are wanted.
        starts: layouts that the environment offers to its reset; without them it is not looked at.
        seconds_each: wall-clock limit per source.
        timeout_s: for all of them, with the child's start.
    """
    results: list[SmokeResult | None] = [_refused(s) for s in sources]
    asked = [i for i, r in enumerate(results) if r is None]
    if asked:
        answers = _ask_child(
            [sources[i] for i in asked], scene, probes, starts, seconds_each, timeout_s
        )
        for i, answer in zip(asked, answers, strict=True):
            results[i] = answer
    return [r for r in results if r is not None]


def _refused(source: str) -> SmokeResult | None:
    try:
        check_code(source)
    except TaskCodeError as error:
        return SmokeResult(runnable=False, error=str(error))
    return None


def trial_request(
    sources: list[str],
    scene: Scene,
    probes: States | None,
    seconds_each: float,
    starts: States | None = None,
) -> dict[str, Any]:
    """Return what the child is asked, as data that JSON can hold."""
    rng = rng_for(
        0, "smoke", scene.title, *(hashlib.sha256(s.encode()).hexdigest() for s in sources)
    )
    count = int(rng.integers(BATCH // 2, 2 * BATCH))
    states = random_states(scene, count, rng)
    return {
        "sources": sources,
        "object_names": [o.name for o in scene.objects],
        "states": _as_lists(states),
        "edge_states": _as_lists(_edge_states(scene)),
        "batch_sizes": rng.integers(1, count, PARTS).tolist(),
        "probes": _as_lists(probes or {}),
        "starts": _as_lists(starts or {}),
        "seconds_each": seconds_each,
    }


def _ask_child(
    sources: list[str],
    scene: Scene,
    probes: States | None,
    starts: States | None,
    seconds_each: float,
    timeout_s: float,
) -> list[SmokeResult]:
    request = trial_request(sources, scene, probes, seconds_each, starts)
    with (
        tempfile.TemporaryDirectory(prefix="v2p-task-") as folder,
        tempfile.TemporaryFile() as answers,
        tempfile.TemporaryFile() as complaints,
    ):
        environment = {
            "OMP_NUM_THREADS": "1",
            "HOME": folder,
            "TMPDIR": folder,
            "PATH": "/usr/bin:/bin",
        }
        with subprocess.Popen(
            own_python(CHILD),
            stdin=subprocess.PIPE,
            stdout=answers,
            stderr=complaints,
            cwd=folder,
            env=environment,
            start_new_session=True,
        ) as process:
            try:
                process.communicate(json.dumps(request).encode(), timeout_s)
            except subprocess.TimeoutExpired:
                late = SmokeResult(
                    runnable=False, error=f"the trial run took more than {timeout_s:g} s"
                )
                return [late] * len(sources)
            finally:
                end_group(process)
        answers.seek(0)
        complaints.seek(0)
        given = _answers(answers.read(MAX_ANSWER_CHARS + 1), complaints.read(), len(sources))
    num_probes, num_starts = (len(x["eef_pos"]) if x else 0 for x in (probes, starts))
    return [_result(data, num_probes, num_starts) for data in given]


def _answers(answer: bytes, complaint: bytes, count: int) -> list[Any]:
    """Return the child's answers, one a sample.

    Raises:
        V2PError: there are not so many.
    """
    try:
        if len(answer) > MAX_ANSWER_CHARS:
            raise ValueError("the answer is too long")  # noqa: TRY301
        data = json.loads(answer)
        if not isinstance(data, list) or len(data) != count:
            raise ValueError(f"{count} answers wanted")  # noqa: TRY301
    except ValueError as error:
        tail = complaint.decode(errors="replace").strip().splitlines()[-1:]
        raise V2PError(
            f"the trial run of task code gave no answer ({error}{'; ' + tail[0] if tail else ''}); "
            "is there memory left for a Python process with torch?"
        ) from error
    return data


def _result(data: Any, num_probes: int, num_starts: int) -> SmokeResult:
    """Return one sample's answer; one that cannot be read is that sample's own failure."""
    try:
        return SmokeResult.from_json(data, num_probes, num_starts)
    except (ValueError, TypeError, OverflowError) as error:
        return SmokeResult(runnable=False, error=f"its answer cannot be read: {shown(error, 200)}")


def _edge_states(scene: Scene) -> States:
    """Return moments at which norms are zero: everything still, the hand at an object's very centre."""
    batches: list[States] = []
    for obj in scene.objects:
        probe = at_rest(scene, 2)
        probe.eef_pos = probe.objects[obj.name].pos.copy()
        probe.progress = 0.0
        batches.append(probe.states())
    return concatenated(batches)


def _as_lists(states: States) -> dict[str, Any]:
    """Return states as lists, without a base observation that says nothing: the child fills in the zeros."""
    return {
        k: np.asarray(v, float).tolist()
        for k, v in states.items()
        if k != "base_observation" or np.any(v)
    }
