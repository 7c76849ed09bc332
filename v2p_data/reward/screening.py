"""Rewards that are not worth training are found before anything is trained: on stored trajectories, or on states that are tried."""

from collections.abc import Sequence

import numpy as np

from v2p_data.reward.candidate import Fault
from v2p_data.reward.drafts import Draft
from v2p_data.reward.prescreen import PrescreenConfig, prescreen, stored_moments
from v2p_data.reward.trajectories import Trajectories
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for
from v2p_data.task.audit.rewards import reward_fault
from v2p_data.task.sandbox.probes import random_states
from v2p_data.task.sandbox.smoke import smoke_run_all

PROBES = 64
"""States on which first rewards are asked, for none are stored yet."""


def screened(
    drafts: Sequence[Draft], scene: Scene, stored: Sequence[Trajectories], seed: int
) -> list[Fault | None]:
    """Return per draft why it is not worth training, or None.

    Args:
        drafts: the rewards of a round.
        scene: the task's.
        stored: what the best policies so far did, successes and failures.
        seed: of the states on which rewards are tried where nothing is stored.
    """
    if not drafts:
        return []
    if stored_moments(stored, PrescreenConfig()) is None:
        return _refused(drafts, scene, seed)
    faults: list[Fault | None] = []
    for draft, verdict in zip(
        drafts, prescreen([d.code for d in drafts], scene, stored), strict=True
    ):
        if verdict.accepted:
            faults.append(None)
        elif draft.origin == "model" and verdict.reason == "not_runnable":
            faults.append(Fault(kind="refused", reason=verdict.detail))
        else:
            reason = f"{verdict.reason}: {verdict.detail}"
            faults.append(Fault(kind="prescreened", reason=reason))
    return faults


def _refused(drafts: Sequence[Draft], scene: Scene, seed: int) -> list[Fault | None]:
    """Return per draft why it cannot be learned from, or None; on stored states the pre-screen finds that out."""
    # Templates are ours, and what `reflect` gives has run already.
    unknown = [d.code for d in drafts if d.origin in ("model", "given")]
    probes = random_states(scene, PROBES, rng_for(seed, "probes"))
    results = iter(smoke_run_all(unknown, scene, probes=probes))
    faults: list[Fault | None] = []
    for draft in drafts:
        if draft.code not in unknown:
            faults.append(None)
            continue
        result = next(results)
        if not result.runnable:
            faults.append(Fault(kind="refused", reason=result.error))
            continue
        found = reward_fault(np.array(result.probe_reward), "states that were tried")
        words = found and f"{found.reason}: it {found.words}"
        faults.append(None if words is None else Fault(kind="prescreened", reason=words))
    return faults
