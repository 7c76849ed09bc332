"""The objects of a clip, searched in its mirror image.

A network sees a mirrored clip a little differently, and so does everything that is built on it,
though the scene is the same.
Where the first search is not sure, a second one in the mirror image often is (test-time
augmentation). Only pixels are mirrored:
what was found is turned back before anything is measured.
"""

from dataclasses import replace

import numpy as np

from v2p_data.kinds import Kind
from v2p_data.scene.data_types import GroundedObjects
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.scene.frames.segmentation import Segmentation, segment_clip
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip
from v2p_data.video.meaning import Meaning

_PLACES = ("box", "points", "click", "stroke")
_OTHER_WAY: dict[Kind, Kind] = {"push_left": "push_right", "push_right": "push_left"}


def has_marks(clip: Clip) -> bool:
    """Return whether somebody marked where something is: then nothing needs to be searched twice."""
    return any(place in hint for hint in clip.hints.values() for place in _PLACES)


def mirrored_clip(prepared: PreparedClip) -> PreparedClip:
    """Return the mirror image of a clip without marks, and what the network sees in it.

    A model of outlines is not carried over: it would show its frames as they were filmed.
    """
    clip = replace(prepared.clip, frames=prepared.clip.frames[:, :, ::-1])
    working = _mirrored_working(prepared.working)
    return PreparedClip(clip=clip, working=working, segmentation=segment_clip(clip, working))


def mirrored_meaning(meaning: Meaning) -> Meaning:
    """Return what the caption asks for in the mirror image."""
    return replace(meaning, kind=_OTHER_WAY.get(meaning.kind, meaning.kind))


def as_filmed(grounded: GroundedObjects, working: WorkingClip) -> GroundedObjects:
    """Return what was found in the mirror image, as it is in the clip.

    Args:
        grounded: masks, table and probabilities of the mirror image.
        working: of the clip as it was filmed.
    """
    there = grounded.working
    return replace(
        grounded,
        objects=tuple(replace(one, masks=_mirrored(one.masks)) for one in grounded.objects),
        working=replace(working, hand_hist=there.hand_hist, rest_hist=there.rest_hist),
        table=_mirrored_table(grounded.table),
        segmentation=_mirrored_segmentation(grounded.segmentation),
    )


def _mirrored[T: np.generic](planes: "np.ndarray[tuple[int, ...], np.dtype[T]]"):  # noqa: ANN202
    """Return planes whose last axis runs from left to right, mirrored."""
    return np.ascontiguousarray(planes[..., ::-1])


def _mirrored_pictures[T: np.generic](pictures: "np.ndarray[tuple[int, ...], np.dtype[T]]"):  # noqa: ANN202
    """Return pictures whose last axis is the colour, mirrored."""
    return np.ascontiguousarray(pictures[..., ::-1, :])


def _mirrored_working(working: WorkingClip) -> WorkingClip:
    return replace(
        working,
        rgb=_mirrored_pictures(working.rgb),
        lab=_mirrored_pictures(working.lab),
        early=_mirrored_pictures(working.early),
        late=_mirrored_pictures(working.late),
        always=_mirrored_pictures(working.always),
        outliner=None,
    )


def _mirrored_table(table: Table) -> Table:
    return replace(
        table,
        seen=_mirrored(table.seen),
        hull=_mirrored(table.hull),
        lab=_mirrored_pictures(table.lab),
    )


def _mirrored_segmentation(segmentation: Segmentation) -> Segmentation:
    return replace(
        segmentation,
        shares=_mirrored(segmentation.shares),
        early=_mirrored(segmentation.early),
        late=_mirrored(segmentation.late),
    )
