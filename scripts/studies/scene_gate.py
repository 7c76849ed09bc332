"""What the default settings say of a scene that was rebuilt without any gate."""

from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import Reconstruction


def gate(made: Reconstruction) -> str:
    """Return the slug of the rejection by the default settings; empty where they accept the scene."""
    cfg = SceneConfig()
    if made.least_found < cfg.min_found:
        return "object_not_found"
    if made.contradiction is not None:
        return "motion_contradicts_caption"
    return "" if made.confidence >= cfg.min_confidence else "low_confidence"
