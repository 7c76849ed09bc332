"""One video's part of the page: what was understood, which task it became, how it was learned, sample episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from policies.evaluation.rate import Rate
from v2p_data.episodes.dataset.features import ACTION_NAMES, EXECUTED_KEY, FPS
from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.report.chart import Line, line_chart, training_charts
from v2p_data.report.media import (
    MediaBudget,
    Medium,
    PageConfig,
    draw_mesh,
    film_uri,
    frames_uri,
    picture_uri,
    png_uri,
)
from v2p_data.report.reading import (
    ITEM_STAGES,
    Result,
    Run,
    as_dict,
    as_dicts,
    number,
    rate_of,
    read_curve,
)
from v2p_data.report.rewards import RewardView, reward_view
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import REWARD_SEARCH_FOLDER

MAX_MODEL_CHARS = 100
STRIP_MOMENTS = 6
"""Masks side by side, for those who do not press play."""


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
    objects: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    code: str = ""
    task: dict[str, Any] = field(default_factory=dict[str, Any])
    audit: dict[str, Any] = field(default_factory=dict[str, Any])
    """The score of the success function, and the answer to each question."""
    samples: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """The task codes that were written."""
    pick: str = ""
    """Who wrote and who picked, and what picking was good for."""
    reward: RewardView | None = None
    rate: Rate | None = None
    made_by: str = ""
    """Who made the expert, and what PPO changed, in a sentence or two."""
    charts: list[Markup] = field(default_factory=list[Markup])
    sheet: Medium | None = None
    episodes: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """Demonstrations: what the policy sees and what the expert did."""
    notes: list[str] = field(default_factory=list[str])
    """What could not be read, one sentence each."""

    @property
    def ending(self) -> str:
        """Where the video's way ended, as a word of the page's filter: what stopped it, or the last stage made."""
        made = [stage for stage, r in self.results.items() if r and r.status == "made"]
        stopped = [
            stage for stage, r in self.results.items() if r and r.status in ("rejected", "failed")
        ]
        return f"{stopped[0]}-stopped" if stopped else f"{made[-1]}-made" if made else "nothing"


def item_view(
    run: Run,
    item: str,
    anchor: str,
    is_held_out: bool,
    is_shown: bool,
    cfg: PageConfig,
    budget: MediaBudget,
) -> ItemView:
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
    reward, expert, episodes = (view.results[k] for k in ("reward", "expert", "episodes"))
    if reward is not None and is_shown:
        view.reward = reward_view(reward.folder / REWARD_SEARCH_FOLDER)
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
    shown = [budget.admit(film, f"overlay of {view.item}", about, is_film=True)]
    if shown == [None]:
        shown = [
            budget.admit(
                picture_uri(result.folder / f"overlay_{when}.png", cfg.film_width_px),
                f"{when} overlay of {view.item}",
                f"{about}, {when} frame",
            )
            for when in ("first", "last")
        ]
    view.overlay = [medium for medium in shown if medium]
    for obj in scene.objects:
        mesh = _mesh_picture(result.folder, obj, cfg.mesh_size_px)
        about = f"Mesh of {obj.label or obj.name}"
        # The lowest confidence over the frames that have a pose.
        confidence = min(obj.confidences) if obj.confidences else None
        picture = budget.admit(mesh, f"mesh of {obj.name}", about)
        view.objects.append({"obj": obj, "picture": picture, "confidence": confidence})


def _mesh_picture(folder: Path, obj: SceneObject, size_px: int) -> str | None:
    """Return a drawing of the object's mesh, or None if its file is missing, foreign or broken."""
    import trimesh

    path = (folder / obj.mesh).resolve()
    if not obj.mesh or not path.is_relative_to(folder.resolve()) or not path.is_file():
        return None
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        vertices = np.asarray(mesh.vertices, float)  # pyright: ignore[reportAttributeAccessIssue]
        faces = np.asarray(mesh.faces, int)  # pyright: ignore[reportAttributeAccessIssue]
    except (ValueError, IndexError, KeyError, AttributeError, TypeError):
        return None
    if not len(faces) or not np.isfinite(vertices).all():
        return None
    r, g, b = (float(np.clip(c, 0, 1)) for c in obj.rgba[:3])
    return png_uri(draw_mesh(vertices, faces, (r, g, b), size_px))


def _add_task(view: ItemView, result: Result) -> None:
    code = result.folder / "task.py"
    view.code = code.read_text(errors="replace", encoding="utf-8") if code.is_file() else ""
    view.task = as_dict(json_or_none(result.folder / "task.json"))
    view.kind = str(view.task.get("kind") or view.kind)
    audit = as_dict(view.task.get("audit"))
    view.audit = {
        "score": number(audit.get("score")),
        "checks": [_check_view(check) for check in as_dicts(audit.get("checks"))],
    }
    table = as_dict(json_or_none(result.folder / "audit.json"))
    view.samples = [
        _sample_view(sample, k == table.get("picked"))
        for k, sample in enumerate(as_dicts(table.get("samples")))
    ]
    view.pick = " ".join([*_authors(table), *_pick_words(as_dict(table.get("rates")))])


def _add_expert(view: ItemView, result: Result, cfg: PageConfig, budget: MediaBudget) -> None:
    counts = as_dict(result.counts or json_or_none(result.folder / "evaluation.json"))
    view.rate = rate_of(counts.get("success"))
    view.made_by = _made_by(as_dict(counts.get("learning")))
    view.charts = training_charts(read_curve(result.folder / "curve.csv"))
    view.sheet = budget.admit(
        picture_uri(result.folder / "sheet.png", cfg.sheet_width_px),
        f"contact sheet of {view.item}",
        "Contact sheet of the expert's episodes: a row each, eight moments from left to right",
    )


def _add_episodes(view: ItemView, result: Result, cfg: PageConfig, budget: MediaBudget) -> None:
    staged = staged_episodes(result.folder)
    count = min(cfg.episodes_per_task, len(staged))
    for index in sorted({round(k) for k in np.linspace(0, len(staged) - 1, count)}):
        try:
            view.episodes.append(_episode_view(Episode.load(staged[index]), cfg, budget))
        except V2PError as error:
            view.notes.append(str(error))


def _episode_view(episode: Episode, cfg: PageConfig, budget: MediaBudget) -> dict[str, Any]:
    from v2p_data.sim.render.masks import label_names, labels_to_rgb

    names = label_names(episode.objects)
    greys = labels_to_rgb(np.arange(len(names), dtype=np.uint8)[None])[0, :, 0]
    film = frames_uri(labels_to_rgb(episode.labels), float(FPS))
    moments = np.linspace(0, episode.num_frames - 1, STRIP_MOMENTS).round().astype(int)
    strip = png_uri(labels_to_rgb(np.concatenate([*episode.labels[moments, ::2, ::2]], axis=1)))
    seconds = np.arange(episode.num_frames) / FPS
    steps = episode.simulated.get(EXECUTED_KEY, episode.action)
    lines = [
        Line(name=name.split(".")[0].replace("_", " "), x=seconds, y=steps[:, k].astype(float))
        for k, name in enumerate(ACTION_NAMES)
    ]
    size = {"y_range": (-1.0, 1.0), "width_px": 320, "height_px": 100}
    parts = {"position": lines[:3], "rotation": lines[3:6], "gripper": lines[6:]}
    return {
        "name": episode.id,
        "film": budget.admit(
            film,
            f"masks of episode {episode.id}",
            f"Segmentation masks of episode {episode.id}",
            is_film=True,
        ),
        "strip": budget.admit(
            strip,
            f"moments of episode {episode.id}",
            f"Masks of episode {episode.id} at {STRIP_MOMENTS} moments",
        ),
        "charts": [
            line_chart(group, title=f"Action: {part}", x_label="time [s]", **size)
            for part, group in parts.items()
        ],
        "num_frames": episode.num_frames,
        "greys": ", ".join(f"{names[k].replace('_', ' ')} {greys[k]}" for k in sorted(names)),
        "referee": episode.referee,
    }


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


def _check_view(check: Mapping[str, Any]) -> dict[str, Any]:
    """Return a line of the audit with what was measured in words."""
    name, share = check.get("name"), number(check.get("share"))
    if share is None:
        measured = ""
    elif name == "becomes_true":
        measured = f"after {100 * share:.1f} cm" if share >= 0 else "never"
    elif name == "reward_rises":
        measured = f"by {share:.3g}"
    elif name == "no_warnings":
        measured = f"{share:.0f} warnings" if share != 1 else "1 warning"
    else:
        measured = f"true in {100 * share:.0f} % of moments"
    return {
        "asks": str(check.get("asks") or name or ""),
        "passed": check.get("passed") is True,
        "measured": measured,
    }


def _sample_view(sample: Mapping[str, Any], is_picked: bool) -> dict[str, Any]:
    """Return one of the task codes, with why it was not better: an error, a veto, the checks that failed."""
    audit = as_dict(sample.get("audit"))
    checks = as_dicts(audit.get("checks"))
    failed = [str(c.get("asks")) for c in checks if c.get("passed") is not True]
    return {
        "is_picked": is_picked,
        "runnable": sample.get("runnable") is True,
        "score": number(sample.get("score")),
        "trouble": str(sample.get("error") or audit.get("vetoed") or " ".join(failed)),
    }


def _made_by(learning: Mapping[str, Any]) -> str:
    """Return who made the expert and what PPO changed; nothing where the record does not say."""
    made_by = str(learning.get("made_by") or "")
    compared = as_dict(learning.get("comparison"))
    before, after = (as_dict(compared.get(who)) for who in ("taught", "ppo"))
    rates = [rate_of(judged.get("success")) for judged in (before, after)]
    times = [number(judged.get("median_s")) for judged in (before, after)]
    if not made_by or None in rates or None in times:
        return f"Made by {made_by}." if made_by else ""
    words = [
        f"{rate.value:.0%} after {time:.2f} s"
        for rate, time in zip(rates, times, strict=True)
        if rate
    ]
    return (
        f"Made by {made_by}. On the same {compared['success_gain']['pairs']} episodes the taught policy succeeded in "
        f"{words[0]}, PPO's in {words[1]} (median)."
    )


def _authors(table: Mapping[str, Any]) -> list[str]:
    """Return who wrote the samples and who picked one; nothing where it is not known."""
    model = f"the model {str(table.get('model') or '')[:MAX_MODEL_CHARS]}".rstrip()
    writer = {"templates": "templates", "vlm": model}.get(str(table.get("writer")))
    picker = {"audit": "the audit", "vlm": model}.get(str(as_dict(table.get("pick")).get("by")))
    return [f"Written by {writer}, picked by {picker}."] if writer and picker else []


def _pick_words(rates: Mapping[str, Any]) -> list[str]:
    """Return which share of the samples to pick from was of no use; nothing where it is not known."""
    before = as_dict(rates.get("before_pick"))
    broken, zero = number(before.get("non_runnable")), number(before.get("zero_score"))
    if broken is None or zero is None:
        return []
    return [
        f"Before the pick {broken:.0%} of task codes did not run and {zero:.0%} ran and scored nothing."
    ]
