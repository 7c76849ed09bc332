"""What happens around the policy: rename, batch, move, normalise; and back for the action.

Only LeRobot's own steps, all of them stateless: lerobot-eval never resets processors, so the frame stack lives in
the policy. The task's words pass through untouched.
"""

from typing import Any

from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_pre_post_processors,
)

from policies.bc.configuration_v2p_bc import V2PBCConfig


def make_v2p_bc_pre_post_processors(
    config: V2PBCConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return the pipelines before and after the policy. LeRobot finds this function by its name."""
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
