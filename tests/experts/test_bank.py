from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from v2p_data.errors import V2PError
from v2p_data.experts.bank import UNKNOWN, Bank, BankConfig, Starts, record_bank, use_bank
from v2p_data.sim import randomize
from v2p_data.sim.batch_env import HELD_STEPS, BatchEnv, SimConfig, without_randomization
from v2p_data.task.task import Task, TaskBundle

QUIET = SimConfig(randomization=replace(randomize.training(), action_noise=0.0))
"""Everything varies from world to world, but actions are carried out as they are."""
OPEN = BankConfig(share=1.0, num_plain=0)


@pytest.fixture
def make_env(
    make_bundle: Callable[..., TaskBundle], lift_task: type[Task]
) -> Callable[..., BatchEnv]:
    def make(
        *,
        cfg: SimConfig = QUIET,
        num_envs: int = 8,
        seed: int = 0,
        horizon: int = 60,
        task: type[Task] = lift_task,
    ) -> BatchEnv:
        return BatchEnv(
            make_bundle(horizon=horizon),
            cfg,
            num_envs=num_envs,
            seed=seed,
            num_threads=1,
            task=task,
        )

    return make


def lifting(env: BatchEnv) -> Callable[[], np.ndarray]:
    """Return who drives the gripper over the object, down, shut and up, by the time that has passed."""

    def act() -> np.ndarray:
        states = env.states()
        step = states["progress"].numpy() * env.horizon
        error = (states["cube_pos"] - states["eef_pos"]).numpy()
        action = np.zeros((env.num_envs, 7))
        action[:, :2] = error[:, :2] / 0.03
        action[:, 2] = np.where(step < 10, 0.0, error[:, 2] / 0.03)
        action[:, 2] = np.where(step < 35, action[:, 2], 0.5)
        action[:, 6] = np.where(step < 25, 0.0, 1.0)
        return action

    return act


def idle(env: BatchEnv) -> Callable[[], np.ndarray]:
    return lambda: np.zeros((env.num_envs, 7))


def fingerprint_of(env: BatchEnv, world: int) -> bytes:
    rows = env.rows(np.array([world]))
    obs = env.observe()[world]
    return b"".join(rows[name].tobytes() for name in sorted(rows)) + obs.tobytes()


def fake_bank(count: int) -> Bank:
    return Bank(rows={"number": np.arange(count)}, steps_left=np.arange(count))


def test_a_restored_world_goes_on_exactly_as_the_saved_one(make_env: Callable[..., BatchEnv]):
    saved, other = make_env(seed=1), make_env(seed=2, num_envs=5)
    act = lifting(saved)
    for _ in range(33):
        saved.step(act())
    rows = saved.rows(np.arange(8))
    assert saved.states()["cube_touched"].any()
    for _ in range(7):
        other.step(np.full((5, 7), 0.3))

    # World 6 of one environment goes on as worlds 1 and 4 of another, world 2 as world 3.
    other.restore(np.array([1, 3, 4]), {name: row[[6, 2, 6]] for name, row in rows.items()})

    pairs = [(6, 1), (2, 3), (6, 4)]
    rng = np.random.default_rng(0)
    for _ in range(25):
        for a, b in pairs:
            assert fingerprint_of(saved, a) == fingerprint_of(other, b)
        actions = rng.uniform(-1, 1, (8, 7))
        theirs = rng.uniform(-1, 1, (5, 7))
        for a, b in pairs:
            theirs[b] = actions[a]
        mine, result = saved.step(actions), other.step(theirs)
        for a, b in pairs:
            assert mine.obs[a].tobytes() == result.obs[b].tobytes()
            assert mine.reward[a] == result.reward[b]
            assert mine.held[a] == result.held[b]
            assert mine.truncated[a] == result.truncated[b]


def test_restoring_some_worlds_leaves_the_others_alone(make_env: Callable[..., BatchEnv]):
    env = make_env()
    for _ in range(10):
        env.step(np.full((8, 7), 0.2))
    before = [fingerprint_of(env, k) for k in range(8)]

    env.restore(np.array([3]), env.rows(np.array([5])))

    after = [fingerprint_of(env, k) for k in range(8)]
    assert after[3] == before[5]
    assert after[:3] + after[4:] == before[:3] + before[4:]


def test_a_bank_of_a_task_that_succeeds_knows_how_many_steps_are_left(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(num_envs=16)

    bank = record_bank(env, lifting(env), every_steps=3)

    assert bank.is_solved
    assert (np.diff(bank.steps_left) >= 0).all()
    # Played on, each of them succeeds after just as many steps, and not before.
    count = min(len(bank), 64)
    some = np.linspace(0, len(bank) - 1, count).astype(int)
    again = make_env(num_envs=count, seed=9)
    again.restore(np.arange(count), {name: rows[some] for name, rows in bank.rows.items()})
    act = lifting(again)
    first = np.zeros(count, int)
    for step in range(1, 60):
        success = again.step(act()).success
        first = np.where((first == 0) & success, step, first)
    assert first.tolist() == bank.steps_left[some].tolist()


def test_without_a_success_the_furthest_stage_is_kept(make_env: Callable[..., BatchEnv]):
    class Never(Task):
        def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
            return torch.zeros(self.envs.num_envs, dtype=torch.bool)

        def compute_reward(
            self, actions: torch.Tensor, states: dict[str, torch.Tensor]
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            return torch.zeros(self.envs.num_envs), {}

    env = make_env(num_envs=16, task=Never)

    bank = record_bank(env, lifting(env))

    assert len(bank)
    assert not bank.is_solved
    assert (bank.steps_left == UNKNOWN).all()
    again = make_env(num_envs=len(bank), task=Never)
    again.restore(np.arange(len(bank)), bank.rows)
    height = (again.states()["cube_pos"] - again.states()["cube_start_pos"])[:, 2]
    assert (height > 0.03).all()
    assert again.states()["cube_grasped"].all()


def test_a_bank_in_which_nothing_was_touched_is_empty_and_refused(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(horizon=10)

    bank = record_bank(env, idle(env))

    assert len(bank) == 0
    with pytest.raises(V2PError, match="empty"):
        use_bank(env, bank, OPEN)


def test_too_many_moments_are_thinned_out_evenly(make_env: Callable[..., BatchEnv]):
    env = make_env()
    full = record_bank(env, lifting(env), every_steps=2)
    env.seed(0)

    thin = record_bank(env, lifting(env), every_steps=2, max_rows=20)

    assert len(thin) == 20
    assert len(full) > 40
    assert thin.steps_left[0] == full.steps_left[0]
    assert abs(int(thin.steps_left[10]) - int(np.median(full.steps_left))) <= 4


def test_the_share_of_episodes_begins_in_the_middle_and_never_in_the_plain_worlds(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(num_envs=200)
    bank = record_bank(env, lifting(env), every_steps=8)
    use_bank(env, bank, BankConfig(share=0.5, num_plain=50))

    env.reset(np.arange(200))

    progress = env.states()["progress"].numpy()
    assert (progress[:50] == 0).all()
    # Half of 150, give or take four standard deviations.
    assert 75 - 25 < (progress[50:] > 0).sum() < 75 + 25
    begun = np.flatnonzero(progress > 0)
    assert set(np.round(progress[begun] * 60).astype(int)) <= set(range(8, 60, 8))
    starts = env.states()["cube_start_pos"].numpy()[begun]
    known = bank.rows["env._start_pose"][:, 0, :3].astype(np.float32)
    assert (np.abs(starts[:, None] - known).max(2).min(1) == 0).all()


def test_staggering_leaves_banked_worlds_where_they_are(make_env: Callable[..., BatchEnv]):
    env = make_env(num_envs=40)
    bank = record_bank(env, lifting(env))
    use_bank(env, bank, BankConfig(share=0.5, num_plain=0))
    env.reset(np.arange(40))
    before = env._steps.copy()
    is_banked = before > 0

    env.stagger()

    assert (env._steps[is_banked] == before[is_banked]).all()
    assert len(set(env._steps[~is_banked].tolist())) > 5


def test_the_bank_is_for_training_only(make_env: Callable[..., BatchEnv]):
    env = make_env()
    bank = record_bank(env, lifting(env))
    fine = make_env(cfg=without_randomization(SimConfig(fine=True)))

    with pytest.raises(V2PError, match="training environment only"):
        use_bank(fine, bank, OPEN)


def test_a_bank_of_another_task_is_refused_by_name(make_env: Callable[..., BatchEnv]):
    env = make_env()
    bank = record_bank(env, lifting(env))
    wrong = {name: rows for name, rows in bank.rows.items() if name != "batch.qpos"}

    with pytest.raises(V2PError, match=r"batch\.qpos differ"):
        use_bank(env, replace(bank, rows=wrong), OPEN)


def test_a_bank_survives_the_disk(make_env: Callable[..., BatchEnv], tmp_path):
    env = make_env()
    bank = record_bank(env, lifting(env))

    bank.save(tmp_path / "bank.npz")
    back = Bank.load(tmp_path / "bank.npz")

    assert back.steps_left.tolist() == bank.steps_left.tolist()
    assert back.rows.keys() == bank.rows.keys()
    assert all((back.rows[name] == bank.rows[name]).all() for name in bank.rows)


def test_the_curriculum_opens_what_is_near_success_first():
    starts = Starts(fake_bank(1000), BankConfig(reverse=True, share=1.0, num_plain=0))

    rows = starts.draw(np.arange(5000), np.random.default_rng(0))

    assert starts.level == 0.0
    assert rows.min() == 0
    assert rows.max() == 149  # 15 % of the bank


def test_the_curriculum_goes_back_as_success_rises_and_stays_at_the_end():
    cfg = BankConfig(reverse=True, raise_at=0.6, raise_by=0.25, window_episodes=10, first_part=0.2)
    starts = Starts(fake_bank(100), cfg)
    seen = [(starts.level, starts.num_open)]

    for _ in range(6):
        starts.note(np.full(10, starts.num_open - 1), np.array([True] * 6 + [False] * 4))
        seen.append((starts.level, starts.num_open))

    levels = [level for level, _ in seen]
    assert levels == [0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    assert [count for _, count in seen][:5] == [32, 40, 60, 80, 100]


def test_the_curriculum_waits_while_success_is_rare():
    starts = Starts(fake_bank(100), BankConfig(reverse=True, window_episodes=10))

    for _ in range(50):
        starts.note(np.array([31, 31]), np.array([True, False]))

    assert starts.level == 0.0


def test_success_from_late_moments_opens_nothing():
    starts = Starts(fake_bank(100), BankConfig(reverse=True, window_episodes=10, first_part=0.6))

    for _ in range(50):
        starts.note(
            np.arange(40), np.full(40, True)
        )  # 60 are open, the earliest third is 40 to 59
        starts.note(np.arange(40, 60), np.full(20, False))

    assert starts.level == 0.0


def test_only_finished_episodes_from_the_bank_count_for_the_curriculum(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(num_envs=20)
    bank = record_bank(env, lifting(env))
    cfg = BankConfig(share=1.0, num_plain=10, reverse=True, window_episodes=2, raise_by=0.5)
    starts = use_bank(env, bank, cfg)
    env.reset(np.arange(20))
    env.reset(np.arange(20))  # given up at once: no outcome
    act = lifting(env)

    held = np.zeros(20, bool)
    for _ in range(60):
        result = env.step(act())
        held |= result.held & result.truncated
        env.reset(np.flatnonzero(result.truncated))

    assert held[10:].sum() >= 6
    assert starts.level >= 0.5


def test_a_saved_environment_with_a_bank_goes_on_exactly(make_env: Callable[..., BatchEnv]):
    noisy = SimConfig()
    source = make_env()
    bank = record_bank(source, lifting(source))
    cfg = BankConfig(share=0.6, num_plain=2, reverse=True, window_episodes=1, raise_at=0.2)

    def make() -> BatchEnv:
        env = make_env(cfg=noisy, num_envs=10, seed=1)
        use_bank(env, bank, cfg)
        return env

    def play(env: BatchEnv, steps: int) -> bytes:
        trace = b""
        act = lifting(env)
        for _ in range(steps):
            result = env.step(act())
            env.reset(np.flatnonzero(result.truncated | result.terminated))
            trace += env.observe().tobytes()
        return trace

    env, later = make(), make()
    play(later, 7)
    env.reset(np.arange(10))
    play(env, 40)
    later.load_state_dict(env.state_dict())

    assert play(later, 80) == play(env, 80)
    assert later.starts is not None
    assert env.starts is not None
    assert later.starts.state() == env.starts.state()
    assert env.starts.level > 0


def test_wrong_settings_are_named():
    with pytest.raises(ValueError, match="share must be between 0 and 1"):
        BankConfig(share=1.5)


def test_steps_are_enough_to_hold_a_success(make_env: Callable[..., BatchEnv]):
    env = make_env()

    bank = record_bank(env, lifting(env))

    began = bank.rows["env._steps"] + bank.steps_left
    assert (began <= env.horizon - HELD_STEPS + 1).all()
