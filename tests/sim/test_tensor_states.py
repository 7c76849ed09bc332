"""The formulas on tensors give what the CPU backend's numpy gives; Warp is not needed for that."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.env.states import Observed, StateBlock, named_states
from v2p_data.sim.env.tensor_states import (
    SeenTensors,
    base_observation,
    moved_position,
    moved_rotation,
    object_block,
    robot_block,
)
from v2p_data.sim.model.world import build_world
from v2p_data.sim.robot.robot import COARSE, FINGER_TRAVEL_M, tool_state

N = 64


def down_turned_by(rotvec: np.ndarray) -> np.ndarray:
    turned = Rotation.from_rotvec(rotvec) * Rotation.from_quat((0, 1, 0, 0), scalar_first=True)
    return turned.as_quat(scalar_first=True)


def tensors(**arrays: np.ndarray) -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(np.array(v, np.float32)) for k, v in arrays.items()}


@pytest.mark.parametrize("kinds", [["box"], ["cylinder", "box"], ["box", "sphere", "cylinder"]])
def test_states_are_those_of_the_cpu_backend(
    kinds: list[str], make_scene: Callable[..., Scene], make_object: Callable[..., SceneObject]
):
    rng, count = np.random.default_rng(0), len(kinds)
    world = build_world(
        make_scene(*(make_object(f"o{k}", s) for k, s in enumerate(kinds))), COARSE
    )
    tool = tool_state(rng.uniform(-1, 1, (N, 7)), rng.normal(size=(N, 7)))
    quats = Rotation.random(N * count, random_state=1).as_quat().reshape(N, count, 4)
    pose = np.concatenate([rng.uniform(0, 0.5, (N, count, 3)), quats], axis=2)
    common = {
        "fingers": rng.uniform(0, FINGER_TRAVEL_M, (N, 2)),
        "object_qpos": pose,
        "object_qvel": rng.normal(size=(N, count, 6)),
        "object_size": rng.uniform(0.02, 0.1, (N, count, 3)),
        "start_pose": pose[::-1].copy(),
        "touches": (rng.uniform(size=(N, count, 2)) > 0.4).astype(float),
        "target_pos": rng.uniform(0, 0.5, (N, 3)),
        "target_finger": rng.uniform(0, FINGER_TRAVEL_M, N),
        "last_action": rng.uniform(-1, 1, (N, 7)),
        "progress": rng.uniform(size=N),
    }
    block = StateBlock(world, N)
    block.fill(slice(None), Observed(tool=tool, **common))
    seen = SeenTensors(
        **tensors(
            tool_pos=tool.pos,
            tool_rotation=tool.rotation,
            tool_quat=tool.quat_wxyz,
            tool_vel_linear=tool.vel_linear,
            tool_vel_angular=tool.vel_angular,
            **common,
        )
    )
    is_round = [kind != "box" for kind in kinds]

    states = named_states(
        robot_block(seen),
        object_block(seen),
        base_observation(seen, is_round),
        [o.name for o in world.objects],
    )

    expected = block.tensors()
    assert set(states) == set(expected)
    for key, value in expected.items():
        torch.testing.assert_close(states[key], value, atol=2e-5, rtol=1e-5, msg=key)


def test_the_position_target_stays_on_its_leash_and_in_its_box():
    tool = torch.tensor([[0.5, 0.0, 0.2], [0.5, 0.0, 0.2], [0.5, 0.3, 0.2]])
    target = torch.tensor([[0.5, 0.0, 0.2], [0.55, 0.0, 0.2], [0.5, 0.31, 0.2]])
    action = torch.tensor([[1.0, 0.0, -0.5], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

    moved = moved_position(target, action, tool, step_m=0.03, leash_m=0.06)

    expected = [[0.53, 0.0, 0.185], [0.56, 0.0, 0.2], [0.5, 0.32, 0.2]]
    np.testing.assert_allclose(moved, expected, atol=1e-6)


def test_the_rotation_target_stays_on_its_leash():
    tool = tensors(q=down_turned_by(np.zeros((2, 3))))["q"]
    target = tensors(q=down_turned_by(np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.45]])))["q"]
    action = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]])

    moved = moved_rotation(target, action, tool, step_rad=0.2, leash_rad=0.5, tilt_rad=0.35)

    expected = down_turned_by(np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.5]]))
    np.testing.assert_allclose(np.abs((moved.numpy() * expected).sum(1)), 1.0, atol=1e-6)


def test_the_rotation_target_leans_no_further_than_its_limit():
    rng = np.random.default_rng(0)
    tool = tensors(q=down_turned_by(np.zeros((N, 3))))["q"]
    action = torch.from_numpy(rng.uniform(-1, 1, (N, 3)).astype(np.float32))

    moved = moved_rotation(tool, action, tool, step_rad=0.9, leash_rad=2.0, tilt_rad=0.35)

    axis = Rotation.from_quat(moved.numpy(), scalar_first=True).as_matrix()[:, :, 2]
    lean = np.arccos(np.clip(-axis[:, 2], -1, 1))
    wanted = Rotation.from_rotvec(0.9 * action.numpy()).as_matrix()[:, 2, 2]
    np.testing.assert_allclose(lean, np.minimum(np.arccos(wanted), 0.35), atol=2e-3)
    assert (lean > 0.3).sum() > 10
