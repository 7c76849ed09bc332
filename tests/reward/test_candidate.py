"""What one candidate leaves behind, and what each method starts from."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from policies.ppo.train import NotFiniteError
from v2p_data.errors import V2PError
from v2p_data.reward.candidate import Candidate, Evaluation, Fault, Training, load_candidates
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.methods import load_candidate, prepare, reward_text, save_bundle
from v2p_data.reward.worker import closeness, fault_of
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.sandbox.splice import rest_part, reward_part
from v2p_data.task.task import TaskBundle


@pytest.fixture(scope="module")
def bundle() -> TaskBundle:
    return load_benchmark("lift_up")


def entry(success: float, **more: float) -> dict[str, float]:
    return {"success": success, "ever": success, "closeness": 0, "touched": 0, "control_steps": 10, **more}  # fmt: skip


def training(folder: Path, entries: object, done: object = None, fault: object = None) -> Training:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in (("evaluations", entries), ("done", done), ("fault", fault)):
        if data is not None:
            (folder / f"{name}.json").write_text(json.dumps(data))
    return Training.load(folder)


# --- results -------------------------------------------------------------------------------------------------


def test_success_is_the_mean_of_the_last_evaluations_not_the_best_one(tmp_path: Path):
    made = training(tmp_path, [entry(s) for s in (0.0, 0.9, 0.2, 0.4, 0.6)], {"mark": 5})

    assert made.success(3) == pytest.approx(0.4)
    assert made.success(3, mark=2) == pytest.approx(0.45)


def test_where_nobody_succeeds_who_is_on_the_way_ranks_first_but_never_above_a_success():
    idle = Evaluation.of(entry(0.0))
    on_its_way = Evaluation.of(entry(0.0, closeness=0.5, touched=1.0))
    succeeds = Evaluation.of(entry(0.12))

    assert idle.rank < on_its_way.rank < succeeds.rank


def test_of_rewards_that_succeed_alike_the_one_that_pays_successes_more_than_failures_ranks_first():
    pays_failures = Evaluation.of(entry(0.50, ranking=0.1))
    pays_successes = Evaluation.of(entry(0.48, ranking=0.9))
    succeeds_more = Evaluation.of(entry(0.62, ranking=0.1))
    fails = Evaluation.of(entry(0.0, ranking=None))
    succeeds_once = Evaluation.of(entry(1 / 64, ranking=0.0))
    always = Evaluation.of(entry(1.0, ranking=None))

    assert pays_failures.success > pays_successes.success
    assert pays_failures.rank < pays_successes.rank < succeeds_more.rank
    assert fails.rank < succeeds_once.rank
    assert always.rank > Evaluation.of(entry(0.98, ranking=1.0)).rank


@pytest.mark.parametrize(
    "entries",
    [
        [entry(float("nan"))],
        [entry(0.5, ranking=float("nan"))],
        [entry(1.5)],
        [{"success": "all"}],
        {"success": 1.0},
        [["a"]],
        "x" * 100,
    ],
)
def test_whatever_a_process_wrote_instead_of_results_is_its_own_failure(tmp_path: Path, entries):
    made = training(tmp_path, entries, {"mark": 1})

    assert made.fault is not None
    assert made.fault.kind == "crashed"


def test_a_process_cannot_claim_more_than_it_has(tmp_path: Path):
    assert training(tmp_path, [entry(1.0)], {"mark": 99}).done == 1


def test_an_invented_reason_counts_as_a_crash(tmp_path: Path):
    made = training(tmp_path, [], fault={"kind": "victory", "reason": "trust me"})

    assert made.fault == Fault(kind="crashed", reason="its process left no readable reason")


def test_a_candidate_is_read_back_as_it_was_written(tmp_path: Path):
    folder = tmp_path / "candidates" / "003"
    made = Candidate(
        folder=folder, number=3, iteration=1, code="x = 1\n", parent=0, origin="reflection",
        reasons=("it was flat",),
    )  # fmt: skip

    made.save()

    assert load_candidates(tmp_path) == [made]
    assert made.training().evaluations == ()


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (NotFiniteError("'reward' of world 3 is not finite"), "not_finite"),
        (V2PError("the reward of task 't' is nan in world 0"), "not_finite"),
        (MemoryError(), "out_of_memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out_of_memory"),
        (KeyError("cup_pos"), "error"),
    ],
)
def test_a_failure_is_named_by_its_kind(error: Exception, kind: str):
    assert fault_of(error).kind == kind


def test_closeness_is_how_much_of_the_videos_way_was_gone(bundle: TaskBundle):
    moved = np.array([[0, 0, 0], [0, 0, 0.08], [0, 0, 0.16], [0, 0, -0.2], [0.5, 0, 0.16]])

    found = closeness(moved, bundle.scene.manipulated)  # the video lifts it by 0.16 m

    np.testing.assert_allclose(found, [0, 0.5, 1, 0, 0], atol=1e-6)


# --- costs ---------------------------------------------------------------------------------------------------


def test_five_rounds_of_eight_cost_less_than_a_third_of_training_all_to_the_end():
    cfg = RewardConfig(iterations=5)

    # A round: 8 to 0.1, 4 on to 0.2, 2 on to 0.4, 1 to the end; then two more seeds of the choice.
    by_hand = 5 * (8 * 0.1 + 4 * 0.1 + 2 * 0.2 + 1 * 0.6) + 2
    assert cfg.steps_at_most() == pytest.approx(by_hand * cfg.steps)
    assert cfg.steps_at_most() / cfg.steps_without_halving() < 1 / 3


@pytest.mark.parametrize("rungs", [(), (0.5,), (0.3, 1.0), (0.5, 0.25, 1.0), (0.0, 1.0)])
def test_rungs_that_lead_nowhere_are_refused(rungs: tuple[float, ...]):
    with pytest.raises(ValueError, match="rungs must rise"):
        RewardConfig(rungs=rungs)


# --- methods -------------------------------------------------------------------------------------------------


def prepared(bundle: TaskBundle, cfg: RewardConfig):
    return prepare(bundle, cfg, np.random.default_rng(0))


def with_motion(bundle: TaskBundle, height_m: float) -> TaskBundle:
    """The same task from a video that lifts the object by another height."""
    obj = bundle.scene.manipulated
    first, last = np.array(obj.poses_world[0]), np.array(obj.poses_world[-1])
    last[2] = first[2] + height_m
    moved = replace(obj, poses_world=(tuple(first.tolist()), tuple(last.tolist())), frames=(0, 1))
    return replace(bundle, scene=replace(bundle.scene, objects=(moved,)))


def test_the_first_round_has_eight_different_rewards_over_the_audited_success(bundle: TaskBundle):
    made = prepared(bundle, RewardConfig())

    assert len({reward_part(code) for code in made.codes}) == 8
    assert {rest_part(code) for code in made.codes} == {rest_part(bundle.code)}
    assert made.codes[0] == bundle.code


@pytest.mark.parametrize("cfg", [RewardConfig(method="eureka"), RewardConfig(without=("visual",))])
def test_without_the_video_nothing_depends_on_its_motion(bundle: TaskBundle, cfg: RewardConfig):
    low, high = with_motion(bundle, 0.08), with_motion(bundle, 0.3)

    assert prepared(low, cfg).codes == prepared(high, cfg).codes
    assert prepared(low, cfg).bundle.scene == low.scene  # what is simulated stays


def test_without_tracking_sizes_are_still_known(bundle: TaskBundle):
    seen = prepared(bundle, RewardConfig(without=("tracking",))).seen

    assert seen.manipulated.size_m == bundle.scene.manipulated.size_m
    assert len(seen.manipulated.poses_world) == 1


def test_robogen_trains_one_reward_once_and_without_a_bonus_for_success(bundle: TaskBundle):
    cfg = RewardConfig(method="robogen", iterations=5)

    assert (cfg.num_iterations, cfg.num_candidates, cfg.paid_bonus_ratio) == (1, 1, 0.0)
    assert len(prepared(bundle, cfg).codes) == 1


def test_the_switches_take_rounds_and_samples_away():
    assert RewardConfig(iterations=5, without=("iteration",)).num_iterations == 1
    assert RewardConfig(iterations=5, without=("samples",)).num_candidates == 1


def test_without_the_pick_success_is_that_of_any_sample(bundle: TaskBundle):
    cfg = RewardConfig(without=("pick",))

    made = {
        rest_part(prepare(bundle, cfg, np.random.default_rng(k)).bundle.code) for k in range(6)
    }

    assert len(made) > 1


def test_a_scene_that_never_lay_on_disk_is_saved_whole(bundle: TaskBundle, tmp_path: Path):
    save_bundle(bundle, tmp_path / "bundle")
    code = tmp_path / "code.py"
    code.write_text(prepared(bundle, RewardConfig()).codes[3])

    loaded = load_candidate(tmp_path / "bundle", code)

    assert loaded.scene.objects == bundle.scene.objects
    assert reward_text(loaded.code) != reward_text(bundle.code)
    assert not (tmp_path / "bundle.partial").exists()


class SilentWriter:
    """A model that must not be asked."""

    def task_code(self, bundle: TaskBundle) -> str:
        raise AssertionError("asked for another success")

    first_rewards = better_rewards = task_code


def test_a_search_that_goes_on_keeps_the_success_that_it_began_with(bundle: TaskBundle):
    made = replace(bundle, code=bundle.code + "\n# as it was made\n")

    prepared = prepare(
        bundle, RewardConfig(method="eureka"), np.random.default_rng(0), SilentWriter(), made
    )

    assert prepared.codes == (made.code,)
    assert prepared.bundle.code == made.code
