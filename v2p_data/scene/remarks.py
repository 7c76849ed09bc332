"""Sentences for a person about what a scene assumes: they are written with it as warnings."""

import numpy as np

from v2p_data.kinds import Kind
from v2p_data.scene.data_types import GroundedObjects, Placement

_CLOSE_RIVAL = 0.02
"""IoU: where the next best face down covers the outlines no worse than this, the choice was as good as drawn by lot."""


def remarks_on(
    kind: Kind, grounded: GroundedObjects, placement: Placement, num_frames: int
) -> list[str]:
    """Return what is assumed or hardly seen: scale, unknown nouns, close rivals, hidden ends, two people, lifts."""
    spread = placement.scale_spread
    out = [
        "scale comes from usual sizes and from what the network makes of the picture: "
        f"all lengths may be off by {spread:.0%} together"
    ]
    out += [
        f"'{s.phrase}' is no known noun; its size is a guess"
        for s in grounded.objects
        if not s.noun.known
    ]
    out += [
        f"outlines hardly tell how '{s.phrase}' lies: the next best way covers them {placed.rival:.3f} worse"
        for s, placed in zip(grounded.objects, placement.objects, strict=True)
        if placed.rival is not None and placed.rival < _CLOSE_RIVAL
    ]
    thing = placement.objects[0]
    if thing.unseen:
        phrase, goal = (s.phrase for s in grounded.objects[:2])
        out.append(
            f"nothing shows where '{phrase}' ends: it is taken to lie in the middle of '{goal}'"
        )
    if grounded.objects[0].brought:
        way_m = placement.height_m * (thing.T_world_objs[-1] - thing.T_world_objs[0])[:2, 3]
        out.append(
            f"a hand brings '{grounded.objects[0].phrase}': nothing shows it on the table at "
            "first; its first pose is a place that was chosen, "
            f"{100 * np.linalg.norm(way_m):.0f} cm from where it ends"
        )
    last_frame = int(grounded.working.frame_idx[thing.last_i])
    if kind == "lift_up":
        out.append("one view shows no depth in mid-air: the lift is taken to go straight up")
        if thing.hidden_in_hand:
            out.append("the hand hides what it lifts: it is taken to go with the hand")
        if last_frame < num_frames - 1:
            out.append(f"the lift is highest at frame {last_frame}; what comes after is left out")
    return out
