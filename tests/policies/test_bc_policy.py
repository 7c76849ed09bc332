"""The network and policy of `v2p_bc`, by hand numbers and laws; no dataset, no simulator."""

import json

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torchvision.models import resnet18

from policies.bc.configuration_v2p_bc import BACKBONE_WEIGHTS, V2PBCConfig
from policies.bc.encoders import pretrained_backbone_file
from policies.bc.modeling_v2p_bc import V2PBCPolicy, task_words

MASK = "observation.images.mask"
GREYS = (0, 64, 128, 192, 255)


def config(image=(3, 48, 64), cameras=(MASK,), **settings) -> V2PBCConfig:
    settings = {
        "pretrained_backbone_weights": None,
        "input_size_px": 32,
        "encoder": "none",
        **settings,
    }
    cfg = V2PBCConfig(device="cpu", **settings)
    cfg.input_features = {
        **{key: PolicyFeature(FeatureType.VISUAL, image) for key in cameras},
        "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
    }
    cfg.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    return cfg


def policy(seed=0, **settings) -> V2PBCPolicy:
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(seed)
        return V2PBCPolicy(config(**settings))


def observation(batch=2, seed=0, task="lift the mug", cameras=(MASK,)):
    rng = torch.Generator().manual_seed(seed)
    greys = torch.tensor(GREYS) / 255
    labels = torch.randint(0, 5, (batch, 1, 48, 64), generator=rng)
    return {
        **{key: greys[labels].expand(-1, 3, -1, -1) for key in cameras},
        "observation.state": torch.randn(batch, 7, generator=rng),
        "task": [task] * batch,
    }


def training_batch(chunk=1, batch=2):
    first, second = observation(batch, 1), observation(batch, 2)
    rng = torch.Generator().manual_seed(3)
    return {
        MASK: torch.stack([first[MASK], second[MASK]], 1),
        "observation.state": torch.stack(
            [first["observation.state"], second["observation.state"]], 1
        ),
        "action": torch.randn(batch, chunk, 7, generator=rng),
        "action_is_pad": torch.zeros(batch, chunk, dtype=torch.bool),
        "task": ["lift the mug", "push the box left"][:batch],
    }


def test_the_same_words_give_the_same_vector_and_other_words_another():
    lift = task_words("Lift the mug!", 64)

    assert torch.equal(lift, task_words("lift THE mug", 64))
    assert abs(float(lift.norm()) - 1) < 1e-6
    assert float(task_words("push the box left", 64) @ task_words("push the box right", 64)) < 0.99
    assert not task_words("", 64).any()


def test_the_loss_is_the_huber_loss_of_the_actions_inside_the_episode():
    net = policy(chunk_size=3, head="regression").eval()
    batch = training_batch(chunk=3)
    batch["action_is_pad"][0, 1:] = True
    with torch.no_grad():
        error = (net.net(batch)[..., 0] - batch["action"]).abs().numpy()

    loss, logged = net(batch)

    huber = np.where(error < 1, error**2 / 2, error - 0.5)
    by_hand = (huber[0, :1].sum() + huber[1].sum()) / (4 * 7)
    assert loss.item() == pytest.approx(by_hand, rel=1e-5)
    assert logged["huber"] == pytest.approx(by_hand, rel=1e-5)
    each, _ = net(batch, reduction="none")
    assert each.tolist() == pytest.approx([huber[0, :1].mean(), huber[1].mean()], rel=1e-5)


def test_stepping_through_an_episode_acts_as_the_stacked_frames_would():
    net = policy()
    first, second = observation(seed=1), observation(seed=2)
    net.reset()

    acted = [net.select_action(first), net.select_action(second)]

    def stacked(a, b):
        keys = (MASK, "observation.state")
        return {**{k: torch.stack([a[k], b[k]], 1) for k in keys}, "task": a["task"]}

    torch.testing.assert_close(acted[0], net.predict_action_chunk(stacked(first, first))[:, 0])
    torch.testing.assert_close(acted[1], net.predict_action_chunk(stacked(first, second))[:, 0])


def test_a_reset_forgets_the_last_episode():
    net = policy()
    fresh = net.select_action(observation(seed=2))
    net.select_action(observation(seed=1))
    net.reset()

    torch.testing.assert_close(net.select_action(observation(seed=2)), fresh)


def test_a_chunk_is_carried_out_before_the_policy_looks_again():
    net = policy(chunk_size=3, n_action_steps=2)
    net.reset()
    chunk = net.predict_action_chunk(observation(seed=1))
    net.reset()

    acted = [net.select_action(observation(seed=s)) for s in (1, 5)]

    torch.testing.assert_close(acted[0], chunk[:, 0])
    torch.testing.assert_close(acted[1], chunk[:, 1])


def test_the_task_changes_the_action_and_can_be_ignored():
    listens, ignores = policy(), policy(use_task=False)
    lift, push = observation(task="lift it"), observation(task="push it")

    def act(net, obs):
        net.reset()
        return net.select_action(obs)

    assert not torch.equal(act(listens, lift), act(listens, push))
    assert torch.equal(act(ignores, lift), act(ignores, push))


def test_any_mix_of_cameras_works_and_only_masks_are_split_into_labels():
    cameras = (MASK, "observation.images.wrist")
    net = policy(cameras=cameras, encoder="resnet18")

    action = net.select_action(observation(cameras=cameras))

    assert action.shape == (2, 7)
    assert [camera.backbone[0].in_channels for camera in net.net.cameras] == [2 * 9, 2 * 3]
    assert (
        policy(camera_input="rgb", encoder="resnet18").net.cameras[0].backbone[0].in_channels == 6
    )
    assert policy(num_labels=3, encoder="resnet18").net.cameras[0].backbone[0].in_channels == 2 * 3
    small = policy(cameras=cameras, preset="small")  # colours need a backbone in any case
    assert [camera.backbone is None for camera in small.net.cameras] == [True, False]
    assert small.select_action(observation(cameras=cameras)).shape == (2, 7)


def test_states_beyond_those_used_change_nothing():
    net = policy(state_entries=3)
    obs = observation()
    net.reset()
    before = net.select_action(obs)
    obs["observation.state"][:, 3:] += 5.0
    net.reset()

    assert torch.equal(net.select_action(obs), before)


def test_the_learning_rate_falls_to_a_hundredth_whatever_the_trainings_length():
    net = policy()
    for steps in (100, 1000):
        optimizer = net.config.get_optimizer_preset().build(net.get_optim_params())
        schedule = net.config.get_scheduler_preset().build(optimizer, steps)
        rates = []
        for _ in range(steps):
            rates.append(schedule.get_last_lr()[0])
            optimizer.step()
            schedule.step()

        assert max(rates) == pytest.approx(3e-4, rel=0.01)
        assert rates[steps // 2] == pytest.approx(3e-4 * 0.505, rel=0.05)
        assert rates[-1] == pytest.approx(3e-6, rel=0.1)
    assert V2PBCConfig(device="cpu", lr_schedule="constant").get_scheduler_preset() is None


def test_without_pretrained_weights_at_hand_the_policy_starts_anyway_and_says_so(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))

    net = policy(encoder="resnet18", pretrained_backbone_weights=BACKBONE_WEIGHTS)

    assert "random weights" in caplog.text
    assert {group.get("lr") for group in net.get_optim_params()} == {None, net.config.optimizer_lr}


def test_pretrained_weights_at_hand_are_used_and_trained_ten_times_slower(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    path = pretrained_backbone_file()
    path.parent.mkdir(parents=True)
    given = resnet18(weights=None).state_dict()
    torch.save(given, path)

    net = policy(
        encoder="resnet18",
        pretrained_backbone_weights=BACKBONE_WEIGHTS,
        cameras=("observation.images.front",),
    )

    stem = net.net.cameras[0].backbone[0].weight
    torch.testing.assert_close(stem[:, :3] + stem[:, 3:], given["conv1.weight"])
    torch.testing.assert_close(
        net.net.cameras[0].backbone[7][1].conv2.weight, given["layer4.1.conv2.weight"]
    )
    heads, backbones = net.get_optim_params()
    assert "lr" not in heads
    assert backbones["lr"] == 3e-5
    assert (
        policy(encoder="resnet18", optimizer_lr_backbone=1e-6).get_optim_params()[1]["lr"] == 1e-6
    )


def test_a_saved_policy_loads_without_looking_for_pretrained_weights(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "empty"))
    net = policy(encoder="resnet18", pretrained_backbone_weights=BACKBONE_WEIGHTS)
    net.save_pretrained(tmp_path / "saved")
    path = tmp_path / "saved/config.json"
    older = {"random_shift": 0.1, "mask_jitter_px": 2.0, "moments_dropout": 0.2}
    path.write_text(json.dumps(json.loads(path.read_text()) | older))
    caplog.clear()

    again = V2PBCPolicy.from_pretrained(tmp_path / "saved")

    assert "random weights" not in caplog.text
    torch.testing.assert_close(
        again.select_action(observation()), net.select_action(observation())
    )


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"n_action_steps": 2}, "chunk_size"),
        ({"input_size_px": 16}, "input_size_px"),
        ({"mask_greys": (0,)}, "mask_greys"),
        ({"pretrained_backbone_weights": "resnet50"}, "IMAGENET1K_V1"),
        ({"n_obs_steps": 0}, "n_obs_steps"),
        ({"num_bins": 1}, "num_bins"),
        ({"num_labels": 10}, "num_labels"),
    ],
)
def test_impossible_settings_are_refused_by_name(settings, word):
    with pytest.raises(ValueError, match=word):
        V2PBCConfig(device="cpu", **settings)
