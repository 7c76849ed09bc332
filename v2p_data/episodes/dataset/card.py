"""The dataset card: what is in a dataset and how it was made, for people and for the Hub's search."""

from collections import Counter
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import demand_about
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    COLUMNS,
    FRAMES,
    HANDOVER,
    INTERVENTION_KEY,
    MASK_KEY,
    RGB_KEY,
    STATE_KEY,
    WRIST_KEY,
    action_column,
    state_column,
)
from v2p_data.episodes.dataset.sheet import SHEET_FILE, write_sheet, write_whole
from v2p_data.episodes.dataset.tables import damage_named, read_info

CARD_FILE = "README.md"
TAGS = ("LeRobot", "robotics", "segmentation", "simulation", "mujoco", "video2policy")
LICENSE = "apache-2.0"
BADGE = (
    "https://huggingface.co/datasets/huggingface/badges/resolve/main/visualize-this-dataset-xl.svg"
)
VISUALISER = "https://huggingface.co/spaces/lerobot/visualize_dataset?path="
USE = """\
```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{0}")  # root="FOLDER" for a copy on disk
```

```bash
hf download {0} --repo-type dataset --local-dir FOLDER
v2p train FOLDER --out RUN
lerobot-train --dataset.repo_id={0} --dataset.root=FOLDER --policy.type=act --policy.push_to_hub=false
lerobot-eval --policy.path=POLICY --env.type=v2p --env.tasks=FOLDER/v2p/tasks
```

Masks are no photographs: give `lerobot-train` also `--dataset.use_imagenet_stats=false --policy.pretrained_backbone_weights=null`, and
a `--policy.chunk_size` below the episodes' length."""
PICTURES = {
    MASK_KEY: "segmentation mask as grey video, lossless",
    WRIST_KEY: "segmentation mask as grey video, lossless, of a camera that the hand carries",
    RGB_KEY: "picture of the same camera at the same moment",
}
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""The Hub's words for how many rows there are."""


def write_card(root: Path, repo_id: str) -> Path:
    """Write `README.md` into a dataset that `writer.pack` made, and return it.

    Raises:
        V2PError: the dataset was not made by this engine, or nothing can be written there.
    """
    about, info = demand_about(root), read_info(root)
    has_sheet = (root / SHEET_FILE).is_file() or write_sheet(root, info, about)
    path = root / CARD_FILE
    with damage_named(root):
        card = dataset_card(about, info, repo_id, has_sheet=has_sheet)
    write_whole(path, card.encode())
    return path


def dataset_card(
    about: dict[str, Any], info: dict[str, Any], repo_id: str, *, has_sheet: bool = False
) -> str:
    """Return the card's Markdown with its YAML head."""
    episodes: list[dict[str, Any]] = about["episodes"]
    seconds = info["total_frames"] / info["fps"]
    sections = [
        _head(info["total_frames"]),
        f"# {repo_id}",
        "Demonstrations of a simulated Franka-like arm, made from ordinary videos: each video was rebuilt as a "
        "simulated task, an expert learned the task, and its successful episodes were recorded under "
        f"randomisation. {len(episodes)} episodes, {info['total_frames']} frames, {seconds:.0f} s at "
        f"{info['fps']} frames a second.",
        "[![Look at it in LeRobot's visualiser, once it is on the "
        f"Hub]({BADGE})]({VISUALISER}{repo_id})\n\nLicense: {LICENSE}.",
        *([f"![Moments of one episode of each task]({SHEET_FILE})"] if has_sheet else []),
        "## Tasks and results",
        _tasks(episodes),
        _results(about, episodes),
        "## Load, train, evaluate",
        USE.format(repo_id),
        "## Limits",
        "Everything is simulated, and sizes, masses and frictions of the objects are estimates from one video "
        "each. Only episodes that succeeded by the task's own measure and by an independent one are included.",
        "## What a frame holds",
        _frame(info),
        *(["## Who acted", _who_acted(episodes)] if INTERVENTION_KEY in info["features"] else []),
        "## Masks",
        _palette(about, episodes),
        "## How it was made",
        _making(about),
        "<details><summary>What was drawn for the episodes: "
        f"ranges</summary>\n\n{_randomisation(episodes)}\n\n</details>",
    ]
    return "\n\n".join(sections) + "\n"


def _head(num_rows: int) -> str:
    tags = "\n".join(f"- {tag}" for tag in TAGS)
    size = next((s for n, s in SIZES if num_rows < n), "n>1M")
    return (
        f"---\nlicense: {LICENSE}\nlanguage:\n- en\nsize_categories:\n- "
        f"{size}\ntask_categories:\n- robotics\ntags:\n{tags}\n"
        "configs:\n- config_name: default\n  data_files: data/*/*.parquet\n---"
    )


def _tasks(episodes: list[dict[str, Any]]) -> str:
    count = Counter((e["item"], e["task"]) for e in episodes)
    frames: Counter[tuple[str, str]] = Counter()
    for e in episodes:
        frames[e["item"], e["task"]] += e["length"]
    lines = ["| task | made from | episodes | frames |", "|---|---|---|---|"]
    lines += [
        f"| {_cell(task)} | {_cell(item)} | {number} | {frames[item, task]} |"
        for (item, task), number in count.items()
    ]
    return "\n".join(lines)


def _frame(info: dict[str, Any]) -> str:
    lines = ["| column | shape | entries [unit, frame] | meaning |", "|---|---|---|---|"]
    for key, feature in info["features"].items():
        told, names = COLUMNS.get(key), feature.get("names") or ()
        if key == STATE_KEY:
            told = state_column(names)  # datasets of earlier versions have the first seven
        elif key == ACTION_KEY:
            told = action_column(names)
        if key in PICTURES:
            words = f" | {PICTURES[key]}"
        elif told is not None:
            words = f"{told.entries} | {told.meaning}"
        else:
            continue
        lines.append(f"| `{key}` | {list(feature['shape'])} | {words} |")
    frames = "\n".join(f"- {name}: {words}" for name, words in FRAMES.items())
    return "\n".join(lines) + f"\n\nFrames:\n\n{frames}"


def _who_acted(episodes: list[dict[str, Any]]) -> str:
    handovers = [e for e in episodes if e.get("source") == HANDOVER]
    frames = sum(int(e["length"]) for e in handovers)
    by_student = sum(int(e["student_frames"]) for e in handovers)
    alone = sum(int(e["length"]) for e in episodes) - frames
    return "\n".join(
        [
            "| episodes | number | frames in which the expert acted | frames in which a student acted |",
            "|---|---|---|---|",
            f"| demonstrations | {len(episodes) - len(handovers)} | {alone} | 0 |",
            f"| handovers | {len(handovers)} | {frames - by_student} | {by_student} |",
            "",
            "In a handover a student policy acts and the expert takes over. `action` is the expert's in every frame: "
            "where a student acted, it is what the expert would have done there, not what was done. LeRobot's own "
            f"recordings hold the policy's action there. `{INTERVENTION_KEY}` is true throughout in demonstrations; "
            "`source` in `meta/v2p.json` tells the two kinds of episode apart.",
        ]
    )


def _palette(about: dict[str, Any], episodes: list[dict[str, Any]]) -> str:
    names: dict[str, list[str]] = {}
    for e in episodes:
        for label, name in e["labels"].items():
            if name not in names.setdefault(label, []):
                names[label].append(name)
    lines = ["| label | grey (R = G = B) | meaning |", "|---|---|---|"]
    lines += [
        f"| {label} | {about['palette'][label]} | {_cell(', '.join(found))} |"
        for label, found in sorted(names.items(), key=lambda pair: int(pair[0]))
    ]
    lines.append("")
    lines.append(
        "Every decoded pixel is one of these greys exactly; `meta/v2p.json` names the objects per episode."
    )
    return "\n".join(lines)


def _randomisation(episodes: list[dict[str, Any]]) -> str:
    """Return the ranges that the drawn values span, by name."""
    spans: dict[str, list[float]] = {}
    for e in episodes:
        for name, value in _numbers(e["params"]):
            spans.setdefault(name, []).append(value)
    if not spans:
        return "None was recorded."
    lines = ["| drawn per episode | lowest | highest |", "|---|---|---|"]
    lines += [
        f"| {_cell(name)} | {min(values):.4g} | {max(values):.4g} |"
        for name, values in sorted(spans.items())
    ]
    return "\n".join(lines)


def _numbers(value: Any, name: str = "") -> list[tuple[str, float]]:
    if isinstance(value, bool):
        return []
    if isinstance(value, int | float):
        return [(name, float(value))]
    if isinstance(value, dict):
        return [pair for k, v in value.items() for pair in _numbers(v, f"{name} {k}".strip())]
    if isinstance(value, list):
        return [pair for k, v in enumerate(value) for pair in _numbers(v, f"{name}[{k}]")]
    return []


def _results(about: dict[str, Any], episodes: list[dict[str, Any]]) -> str:
    """Return per task how often its expert succeeded, and what became of the episodes."""
    items: dict[str, Any] = about.get("provenance", {}).get("items", {})
    lines = [
        "| made from | expert made by | expert succeeds | episodes tried | succeeded | left out, by reason |",
        "|---|---|---|---|---|---|",
    ]
    known = len(lines)
    for key in dict.fromkeys(e.get("history", e["item"]) for e in episodes):
        counts = items.get(key, {}).get("counts") or {}
        expert = items.get(key, {}).get("inputs", {}).get("expert", {}).get("counts", {})
        rate = expert.get("success")
        shown = (
            f"{rate['rate']:.0%} [{rate['low']:.0%}, {rate['high']:.0%}]"
            if isinstance(rate, dict) and {"rate", "low", "high"} <= set(rate)
            else "not recorded"
        )
        if not counts and not expert:
            continue
        made_by = _cell((expert.get("learning") or {}).get("made_by") or "not recorded")
        rejected = ", ".join(
            f"{n} {reason}" for reason, n in (counts.get("rejected") or {}).items()
        )
        tried, share = counts.get("rollouts", "-"), counts.get("success")
        won = f"{share:.1%}" if isinstance(share, float | int) else "-"
        lines.append(
            f"| {_cell(key)} | {made_by} | {shown} | {tried} | {won} | {_cell(rejected) or 'none'} |"
        )
    if len(lines) == known:
        return "No rates were recorded with this dataset."
    lines.append("")
    lines.append(
        "An expert succeeds where the task's own measure and an independent one agree, at the simulator's fine time "
        "step under the randomisation below; the interval is Wilson's at 95 %."
    )
    return "\n".join(lines)


def _making(about: dict[str, Any]) -> str:
    provenance = about["provenance"]
    packages = ", ".join(f"{k} {v}" for k, v in sorted(provenance.get("packages", {}).items()))
    lines = [
        "`v2p generate VIDEOS`: video, scene, task code, expert, episodes, dataset. Recipes, seeds and "
        "counts of every stage are in `meta/v2p.json`.",
    ]
    for edit in provenance.get("edits", []):
        if edit["operation"] == "merge":
            parts = ", ".join(
                f"{p['repo_id']} ({p['episodes']} episodes)" for p in edit["sources"]
            )
            lines.append(f"Put together by `v2p merge` from {parts}.")
        else:
            lines.append(
                f"`v2p drop` took {edit['episodes']} episodes out of {edit['source']}: {'; '.join(edit['tasks'])}."
            )
    if provenance.get("commit"):
        lines.append(f"Commit {provenance['commit']}.")
    if packages:
        lines.append(f"Versions: {packages}.")
    return "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
