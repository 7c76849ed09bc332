"""Stages small enough to read at a glance; a module of its own because workers must be able to import it."""

import os
import shutil
import signal
import time
from dataclasses import dataclass, replace

from v2p_data.errors import ItemRejectedError
from v2p_data.pipeline.runner import Stage
from v2p_data.pipeline.workers import run_stages


@dataclass(frozen=True, kw_only=True)
class Recipe:
    text: str = "a"
    trouble: str = ""
    waits: bool = False
    """For somebody to let it go on."""


BEGUN = "begun"
"""File of a run with a line for every time that a stage was begun, and the process that began it."""
GO_ON = "go_on"
"""File of a run that lets go on what waits."""


def make_noted(config, inputs, out, runtime):
    with (runtime.root / BEGUN).open("a") as file:
        file.write(f"{out.name.removesuffix('.partial')} {os.getppid()}\n")
    deadline = time.monotonic() + 600
    while config.waits and not (runtime.root / GO_ON).exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    return make_text(config, inputs, out, runtime)


def make_text(config, inputs, out, runtime):
    if config.trouble == "reject":
        raise ItemRejectedError("too_dull", "the text is too dull", 0.1)
    if config.trouble == "raise":
        raise RuntimeError("boom")
    if config.trouble == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if config.trouble == "full":
        raise RuntimeError("writer: No space left on device (os error 28)")
    if config.trouble == "big":
        (out / "big").write_bytes(bytes(5000))
    if config.trouble == "deleted":
        shutil.rmtree(out)
    before = "".join((folder / "text").read_text() for folder in inputs.values())
    (out / "text").write_text(before + config.text)
    return {"letters": len(before + config.text)}


def chain(first: Recipe, second: Recipe, item: str = "clip") -> Stage:
    one = Stage(name="one", item=item, config=first, make=make_text)
    return Stage(name="two", item=item, config=second, inputs={"one": one}, make=make_text)


def make_by_stages(config, inputs, out, runtime):
    stages = [chain(Recipe(), Recipe()), chain(Recipe(trouble="crash"), Recipe(), item="bad")]
    inner = replace(runtime, root=out / "inner", engine="local")
    outcomes = run_stages(stages, inner, lambda event: None)
    return {f"{o.stage} {o.item}": o.reason or o.status for o in outcomes.values()}
