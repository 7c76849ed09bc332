"""A noun with two usual forms gets the one that its outline and size fit: bins are round or square, lids are of jars or of pots."""

from dataclasses import replace

import numpy as np

from v2p_data.kinds import Kind
from v2p_data.scene.data_types import CameraGuess, Fit, ObjectTrack
from v2p_data.scene.fitting.end_poses import is_lid
from v2p_data.scene.fitting.object_view import other_objects
from v2p_data.scene.fitting.plans import plan_of
from v2p_data.scene.fitting.shape_fit import fit_shape
from v2p_data.scene.fitting.silhouette import Silhouette, camera_above
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.nouns import Noun

_OTHER_FORM_COST = 0.02
"""By so much a noun's second form must cover an outline better where it alone is a box: that has a side and a turn more to choose than a cylinder."""
_SIZE_TELLS, _MOST_OFF = 0.01, 3.0
"""Of a form whose size is one standard deviation off, in units of IoU, and from where on it counts no more."""
_COVERED_TELLS = 0.02
"""The same of a lid that is not as wide as what it covers: no jar's lid lies on a pot."""


def with_noun_variants(
    working: WorkingClip, objects: tuple[ObjectTrack, ...], guess: CameraGuess, kind: Kind
) -> tuple[ObjectTrack, ...]:
    """Return the object tracks with their nouns in the form that their outlines fit, where a noun has two; a lid is about as wide as what it covers."""
    beneath = objects[1].noun if plan_of(kind).covers and len(objects) > 1 else None
    camera = camera_above(working.shape, guess.pitch_rad, guess.fov_rad)
    out = []
    for k, s in enumerate(objects):
        if s.noun.variant is not None:
            unknown = other_objects(objects, s, s.at)
            silhouette = Silhouette(s.first, unknown, camera)
            under = beneath if k == 0 and is_lid(s.noun) else None
            usual, other = (
                _cost_of(fit_shape(silhouette, noun, np.eye(3)), noun, guess, under)
                for noun in (s.noun, s.noun.variant)
            )
            freer = _OTHER_FORM_COST if s.noun.variant.form == "box" != s.noun.form else 0.0
            s = replace(s, noun=s.noun.variant if other + freer < usual else s.noun)
        out.append(s)
    return tuple(out)


def _cost_of(fit: Fit, noun: Noun, guess: CameraGuess, beneath: Noun | None) -> float:
    """Return what a fit costs as one of a noun's two forms: jar lids and pot lids are alike but for their size.

    `beneath` is the round thing that a lid covers.
    """
    sizes = np.log(np.array(fit.size) / np.array(noun.size_m)).mean()
    offs = [
        (sizes + np.log(height_m)) / np.hypot(noun.spread, sd)
        for height_m, sd in guess.heights(guess.pitch_rad)
    ]
    size_cost = _SIZE_TELLS * float(np.square(np.clip(offs, -_MOST_OFF, _MOST_OFF)).sum())
    if beneath is not None and beneath.form == "cylinder":
        wider = np.log(noun.size_m[0] / beneath.size_m[0]) / np.hypot(noun.spread, beneath.spread)
        size_cost += _COVERED_TELLS * float(np.clip(wider, -_MOST_OFF, _MOST_OFF)) ** 2
    return fit.cost + size_cost
