"""How alike two tasks are: a model that writes a task is shown similar ones.

Likeness is counted in points, by what decides how the arm moves: the family of the kind (carrying, pushing,
tipping, throwing), the kind itself, the number of objects, and their shapes and sizes.
"""

import math

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import TaskBundle

FAMILY_POINTS = 4.0
KIND_POINTS = 2.0
COUNT_POINTS = 1.0
"""For the same number of objects: then their observations lie in the same places."""


def likeness(a: TaskBundle, b: TaskBundle) -> float:
    """Return how alike two tasks are, in points: 0 for nothing in common, about 9 for the same task."""
    points = FAMILY_POINTS * (KINDS[a.kind].family == KINDS[b.kind].family)
    points += KIND_POINTS * (a.kind == b.kind)
    points += COUNT_POINTS * (len(a.scene.objects) == len(b.scene.objects))
    return points + _alike(a.scene, b.scene)


def _alike(a: Scene, b: Scene) -> float:
    """Return the mean likeness of the scenes' objects in order, 0 to 2."""
    pairs = list(zip(a.objects, b.objects, strict=False))
    return sum(_alike_objects(x, y) for x, y in pairs) / max(len(a.objects), len(b.objects), 1)


def _alike_objects(a: SceneObject, b: SceneObject) -> float:
    """Return 1 for the same shape, and up to 1 for the same size."""
    apart = sum(abs(math.log(x / y)) for x, y in zip(a.size_m, b.size_m, strict=True)) / 3
    return float((a.shape, a.hollow) == (b.shape, b.hollow)) + math.exp(-apart)
