"""The card of a policy: written with its folder, given each evaluation, and pushed as it is."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.card import CARD_FILE, LICENSE
from v2p_data.episodes.dataset.features import STATE_NAMES, actions_named
from v2p_data.episodes.dataset.sheet import write_whole
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none

BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"
NOT_JUDGED = "Not evaluated yet: `v2p eval` writes its rates here."
PLACEHOLDER = "POLICY is this folder, or its name on the Hub. "
DEMO_REPO_ID = "v2p/demo"
"""Name of the dataset of `v2p demo`, which nobody pushes by that name."""
CARD = """\
---
library_name: lerobot
pipeline_tag: robotics
license: {license}
{head}tags:
- lerobot
- robotics
- {kind}
- video2policy
---

# {title}

{words} It acts on segmentation masks and the robot's state. License: {license}.

## Results

{begin}
{not_judged}
{end}

## Load, evaluate

{placeholder}The package `lerobot_policy_v2p` knows policies of type `v2p_bc` and the simulated tasks. It is on
no package index: in a clone of its repository, `make setup` installs it.

```bash
{fetch}v2p eval POLICY --tasks {tasks}
lerobot-eval --policy.path=POLICY --env.type=v2p --env.tasks={tasks}{actions}{joints}
```

## What it sees and does

| feature | shape |
|---|---|
{features}

## Limits

It was trained in simulation; sizes, masses and frictions of the objects are estimates from one video each.
"""


def write_policy_card(folder: Path) -> None:
    """Write `README.md` into the folder of a LeRobot policy.

    Raises:
        V2PError: its settings cannot be read, or the card cannot be written.
    """
    config = json_or_none(folder / "config.json")
    if not isinstance(config, dict):
        raise V2PError(f"{folder / 'config.json'} is damaged: it is no JSON object")
    trained = json_or_none(folder / "train_config.json")
    recipe: dict[str, Any] = trained if isinstance(trained, dict) else {}
    source = recipe.get("dataset")
    dataset = str(source.get("repo_id", "")) if isinstance(source, dict) else ""
    kind = str(config.get("type", "unknown"))
    is_demo = dataset == DEMO_REPO_ID
    words = f"Policy of type `{kind}`" + (f", trained on `{dataset}`" if dataset else "")
    words += " (on no Hub)" if is_demo else ""
    dataset = "" if is_demo else dataset
    if "steps" in recipe and "batch_size" in recipe:
        words += f" for {recipe['steps']} steps of {recipe['batch_size']} frames"
    features = _features(config)
    facts = json_or_none(folder / "v2p.json")
    known: dict[str, Any] = facts if isinstance(facts, dict) else {}
    actions, states = actions_named(known.get("action")), known.get("state") or ()
    text = CARD.format(
        license=LICENSE,
        head=f"datasets:\n- {dataset}\n" if dataset else "",
        kind=kind,
        title=f"Policy of {dataset}" if dataset else f"Policy of type {kind}",
        words=f"{words}.",
        begin=BEGIN,
        not_judged=NOT_JUDGED,
        end=END,
        placeholder=PLACEHOLDER,
        fetch=f"hf download {dataset} --repo-type dataset --include 'v2p/tasks/*' --local-dir dataset\n"
        if dataset
        else "",
        tasks="dataset/v2p/tasks" if dataset else "TASKS",
        actions=f" --env.actions={actions}" if actions not in (None, "delta_tool") else "",
        joints=" --env.joint_state=true" if len(states) > len(STATE_NAMES) else "",
        features="\n".join(f"| `{name}` | {shape} |" for name, shape in features.items()),
    )
    write_whole(folder / CARD_FILE, text.encode())


def name_policy(folder: Path, repo_id: str) -> None:
    """Put a policy's name on the Hub into the commands of its card; a card of other hands stays as it is."""
    path = folder / CARD_FILE
    card = path.read_text(errors="replace", encoding="utf-8")
    if PLACEHOLDER in card:
        card = re.sub(r"^# .*$", f"# {repo_id}", card, count=1, flags=re.MULTILINE)
        write_whole(path, card.replace(PLACEHOLDER, "").replace("POLICY", repo_id).encode())


def note_results(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Put an evaluation's rates into a policy's card; a card without a place for them stays as it is.

    Args:
        folder: of the policy.
        rows: one a task, as in `evaluation.json`.
    """
    path = folder / CARD_FILE
    card = path.read_text(errors="replace", encoding="utf-8") if path.is_file() else ""
    before, begin, rest = card.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        return
    lines = [
        "| task | in training | success, 95 % interval | at the end | episodes |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        at_end = f"{row['at_end']['rate']:.0%}" if row.get("at_end") else ""
        lines.append(
            f"| {row['task']} | {'yes' if row['seen'] else 'no'} | {row['rate']:.0%} "
            f"({row['low']:.0%} to {row['high']:.0%}) |"
            f" {at_end} | {row['trials']} |"
        )
    results = "\n".join(lines)
    write_whole(path, f"{before}{begin}\n{results}\n{end}{after}".encode())


def _features(config: Mapping[str, Any]) -> dict[str, str]:
    parts = [config.get(name) for name in ("input_features", "output_features")]
    return {
        str(name): " x ".join(map(str, feature.get("shape") or ()))
        for part in parts
        if isinstance(part, dict)
        for name, feature in part.items()
        if isinstance(feature, dict)
    }
