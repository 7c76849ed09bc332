"""The child process of `smoke`: reads task codes as JSON, tries each in a fork with nothing left to abuse.

A fork may open no file and no socket, start no process, write no file, and use a bounded amount of time and
memory (`confine`).
"""

import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import torch

from v2p_data.task.sandbox.confine import Rights, confine, leave_the_network
from v2p_data.task.sandbox.guarded import Answers, GuardedTask, TaskOutputError, demand_equal
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.sandbox import make_task
from v2p_data.task.sandbox.time_limit import line_in_task_code
from v2p_data.task.task import BASE_OBSERVATION_DIM

MEMORY_BYTES = 2 * 1024**3
"""On top of what importing torch has mapped."""
LARGE_REWARD = 1000.0
"""Ten full rewards: beside them the bonus for success hardly counts."""
MAX_ANSWER_BYTES = 4_000_000
SLOW_S = 1.0
SCALED = ("_pos", "_size", "_width")
"""How the names of states in metres end."""

_FAULTS: dict[int, str] = {
    signal.SIGFPE: "it divides whole numbers in a way that the processor refuses (SIGFPE); use floats",
    signal.SIGSEGV: "it makes torch crash (SIGSEGV); write it with other operations",
    signal.SIGILL: "it makes torch crash (SIGILL); write it with other operations",
}
"""What ends a process at once and is no lack of memory, which is SIGKILL's and SIGABRT's."""

_HARMLESS = """
scene_info = {}
class Warm(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
    def compute_success(self, states):
        return torch.norm(states["eef_pos"], dim=-1) < 0.0
    def compute_reward(self, actions, states):
        return reward_function(actions, states)
def reward_function(actions, states):
    x = 1 - torch.tanh(torch.linalg.norm(states["eef_pos"], dim=-1))
    return x + actions.square().sum(dim=-1), {"x": torch.where(x > 0, x, -x).clamp(0, 1)}
"""


class BadTaskError(Exception):
    """What a sample does wrong, as a sentence."""


class FakePlacer:
    """Stands in for the environment: every object is put where the states say."""

    def __init__(self, states: dict[str, torch.Tensor], names: list[str]) -> None:
        self._names = names
        self.offer(states)

    def offer(self, states: dict[str, torch.Tensor]) -> None:
        """Let resets be offered other layouts from now on."""
        self._states = states

    @property
    def num_envs(self) -> int:
        return len(self._states["eef_pos"])

    def sample_object_poses(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        return {
            n: torch.cat([self._states[f"{n}_pos"], self._states[f"{n}_quat"]], dim=1)[env_ids]
            for n in self._names
        }


def main() -> None:
    """Answer the request that is on stdin, on stdout."""
    leave_the_network()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    request: dict[str, Any] = json.load(sys.stdin)
    warm_up(request)
    answers = [in_a_fork(source, request) for source in request["sources"]]
    print(json.dumps(answers), flush=True)  # noqa: T201 - this is the answer


def warm_up(request: dict[str, Any]) -> None:
    """Let torch load what it loads late, before files can no longer be opened."""
    with suppress(BadTaskError):
        judge(_HARMLESS, request)


def judge(source: str, request: dict[str, Any]) -> dict[str, Any]:
    """Return what the code does with the request's states.

    Raises:
        BadTaskError: it does not work.
    """
    states = _tensors(request["states"])
    names: list[str] = request["object_names"]
    placer = FakePlacer(states, names)
    task = make_task(source, placer, "")
    n = len(states["eef_pos"])
    task.reset_poses(torch.arange(n), names)

    first = _answers(task, states)
    demand_equal(first, _answers(task, states))
    order = torch.arange(n - 1, -1, -1)
    turned = _answers(task, {k: v[order] for k, v in states.items()})
    if not _agree(first, turned, order):
        raise BadTaskError("the result depends on the order of the environments")
    warnings: list[str] = []
    for count in request["batch_sizes"]:
        some = _answers(task, {k: v[:count] for k, v in states.items()})
        if not _agree(first, some, slice(count)):
            warnings.append("the result for one environment depends on the others")
            break
    _demand_own_success(task, states, first)
    edge = _answers(task, _tensors(request["edge_states"]))
    biggest = max(float(first.reward.max()), float(edge.reward.max()))
    if biggest > LARGE_REWARD:
        warnings.append(
            f"the reward reaches {biggest:.3g}, a full one is 100; beside it the bonus for success hardly counts"
        )
    answer = {
        "runnable": True,
        "observation_dim": first.observation.shape[1],
        "components": list(first.components),
        "warnings": warnings,
    }
    if request["probes"]:
        asked = _tensors(request["probes"])
        probes = _answers(task, asked)
        _demand_own_success(task, asked, probes)
        answer |= {
            "probe_success": probes.success.int().tolist(),
            "probe_reward": probes.reward.tolist(),
        }
    if request["starts"]:
        answer |= _starts(task, placer, _tensors(request["starts"]), names)
    return answer


def _demand_own_success(
    task: GuardedTask, states: dict[str, torch.Tensor], answers: Answers
) -> None:
    """Demand that success in one world does not depend on the others, as that of a maximum or a majority does.

    Raises:
        BadTaskError: it changes when two worlds with very large and very small numbers are added, or more copies than
            there are worlds of one that succeeds, or of one that fails.
    """
    one = {k: v[:1] for k, v in states.items()}
    wide = {k: v * 9 if k.endswith(SCALED) else v for k, v in one.items()}
    wide |= {k: v + 1e4 for k, v in one.items() if "_vel_" in k}
    narrow = {k: v * 0.01 if k.endswith(SCALED) else v for k, v in one.items()}
    crowds = [{k: torch.cat([wide[k], narrow[k]]) for k in one}]
    count = len(answers.success)
    for value in (True, False):
        row = (answers.success == value).nonzero()[:1, 0].repeat(count + 1)
        crowds.append({k: v[row] for k, v in states.items()})
    for crowd in crowds:
        beside = {k: torch.cat([v, crowd[k]]) for k, v in states.items()}
        success = task.succeeds(lambda beside=beside: {k: v.clone() for k, v in beside.items()})
        if not torch.equal(success[:count], answers.success):
            raise BadTaskError(
                "success in one environment depends on the others; take the maximum, minimum or mean along a dimension"
            )


def _starts(
    task: GuardedTask, placer: FakePlacer, offered: dict[str, torch.Tensor], names: list[str]
) -> dict[str, Any]:
    """Return where the task's reset puts the objects, and what its success says there.

    All layouts are reset, then some of them again and again, then all: a task may count its resets.
    """
    placer.offer(offered)
    everyone = torch.arange(placer.num_envs)
    some = everyone[: len(everyone) // 4]
    ids = [everyone, some, some, some, everyone]
    made = [task.reset_poses(each, names) for each in ids]
    rows = torch.cat(ids)
    states = {k: v[rows] for k, v in offered.items()}
    poses = {name: torch.cat([poses[name].float() for poses in made]) for name in names}
    for name, pose in poses.items():
        states |= {f"{name}_pos": pose[:, :3], f"{name}_start_pos": pose[:, :3].clone()}
        states |= {f"{name}_quat": pose[:, 3:], f"{name}_start_quat": pose[:, 3:].clone()}
        states[f"{name}_up"] = 1 - 2 * (pose[:, 4] ** 2 + pose[:, 5] ** 2)
    return {
        "start_poses": {name: pose.tolist() for name, pose in poses.items()},
        "start_rows": rows.tolist(),
        "start_success": _answers(task, states).success.int().tolist(),
    }


def _answers(task: GuardedTask, given: dict[str, torch.Tensor]) -> Answers:
    """Return copies of all that the task says of these states, checked."""
    n = len(given["eef_pos"])
    begin = time.monotonic()
    answers = task.judge(
        lambda: {k: v.clone() for k, v in given.items()}, torch.full((n, 7), 0.1)
    ).cloned()
    said = task.observation_size()
    if said != answers.observation.shape[1]:
        raise BadTaskError(
            f"get_observation_space says {said}, but the observation has length {answers.observation.shape[1]}"
        )
    answers.check_finite()
    if not answers.components:
        raise BadTaskError("the reward needs at least one named component")
    if time.monotonic() - begin > SLOW_S:
        raise BadTaskError(f"one step of {n} environments takes more than {SLOW_S:.0f} s")
    return answers


def _agree(first: Answers, second: Answers, rows: torch.Tensor | slice) -> bool:
    """Tell whether some rows got the answers that they get among all."""
    other = second.named()
    return all(_close(value[rows], other[what]) for what, value in first.named().items())


def _close(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.shape == b.shape and torch.allclose(a.float(), b.float(), atol=1e-4, rtol=1e-4)


def _tensors(lists: dict[str, Any]) -> dict[str, torch.Tensor]:
    states = {k: torch.tensor(v, dtype=torch.float32) for k, v in lists.items()}
    if states and "base_observation" not in states:
        states["base_observation"] = torch.zeros(len(states["eef_pos"]), BASE_OBSERVATION_DIM)
    return states


# --- confinement ---------------------------------------------------------------------------------------------


def in_a_fork(
    source: str,
    request: dict[str, Any],
    answer_to: Callable[[str, dict[str, Any]], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return the confined fork's answer, or a sentence that says how it ended.

    Args:
        source: task code.
        request: what `smoke.trial_request` returns.
        answer_to: what the fork does with them instead of `answer`, for whoever looks on.
    """
    read_end, write_end = os.pipe()
    seconds = float(request["seconds_each"])
    parent_pid, pid = os.getpid(), os.fork()
    if pid == 0:
        os.close(read_end)
        code = 1
        try:
            _leave_the_pipes()
            confine(Rights(seconds=seconds, memory_bytes=MEMORY_BYTES), parent_pid=parent_pid)
            _send(write_end, (answer_to or answer)(source, request))
            code = 0
        finally:
            os._exit(code)
    os.close(write_end)
    received, is_late = _receive(read_end, seconds)
    os.close(read_end)
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    if is_late:
        return _failed(f"it took more than {seconds:g} s")
    try:
        return json.loads(received)
    except (ValueError, RecursionError):
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
            return _failed(f"it took more than {seconds:g} s of computing")
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) in _FAULTS:
            return _failed(_FAULTS[os.WTERMSIG(status)])
        return _failed("its process ended before it had answered; it may need too much memory")


def _leave_the_pipes() -> None:
    """Let a fork neither read the next request nor write an answer in our name."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nothing, stream)
    os.close(nothing)


def answer(source: str, request: dict[str, Any]) -> dict[str, Any]:
    """Return the verdict on task code as data, whatever the code does."""
    try:
        return judge(source, request)
    except (BadTaskError, TaskCodeError, TaskOutputError) as error:
        return _failed(str(error))
    except MemoryError:
        return _failed("it needs too much memory")
    except Exception as error:  # noqa: BLE001 - whatever strange code raises is its own result
        line = line_in_task_code(error)
        where = f"line {line}: " if line else ""
        return _failed(f"{where}{type(error).__name__}: {str(error)[:300]}")


def _failed(error: str) -> dict[str, Any]:
    return {"runnable": False, "error": error}


def _send(end: int, answer: dict[str, Any]) -> None:
    data = memoryview(json.dumps(answer).encode())
    while data:
        data = data[os.write(end, data) :]


def _receive(end: int, seconds: float) -> tuple[bytes, bool]:
    """Return what came before the other end closed, and whether time ran out first."""
    deadline = time.monotonic() + seconds
    received = bytearray()
    while len(received) < MAX_ANSWER_BYTES:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([end], [], [], left)[0]:
            return bytes(received), True
        chunk = os.read(end, 65536)
        if not chunk:
            return bytes(received), False
        received += chunk
    return bytes(received), False
