"""A detector's boxes for the caption's phrases, at either end of the clip."""

from collections.abc import Sequence

from v2p_data.scene.backends.config import GroundConfig
from v2p_data.scene.grounding.methods.base import Mark, Method, Seen, mark_in_box


class Detector(Method):
    """The detector that the settings name."""

    def __init__(self, cfg: GroundConfig) -> None:
        self._cfg = cfg

    def marks(self, seen: Seen, phrases: Sequence[str]) -> dict[str, Mark]:
        """Return each phrase's best box in the first frame, or in the last where only that shows it."""
        from v2p_data.scene.backends.detect import detect  # imports transformers

        clip, working = seen.clip, seen.working
        ends = [int(working.frame_idx[0]), int(working.frame_idx[-1])]
        by_picture = detect([clip.frames[i] for i in ends], phrases, self._cfg)
        marks: dict[str, Mark] = {}
        for frame, by_phrase in zip(ends, by_picture, strict=True):
            for phrase, found in zip(phrases, by_phrase, strict=True):
                if found and phrase not in marks:
                    best = found[0]
                    marks[phrase] = mark_in_box(seen, frame, best.box_xyxy, best.score)
        return marks
