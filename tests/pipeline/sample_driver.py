"""One driver of a shared run: three items of two stages each; prints what became of them.

python sample_driver.py ROOT STORE MARKS SECONDS LEASE_S
"""

import json
import sys
import time
from pathlib import Path

from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.pipeline.workers import run_stages

ITEMS = ("a", "b", "c")


def make_marked(config, inputs, out, runtime):
    """Write a text after some seconds, and leave a mark that this was done."""
    del runtime
    with Path(config["marks"]).open("a") as stream:
        stream.write(config["name"] + "\n")
    time.sleep(config["seconds"])
    before = "".join((folder / "text").read_text() for folder in inputs.values())
    (out / "deep").mkdir()
    (out / "text").write_text(before + config["name"])
    (out / "deep" / "README.md").write_text("a card, which records do not list")
    return {"letters": len(config["name"])}


def marked(item: str, marks: Path, seconds: float = 0.0) -> Stage:
    def stage(name: str, inputs: dict[str, Stage]) -> Stage:
        config = {"name": f"{name} {item}", "marks": str(marks), "seconds": seconds}
        return Stage(name=name, item=item, config=config, inputs=inputs, make=make_marked)

    return stage("two", {"one": stage("one", {})})


if __name__ == "__main__":
    root, store, marks, seconds, lease_s = sys.argv[1:]
    stages = [marked(item, Path(marks), float(seconds)) for item in ITEMS]
    runtime = Runtime(root=Path(root), store=store, lease_s=float(lease_s))
    made = run_stages(stages, runtime, lambda event: None)
    sys.stdout.write(json.dumps({f"{o.stage} {o.item}": o.status for o in made.values()}))
