"""What a person sees while stages run: bars with the time left in a terminal, plain lines elsewhere."""

import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from typing import TextIO

import rich.progress
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn

from v2p_data.commands.pace import Pace, said
from v2p_data.errors import NOT_ALL, NOTHING
from v2p_data.pipeline.at_work import Event
from v2p_data.pipeline.runner import Outcome, Progress

PLAIN_EVERY_S = 15.0
"""Nobody waits longer for a word."""
STAGE_ORDER = (
    *("scene", "cousin", "task", "reward", "expert", "episodes"),
    *("dataset", "distillation", "policy", "evaluation"),
)


class Display:
    """Shows events; use as a context manager and pass it to `run_stages`."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.is_terminal = self.stream.isatty()
        self.bars: dict[str, TaskID] = {}
        self.started: dict[str, float] = {}
        self.spoken: dict[str, float] = {}
        self.pace = Pace()
        self.progress = rich.progress.Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[words]}"),
            console=Console(file=self.stream),
            transient=True,
            disable=not self.is_terminal,
        )

    def __enter__(self) -> "Display":
        self.progress.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.progress.stop()

    def __call__(self, event: Event) -> None:
        name = f"{event.stage.name} {event.stage.item}"
        if event.kind == "started":
            self.started[name] = time.monotonic()
            self.bars[name] = self.progress.add_task(name, total=1.0, words="")
            if not self.is_terminal:
                self.say(f"{name}: started")
        elif event.kind == "progress":
            self._moved(name, event)
        elif event.outcome is not None:
            if name in self.bars:
                self.progress.remove_task(self.bars.pop(name))
            if event.outcome.status == "made":
                self.pace.finished[event.stage.name].append(event.outcome.seconds)
            self.say(f"{name}: {describe(event.outcome)}")

    def _moved(self, name: str, event: Event) -> None:
        now = time.monotonic()
        passed_s = now - self.started[name]
        words = event.words + said(self.pace.left_s(event.stage.name, name, passed_s, event.share))
        if self.is_terminal:
            self.progress.update(self.bars[name], completed=event.share, words=words)
            return
        if now - self.spoken.get(name, self.started.get(name, now)) < PLAIN_EVERY_S:
            return
        self.spoken[name] = now
        self.say(f"{name}: {event.share:.0%} {words}")

    def say(self, line: str) -> None:
        """Print a line that stays."""
        if self.is_terminal:
            self.progress.console.print(line, markup=False, highlight=False)
        else:
            print(line, file=self.stream, flush=True)


@contextmanager
def telling(what: str) -> Generator[Progress]:
    """Say on stderr every now and then how far something is; give what is to be told of its steps."""
    now, done, began = ["at work"], threading.Event(), time.monotonic()

    def heard(share: float, words: str) -> None:
        now[0] = f"{share:.0%} {words}"

    def say() -> None:
        while not done.wait(PLAIN_EVERY_S):
            seconds = time.monotonic() - began
            print(f"{what}: {now[0]}, {seconds:.0f} s so far", file=sys.stderr, flush=True)  # noqa: T201

    teller = threading.Thread(target=say, daemon=True)
    teller.start()
    try:
        yield heard
    finally:
        done.set()
        teller.join()


def describe(outcome: Outcome) -> str:
    """Return an outcome in words."""
    if outcome.status == "made":
        return f"made in {outcome.seconds:.0f} s"
    if outcome.status == "kept":
        return "kept"
    if outcome.status == "blocked":
        return f"not run, {outcome.detail}"
    return f"{outcome.status} ({outcome.reason}): {outcome.detail}"


def outcome_table(outcomes: Sequence[Outcome]) -> str:
    """Return which item came how far and why it stopped there, one line an item."""
    by_item: dict[str, dict[str, Outcome]] = {}
    for outcome in outcomes:
        by_item.setdefault(outcome.item, {})[outcome.stage] = outcome
    width = max((len(item) for item in by_item), default=0)
    lines: list[str] = []
    for item, stages in by_item.items():
        good = [s for s in STAGE_ORDER if s in stages and stages[s].is_usable]
        stopped = next((o for o in stages.values() if o.status in ("rejected", "failed")), None)
        line = f"  {item:<{width}}  {' > '.join(good) or '-'}"
        if stopped is not None:
            line += f"  stopped at {stopped.stage} ({stopped.reason}): {stopped.detail}"
        lines.append(line)
    return "\n".join(lines)


def cost_line(outcomes: Sequence[Outcome]) -> str:
    """Return what a task with episodes cost: the workers' time, that of rejected items and of earlier runs included."""
    usable = sum(o.stage == "episodes" and o.is_usable for o in outcomes)
    by_stage: dict[str, float] = defaultdict(float)
    for outcome in outcomes:
        by_stage[outcome.stage] += outcome.seconds
    total = max(sum(by_stage.values()), 1e-9)
    dearest = sorted(by_stage.items(), key=lambda pair: -pair[1])
    shares = ", ".join(f"{stage} {seconds / total:.0%}" for stage, seconds in dearest)
    each = f", {total / 60 / usable:.1f} each" if usable else ""
    return f"{total / 60:.1f} minutes of worker time for {usable} usable tasks{each}: {shares}"


def exit_code(outcomes: Iterable[Outcome], *, is_made: bool) -> int:
    """Return the exit code of a command that makes things.

    A rejection is an answer, which running again would not change; a failure is none.

    Args:
        outcomes: of all that the command was to make.
        is_made: there is something of what was asked for.
    """
    if not is_made:
        return NOTHING
    return NOT_ALL if any(o.status == "failed" for o in outcomes) else 0


def tally(outcomes: Sequence[Outcome], stage: str) -> Counter[str]:
    """Return how many items of a stage are usable, rejected, failed or blocked."""
    return Counter("usable" if o.is_usable else o.status for o in outcomes if o.stage == stage)
