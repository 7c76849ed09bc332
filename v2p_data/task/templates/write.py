"""Task codes for a scene: the eight samples, or one."""

from v2p_data.scene.scene import Scene
from v2p_data.task.templates.draft import Measured
from v2p_data.task.templates.recipes import draft_of
from v2p_data.task.templates.six_parts import task_text
from v2p_data.task.templates.variants import NUM_VARIANTS, VARIANTS, Variant


def write_samples(scene: Scene, count: int = NUM_VARIANTS) -> list[str]:
    """Return `count` task codes for the scene, the one that trained best so far first."""
    return [write_task(scene, VARIANTS[i % NUM_VARIANTS]) for i in range(count)]


def write_task(scene: Scene, variant: Variant) -> str:
    """Return one task code."""
    measured = Measured.of(scene)
    return task_text(scene, measured, variant, draft_of(measured, variant))
