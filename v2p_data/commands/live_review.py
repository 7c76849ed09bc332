"""What stands behind the served review page: clips, their marks, and the work that a mark starts.

A mark is saved in the caption file beside the videos before anything else happens. Then the clip alone is rebuilt, in the run's own
folder and with its settings, as `v2p scene` would do it: that command finds the result there and keeps it.
"""

import threading
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from v2p_data.commands.display import outcomes_json
from v2p_data.commands.prepared_clips import PreparedClips, outlines_of, prepared_ahead
from v2p_data.commands.run import RUN_FILE
from v2p_data.commands.scene_settings import settings_of, usual_settings
from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import read_record, write_json_atomically
from v2p_data.pipeline.runner import Outcome, Runtime, make_stage, stored_outcome
from v2p_data.report.reading import Result, as_dict, as_dicts, read_run
from v2p_data.report.review_page import SCHEMA, ReviewClip, clip_json
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.stages import EngineConfig, make_scene, scene_stage
from v2p_data.video.captions import CAPTIONS_FILE, VideoItem, find_videos
from v2p_data.video.decode import VideoConfig
from v2p_data.video.hints import MARK_KEYS, TABLE, check_hints, read_hint
from v2p_data.video.save_hints import with_hint, write_captions

REVIEW_FILE = "review.json"
"""In the run folder: what a person said of each result, in the form that the page from disk downloads."""
LOOK_AHEAD = 2
"""So many clips after the one that is looked at are made ready meanwhile."""
_AT_ONCE = 3
"""A new mark does not wait until the work on the one before has ended."""
_MORE_TO_COME_S = 2.0
"""While objects are unmarked the next click is waited for so long: work on half of the marks would only be in its way."""
_STILLS_WAIT_S = 60.0
_JUDGEMENTS = ("right", "wrong", "unsure")

Outlines = Mapping[str, list[list[list[float]]]]
"""Polygons [px of the file] of what each mark stands for, by phrase."""


@dataclass
class _Desk:
    """What is known of one clip while its page is served."""

    video: VideoItem
    result: Result | None
    cfg: EngineConfig
    marks: int = 0
    """How often it was marked: a result belongs to the last mark only."""
    state: str = ""
    """What is being done, in words; empty when nothing is."""
    trouble: str = ""
    """Why the clip cannot be shown or its marks not be used, in a sentence."""
    outlines: Outlines = field(default_factory=dict[str, list[list[list[float]]]])


class LiveReview:
    """The clips of a run, as a person goes through them.

    Args:
        root: the run.
        videos: folder of its videos.

    Raises:
        V2PError: there are no videos, or their captions cannot be used.
    """

    def __init__(self, root: Path, videos: Path) -> None:
        self.root = root
        self.home = videos if videos.is_dir() else videos.parent
        self._lock = threading.RLock()
        self._marking = threading.Lock()
        """Marks are saved one after the other; what is shown meanwhile need not wait."""
        self._ready = PreparedClips(prepared_ahead)
        self._worker = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="rebuild")
        self._jobs = 0
        self._at_work: dict[str, threading.Lock] = {}
        """By result folder: two marks that mean the same are not rebuilt at once."""
        results = {r.item: r for r in read_run(root).of_stage("scene")}
        usual = usual_settings(results.values())
        self._desks = {
            video.item: _Desk(
                video=video,
                result=results.get(video.item),
                cfg=settings_of(results.get(video.item)) or usual,
            )
            for video in _in_order(find_videos(videos), results)
        }
        self._judged = _judgements(root / REVIEW_FILE)
        self._backs_up = True

    @property
    def captions(self) -> Path:
        """The file that marks go into."""
        return self.home / CAPTIONS_FILE

    def close(self) -> None:
        """End: what is being made is finished, nothing new is begun."""
        self._ready.close()
        self._worker.shutdown(wait=True, cancel_futures=True)

    # --- what the page asks for ------------------------------------------------------------------------------

    def overview(self) -> dict[str, Any]:
        """Return what the page shows of all clips."""
        with self._lock:
            return {"clips": [self._row(desk) for desk in self._desks.values()]}

    def clip(self, item: str) -> dict[str, Any]:
        """Return what the page shows of one clip, which is looked at now: it and the next ones are made ready.

        Raises:
            KeyError: there is no such clip.
        """
        desk = self._desks[item]
        self._ask(desk)
        items = list(self._desks)
        ahead = [self._desks[later] for later in items[items.index(item) + 1 :]]
        for later in [d for d in ahead if self._is_open(d)][:LOOK_AHEAD]:
            self._ready.ask(later.video, *_both(later.cfg), is_ahead=True)
        self._ask(desk)  # once more: it is the last that may be forgotten
        with self._lock:
            if desk.result is None and not desk.state and not desk.trouble:
                self._rebuild(desk)
        return self._shown(desk)

    def still(self, item: str, number: int) -> bytes:
        """Return a still as a JPEG.

        Raises:
            LookupError: there is no such still.
        """
        try:
            return self._ready.stills(item).result(_STILLS_WAIT_S).jpegs[number]
        except (ItemRejectedError, TimeoutError) as error:
            raise LookupError(item) from error

    def film(self, item: str) -> Path | None:
        """Return the overlay video of the clip's scene."""
        result = self._desks[item].result
        return result.folder / "overlay.mp4" if result and result.status == "made" else None

    # --- what the page changes -------------------------------------------------------------------------------

    def mark(self, item: str, phrase: str, hint: Mapping[str, Any] | None) -> dict[str, Any]:
        """Save what was marked for an object, or that nothing is, and rebuild the clip; return the clip.

        Raises:
            V2PError: it cannot be a mark of this clip; nothing was changed.
            KeyError: there is no such clip.
        """
        desk = self._desks[item]
        with self._marking:
            if phrase not in (*desk.video.objects, TABLE):
                raise V2PError(
                    f"'{phrase}' is none of the objects of {desk.video.path.name}: {', '.join(desk.video.objects)}"
                )
            old = desk.video.hints.get(phrase, {})
            kept = {key: value for key, value in old.items() if key not in MARK_KEYS}
            new = {**kept, **(hint or {})}
            outlines = self._checked(desk, phrase, new)
            merged = with_hint(self.home, desk.video, phrase, new or None)
            write_captions(merged, keeps_old=self._backs_up)
            self._backs_up = False
            with self._lock:
                desk.video = replace(desk.video, hints=merged.hints[desk.video.path.name])
                desk.outlines = outlines
                self._rebuild(desk)
        return self._shown(desk)

    def judge(self, item: str, judgement: str | None) -> dict[str, Any]:
        """Save what a person says of the clip's result, and return the clip.

        Raises:
            V2PError: there is nothing to judge.
            KeyError: there is no such clip.
        """
        desk = self._desks[item]
        if judgement is not None and judgement not in _JUDGEMENTS:
            raise V2PError(f"a judgement is one of {', '.join(_JUDGEMENTS)}, not {judgement!r}")
        with self._lock:
            if desk.state or desk.result is None:
                raise V2PError(f"{item} is being rebuilt; judge it when its result is there")
            self._judged[_key(desk)] = judgement
            rows = [self._row(d) for d in self._desks.values()]
            write_json_atomically(self.root / REVIEW_FILE, {"schema": SCHEMA, "clips": rows})
        return self._shown(desk)

    # --- work ------------------------------------------------------------------------------------------------

    def _checked(self, desk: _Desk, phrase: str, hint: Mapping[str, Any]) -> Outlines:
        """Return the outlines of all marks with this one among them, as far as the clip is ready.

        Raises:
            V2PError: the mark cannot be used: outside of the picture, or on no object.
        """
        where = f"{desk.video.path.name}, hint '{phrase}'"
        hints = {name: old for name, old in desk.video.hints.items() if name != phrase}
        if hint:
            hints[phrase] = read_hint(dict(hint), where)
        future = self._ask(desk)
        if not future.done() or future.exception() is not None:
            return {}
        ready = future.result()
        clip = ready.clip
        check_hints(hints, clip.source_size_px, clip.total_frames, desk.video.path.name)
        try:
            return outlines_of(ready.with_hints(hints))
        except ItemRejectedError as error:
            raise V2PError(error.detail) from error

    def _rebuild(self, desk: _Desk) -> None:
        desk.marks += 1
        desk.state, desk.trouble = "waiting", ""
        self._worker.submit(self._make, desk, desk.marks)

    def _make(self, desk: _Desk, mark: int) -> None:
        """Rebuild a clip, unless it was marked again since."""
        if any(phrase not in desk.video.hints for phrase in desk.video.objects) and mark > 1:
            time.sleep(_MORE_TO_COME_S)
        with self._lock:
            self._jobs += 1
            self._ready.quiet.clear()
        try:
            with self._lock:
                if mark != desk.marks:
                    return
                desk.state, video, future = "reading the video", desk.video, self._ask(desk)
            prepared = _prepared(future, video)
            with self._lock:
                desk.state = "finding objects"
                if isinstance(prepared, PreparedClip) and video.hints and not desk.outlines:
                    desk.outlines = _outlines_or_none(prepared)
            outcome = self._outcome(video, desk.cfg, prepared)
            with self._lock:
                self._remember(outcome)
                if mark == desk.marks:
                    desk.result, desk.state = _result(outcome), ""
                    desk.trouble = outcome.detail if outcome.reason == "bad_hint" else ""
        except Exception as error:  # noqa: BLE001  # a page that waits for ever says nothing
            with self._lock:
                if mark == desk.marks:
                    desk.state, desk.trouble = "", f"this clip could not be rebuilt: {error}"
        finally:
            with self._lock:
                self._jobs -= 1
                if not self._jobs:
                    self._ready.quiet.set()

    def _outcome(
        self, video: VideoItem, cfg: EngineConfig, prepared: PreparedClip | V2PError
    ) -> Outcome:
        stage = scene_stage(video, cfg)

        def ready() -> PreparedClip:
            if isinstance(prepared, PreparedClip):
                return prepared
            raise prepared

        with self._lock:
            own = self._at_work.setdefault(stage.folder_name, threading.Lock())
        with own:
            stored = stored_outcome(stage, self.root)
            if stored is not None:
                return stored
            make = partial(make_scene, video=video, prepared=ready)
            return make_stage(replace(stage, make=make), Runtime(root=self.root))

    def _remember(self, outcome: Outcome) -> None:
        """Put the outcome into the run's list of what its last command made: pages read there which result counts."""
        path = self.root / RUN_FILE
        rows = as_dicts(json_or_none(path))
        others = [r for r in rows if (r.get("stage"), r.get("item")) != ("scene", outcome.item)]
        write_json_atomically(path, [*others, *outcomes_json([outcome])])

    # --- what is shown ---------------------------------------------------------------------------------------

    def _is_open(self, desk: _Desk) -> bool:
        """Return whether the clip still waits for a person: nothing was accepted or said of it."""
        made = desk.result is not None and desk.result.status == "made"
        return not made and self._judged.get(_key(desk)) is None

    def _ask(self, desk: _Desk) -> Future[PreparedClip]:
        return self._ready.ask(desk.video, *_both(desk.cfg))

    def _row(self, desk: _Desk) -> dict[str, Any]:
        result, key = desk.result, _key(desk)
        rejected = (result.record.rejected or {}) if result and result.record else {}
        status = result.status if result else "not made"
        return {
            "item": desk.video.item,
            "key": key,
            "status": "accepted" if status == "made" else status,
            "reason": result.reason if result else "",
            "value": rejected.get("value"),
            "video": desk.video.path.name,
            "caption": desk.video.caption,
            "judgement": self._judged.get(key),
            "hints": {phrase: dict(hint) for phrase, hint in desk.video.hints.items()},
            "state": desk.state,
        }

    def _shown(self, desk: _Desk) -> dict[str, Any]:
        stills, trouble = None, desk.trouble
        try:
            stills = self._ready.stills(desk.video.item).result(_STILLS_WAIT_S)
        except (ItemRejectedError, TimeoutError, LookupError) as error:
            trouble = trouble or str(error)
        with self._lock:
            result, row = desk.result, self._row(desk)
            made = result.folder if result is not None and result.status == "made" else None
            shown = clip_json(
                ReviewClip(
                    item=desk.video.item, key=row["key"], status="accepted" if made else "rejected", caption=desk.video.caption,
                    objects=desk.video.objects, folder=made, reason=row["reason"], detail=result.detail if result else "",
                    value=row["value"], video=desk.video.path.name, hints=desk.video.hints, trouble=trouble,
                ),
                self.root,
            )  # fmt: skip
            shown |= row
            shown["outlines"] = dict(desk.outlines)
        shown["size_px"] = list(stills.size_px) if stills else None
        shown["stills"] = list(stills.frames) if stills else []
        shown["num_frames"] = stills.num_frames if stills else 0
        return shown


def _prepared(future: Future[PreparedClip], video: VideoItem) -> PreparedClip | V2PError:
    """Return the clip with its hints, or why it cannot be used."""
    try:
        ready = future.result()
    except V2PError as error:
        return error
    try:
        return ready.with_hints(video.hints)
    except V2PError as error:
        return ItemRejectedError("bad_hint", str(error))


def _outlines_or_none(prepared: PreparedClip) -> Outlines:
    try:
        return outlines_of(prepared)
    except ItemRejectedError:
        return {}  # the rebuilding says so


def _result(outcome: Outcome) -> Result:
    return Result(
        stage=outcome.stage,
        item=outcome.item,
        status="made" if outcome.is_usable else "rejected" if outcome.status == "rejected" else "failed",
        folder=outcome.folder,
        record=read_record(outcome.folder),
        reason=outcome.reason,
        detail=outcome.detail,
    )  # fmt: skip


def _key(desk: _Desk) -> str:
    """Return what changes when the scene is made anew, as on the page from disk."""
    if desk.result is None:
        return ""
    record = desk.result.record
    made = str((record.provenance or {}).get("time", "")) if record else ""
    return f"{desk.result.folder.name}@{made}"


def _both(cfg: EngineConfig) -> tuple[VideoConfig, SceneConfig]:
    return cfg.video, cfg.scene


def _in_order(videos: Iterable[VideoItem], results: Mapping[str, Result]) -> list[VideoItem]:
    """Return the videos, those first whose scene was accepted, as on the page from disk."""
    made = {item for item, result in results.items() if result.status == "made"}
    return sorted(videos, key=lambda video: (video.item not in made, video.item))


def _judgements(path: Path) -> dict[str, str | None]:
    """Return what was said earlier, by the results' keys; what cannot be read is not counted."""
    rows = as_dicts(as_dict(json_or_none(path)).get("clips"))
    return {str(r.get("key")): r["judgement"] for r in rows if r.get("judgement") in _JUDGEMENTS}
