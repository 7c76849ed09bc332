"""The settings that a run's scenes were made with, read back from their records: a scene made anew should differ by its hints alone."""

from collections.abc import Iterable

from v2p_data.errors import V2PError
from v2p_data.pipeline.settings import from_values
from v2p_data.report.reading import Result
from v2p_data.scene.config import SceneConfig
from v2p_data.stages import EngineConfig
from v2p_data.video.decode import VideoConfig


def settings_of(result: Result | None) -> EngineConfig | None:
    """Return the settings that a scene was made with; None where they are not known to this version."""
    recipe = result.record.recipe.get("config") if result is not None and result.record else None
    if not isinstance(recipe, dict):
        return None
    try:
        return EngineConfig(
            video=from_values(VideoConfig, recipe.get("video"), "the record's video"),
            scene=from_values(SceneConfig, recipe.get("scene"), "the record's scene"),
            seed=int(recipe.get("seed", 0)),
        )
    except (V2PError, TypeError, ValueError):
        return None


def usual_settings(results: Iterable[Result]) -> EngineConfig:
    """Return the settings of the run's newest scene, the usual ones where there is none."""
    dated = [
        (str((r.record.provenance or {}).get("time", "")), cfg)
        for r in results
        if r.record is not None and (cfg := settings_of(r)) is not None
    ]
    return max(dated, key=lambda pair: pair[0])[1] if dated else EngineConfig()
