"""Training on frames in memory: the same seed, a stop and a continuation, the mean weights, the best checkpoint."""

import csv
import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from small_dataset import (
    FPS,
    LENGTHS,
    MASK,
    REPO_ID,
    STATE,
    are_equal,
    config,
    policy,
    table,
    weights,
    write_dataset,
)

from policies.bc import trainer
from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import DatasetError, FrameTable, read_frames
from policies.bc.student import fill_in_features
from policies.bc.trainer import (
    BEST_FILE,
    CURVE_FILE,
    STATE_FILE,
    TrainerConfig,
    load_policy,
    make_policy,
    normalised,
    save_policy,
    train,
)

STEPS = 6
NUM_FRAMES = sum(LENGTHS)


class Stopped(Exception):  # noqa: N818 - it stands for a kill
    pass


def small(**settings) -> V2PBCConfig:
    """Return settings of a network without convolutions, whose steps take a millisecond."""
    return config(num_labels=3, **{"encoder": "none", **settings})


def recipe(**settings) -> TrainerConfig:
    return TrainerConfig(
        **{
            "steps": STEPS,
            "batch_size": 4,
            "precision": "float32",
            "log_points": STEPS,
            **settings,
        }
    )


def trained(
    out: Path, cfg: V2PBCConfig, how: TrainerConfig, *, seed: int = 5, net: int = 0, **more
):
    """Return what a training ended with and its weights; `net` is the seed of the first weights."""
    net_, processors = policy(cfg, seed=net)
    told = train(net_, normalised(table(net_.net), processors), how, out, seed=seed, **more)
    return told, weights(net_)


def stop_at(step: int):
    """Return a callback that stops a training as a kill would, before the state of this step is saved."""

    def on_progress(share: float, words: str) -> None:
        if round(share * STEPS) == step:
            raise Stopped

    return on_progress


def test_the_same_seed_gives_the_same_weights_and_another_one_others(tmp_path: Path):
    _, first = trained(tmp_path / "1", small(), recipe())
    _, again = trained(tmp_path / "2", small(), recipe())
    _, other = trained(tmp_path / "3", small(), recipe(), seed=6)

    assert are_equal(first, again)
    assert not are_equal(first, other)


@pytest.mark.parametrize(("step", "net"), [(1, 0), (4, 9)])
def test_a_training_that_was_killed_while_it_saved_ends_in_the_same_files(
    tmp_path: Path, monkeypatch, step: int, net: int
):
    """Killed by the kernel, with half of a state written. The batches cross the end of the table.

    Only the first state is
    preceded by none, so that the first weights matter."""

    def files(out: Path, net: int) -> dict[str, bytes]:
        policy_, processors = policy(small(), seed=net)
        frames = normalised(table(policy_.net), processors)
        train(policy_, frames, recipe(save_every_s=0.0), out, seed=5)
        save_policy(out / "policy", policy_, processors)
        return {path.name: path.read_bytes() for path in (out / "policy").iterdir()}

    def half(state: dict[str, Any], path: Path) -> None:
        whole(state, path)
        if state["step"] == step:
            os.truncate(path, path.stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    whole = torch.save
    assert STEPS * recipe().batch_size > NUM_FRAMES
    calm = files(tmp_path / "calm", net=0)

    child = os.fork()
    if child == 0:
        monkeypatch.setattr(torch, "save", half)
        files(tmp_path / "killed", net=0)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL

    assert files(tmp_path / "killed", net) == calm
    assert not (tmp_path / "killed" / STATE_FILE).exists()


@pytest.mark.parametrize("step", [3, 4, 5, 6])
def test_a_stopped_training_keeps_the_checkpoint_that_an_undisturbed_one_keeps(
    tmp_path: Path, step: int
):
    def judge(net: torch.nn.Module) -> float:
        torch.rand(3)  # a simulation draws numbers too
        bias = dict(net.named_parameters())["net.head.6.bias"]
        return float(bias.detach().double().abs().sum() * 1e6) % 1.0

    def stopping(net: torch.nn.Module) -> float:
        calls.append(step)
        if len(calls) == step - 2:
            raise Stopped
        return judge(net)

    calls: list[int] = []
    how = recipe(checkpoints=3, steps=STEPS, save_every_s=0.0)
    calm, expected = trained(tmp_path / "calm", small(), how, judge=judge)
    assert [at for at, _ in calm.judged] == [4, 5, 6]

    if step < 6:
        with pytest.raises(Stopped):
            trained(tmp_path / "out", small(), how, judge=stopping)
    else:
        with pytest.raises(Stopped):
            trained(tmp_path / "out", small(), how, judge=judge, on_progress=stop_at(step))
    told, found = trained(tmp_path / "out", small(), how, judge=judge, net=9)

    assert told.judged == calm.judged
    assert are_equal(found, expected)


def test_the_best_checkpoint_that_was_judged_is_what_remains(tmp_path: Path):
    rates, seen = [0.2, 0.9, 0.5], []

    def judge(net: torch.nn.Module) -> float:
        seen.append(weights(net))
        return rates[len(seen) - 1]

    told, kept = trained(tmp_path, small(), recipe(checkpoints=3), judge=judge)

    assert told.judged == ((4, 0.2), (5, 0.9), (6, 0.5))
    assert are_equal(kept, seen[1])
    assert not are_equal(kept, seen[2])
    assert not (tmp_path / BEST_FILE).exists()


def test_of_two_equally_good_checkpoints_the_later_one_remains(tmp_path: Path):
    seen = []

    def judge(net: torch.nn.Module) -> float:
        seen.append(weights(net))
        return 0.5

    _, kept = trained(tmp_path, small(), recipe(checkpoints=2), judge=judge)

    assert are_equal(kept, seen[-1])


def test_the_mean_weights_after_two_steps_are_those_worked_out_by_hand(tmp_path: Path):
    def after(steps: int, decay: float) -> dict[str, torch.Tensor]:
        how = recipe(steps=steps, ema_decay=decay, log_points=1)
        return trained(tmp_path / f"{steps}-{decay}", small(lr_schedule="constant"), how)[1]

    start = weights(policy(small())[0])
    one, two = after(1, 0.0), after(2, 0.0)

    mean = after(2, 0.995)

    # The decay is (1 + step) / (10 + step), at most 0.995: a tenth, then two elevenths.
    for name in start:
        if name.startswith("net.cameras"):
            continue  # running statistics are no weights; the latest are kept
        first = 0.1 * start[name] + 0.9 * one[name]
        by_hand = 2 / 11 * first + 9 / 11 * two[name]
        torch.testing.assert_close(mean[name], by_hand, rtol=1e-5, atol=1e-6)
    assert int(mean["net.cameras.0.standardise.count"]) == 2 * 4


@dataclass(kw_only=True)
class Watched(FrameTable):
    """Remembers the rows that were drawn."""

    drawn: list[int] = field(default_factory=list)

    def batch(self, rows, observed, acted) -> dict[str, Any]:
        self.drawn.extend(rows.tolist())
        return super().batch(rows, observed, acted)


def test_every_frame_is_drawn_once_per_epoch_in_a_new_order(tmp_path: Path):
    net, processors = policy(small())
    watched = Watched(**vars(table(net.net)))

    # 9 steps of 4 are two epochs of 18 frames; the fifth step is in both.
    train(net, normalised(watched, processors), recipe(steps=9), tmp_path, seed=1)

    first, second = watched.drawn[:NUM_FRAMES], watched.drawn[NUM_FRAMES:]
    assert sorted(first) == sorted(second) == list(range(NUM_FRAMES))
    assert first != second
    assert first != sorted(first)


def test_a_batch_larger_than_the_dataset_goes_round_it(tmp_path: Path):
    net, processors = policy(small())
    watched = Watched(**vars(table(net.net)))

    how = recipe(steps=1, batch_size=2 * NUM_FRAMES)
    train(net, normalised(watched, processors), how, tmp_path, seed=1)

    assert sorted(watched.drawn) == sorted([*range(NUM_FRAMES)] * 2)


def test_a_training_fits_its_frames_and_writes_its_curve(tmp_path: Path):
    how = recipe(steps=150, batch_size=18, log_points=10)
    told, _ = trained(tmp_path, small(optimizer_lr=3e-3), how)

    with (tmp_path / CURVE_FILE).open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["step"]) for row in rows] == list(range(15, 151, 15))
    assert float(rows[-1]["loss"]) == told.final_loss < 0.5 * float(rows[0]["loss"])
    assert 0 < told.loader_share < 1


@pytest.mark.parametrize("damage", ["half", "nonsense", "other keys", "other network"])
def test_a_damaged_training_state_is_named_in_one_sentence(tmp_path: Path, damage: str):
    with pytest.raises(Stopped):
        trained(tmp_path, small(), recipe(save_every_s=0.0), on_progress=stop_at(3))
    path = tmp_path / STATE_FILE
    state = torch.load(path, weights_only=True)
    match damage:
        case "half":
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        case "nonsense":
            path.write_bytes(b"nonsense")
        case "other keys":
            torch.save({k: v for k, v in state.items() if k != "step"}, path)
        case "other network":
            torch.save(state | {"policy": {}}, path)

    with pytest.raises(
        DatasetError, match=r"training_state\.pt cannot be read .*; delete it to train from the"
    ) as caught:
        trained(tmp_path, small(), recipe())

    assert "\n" not in str(caught.value)
    path.unlink()
    trained(tmp_path, small(), recipe())


@pytest.mark.parametrize("head", ["regression", "bins"])
def test_a_loss_that_is_not_finite_is_told_in_one_sentence(tmp_path: Path, head: str):
    wild = small(optimizer_lr=1e30, lr_schedule="constant", head=head)

    with pytest.raises(DatasetError, match=r"the loss is (nan|inf) at step \d of 6; .*lower"):
        trained(tmp_path, wild, recipe())


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("trainer") / "small"
    write_dataset(root)
    return root


@pytest.mark.parametrize(
    "settings", [{"encoder": "resnet18"}, {"preset": "small"}, {"chunk_size": 3}]
)
def test_the_loss_of_a_batch_is_the_one_that_lerobots_loader_and_processors_give(
    dataset: Path, tmp_path: Path, settings: dict[str, Any]
):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from torch.utils.data import default_collate

    cfg = config(num_labels=3, **settings)
    net, processors = make_policy(cfg, fill_in_features(cfg, dataset, REPO_ID), seed=0)
    net.eval()
    seen = [k / FPS for k in cfg.observation_delta_indices]
    wanted = {MASK: seen, STATE: seen, "action": [k / FPS for k in cfg.action_delta_indices]}
    theirs: Any = LeRobotDataset(REPO_ID, root=dataset, delta_timestamps=wanted)
    rows = torch.tensor([0, 6, 7, 11, 17])

    with torch.no_grad():
        expected, _ = net(processors.before(default_collate([theirs[int(k)] for k in rows])))
        frames = normalised(read_frames(dataset, REPO_ID, net.net, tmp_path), processors)
        batch = frames.batch(rows, cfg.observation_delta_indices, cfg.action_delta_indices)
        loss, _ = net(batch)

    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)


def test_lerobot_loads_the_saved_folder_and_acts_the_same(dataset: Path, tmp_path: Path):
    from lerobot.configs import PreTrainedConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.policies.factory import make_policy as lerobots_policy
    from lerobot.policies.factory import make_pre_post_processors

    cfg = config(num_labels=3, preset="small")
    net, processors = make_policy(cfg, fill_in_features(cfg, dataset, REPO_ID), seed=0)
    frames = read_frames(dataset, REPO_ID, net.net, tmp_path / "cache")
    train(net, normalised(frames, processors), recipe(), tmp_path / "out", seed=0)
    save_policy(tmp_path / "policy", net, processors)
    rng = torch.Generator().manual_seed(0)
    seen = {
        MASK: torch.randint(0, 2, (1, 3, 64, 64), generator=rng) * 64 / 255,
        STATE: torch.randn(1, 3, generator=rng),
        "task": ["push the box"],
    }

    loaded = PreTrainedConfig.from_pretrained(tmp_path / "policy")
    loaded.pretrained_path = tmp_path / "policy"
    theirs = lerobots_policy(loaded, ds_meta=LeRobotDatasetMetadata(REPO_ID, root=dataset))
    before, after = make_pre_post_processors(loaded, pretrained_path=str(tmp_path / "policy"))
    ours, our_processors = load_policy(tmp_path / "policy")

    net.reset()
    expected = processors.after(net.select_action(processors.before(dict(seen))))
    assert torch.equal(after(theirs.select_action(before(dict(seen)))), expected)
    again = our_processors.after(ours.select_action(our_processors.before(dict(seen))))
    assert torch.equal(again, expected)


def test_the_bytes_of_frames_are_those_of_all_their_arrays():
    frames = table(policy(small())[0].net)
    values = (*frames.pictures[MASK].values(), *frames.vectors.values(), frames.action)
    assert frames.num_bytes == sum(v.numel() * v.element_size() for v in values)


@pytest.mark.gpu
@pytest.mark.parametrize("encoder", ["none", "resnet18"])
def test_a_gpu_that_holds_all_frames_learns_what_one_that_fetches_them_does(
    tmp_path: Path, monkeypatch, encoder: str, gpu: str
):
    def trained_on(device: str, share: float) -> dict[str, torch.Tensor]:
        monkeypatch.setattr(trainer, "GPU_SHARE_FOR_FRAMES", share)
        net_, processors = policy(small(encoder=encoder), device=device)
        # Frames are prepared on the CPU, as a dataset's are.
        frames = table(policy(small(encoder=encoder))[0].net)
        out = tmp_path / f"{device}{share}"
        train(net_, normalised(frames, processors), recipe(), out, seed=5)
        return {name: value.cpu() for name, value in weights(net_).items()}

    held, fetched, on_cpu = (trained_on(d, s) for d, s in ((gpu, 0.5), (gpu, 0.0), ("cpu", 0.0)))
    for name in held:
        torch.testing.assert_close(held[name], fetched[name], atol=1e-6, rtol=1e-4)
        # Adam turns rounding of a gradient near zero into a whole step of the learning rate.
        assert (held[name] - on_cpu[name]).float().abs().mean() < 1e-4
