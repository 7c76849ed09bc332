"""The two tasks every model is shown first, as the paper does: reach a block, grasp a block.

They are what later tasks are made of: going to an object, and having it. Each comes with the thoughts that lead to it.
"""

from dataclasses import dataclass

import numpy as np

from v2p_data.geometry.camera import Camera, intrinsics, look_at
from v2p_data.scene.scene import Scene, SceneObject

REACH_A_BLOCK = '''import torch
from factory.tasks.task import Task

scene_info = {"task_class_name": "ReachABlock", "objects": ["block"]}


class ReachABlock(Task):
    """Reach the block."""

    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
        self.task_description = "reach the block"

    def reset_objects_states(self, env_ids):
        return super().reset_objects_states(env_ids)

    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        # Where the block is as seen from the gripper: the way that is left to go.
        states["eef_to_block"] = (states["block_pos"] - states["eef_pos"]) * 5
        obs_keys.append("eef_to_block")
        return obs_keys

    def get_observation_space(self):
        # eef_to_block has three numbers.
        return super().get_observation_space() + 3

    def compute_success(self, states):
        distance = torch.norm(states["block_pos"] - states["eef_pos"], dim=-1)
        # Near is measured by the block's own size: the tool centre point is inside or right beside it.
        is_near = distance < states["block_size"].amax(dim=-1) / 2 + 0.01
        is_still = torch.norm(states["eef_vel_linear"], dim=-1) < 0.15
        # The block was reached, not knocked away.
        moved = torch.norm(states["block_pos"] - states["block_start_pos"], dim=-1)
        return is_near & is_still & (moved < 0.03)

    def compute_reward(self, actions, states):
        return reward_function(actions, states)


# REWARD FUNCTION
@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    """
    # Chain of Thoughts for reward designs:
    1. Go to the block: the nearer, the better, with a slope that is felt from everywhere on the table.
    2. Slow down there, and leave the block where it is.
    # Reward Components:
    1. reach: 1 at the block, falling with distance.
    2. calm: speed of the gripper counts against it near the block only.
    3. disturb: pushing the block away costs.
    """
    distance = torch.norm(states["block_pos"] - states["eef_pos"], dim=-1)
    near = (distance < 0.05).float()
    moved = torch.norm(states["block_pos"] - states["block_start_pos"], dim=-1)
    reward_components = {}
    reward_components["reach"] = 1 - torch.tanh(5.0 * distance)
    reward_components["calm"] = -0.2 * near * torch.norm(states["eef_vel_linear"], dim=-1).clamp(max=1.0)
    reward_components["disturb"] = -0.5 * (moved - 0.01).clamp(0.0, 0.3)
    total = 100.0 * (reward_components["reach"] + reward_components["calm"] + reward_components["disturb"])
    return total, reward_components
'''

GRASP_A_BLOCK = '''import torch
from factory.tasks.task import Task

scene_info = {"task_class_name": "GraspABlock", "objects": ["block"]}


class GraspABlock(Task):
    """Grasp the block."""

    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
        self.task_description = "grasp the block"

    def reset_objects_states(self, env_ids):
        return super().reset_objects_states(env_ids)

    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        states["eef_to_block"] = (states["block_pos"] - states["eef_pos"]) * 5
        obs_keys.append("eef_to_block")
        return obs_keys

    def get_observation_space(self):
        return super().get_observation_space() + 3

    def compute_success(self, states):
        # Both pads touch it: a state of the simulator, better than a guess from the gripper's width.
        is_grasped = states["block_grasped"] > 0.5
        # A block that is held comes along: raised by more than contact jitter gives.
        height = states["block_pos"][:, 2] - states["block_start_pos"][:, 2]
        is_raised = height > 0.03
        is_still = torch.norm(states["block_vel_linear"], dim=-1) < 0.15
        return is_grasped & is_raised & is_still

    def compute_reward(self, actions, states):
        return reward_function(actions, states)


# REWARD FUNCTION
@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    """
    # Chain of Thoughts for reward designs:
    1. Go to the block with the gripper open.
    2. Close the gripper around it; a touch elsewhere than at the block is worth nothing.
    3. Raise it a little, which only works if the grasp is firm.
    # Reward Components:
    1. reach: 1 at the block, falling with distance.
    2. grasp: 1 while both pads touch the block and the gripper is at it.
    3. raise: share of 5 cm that the block is up, counted in the gripper only, so that flinging it earns nothing.
    4. effort: large actions cost a little.
    """
    distance = torch.norm(states["block_pos"] - states["eef_pos"], dim=-1)
    near = (distance < 0.045).float()
    held = states["block_grasped"] * near
    height = states["block_pos"][:, 2] - states["block_start_pos"][:, 2]
    reward_components = {}
    reward_components["reach"] = 0.2 * (1 - torch.tanh(8.0 * distance))
    reward_components["grasp"] = 0.2 * held
    reward_components["raise"] = 0.6 * (height / 0.05).clamp(0.0, 1.0) * held
    reward_components["effort"] = -0.005 * (actions**2).sum(dim=-1)
    total = 100.0 * (
        reward_components["reach"]
        + reward_components["grasp"]
        + reward_components["raise"]
        + reward_components["effort"]
    )
    return total, reward_components
'''


@dataclass(frozen=True, kw_only=True)
class Example:
    """A task with its code, as shown to a model."""

    task: str
    """What is to be done, and with which objects."""
    thoughts: str
    code: str
    source: str
    """Where it comes from, for the reader of a stored call."""


BASIC_EXAMPLES = (
    Example(
        task="reach the block. Objects: block (box, 5 x 5 x 5 cm).",
        thoughts=(
            "What must be true at the end? The tool centre point is at the block. How near is "
            "near? That depends on the "
            "block, so the threshold comes from block_size. What would fool this? Flying past, so the gripper must be "
            "slow; knocking the block away, so the block must be where it started. Is it false at the start? Yes, the "
            "gripper starts 20 cm above the table. What helps the policy? The vector from the gripper to the block."
        ),
        code=REACH_A_BLOCK,
        source="built in",
    ),
    Example(
        task="grasp the block. Objects: block (box, 5 x 5 x 5 cm).",
        thoughts=(
            "What must be true at the end? The block is in the gripper. block_grasped says that "
            "both pads touch it, but "
            "pads may touch a block without holding it; a held block comes along when the gripper rises, so 3 cm of "
            "height are asked for, measured from where it started, not from the table, because the centre of a resting "
            "block is above the table already. What would fool this? Flinging it up: then it is not grasped, and not "
            "still. The reward leads there in the order in which things happen: reach, grasp, raise."
        ),
        code=GRASP_A_BLOCK,
        source="built in",
    ),
)


def block_scene() -> Scene:
    """Return a table with one block of 5 cm that is raised by 10 cm: where the basic examples are at home."""
    poses = tuple((0.0, 0.0, 0.025 + z, 1.0, 0.0, 0.0, 0.0) for z in np.linspace(0, 0.1, 5))
    block = SceneObject(
        name="block",
        label="block",
        role="manipulated",
        shape="box",
        size_m=(0.05, 0.05, 0.05),
        mass_kg=0.1,
        friction=0.8,
        frames=tuple(range(5)),
        poses_world=poses,
        confidences=(1.0,) * 5,
    )
    camera = Camera(
        width_px=640,
        height_px=480,
        K=intrinsics(640, 480, 1.0),
        T_world_cam=look_at(np.array([-0.6, 0.0, 0.6]), np.zeros(3)),
    )
    return Scene(
        title="block",
        video="",
        description="grasp the block",
        kind="generic",
        objects=(block,),
        camera=camera,
        fps=20.0,
        num_frames=5,
        confidence=1.0,
    )
