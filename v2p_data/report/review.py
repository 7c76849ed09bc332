"""Review of a run's scenes: what the page shows of each clip, and the work that a mark starts.

The page is served, or written as one file that is read only. A mark is saved in the caption file beside the videos
before anything else happens. Then the clip alone is rebuilt, in the run's own folder and with its settings, as
`v2p scene` would do it: that command finds the result there and keeps it.
"""

import base64
import hashlib
import os
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import read_record, write_json_atomically
from v2p_data.pipeline.run_file import RUN_FILE, outcomes_json
from v2p_data.pipeline.runner import Outcome, Runtime, Stage, make_stage, stored_outcome
from v2p_data.report.media import jpeg_bytes
from v2p_data.report.prepared_clips import (
    Polygons,
    PreparedClips,
    Promise,
    outlines_of,
    stills_of,
)
from v2p_data.report.reading import Result, as_dict, as_dicts, as_list, number, read_run
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.scene.scene import SCENE_FILE
from v2p_data.video.captions import CAPTIONS_FILE, VideoItem
from v2p_data.video.hints import MARK_KEYS, TABLE, check_hints, read_hint
from v2p_data.video.save_hints import save_hint

REVIEW_FILE = "review.json"
"""In the run folder: what a person said of each result."""
PAGE_FILE = "review.html"
OVERLAY_FILE = "overlay.mp4"
SCHEMA = 1
LOOK_AHEAD = 1
"""So many clips after the one that is looked at are made ready meanwhile."""
STILL_WIDTH_PX = 960
_MORE_TO_COME_S = 2.0
"""While objects are unmarked the next click is waited for so long: work on half of the marks is in its way."""
_PICTURES_WAIT_S = 60.0
_JUDGEMENTS = ("right", "wrong")

StageOf = Callable[[VideoItem, Callable[[], PreparedClip] | None], Stage]
"""Returns the stage that makes a video's scene, from the prepared clip where one is given."""


@dataclass
class ReviewClip:
    """One clip of the page; its video or its result may be missing."""

    item: str
    video: VideoItem | None
    result: Result | None
    marks: int = 0
    """How often it was marked: a result belongs to the last mark only."""
    state: str = ""
    """What is being done, in words; empty when nothing is."""
    trouble: str = ""
    """Why the clip cannot be shown or its marks not be used, in a sentence."""
    outlines: Mapping[str, Polygons] = field(default_factory=dict[str, Polygons])
    """What each mark stands for, by phrase."""

    @property
    def key(self) -> str:
        """Return what changes when the scene is made anew, so that an old judgement does not stick to it."""
        if self.result is None:
            return ""
        record = self.result.record
        made = str((record.provenance or {}).get("time", "")) if record else ""
        return f"{self.result.folder.name}@{made}"

    @property
    def scene(self) -> Path | None:
        """Return the folder of the accepted scene."""
        return self.result.folder if self.result and self.result.status == "made" else None

    def as_json(self, judgement: str | None, film: str) -> dict[str, Any]:
        """Return what the page shows of the clip; `film` is the address of a video of it."""
        result, record = self.result, self.result.record if self.result else None
        recipe = as_dict(record.recipe.get("config")) if record else {}
        scene = as_dict(json_or_none(self.scene / SCENE_FILE)) if self.scene else {}
        said = self.video or VideoItem(
            item=self.item,
            path=Path(),
            caption=str(recipe.get("caption", self.item)),
            objects=tuple(map(str, as_list(recipe.get("objects")))),
        )
        return {
            "item": self.item,
            "key": self.key,
            "status": "accepted" if self.scene else result.status if result else "not made",
            "reason": result.reason if result else "",
            "detail": result.detail if result else "",
            "value": number((record.rejected or {}).get("value")) if record else None,
            "video": said.path.name,
            "caption": said.caption,
            "objects": list(said.objects),
            "hints": {phrase: dict(hint) for phrase, hint in said.hints.items()},
            "kind": str(scene.get("kind", "")),
            "confidence": number(scene.get("confidence")),
            "stages": [
                {"name": str(name), "value": value, "reason": str(sure.get("reason", ""))}
                for name, sure in as_dict(scene.get("confidences")).items()
                if isinstance(sure, dict) and (value := number(sure.get("value"))) is not None
            ],
            "things": [
                {
                    "name": str(thing.get("label") or thing.get("name", "")),
                    "size_cm": [
                        100 * size
                        for size in map(number, as_list(thing.get("size_m")))
                        if size is not None
                    ],
                    "mass_kg": number(thing.get("mass_kg")),
                }
                for thing in as_dicts(scene.get("objects"))
            ],
            "warnings": [str(warning) for warning in as_list(scene.get("warnings"))],
            "judgement": judgement,
            "film": film,
            "state": self.state,
            "trouble": self.trouble,
            "outlines": dict(self.outlines),
            "size_px": None,
            "stills": [],
        }


def review_clips(root: Path, videos: Sequence[VideoItem]) -> list[ReviewClip]:
    """Return the clips of a run and of its videos, the accepted ones first."""
    results = {
        r.item: r
        for r in read_run(root).of_stage("scene")
        if r.status in ("made", "rejected", "failed")
    }
    by_item = {video.item: video for video in videos}
    clips = [
        ReviewClip(
            item=item,
            video=by_item.get(item),
            result=results.get(item),
            trouble=""
            if item in by_item
            else "its video is not at hand, so nothing can be marked",
        )
        for item in {**by_item, **results}
    ]
    return sorted(clips, key=lambda clip: (clip.scene is None, clip.item))


def write_review(root: Path, videos: Sequence[VideoItem], out: Path) -> list[dict[str, Any]]:
    """Write the page as a file that links the videos beside it, and return what it shows of the clips.

    Raises:
        V2PError: the page cannot be written.
    """
    judged = judgements(root)
    rows: list[dict[str, Any]] = []
    for clip in review_clips(root, videos):
        film = clip.scene / OVERLAY_FILE if clip.scene else clip.video and clip.video.path
        link = os.path.relpath(film.resolve(), out.parent.resolve()) if film else ""
        address = quote(Path(link).as_posix()) if film and film.is_file() else ""
        rows.append(clip.as_json(judged.get(clip.key), address))
    page = page_of(root, {"served": False, "clips": rows})
    temporary = out.with_name(out.name + ".tmp")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(page)
        temporary.replace(out)
    except OSError as error:
        raise V2PError(f"cannot write the page {out}: {error.strerror}") from error
    return rows


def page_of(root: Path, data: Mapping[str, Any]) -> bytes:
    """Return the page with its data.

    Text from users reaches it as JSON only, and a content policy lets no script run but the page's own.
    """
    template = Path(__file__).with_suffix(".html").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}
    script = re.search(r'<script id="app">(.*?)</script>', template, re.S)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    page = environment.from_string(template).render(
        title=root.resolve().name, data=data, script_hash=digest
    )
    # File names may hold bytes that are no text; they must not keep the page from being made.
    return page.encode("utf-8", "replace")


def judgements(root: Path) -> dict[str, str]:
    """Return what was said earlier, by the results' keys; what cannot be read is not counted."""
    rows = as_dicts(as_dict(json_or_none(root / REVIEW_FILE)).get("clips"))
    return {str(r.get("key")): r["judgement"] for r in rows if r.get("judgement") in _JUDGEMENTS}


class Review:
    """The clips of a run, as a person goes through them on the served page.

    Args:
        root: the run.
        videos: its videos, of one folder.
        stage_of: gives the stage of a video's scene.
    """

    def __init__(self, root: Path, videos: Sequence[VideoItem], stage_of: StageOf) -> None:
        self.root, self._stage_of = root, stage_of
        self.captions = videos[0].path.parent / CAPTIONS_FILE
        """The file that marks go into."""
        self._clips = {clip.item: clip for clip in review_clips(root, videos)}
        self._judged = judgements(root)
        self._lock = threading.RLock()
        self._marking = threading.Lock()
        """Marks are saved one after the other; what is shown meanwhile need not wait."""
        self._ready = PreparedClips()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="rebuild")
        self._backs_up = True

    def close(self) -> None:
        """End: what is being made is finished, nothing new is begun."""
        self._ready.close()
        self._worker.shutdown(wait=True, cancel_futures=True)

    # --- what the page asks for ------------------------------------------------------------------------------

    def page(self) -> bytes:
        """Return the page."""
        with self._lock:
            rows = [self._as_json(clip) for clip in self._clips.values()]
        return page_of(self.root, {"served": True, "clips": rows})

    def clip(self, item: str) -> dict[str, Any]:
        """Return what the page shows of one clip, which is looked at now: it and the next ones are made ready.

        Raises:
            KeyError: there is no such clip.
        """
        clip = self._clips[item]
        if clip.video is not None:
            self._ask(clip.video)
            later = list(self._clips.values())[list(self._clips).index(item) + 1 :]
            for ahead in [c for c in later if c.video and self._waits_for_a_person(c)][
                :LOOK_AHEAD
            ]:
                assert ahead.video is not None
                self._ask(ahead.video)
            self._ask(clip.video)  # once more: it is the last that may be forgotten
            with self._lock:
                if clip.result is None and not clip.state and not clip.trouble:
                    self._rebuild(clip)
        return self._shown(clip)

    def still(self, item: str, number: int) -> bytes:
        """Return a still as a JPEG.

        Raises:
            LookupError: there is no such still.
        """
        try:
            clip = self._ready.decoded(item).result(_PICTURES_WAIT_S)
        except (ItemRejectedError, TimeoutError) as error:
            raise LookupError(item) from error
        return jpeg_bytes(clip.frames[stills_of(clip)[number]], STILL_WIDTH_PX)

    def film(self, item: str) -> Path | None:
        """Return the overlay video of the clip's scene."""
        scene = self._clips[item].scene
        return scene / OVERLAY_FILE if scene else None

    # --- what the page changes -------------------------------------------------------------------------------

    def mark(self, item: str, phrase: str, hint: Mapping[str, Any] | None) -> dict[str, Any]:
        """Save what was marked for an object, or that nothing is, and rebuild the clip; return the clip.

        Raises:
            V2PError: it cannot be a mark of this clip; nothing was changed.
            KeyError: there is no such clip.
        """
        clip = self._clips[item]
        with self._marking:
            video = clip.video
            if video is None or phrase not in (*video.objects, TABLE):
                objects = ", ".join(video.objects) if video else "its video is not at hand"
                raise V2PError(f"'{phrase}' is none of the objects of {item}: {objects}")
            kept = {k: v for k, v in video.hints.get(phrase, {}).items() if k not in MARK_KEYS}
            new = {**kept, **(hint or {})}
            outlines = self._checked(video, phrase, new)
            hints = save_hint(video, phrase, new or None, keeps_old=self._backs_up)
            self._backs_up = False
            with self._lock:
                clip.video = replace(video, hints=hints)
                clip.outlines = outlines
                self._rebuild(clip)
        return self._shown(clip)

    def judge(self, item: str, judgement: str) -> dict[str, Any]:
        """Save what a person says of the clip's result, and return the clip.

        Raises:
            V2PError: there is nothing to judge.
            KeyError: there is no such clip.
        """
        clip = self._clips[item]
        if judgement not in _JUDGEMENTS:
            raise V2PError(f"a judgement is one of {', '.join(_JUDGEMENTS)}, not {judgement!r}")
        with self._lock:
            if clip.state or clip.result is None:
                raise V2PError(f"{item} is being rebuilt; judge it when its result is there")
            self._judged[clip.key] = judgement
            shown = ("item", "key", "status", "reason", "value", "video", "caption", "judgement")
            rows = [
                {name: row[name] for name in (*shown, "hints")}
                for row in map(self._as_json, self._clips.values())
            ]
            write_json_atomically(self.root / REVIEW_FILE, {"schema": SCHEMA, "clips": rows})
        return self._shown(clip)

    # --- work ------------------------------------------------------------------------------------------------

    def _checked(
        self, video: VideoItem, phrase: str, hint: Mapping[str, Any]
    ) -> dict[str, Polygons]:
        """Return the outlines of all marks with this one among them, as far as the clip is ready.

        Raises:
            V2PError: the mark cannot be used: outside of the picture, or on no object.
        """
        hints = {name: old for name, old in video.hints.items() if name != phrase}
        if hint:
            hints[phrase] = read_hint(dict(hint), f"{video.path.name}, hint '{phrase}'")
        future = self._ask(video).prepared
        if not future.done() or future.exception() is not None:
            return {}
        clip = future.result().clip
        check_hints(hints, clip.source_size_px, clip.total_frames, video.path.name)
        try:
            return outlines_of(future.result().with_hints(hints))
        except ItemRejectedError as error:
            raise V2PError(error.detail) from error

    def _rebuild(self, clip: ReviewClip) -> None:
        clip.marks += 1
        clip.state, clip.trouble = "waiting", ""
        self._worker.submit(self._make, clip, clip.marks)

    def _make(self, clip: ReviewClip, mark: int) -> None:
        """Rebuild a clip, unless it was marked again since."""
        assert clip.video is not None
        if mark > 1 and any(phrase not in clip.video.hints for phrase in clip.video.objects):
            time.sleep(_MORE_TO_COME_S)
        with self._lock:
            if mark != clip.marks:
                return
            clip.state, video = "reading the video", clip.video
            prepared = self._ask(video).prepared

        def ready() -> PreparedClip:
            hinted = _with_hints(prepared, video)
            with self._lock:
                clip.state = "finding objects"
                if video.hints and not clip.outlines and mark == clip.marks:
                    with suppress(ItemRejectedError):  # the rebuilding says so
                        clip.outlines = outlines_of(hinted)
            return hinted

        result, trouble = clip.result, ""
        try:
            prepared.exception()  # waits until the clip is ready, or cannot be
            stage = self._stage_of(video, ready)
            stored = stored_outcome(stage, self.root)
            outcome = stored or make_stage(stage, Runtime(root=self.root))
            self._remember(outcome)
            result = _result(outcome)
            trouble = outcome.detail if outcome.reason == "bad_hint" else ""
        except CancelledError:
            pass  # the person went on; the clip is rebuilt when it is opened again
        except Exception as error:  # noqa: BLE001  # a page that waits for ever says nothing
            trouble = f"this clip could not be rebuilt: {error}"
        with self._lock:
            if mark == clip.marks:
                clip.result, clip.state, clip.trouble = result, "", trouble

    def _remember(self, outcome: Outcome) -> None:
        """Put the outcome into the run's list of what its last command made: pages read there which result counts."""
        path = self.root / RUN_FILE
        rows = as_dicts(json_or_none(path))
        others = [r for r in rows if (r.get("stage"), r.get("item")) != ("scene", outcome.item)]
        write_json_atomically(path, [*others, *outcomes_json([outcome])])

    def _ask(self, video: VideoItem) -> Promise:
        return self._ready.ask(video, lambda: self._stage_of(video, None).config)

    # --- what is shown ---------------------------------------------------------------------------------------

    def _waits_for_a_person(self, clip: ReviewClip) -> bool:
        return clip.scene is None and clip.key not in self._judged

    def _as_json(self, clip: ReviewClip) -> dict[str, Any]:
        # The key in the address keeps a browser from showing the film of an earlier result.
        film = f"film/{clip.item}/{quote(clip.key.split('@')[0])}" if clip.scene else ""
        return clip.as_json(self._judged.get(clip.key), film)

    def _shown(self, clip: ReviewClip) -> dict[str, Any]:
        pictures: dict[str, Any] = {}
        trouble = ""
        try:
            decoded = self._ready.decoded(clip.item).result(_PICTURES_WAIT_S)
            stills = decoded.source_frame[stills_of(decoded)].tolist()
            pictures = {"size_px": list(decoded.source_size_px), "stills": stills}
        except (ItemRejectedError, TimeoutError, LookupError) as error:
            trouble = str(error)
        with self._lock:
            shown = self._as_json(clip)
        return shown | pictures | {"trouble": shown["trouble"] or trouble}


def _with_hints(prepared: Future[PreparedClip], video: VideoItem) -> PreparedClip:
    """Return the clip with its hints.

    Raises:
        ItemRejectedError: the clip or a hint cannot be used.
    """
    clip = prepared.result()
    try:
        return clip.with_hints(video.hints)
    except V2PError as error:
        raise ItemRejectedError("bad_hint", str(error)) from error


def _result(outcome: Outcome) -> Result:
    return Result(
        stage=outcome.stage,
        item=outcome.item,
        status="made"
        if outcome.is_usable
        else "rejected"
        if outcome.status == "rejected"
        else "failed",
        folder=outcome.folder,
        record=read_record(outcome.folder),
        reason=outcome.reason,
        detail=outcome.detail,
    )
