"""A policy judged on one task in the training simulator or in the twin: the entries of a result line that both have."""

from pathlib import Path

from v2p_data.deployment.view import allowing_for_place
from v2p_data.evaluation.batch import judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import contestant, play_of
from v2p_data.task.task import TaskBundle
from v2p_data.twin.judge import TwinSetup, judge_in_twin
from v2p_data.twin.parameters import nominal

from .results import Row, letters_of

AS_DEPLOYED = TwinSetup(look=allowing_for_place, waits=True)
"""The nominal twin through all of `v2p deploy`."""


def in_training(
    policy: Path,
    task: Path,
    seeds: range,
    *,
    at_end: bool,
    device: str = "cpu",
    num_threads: int = 1,
) -> Row:
    """Return what became of each episode in the training simulator with its ordinary randomisation."""
    bundle = TaskBundle.load(task)
    actor, size_px = play_of(contestant(policy), seeds.start, device)(bundle)
    judged = judge(
        bundle,
        actor,
        first_seed=seeds.start,
        cfg=EvaluationConfig(episodes=len(seeds), at_end=at_end),
        num_threads=num_threads,
        size_px=size_px,
    )
    row: Row = {"once": letters_of(judged.successes), "failures": judged.failure_counts()}
    return row if judged.at_end is None else row | {"at_end": letters_of(judged.at_end)}


def in_twin(
    policy: Path,
    task: Path,
    seeds: range,
    *,
    at_end: bool,
    device: str = "cpu",
    setup: TwinSetup = AS_DEPLOYED,
) -> Row:
    """Return what became of each episode in the twin, by default the nominal one through all of `v2p deploy`."""
    judged = judge_in_twin(
        task,
        play_of(contestant(policy), seeds.start, device),
        seeds=seeds,
        cfg=EvaluationConfig(episodes=len(seeds), at_end=at_end),
        setup=setup,
    )
    row: Row = {"once": letters_of(judged.successes), "failures": judged.failure_counts()}
    row["twin"] = (setup.parameters or nominal()).digest()[:12]
    return row | {"at_end": letters_of(judged.at_end)} if at_end else row
