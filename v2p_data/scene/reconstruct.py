"""The order of steps from a clip to a scene.

Frames, then grounding, then camera and poses in camera heights, then meshes in metres, then how
sure all of it is. Where that is not sure, the objects are searched once more in the clip's mirror
image, and the surer scene is kept. What is turned away all the same may show a hand that brings
the object: then its end is searched alone.
"""

from dataclasses import replace

import numpy as np

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.confidence import (
    by_stage,
    check_confidence,
    check_motion,
    confidence_of,
    cues_of,
)
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import Estimate, GroundedObjects, Placement, Reconstruction
from v2p_data.scene.estimates import estimates_of
from v2p_data.scene.fitting.by_model import camera_from_depth
from v2p_data.scene.fitting.camera_guess import camera_guess
from v2p_data.scene.fitting.metric import clip_camera
from v2p_data.scene.fitting.placement import place
from v2p_data.scene.fitting.start_place import with_start_place
from v2p_data.scene.frames.prepare import PreparedClip, prepare
from v2p_data.scene.grounding.by_model import outliner_of, segmented
from v2p_data.scene.grounding.ground_objects import (
    ground_brought,
    ground_objects,
    without_asides,
)
from v2p_data.scene.grounding.methods.base import Method
from v2p_data.scene.grounding.methods.detector import Detector
from v2p_data.scene.grounding.methods.hint import Hints
from v2p_data.scene.grounding.mirror_image import (
    as_filmed,
    has_marks,
    mirrored_clip,
    mirrored_meaning,
)
from v2p_data.scene.meshes import with_meshes
from v2p_data.scene.preset import with_preset
from v2p_data.scene.remarks import remarks_on
from v2p_data.video.captions import parse_caption
from v2p_data.video.clip import Clip
from v2p_data.video.meaning import Meaning

_NOT_FOUND = ("object_not_found", "reference_not_found", "motion_contradicts_caption")
"""Rejections that a search in the mirror image may mend: the object is there, but something else was taken for it."""
_MAY_BE_BROUGHT = ("place_onto", "insert", "cover", "drop_in_front_of", "push_next_to")
"""Kinds of task whose end alone says what is asked for: something is put down at another object."""
_NOT_SEEN_AT_FIRST = ("not_there_at_first", "low_confidence", *_NOT_FOUND)
"""Rejections of clips in which a hand may bring the object: the first says so, the others because
something else was taken for it."""
_SURE_AT_ONCE = 0.65
"""Confidence from which the first search is taken as it is."""


def reconstruct(clip: Clip, cfg: SceneConfig, rng: np.random.Generator) -> Reconstruction:
    """Return the scene that the clip shows.

    Raises:
        ItemRejectedError: `camera_moves`, `nothing_moves`, `no_hand`, `not_there_at_first`,
            `object_not_found`, `reference_not_found`, `bad_hint`, `motion_contradicts_caption` or
            `low_confidence`, with the number that decided.
    """
    return reconstruct_prepared(prepared_for(clip, cfg), cfg, rng)


def prepared_for(clip: Clip, cfg: SceneConfig) -> PreparedClip:
    """Return the clip prepared for a reconstruction with these settings."""
    cfg = with_preset(cfg)
    prepared = prepare(
        clip,
        max_camera_shift_px=cfg.max_camera_shift_px,
    )
    outliner = outliner_of(prepared.clip, prepared.working, cfg.outline)
    working = replace(prepared.working, outliner=outliner)
    return replace(prepared, working=working)


def reconstruct_prepared(
    prepared: PreparedClip, cfg: SceneConfig, rng: np.random.Generator
) -> Reconstruction:
    """Return the scene that a prepared clip shows, as `reconstruct` does of the clip."""
    cfg = with_preset(cfg)
    meaning = parse_caption(prepared.clip.caption, prepared.clip.objects)
    try:
        return _reconstructed(prepared, meaning, cfg, rng)
    except ItemRejectedError as rejected:
        if not (
            meaning.kind in _MAY_BE_BROUGHT
            and rejected.reason in _NOT_SEEN_AT_FIRST
            and _is_ours(cfg)
            and not cfg.pose.worker  # it would pose what is not there yet
        ):
            raise
        try:
            return _with_what_is_brought(prepared, meaning, cfg, rng)
        except ItemRejectedError:
            raise rejected from None


def _reconstructed(
    prepared: PreparedClip, meaning: Meaning, cfg: SceneConfig, rng: np.random.Generator
) -> Reconstruction:
    """Return the scene of a clip whose objects are all there at first."""
    scene, error = None, None
    try:
        scene = _rebuilt(prepared, meaning, _grounded(prepared, meaning, cfg), cfg, rng)
    except ItemRejectedError as rejected:
        if rejected.reason not in _NOT_FOUND:
            raise
        error = rejected
    if _may_search_again(prepared, cfg) and (scene is None or _is_unsure(scene, cfg)):
        try:
            found = _grounded_in_mirror_image(prepared, meaning, cfg)
            again = _rebuilt(prepared, meaning, found, cfg, rng)
        except ItemRejectedError:
            again = None
        if again is not None and (scene is None or _rank(again) > _rank(scene)):
            scene = again
    if scene is None:
        assert error is not None
        raise error
    check_confidence(scene.cues, cfg.min_confidence)
    return scene


def _with_what_is_brought(
    prepared: PreparedClip, meaning: Meaning, cfg: SceneConfig, rng: np.random.Generator
) -> Reconstruction:
    """Return the scene of a clip in which a hand brings the object.

    Raises:
        ItemRejectedError: the clip does not show that surely enough.
    """
    found = ground_brought(prepared.clip, prepared.working, meaning, cfg.min_found)
    scene = _rebuilt(prepared, meaning, found, cfg, rng)
    check_confidence(scene.cues, cfg.min_confidence)
    return scene


def _may_search_again(prepared: PreparedClip, cfg: SceneConfig) -> bool:
    """Return whether a search in the mirror image can differ: with our network and without marks."""
    return _is_ours(cfg) and not has_marks(prepared.clip)


def _is_ours(cfg: SceneConfig) -> bool:
    """Return whether our network searches the objects, and nothing else follows them."""
    return cfg.ground.backend == "network" and cfg.segment.backend == "flow"


def _is_unsure(scene: Reconstruction, cfg: SceneConfig) -> bool:
    return scene.contradiction is not None or scene.confidence < max(
        cfg.min_confidence, _SURE_AT_ONCE
    )


def _rank(scene: Reconstruction) -> tuple[bool, float]:
    """Return what orders scenes of one clip: those that move as their caption says first, then the surest."""
    return scene.contradiction is None, scene.confidence


def _rebuilt(
    prepared: PreparedClip,
    meaning: Meaning,
    grounded: GroundedObjects,
    cfg: SceneConfig,
    rng: np.random.Generator,
) -> Reconstruction:
    """Return the scene of the objects that were found, however sure it is.

    Raises:
        ItemRejectedError: `motion_contradicts_caption`.
    """
    clip, segmentation = prepared.clip, grounded.segmentation
    guess = camera_guess(segmentation.camera, cfg)
    tracks = grounded.objects
    if cfg.depth.backend != "none":
        guess = camera_from_depth(clip, grounded.working, tracks, guess, cfg.depth, rng)
    placement = place(grounded.working, tracks, meaning.kind, guess, cfg.max_poses, segmentation)
    if tracks[0].brought:
        placement = with_start_place(grounded, placement, meaning.kind)
    meshed = with_meshes(grounded, placement)
    objects = estimates_of(clip, grounded, placement, meshed, meaning.kind, cfg)

    contradiction = _contradiction(meaning, grounded, placement, objects, cfg)
    cues = cues_of(grounded, placement, meaning.kind)
    if confidence_of(cues) < cfg.min_confidence:
        kept, warnings = without_asides(grounded, meaning, clip)
        objects = [objects[k] for k in kept]
        grounded, placement = _only(kept, grounded, placement, warnings)
        cues = cues_of(grounded, placement, meaning.kind)
    remarks = remarks_on(meaning.kind, grounded, placement, len(clip.frames))
    return Reconstruction(
        clip=clip,
        kind=meaning.kind,
        objects=tuple(objects),
        camera=clip_camera(clip, placement),
        confidence=confidence_of(cues),
        stages=by_stage(cues),
        cues=cues,
        scale_spread=placement.scale_spread,
        least_found=min(track.sure for track in grounded.objects),
        contradiction=contradiction,
        warnings=(*grounded.warnings, *remarks),
    )


def _grounded_in_mirror_image(
    prepared: PreparedClip, meaning: Meaning, cfg: SceneConfig
) -> GroundedObjects:
    """Return the caption's objects as they are found in the clip's mirror image."""
    mirrored = mirrored_clip(prepared)
    outliner = outliner_of(mirrored.clip, mirrored.working, cfg.outline)
    mirrored = replace(mirrored, working=replace(mirrored.working, outliner=outliner))
    found = _grounded(mirrored, mirrored_meaning(meaning), cfg)
    return as_filmed(found, prepared.working)


def _grounded(prepared: PreparedClip, meaning: Meaning, cfg: SceneConfig) -> GroundedObjects:
    """Return the caption's objects with their mask tracks."""
    clip, working, segmentation = prepared.clip, prepared.working, prepared.segmentation
    methods: tuple[Method, ...] = (Hints(),)
    if cfg.ground.backend != "network":
        methods = (Detector(cfg.ground), *methods)
    grounded = ground_objects(clip, working, meaning, segmentation, cfg.min_found, methods)
    if cfg.segment.backend != "flow":
        tracks = segmented(clip, grounded.working, grounded.objects, cfg.segment)
        grounded = replace(grounded, objects=tracks)
    return grounded


def _contradiction(
    meaning: Meaning,
    grounded: GroundedObjects,
    placement: Placement,
    objects: list[Estimate],
    cfg: SceneConfig,
) -> str | None:
    """Return how the motion contradicts the caption, where nothing is rejected for it.

    Raises:
        ItemRejectedError: `motion_contradicts_caption`, where that is asked for.
    """
    poses = [thing.T_world_objs for thing in objects]
    try:
        check_motion(meaning.kind, grounded, placement, poses, objects[0].size_m)
    except ItemRejectedError as error:
        if cfg.check_motion:
            raise
        return error.detail
    return None


def _only(
    kept: list[int], grounded: GroundedObjects, placement: Placement, warnings: tuple[str, ...]
) -> tuple[GroundedObjects, Placement]:
    """Return the objects of these numbers alone, with more warnings."""
    tracks = tuple(grounded.objects[k] for k in kept)
    placed = tuple(placement.objects[k] for k in kept)
    return (
        replace(grounded, objects=tracks, warnings=(*grounded.warnings, *warnings)),
        replace(placement, objects=placed),
    )
