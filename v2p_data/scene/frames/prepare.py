"""What a reconstruction needs of a clip before it asks which pixels are which object: nothing here depends on hints."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from v2p_data.scene.frames.checks import check_change, check_still
from v2p_data.scene.frames.crop import with_named_part
from v2p_data.scene.frames.footage import check_cuts, without_bars
from v2p_data.scene.frames.segmentation import Segmentation, segment_clip
from v2p_data.scene.frames.stabilise import hint_in_aligned, stabilised
from v2p_data.scene.frames.working_clip import WorkingClip, working_clip_of
from v2p_data.video.clip import Clip, Hint
from v2p_data.video.hints import CROP, check_hints, hints_in_clip, hints_in_crop


@dataclass(frozen=True, kw_only=True)
class PreparedClip:
    """A clip whose camera stands still, with its working frames and what the network sees in them."""

    clip: Clip
    """Aligned, where the camera swayed."""
    working: WorkingClip
    segmentation: Segmentation

    def with_hints(self, hints: Mapping[str, Hint]) -> "PreparedClip":
        """Return the same with these hints, given in the file's pixels and frames, in place of the clip's own.

        Raises:
            V2PError: a mark lies outside of the picture, or in a frame that there is not.
        """
        clip = self.clip
        name = clip.path.name
        hints = {p: h for p, h in hints.items() if p != CROP or CROP in clip.objects}
        check_hints(hints, clip.source_size_px, clip.total_frames, name)
        size_px = clip.width_px, clip.height_px
        decoded_px = size_px if clip.crop is None else clip.crop.full_px
        own = hints_in_clip(hints, decoded_px, clip.source_size_px, clip.source_frame)
        if clip.crop is not None:
            own = hints_in_crop(own, clip.crop, clip.in_file_px, name)
        if clip.to_filmed is not None:
            own = {
                phrase: hint_in_aligned(hint, clip.to_filmed, size_px)
                for phrase, hint in own.items()
            }
        return replace(self, clip=replace(clip, hints=own))


def prepare(clip: Clip, *, max_camera_shift_px: float) -> PreparedClip:
    """Return the clip ready to be searched, with its working frames and what the network sees.

    The part of the pictures that a person named is taken. Black bars are cut off, and frames
    aligned where the camera sways. `max_camera_shift_px` is of a picture 320 px wide.

    Raises:
        ItemRejectedError: `bad_hint`, `nothing_moves`, `cut` or `camera_moves`, with the number that decided.
    """
    clip = without_bars(with_named_part(clip))
    working = working_clip_of(clip)
    check_change(working)
    check_cuts(clip, working)
    steady = stabilised(clip, working)
    if steady is not clip:
        clip, working = steady, working_clip_of(steady)
    segmentation = segment_clip(clip, working)
    check_still(working, segmentation, max_camera_shift_px)
    return PreparedClip(clip=clip, working=working, segmentation=segmentation)
