"""Which recipe a kind of task has, and the one for all others: as far from the start as in the video."""

from collections.abc import Callable

import numpy as np

from v2p_data.kinds import KINDS, Kind, check_every_kind
from v2p_data.task.templates import carrying, pushing
from v2p_data.task.templates.draft import Draft, Measured
from v2p_data.task.templates.phrases import (
    grasp_setup,
    is_still,
    push_point_setup,
    shifted,
    stands,
)
from v2p_data.task.templates.variants import Variant, tolerance

Recipe = Callable[[Measured, Variant], Draft]


def draft_of(measured: Measured, variant: Variant) -> Draft:
    """Return the task in expressions.

    A kind that needs a second object follows the tracked motion where there is none.
    """
    lacks_other = KINDS[measured.kind].other == "needed" and measured.ref is None
    recipe = _generic if lacks_other else RECIPES[measured.kind]
    return recipe(measured, variant)


def _generic(m: Measured, v: Variant) -> Draft:
    """The object must come as far from its start as it did in the video."""
    move = np.array(m.move_m)
    distance = float(np.linalg.norm(move))
    wanted = float(np.clip(distance, 0.08, 0.25))
    move = move / distance * wanted if distance > 0.02 else np.array([0.0, 0.0, 0.1])
    lifts = move[2] > 0.05
    if not lifts:
        move[2] = 0.0
    x, y, z = (round(float(c), 3) for c in move)
    success = [
        ("is_there", f"remaining < {tolerance(float(np.clip(0.4 * wanted, 0.04, 0.08)), v)}"),
        (
            "is_on_its_way",
            f"((obj_pos - obj_start) * goal_direction).sum(dim=-1) > {0.5 * wanted:.3f}",
        ),
        *(stands(v, is_asked=False) if m.stood else []),
        is_still(v),
    ]
    if lifts and v.holds != "any":
        success.insert(1, ("is_held", "obj_grasped > 0.5"))
    return Draft(
        thoughts=["Reach the object.", "Move it as in the video.", "Keep it there."],
        setup=[
            f"goal_point = {shifted('obj_start', x=x, y=y, z=z)}",
            "goal_direction = "
            f"torch.nn.functional.normalize({shifted('torch.zeros_like(obj_pos)', x=x, y=y, z=z)}, dim=-1)",
            "remaining = torch.norm(goal_point - obj_pos, dim=-1)",
        ],
        success=success,
        reward_setup=grasp_setup(by_wall=m.by_wall)
        if lifts
        else push_point_setup(clearance_m=0.02),
        target="grasp_point" if lifts else "push_point",
        contact="gripped * near" if lifts else "near",
        pays_contact=bool(lifts),
        progress=f"(1 - remaining / {wanted:.3f}).clamp(-1.0, 1.0)",
        remaining="remaining",
        goal="goal_point",
    )


RECIPES: dict[Kind, Recipe] = {
    "lift_up": carrying.lift,
    "push_left": pushing.push,
    "push_right": pushing.push,
    "tip_over": pushing.tip_over,
    "push_next_to": pushing.push_next_to,
    "slide_to": pushing.push_next_to,
    "insert": carrying.insert,
    "place_onto": carrying.place_onto,
    "drop_in_front_of": carrying.drop_in_front_of,
    "cover": carrying.cover,
    "uncover": carrying.uncover,
    "throw_into": carrying.throw_into,
    "push_with": pushing.push_with,
    "generic": _generic,
}
"""Which recipe writes the code of each kind."""

check_every_kind(RECIPES, "template", "RECIPES in v2p_data/task/templates/recipes.py")
