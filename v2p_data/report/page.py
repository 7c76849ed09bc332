"""One page that shows what a run made, what it refused and why: `report.html`, a single file without a script.

Text from users (captions, file names, code) reaches the page only through the template's escaping, and a
content policy in its head forbids the browser to load anything that is not inside the file.
"""

import shlex
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from v2p_data.errors import V2PError, write_refusal
from v2p_data.report.chart import Line, line_chart
from v2p_data.report.evaluations import EvaluationRow, evaluation_rows
from v2p_data.report.items import ItemView, item_view
from v2p_data.report.media import MediaBudget, PageConfig
from v2p_data.report.reading import (
    ITEM_STAGES,
    JOINT_STAGES,
    STAGES,
    Dropped,
    Run,
    as_dict,
    as_list,
    dropped,
    model_use,
    number,
    read_curve,
    read_run,
)
from v2p_data.report.words import NO_BREAK as NO_BREAK
from v2p_data.report.words import duration, percent

PAGE_FILE = "report.html"
TEMPLATE_FILE = "page.html"


def write_page(root: Path, out: Path | None = None, cfg: PageConfig | None = None) -> Path:
    """Write a run's page and return its path, `root/report.html` unless told otherwise.

    Works on any run, also one that is half finished: what is missing is said to be missing.

    Raises:
        V2PError: the place cannot be written to, or memory does not suffice.
    """
    path = out or root / PAGE_FILE
    temporary = path.with_name(path.name + ".tmp")
    try:
        html = render_page(root, cfg or PageConfig())
        # File names may hold bytes that are no text; they must not keep the page from being written.
        temporary.write_bytes(html.encode("utf-8", "replace"))
        temporary.replace(path)
    except (OSError, MemoryError) as error:
        with suppress(OSError):  # half a page takes room that may be what is missing
            temporary.unlink()
        why = write_refusal(error) or str(error) or "memory does not suffice"
        raise V2PError(
            f"cannot write the page {path}: {why}, then run 'v2p report {shlex.quote(str(root))}';"
            " what the run made is kept"
        ) from error
    return path


def render_page(root: Path, cfg: PageConfig) -> str:
    """Return the page as HTML."""
    run = read_run(root)
    budget = MediaBudget(max_bytes=cfg.max_media_bytes)
    evaluation = evaluation_rows(run, cfg, budget)
    unseen = {(row.folder, row.task) for row in evaluation if row.is_policy and not row.is_seen}
    held_out = {
        item
        for item in run.items
        if ("", item) in unseen
        or ((task := run.get("task", item)) and task.folder.name in dict(unseen))
    }
    items = [
        item_view(run, item, f"video-{k}", item in held_out, k <= cfg.max_shown_items, cfg, budget)
        for k, item in enumerate(run.items, 1)
    ]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        duration=duration, percent=percent, words=lambda s: str(s).replace("_", " ")
    )
    provenance, figures = _newest_provenance(run), _figures(run, items, evaluation)
    page = environment.get_template(TEMPLATE_FILE).render(
        title=root.resolve().name,
        summary=_summary(figures),
        figures=_key_figures(figures),
        items=items,
        endings=Counter(view.ending for view in items),
        item_stages=[s for s in ITEM_STAGES if s != "reward" or run.of_stage(s)],
        joint=[r for stage in JOINT_STAGES for r in run.of_stage(stage)],
        evaluation=evaluation,
        policy_charts=_policy_charts(run),
        dropped=dropped(run),
        num_dropped=_count_dropped(dropped(run)),
        times=_times(run),
        total_seconds=sum((r.seconds or 0.0 for r in run.results.values()), 0.0),
        use=model_use(run),
        provenance=provenance,
        command=shlex.join(map(str, as_list(provenance.get("argv")))),
        packages=as_dict(provenance.get("packages")),
        commands=_commands(run),
        unreadable=run.unreadable,
        left_out=budget.left_out,
    )
    return page.lstrip()


# --- numbers in words ----------------------------------------------------------------------------------------


def _plural(count: int, noun: str, plural: str = "") -> str:
    return f"{_grouped(count)} {noun if count == 1 else plural or noun + 's'}"


def _grouped(count: int) -> str:
    return f"{count:,}".replace(",", "\u202f")


@dataclass(frozen=True, kw_only=True)
class Figures:
    """The numbers that matter."""

    videos: int
    """Without those that are held out to judge the policy."""
    made: dict[str, int]
    """How many of them came through each stage."""
    has_experts: bool
    datasets: list[tuple[str, int, int]]
    """Name, episodes, frames."""
    policy: dict[bool, tuple[int, int]]
    """Successes and trials of the policy, on tasks that it has seen and on those it has not."""


def _figures(run: Run, items: Sequence[ItemView], evaluation: Sequence[EvaluationRow]) -> Figures:
    own = [v.results for v in items if not v.is_held_out]
    counts = [(r.item, r.counts) for r in run.made("dataset")]
    rates = {
        is_seen: [r.rate for r in evaluation if r.is_policy and r.is_seen == is_seen]
        for is_seen in (True, False)
    }
    return Figures(
        videos=len(own),
        made={
            stage: sum((r := results[stage]) is not None and r.status == "made" for results in own)
            for stage in ("scene", "task", "expert")
        },
        has_experts=any(results["expert"] for results in own),
        datasets=[
            (str(c.get("repo_id", item)), _count(c, "episodes"), _count(c, "frames"))
            for item, c in counts
        ],
        policy={
            is_seen: (sum(r.successes for r in of_kind), sum(r.trials for r in of_kind))
            for is_seen, of_kind in rates.items()
            if of_kind
        },
    )


def _count(counts: dict[str, Any], name: str) -> int:
    return int(number(counts.get(name)) or 0)


def _summary(figures: Figures) -> str:
    """Return what happened in a few sentences."""
    accepted = figures.made["scene"]
    sentences = [
        f"{_plural(figures.videos, 'video')} went in; {accepted} became "
        f"{'a simulated scene' if accepted == 1 else 'simulated scenes'}, "
        f"{figures.made['task']} of them with an audited task."
        if figures.videos
        else "This run holds no video yet."
    ]
    if figures.has_experts:
        learned = _plural(figures.made["expert"], "task was", "tasks were")
        sentences.append(f"{learned} learned by an expert.")
    sentences += [
        f"The dataset {name} holds {_plural(episodes, 'successful episode')}, {_plural(frames, 'frame')}."
        for name, episodes, frames in figures.datasets
    ]
    sentences += [
        f"The policy succeeds in {k} of {n} episodes ({percent(k / n)}) on tasks "
        f"{'it was trained on' if is_seen else 'it has never seen'}."
        for is_seen, (k, n) in figures.policy.items()
    ]
    return " ".join(sentences)


def _key_figures(figures: Figures) -> list[tuple[str, str]]:
    """Return label and value of the numbers that matter, dashes where a stage has not run."""
    totals = [_grouped(sum(n)) for n in zip(*(d[1:] for d in figures.datasets), strict=True)]
    episodes, frames = totals or ("-", "-")
    success = {is_seen: percent(k / n) for is_seen, (k, n) in figures.policy.items()}
    return [
        ("Videos in", str(figures.videos)),
        ("Scenes accepted", str(figures.made["scene"])),
        ("Tasks learned", str(figures.made["expert"])),
        ("Episodes", episodes),
        ("Frames", frames),
        ("Policy, seen tasks", success.get(True, "-")),
        ("Policy, unseen tasks", success.get(False, "-")),
    ]


# --- the policy ----------------------------------------------------------------------------------------------


def _policy_charts(run: Run) -> list[Markup]:
    charts: list[Markup] = []
    for result in run.of_stage("policy"):
        curve = read_curve(result.folder / "curve.csv")
        if "step" in curve and "loss" in curve:
            line = Line(name="loss", x=curve["step"], y=curve["loss"])
            charts.append(
                line_chart(
                    [line], title=f"Training loss of {result.item}", x_label="gradient steps"
                )
            )
    return [chart for chart in charts if chart]


# --- time, machine, what next ----------------------------------------------------------------------------


def _times(run: Run) -> list[dict[str, Any]]:
    """Return the time of each stage, with its share of the longest stage's for the bar."""
    by_stage = {
        stage: [r.seconds for r in run.of_stage(stage) if r.seconds is not None]
        for stage in STAGES
    }
    longest = max((sum(s, 0.0) for s in by_stage.values()), default=0.0) or 1.0
    return [
        {"stage": stage, "num_items": len(s), "seconds": sum(s), "share": sum(s) / longest}
        for stage, s in by_stage.items()
        if s
    ]


def _newest_provenance(run: Run) -> dict[str, Any]:
    found = [r.record.provenance for r in run.results.values() if r.record and r.record.provenance]
    return max(found, key=lambda p: str(p.get("time", "")), default={})


def _count_dropped(rows: Sequence[Dropped]) -> str:
    videos = sum(1 for row in rows if row.stage in ITEM_STAGES and row.what != "episode")
    episodes = sum(row.count for row in rows if row.what == "episode")
    return f"{_plural(videos, 'result')} of a stage and {_plural(episodes, 'episode')}"


def _commands(run: Run) -> list[tuple[str, str]]:
    """Return what to type next, as pairs of a heading and a command."""
    commands: list[tuple[str, str]] = []
    for result in run.made("dataset"):
        repo_id = str(result.counts.get("repo_id", result.item))
        folder = str(result.folder)
        commands += [
            (
                "Load the dataset in Python",
                "from lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
                f"dataset = LeRobotDataset({repo_id!r}, root={folder!r})\n"
                "print(len(dataset), dataset[0].keys())",
            ),
            (
                "Look at an episode",
                f"lerobot-dataset-viz --repo-id {shlex.quote(repo_id)} --root {shlex.quote(folder)} "
                "--episode-index 0 --save 1 --output-dir .",
            ),
            ("Train a policy on it", f"v2p train {shlex.quote(folder)}"),
            ("Share it", f"v2p push {shlex.quote(folder)} --repo-id {shlex.quote(repo_id)}"),
        ]
    for result in run.made("policy"):
        policy = str(result.folder / str(result.counts.get("policy", "policy")))
        commands.append(("Judge the policy", f"v2p eval {shlex.quote(policy)}"))
    return commands
