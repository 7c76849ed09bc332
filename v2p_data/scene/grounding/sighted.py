"""What a model that knows everyday things by sight says of a phrase (`frames/sightings.py`), where it was asked for.

Its boxes hold nearly every thing, but it knows few of them by name. `looks.tsv` says what a noun's things may look like to it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.scene.backends.nanodet import CLASSES, overlaps
from v2p_data.scene.frames.colour import balance, colour_match, named_colours
from v2p_data.scene.frames.mask_ops import bounding_box, from_box, inside_box
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.nouns import noun_for

LOOKS = Path(__file__).with_name("looks.tsv")
_LESS_EACH, _NO_NAME = 0.35, 0.3
"""A row's first class counts in full, the k-th less by one over 1 + 0.35 k; of a noun without a row the best class, whatever it is, as 0.3."""
_OTHER_COLOUR = 0.2
"""Added to the share of a box that has the named colour: colours of pictures are not sure."""
_UNSEEN, _LEAST_LIKE = 0.03, 0.02
"""Likeness of what no box is around; and of the likest thing in a picture, below which the model says nothing."""
_SAME_BOX, _MOST_SHARE = 0.5, 0.4
"""IoU of bounding boxes from which a box is that of an outline; share of the picture up to which a box is a thing."""


@dataclass(frozen=True, kw_only=True)
class Sighted:
    """The boxes in one picture, and how like the named thing each is."""

    xyxy: Float32[np.ndarray, "n 4"]
    """Working pixels."""
    likeness: Float[np.ndarray, "n"]

    def of(self, mask: Bool[np.ndarray, "h w"]) -> float:
        """Return how like the named thing an outline's thing is, beside the likest in the picture: 0 to 1."""
        x, y, w, h = bounding_box(mask)
        fits = overlaps(np.array([x, y, x + w, y + h], np.float32), self.xyxy)
        here = float((self.likeness * (fits >= _SAME_BOX)).max())
        return (here + _UNSEEN) / (float(self.likeness.max()) + _UNSEEN)

    def boxed(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        thing: Float32[np.ndarray, "h w"],
        most: int,
        least_thing: float = 0.0,
    ) -> list[Bool[np.ndarray, "h w"]]:
        """Return outlines in the likest boxes.

        Args:
            image: the picture.
            thing: how likely each pixel shows a thing of the kind that is searched.
            most: so many at most.
            least_thing: mean of `thing` in a box, below which it is left out.
        """
        boxes = [tuple(box) for box in self.xyxy[np.argsort(-self.likeness)].tolist()]
        insides = ((box, inside_box(box, thing.shape)) for box in boxes)
        found = (
            from_box(image, box, thing)
            for box, inside in insides
            if inside.any()
            and inside.mean() <= _MOST_SHARE
            and thing[inside].mean() >= least_thing
        )
        return list(islice(found, most))


def sighted(working: WorkingClip, i: int, phrase: str) -> Sighted | None:
    """Return the boxes in working frame `i` with how like the phrase's thing each is.

    None where no such model was asked for, or nothing in the picture is like that to it.
    """
    if working.sightings is None:
        return None
    seen = working.sightings.at(i)
    likeness = (seen.scores * _looks_of(phrase)).max(1)
    if words := named_colours(phrase):
        match = colour_match(balance(working.rgb[i]), words)
        insides = [inside_box(tuple(box), working.shape) for box in seen.xyxy.tolist()]
        share = [match[inside].sum() / max(1, inside.sum()) for inside in insides]
        likeness = likeness * (_OTHER_COLOUR + np.array(share))
    if likeness.max(initial=0.0) < _LEAST_LIKE:
        return None
    return Sighted(xyxy=seen.xyxy, likeness=likeness)


def not_known(working: WorkingClip, phrases: Sequence[str]) -> list[str]:
    """Return a warning for each phrase whose thing nothing is like at either end of the clip, where a model was asked."""
    return [
        f"nothing in the picture looks like '{phrase}' to the model that knows things by sight: motion and place alone decide"
        for phrase in phrases
        if working.sightings and not any(sighted(working, i, phrase) for i in (0, -1))
    ]


def known_by_sight(
    working: WorkingClip, phrase: str, masks: Mapping[int, Bool[np.ndarray, "h w"]]
) -> float | None:
    """Return how like the named thing the outlines in these working frames are, beside the likest things there: 0 to 1.

    None where no model was asked for.
    """
    told = [
        seen.of(mask)
        for i, mask in masks.items()
        if (seen := sighted(working, i, phrase)) is not None
    ]
    return float(np.prod(told)) ** (1 / len(told)) if told else None


def _looks_of(phrase: str) -> Float[np.ndarray, "80"]:
    """Return how much each class speaks for a phrase's noun, 0 to 1: of the longest end of the noun that has a row."""
    words, table = noun_for(phrase).word.split(), _table()
    ends = (" ".join(words[k:]) for k in range(len(words)))
    return next((table[end] for end in ends if end in table), np.full(len(CLASSES), _NO_NAME))


@cache
def _table() -> dict[str, Float[np.ndarray, "80"]]:
    rows = [[cell.split(",") for cell in x.split("\t")] for x in LOOKS.read_text().splitlines()]
    return {
        noun: np.array([1 / (1 + _LESS_EACH * looks.index(c)) if c in looks else 0.0 for c in CLASSES])
        for nouns, looks in rows[1:]
        for noun in nouns
    }  # fmt: skip
