"""One page that shows what a run made, what it refused and why: `report.html`, a single file without a script.

Text from users (captions, file names, code) reaches the page only through the template's escaping, and a
content policy in its head forbids the browser to load anything that is not inside the file.
"""

import csv
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from v2p_data.episodes.features import ACTION_NAMES, FPS
from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.errors import V2PError
from v2p_data.report.chart import NUM_STYLES, Line, line_chart
from v2p_data.report.media import (
    MediaBudget,
    draw_mesh,
    film_uri,
    frames_uri,
    picture_uri,
    png_uri,
)
from v2p_data.report.reading import (
    ITEM_STAGES,
    JOINT_STAGES,
    STAGES,
    Dropped,
    Result,
    Run,
    dropped,
    model_use,
    number,
    read_json,
    read_run,
)
from v2p_data.scene.scene import Scene, SceneObject

PAGE_FILE = "report.html"
TEMPLATE_FILE = "page.html"
STRIP_MOMENTS = 6
NO_BREAK = "\u00a0"
FILM_SUFFIXES = (".mp4", ".webm", ".mkv", ".avi", ".mov", ".gif")


@dataclass(frozen=True, kw_only=True)
class PageConfig:
    """How much goes into a page."""

    max_media_bytes: int = 22_000_000
    """Pictures and films together; with its text the page stays below 25 MB and opens on a phone."""
    max_shown_items: int = 40
    """Videos shown at length; the table lists all."""
    episodes_per_task: int = 2
    """Sample episodes; the first and the last are the most different random draws at hand."""
    max_rollouts_per_task: int = 2
    film_width_px: int = 480
    sheet_width_px: int = 1400
    max_film_frames: int = 160
    mesh_size_px: int = 150


@dataclass(frozen=True, kw_only=True)
class Medium:
    """A picture or a film with the words that stand for it."""

    uri: str
    alt: str
    is_film: bool = False


@dataclass(frozen=True, kw_only=True)
class Rate:
    """A success rate as the records keep it."""

    successes: int
    trials: int
    low: float
    high: float

    @property
    def value(self) -> float:
        return self.successes / self.trials


@dataclass(frozen=True, kw_only=True)
class ObjectView:
    obj: SceneObject
    picture: Medium | None
    confidence: float | None
    """The lowest over the frames that have a pose."""


@dataclass(frozen=True, kw_only=True)
class EpisodeView:
    """One demonstration: what the policy sees and what the expert did."""

    name: str
    film: Medium | None
    strip: Medium | None
    """Moments from the first frame to the last, side by side."""
    charts: list[Markup]
    num_frames: int
    greys: str
    referee: bool


@dataclass(frozen=True, kw_only=True)
class Table:
    """Any flat JSON as rows under a head."""

    head: list[str]
    rows: list[list[str]]


@dataclass(kw_only=True)
class ItemView:
    """One video, from its caption to its episodes."""

    anchor: str
    item: str
    caption: str
    video: str
    kind: str = ""
    is_held_out: bool = False
    """Its task is only there to judge the policy."""
    is_shown: bool = True
    results: dict[str, Result | None] = field(default_factory=dict[str, Result | None])
    scene: Scene | None = None
    overlay: list[Medium] = field(default_factory=list[Medium])
    objects: list[ObjectView] = field(default_factory=list[ObjectView])
    code: str = ""
    task: dict[str, Any] = field(default_factory=dict[str, Any])
    tables: list[tuple[str, Table]] = field(default_factory=list[tuple[str, Table]])
    rate: Rate | None = None
    charts: list[Markup] = field(default_factory=list[Markup])
    sheet: Medium | None = None
    episodes: list[EpisodeView] = field(default_factory=list[EpisodeView])
    notes: list[str] = field(default_factory=list[str])
    """What could not be read, one sentence each."""


@dataclass(frozen=True, kw_only=True)
class EvaluationRow:
    task: str
    is_seen: bool
    rate: Rate
    films: list[Medium]


@dataclass(frozen=True, kw_only=True)
class StageTime:
    stage: str
    num_items: int
    seconds: float
    share: float
    """Of the longest stage, for the bar."""


def write_page(root: Path, out: Path | None = None, cfg: PageConfig | None = None) -> Path:
    """Write a run's page and return its path, `root/report.html` unless told otherwise.

    Works on any run, also one that is half finished: what is missing is said to be missing.
    """
    path = out or root / PAGE_FILE
    html = render_page(root, cfg or PageConfig())
    temporary = path.with_name(path.name + ".tmp")
    # File names may hold bytes that are no text; they must not keep the page from being written.
    temporary.write_bytes(html.encode("utf-8", "replace"))
    temporary.replace(path)
    return path


def render_page(root: Path, cfg: PageConfig) -> str:
    """Return the page as HTML."""
    run = read_run(root)
    budget = MediaBudget(max_bytes=cfg.max_media_bytes)
    evaluation = _evaluation_rows(run, cfg, budget)
    held_out = {row.task for row in evaluation if not row.is_seen}
    items = [
        _item_view(
            run, item, f"video-{k}", item in held_out, k <= cfg.max_shown_items, cfg, budget
        )
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
    provenance = _newest_provenance(run)
    page = environment.get_template(TEMPLATE_FILE).render(
        title=root.resolve().name,
        summary=_summary(run, items, evaluation),
        figures=_key_figures(run, items, evaluation),
        items=items,
        item_stages=ITEM_STAGES,
        joint=[r for stage in JOINT_STAGES for r in run.of_stage(stage)],
        evaluation=evaluation,
        policy_charts=_policy_charts(run),
        dropped=dropped(run),
        num_dropped=_count_dropped(dropped(run)),
        times=_times(run),
        total_seconds=sum((r.seconds or 0.0 for r in run.results.values()), 0.0),
        use=model_use(run),
        provenance=provenance,
        command=shlex.join(str(a) for a in provenance.get("argv", [])),
        packages=provenance.get("packages", {}),
        commands=_commands(run),
        unreadable=run.unreadable,
        left_out=budget.left_out,
    )
    return page.lstrip()


# --- numbers in words ----------------------------------------------------------------------------------------


def duration(seconds: float | None) -> str:
    """Return `0.4 s`, `42 s`, `3 min 10 s` or `1 h 05 min` without line breaks; a dash for None."""
    if seconds is None or not math.isfinite(seconds):
        return "-"
    whole, minutes = round(seconds), round(seconds / 60)
    if seconds < 9.95:
        words = f"{seconds:.1f} s"
    elif whole < 60:
        words = f"{whole} s"
    elif whole < 3600:
        words = f"{whole // 60} min {whole % 60:02d} s"
    else:
        words = f"{minutes // 60} h {minutes % 60:02d} min"
    return words.replace(" ", NO_BREAK)


def percent(share: float) -> str:
    """Return `62 %` without line breaks; `99.5 %` where rounding would claim certainty."""
    digits = 1 if 0.99 <= share < 1 or 0 < share <= 0.01 else 0
    return f"{100 * share:.{digits}f}{NO_BREAK}%"


def _plural(count: int, noun: str, plural: str = "") -> str:
    return f"{_grouped(count)} {noun if count == 1 else plural or noun + 's'}"


def _grouped(count: int) -> str:
    return f"{count:,}".replace(",", "\u202f")


def _summary(run: Run, items: Sequence[ItemView], evaluation: Sequence[EvaluationRow]) -> str:
    """Return what happened in a few sentences."""
    own = [v for v in items if not v.is_held_out]
    accepted = sum(_is_made(v, "scene") for v in own)
    tasks = sum(_is_made(v, "task") for v in own)
    learned = sum(_is_made(v, "expert") for v in own)
    sentences = [
        f"{_plural(len(own), 'video')} went in; {accepted} became "
        f"{'a simulated scene' if accepted == 1 else 'simulated scenes'}, {tasks} of them with an audited task."
        if own
        else "This run holds no video yet."
    ]
    if any(v.results["expert"] for v in own):
        sentences.append(f"{_plural(learned, 'task was', 'tasks were')} learned by an expert.")
    for result in run.made("dataset"):
        episodes, frames = result.counts.get("episodes", 0), result.counts.get("frames", 0)
        sentences.append(
            f"The dataset {result.counts.get('repo_id', result.item)} holds "
            f"{_plural(int(episodes), 'successful episode')}, {_plural(int(frames), 'frame')}."
        )
    for is_seen, words in ((True, "it was trained on"), (False, "it has never seen")):
        rates = [row.rate for row in evaluation if row.is_seen == is_seen]
        if rates:
            k, n = sum(r.successes for r in rates), sum(r.trials for r in rates)
            sentences.append(
                f"The policy succeeds in {k} of {n} episodes ({percent(k / n)}) on tasks {words}."
            )
    return " ".join(sentences)


def _key_figures(
    run: Run, items: Sequence[ItemView], evaluation: Sequence[EvaluationRow]
) -> list[tuple[str, str]]:
    """Return label and value of the numbers that matter, dashes where a stage has not run."""
    own = [v for v in items if not v.is_held_out]
    datasets = run.made("dataset")

    def total(name: str) -> str:
        return _grouped(sum(int(number(r.counts.get(name)) or 0) for r in datasets))

    def success(is_seen: bool) -> str:
        rates = [row.rate for row in evaluation if row.is_seen == is_seen]
        if not rates:
            return "-"
        return percent(sum(r.successes for r in rates) / sum(r.trials for r in rates))

    return [
        ("Videos in", str(len(own))),
        ("Scenes accepted", str(sum(_is_made(v, "scene") for v in own))),
        ("Tasks learned", str(sum(_is_made(v, "expert") for v in own))),
        ("Episodes", total("episodes") if datasets else "-"),
        ("Frames", total("frames") if datasets else "-"),
        ("Policy, seen tasks", success(True)),
        ("Policy, unseen tasks", success(False)),
    ]


def _is_made(view: ItemView, stage: str) -> bool:
    result = view.results[stage]
    return result is not None and result.status == "made"


# --- one video -----------------------------------------------------------------------------------------------


def _item_view(
    run: Run, item: str, anchor: str, is_held_out: bool, is_shown: bool, cfg: PageConfig, budget: MediaBudget
) -> ItemView:  # fmt: skip
    view = ItemView(
        anchor=anchor,
        item=item,
        caption=item,
        video="",
        is_held_out=is_held_out,
        is_shown=is_shown,
        results={stage: run.get(stage, item) for stage in ITEM_STAGES},
    )
    scene, task = view.results["scene"], view.results["task"]
    if scene is not None:
        _add_scene(view, scene, cfg, budget)
    if task is not None and is_shown:
        _add_task(view, task)
    expert, episodes = view.results["expert"], view.results["episodes"]
    if expert is not None and is_shown:
        _add_expert(view, expert, cfg, budget)
    if episodes is not None and is_shown:
        _add_episodes(view, episodes, cfg, budget)
    _note_older_inputs(view)
    return view


def _add_scene(view: ItemView, result: Result, cfg: PageConfig, budget: MediaBudget) -> None:
    recipe = (result.record.recipe if result.record else {}).get("config") or {}
    view.caption = str(recipe.get("caption") or view.item)
    view.kind = str(result.counts.get("kind", ""))
    if result.status != "made":
        return
    try:
        scene = Scene.load(result.folder)
    except (V2PError, OSError, KeyError, TypeError, ValueError) as error:
        view.notes.append(f"The scene's file cannot be read: {error}")
        return
    view.scene, view.kind, view.video = scene, scene.kind, scene.video
    view.caption = scene.description or view.caption
    if not view.is_shown:
        return
    film = film_uri(result.folder / "overlay.mp4", cfg.film_width_px, cfg.max_film_frames)
    about = f"The video '{scene.video}' with outlines of what was understood"
    if uri := budget.admit(film, f"overlay of {view.item}"):
        view.overlay.append(Medium(uri=uri, alt=about, is_film=True))
    else:
        for name, when in (("overlay_first.png", "first"), ("overlay_last.png", "last")):
            picture = picture_uri(result.folder / name, cfg.film_width_px)
            if uri := budget.admit(picture, f"{when} overlay of {view.item}"):
                view.overlay.append(Medium(uri=uri, alt=f"{about}, {when} frame"))
    for obj in scene.objects:
        picture = budget.admit(
            _mesh_picture(result.folder, obj, cfg.mesh_size_px), f"mesh of {obj.name}"
        )
        view.objects.append(
            ObjectView(
                obj=obj,
                picture=Medium(uri=picture, alt=f"Mesh of {obj.label or obj.name}")
                if picture
                else None,
                confidence=min(obj.confidences) if obj.confidences else None,
            )
        )


def _mesh_picture(folder: Path, obj: SceneObject, size_px: int) -> str | None:
    """Return a drawing of the object's mesh, or None if its file is missing, foreign or broken."""
    import trimesh

    path = (folder / obj.mesh).resolve()
    if not obj.mesh or not path.is_relative_to(folder.resolve()) or not path.is_file():
        return None
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)  # pyright: ignore[reportAttributeAccessIssue]
    except (ValueError, IndexError, KeyError, AttributeError, TypeError):
        return None
    if not len(faces) or not np.isfinite(vertices).all():
        return None
    r, g, b = (float(np.clip(c, 0, 1)) for c in obj.rgba[:3])
    return png_uri(draw_mesh(vertices, faces, (r, g, b), size_px))


def _add_task(view: ItemView, result: Result) -> None:
    code = result.folder / "task.py"
    view.code = code.read_text(errors="replace") if code.is_file() else ""
    task = read_json(result.folder / "task.json")
    view.task = task if isinstance(task, dict) else {}
    view.kind = str(view.task.get("kind") or view.kind)
    audit = read_json(result.folder / "audit.json") or view.task.get("audit")
    view.tables += tables_of(audit, "Audit against the video")


def _add_expert(view: ItemView, result: Result, cfg: PageConfig, budget: MediaBudget) -> None:
    counts = result.counts or read_json(result.folder / "evaluation.json") or {}
    view.rate = rate_of(counts.get("success"))
    view.charts = expert_charts(read_curve(result.folder / "curve.csv"))
    uri = budget.admit(
        picture_uri(result.folder / "sheet.png", cfg.sheet_width_px),
        f"contact sheet of {view.item}",
    )
    if uri:
        view.sheet = Medium(
            uri=uri, alt="Contact sheet of the expert's episodes: a row each, eight moments from left to right"
        )  # fmt: skip


def _add_episodes(view: ItemView, result: Result, cfg: PageConfig, budget: MediaBudget) -> None:
    staged = staged_episodes(result.folder)
    count = min(cfg.episodes_per_task, len(staged))
    for index in sorted({round(k) for k in np.linspace(0, len(staged) - 1, count)}):
        try:
            view.episodes.append(_episode_view(Episode.load(staged[index]), cfg, budget))
        except V2PError as error:
            view.notes.append(str(error))


def _episode_view(episode: Episode, cfg: PageConfig, budget: MediaBudget) -> EpisodeView:
    from v2p_data.sim.masks import label_names, labels_to_rgb

    names = label_names(episode.objects)
    greys = labels_to_rgb(np.arange(len(names), dtype=np.uint8)[None])[0, :, 0]
    uri = budget.admit(
        frames_uri(labels_to_rgb(episode.labels), float(FPS)), f"masks of episode {episode.id}"
    )
    moments = np.linspace(0, episode.num_frames - 1, STRIP_MOMENTS).round().astype(int)
    strip = budget.admit(
        png_uri(labels_to_rgb(np.concatenate([*episode.labels[moments, ::2, ::2]], axis=1))),
        f"moments of episode {episode.id}",
    )
    seconds = np.arange(episode.num_frames) / FPS
    lines = [
        Line(name=name.split(".")[0].replace("_", " "), x=seconds, y=episode.action[:, k].astype(float))
        for k, name in enumerate(ACTION_NAMES)
    ]  # fmt: skip
    return EpisodeView(
        name=episode.id,
        film=Medium(uri=uri, alt=f"Segmentation masks of episode {episode.id}", is_film=True)
        if uri
        else None,
        strip=Medium(uri=strip, alt=f"Masks of episode {episode.id} at {STRIP_MOMENTS} moments")
        if strip
        else None,
        charts=[
            line_chart(
                group,
                title=title,
                x_label="time [s]",
                y_range=(-1.0, 1.0),
                width_px=320,
                height_px=100,
            )
            for title, group in (
                ("Action: position", lines[:3]),
                ("Action: rotation", lines[3:6]),
                ("Action: gripper", lines[6:]),
            )
        ],
        num_frames=episode.num_frames,
        greys=", ".join(f"{names[k].replace('_', ' ')} {greys[k]}" for k in sorted(names)),
        referee=episode.referee,
    )


def _note_older_inputs(view: ItemView) -> None:
    """Say so where a result was not made from the newest result before it."""
    for result in view.results.values():
        if result is None or result.record is None:
            continue
        for name, folder in result.record.inputs.items():
            newest = view.results.get(name)
            if newest is not None and newest.record is not None and newest.folder.name != folder:
                view.notes.append(
                    f"The {result.stage} shown here was made from {name} {folder}, "
                    f"while the newest {name} is {newest.folder.name}."
                )


# --- pieces --------------------------------------------------------------------------------------------------


def rate_of(data: Any) -> Rate | None:
    """Return a success rate from a record, None if it is not one."""
    if not isinstance(data, Mapping):
        return None
    values = [number(data.get(k)) for k in ("successes", "trials", "low", "high")]
    if any(v is None for v in values) or not values[1]:
        return None
    successes, trials, low, high = (float(v) for v in values if v is not None)
    return Rate(successes=int(successes), trials=int(trials), low=low, high=high)


def tables_of(data: Any, title: str) -> list[tuple[str, Table]]:
    """Return JSON as titled tables: a list of objects as rows, anything else as name and value."""
    if isinstance(data, list) and data and all(isinstance(row, dict) for row in data):
        head = list(dict.fromkeys(str(k) for row in data for k in row))
        rows = [[_cell(row.get(k)) for k in head] for row in data]
        return [(title, Table(head=head, rows=rows))]
    if not isinstance(data, dict) or not data:
        return []
    flat = {k: v for k, v in data.items() if not isinstance(v, dict | list) or not v}
    nested = {k: v for k, v in data.items() if k not in flat}
    tables: list[tuple[str, Table]] = []
    if flat:
        rows = [[str(k), _cell(v)] for k, v in flat.items()]
        tables.append((title, Table(head=["check", "result"], rows=rows)))
    for key, value in nested.items():
        inner = tables_of(value, f"{title}: {key}")
        tables += inner or [(f"{title}: {key}", Table(head=["value"], rows=[[_cell(value)]]))]
    return tables


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict | list):
        return json.dumps(value, ensure_ascii=False)
    return str(value)


def read_curve(path: Path) -> dict[str, np.ndarray]:
    """Return a CSV's columns; what is no number is NaN, and a last line that a kill cut short is left out."""
    if not path.is_file():
        return {}
    with path.open(newline="", errors="replace") as stream:
        head, *rows = [*csv.reader(stream)] or [[]]
    whole = [row for row in rows if len(row) == len(head)]
    return {name: np.array([_float(row[k]) for row in whole]) for k, name in enumerate(head)}


def expert_charts(curve: Mapping[str, np.ndarray]) -> list[Markup]:
    """Return success, return and reward parts over control steps."""
    steps = curve.get("steps")
    if steps is None or not len(steps):
        return []

    def lines(names: Mapping[str, str]) -> list[Line]:
        return [Line(name=words, x=steps, y=curve[k]) for k, words in names.items() if k in curve]

    parts = {
        k: k.removeprefix("reward_").replace("_", " ") for k in curve if k.startswith("reward_")
    }
    charts = [
        line_chart(
            lines({"success_deterministic": "deterministic", "success_stochastic": "exploring"}),
            title="Success while training", x_label="control steps", y_range=(0.0, 1.0),
        ),
        line_chart(
            lines({"return": "mean return"}), title="Return per episode", x_label="control steps"
        ),
        line_chart(
            lines(parts)[:NUM_STYLES], title="Reward parts, mean per step", x_label="control steps"
        ),
    ]  # fmt: skip
    return [chart for chart in charts if chart]


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


# --- the policy ----------------------------------------------------------------------------------------------


def _evaluation_rows(run: Run, cfg: PageConfig, budget: MediaBudget) -> list[EvaluationRow]:
    rows: list[EvaluationRow] = []
    for result in run.made("evaluation"):
        data = result.counts.get("rows") or read_json(result.folder / "evaluation.json")
        for row in data if isinstance(data, list) else []:
            rate = rate_of(row)
            if rate is None:
                continue
            task = str(row.get("task", ""))
            films = [
                Medium(uri=uri, alt=f"The policy tries {task}: {path.stem}", is_film=True)
                for path in _films(result.folder / "videos" / task, result.folder)[: cfg.max_rollouts_per_task]
                if (uri := budget.admit(film_uri(path, 320, cfg.max_film_frames), f"{task}: {path.name}"))
            ]  # fmt: skip
            rows.append(
                EvaluationRow(task=task, is_seen=bool(row.get("seen")), rate=rate, films=films)
            )
    return sorted(rows, key=lambda row: (not row.is_seen, row.task))


def _films(folder: Path, inside: Path) -> list[Path]:
    if not folder.resolve().is_relative_to(inside.resolve()) or not folder.is_dir():
        return []
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in FILM_SUFFIXES)


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


def _times(run: Run) -> list[StageTime]:
    by_stage = {
        stage: [r.seconds for r in run.of_stage(stage) if r.seconds is not None]
        for stage in STAGES
    }
    longest = max((sum(s, 0.0) for s in by_stage.values()), default=0.0) or 1.0
    return [
        StageTime(stage=stage, num_items=len(s), seconds=sum(s), share=sum(s) / longest)
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
