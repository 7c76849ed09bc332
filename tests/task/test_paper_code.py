"""The code printed in the paper's appendix (figures 7, 8 and 11), quotes straightened, elisions completed, runs.

Every printed line stands here as it is printed, indented as Python needs it. What is not printed was completed so:

- Figure 7: `import torch` before the first import; the name and the objects in `scene_info`; the heights of the lower
  and upper ends of fork and box, which the success function names and the figure leaves out; a reward function of
  one component over the distance that its observation adds.
- Figure 8 prints a reward function alone: the class of the task *Throw* around it is figure 7's, with the one
  observation (`dist_garlic_to_bowl`) that the reward reads.
- Figure 11 prints three methods of a class, twice: the rest of the class is figure 7's, with the card's height above
  the table as reward.
"""

import ast

import numpy as np
import pytest
import torch

from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.sandbox.probes import at_rest
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.sandbox import load_task
from v2p_data.task.sandbox.smoke import smoke_run_all
from v2p_data.task.sandbox.smoke_child import FakePlacer
from v2p_data.task.task import OBJECT_STATES, ROBOT_STATES, TaskBundle

FIGURE_7 = '''
import torch
from factory.tasks.task import Task

scene_info = {'task_class_name': 'InsertForkIntoStorageBox', 'objects': ['fork', 'storage_box']}

class InsertForkIntoStorageBox(Task):
    """
    insert fork into storage box
    """
    def __init__(self, envs, urdf_assets_root) -> None:
        super().__init__(envs, urdf_assets_root, scene_info)
        self.task_description = "insert fork into storage box"
    def reset_objects_states(self, env_ids):
        return super().reset_objects_states(env_ids)
    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        # Add distance observation between the end-effector and the fork
        dist_to_fork = torch.norm(states["fork_pos"] - states["eef_pos"], dim=-1)
        states["dist_to_fork"] = dist_to_fork
        obs_keys.append("dist_to_fork")
        # Add distance observation between the fork and the storage box
        dist_fork_to_box = torch.norm(states["fork_pos"] - states["storage_box_pos"], dim=-1)
        states["dist_fork_to_box"] = dist_fork_to_box
        obs_keys.append("dist_fork_to_box")
        return obs_keys
    def get_observation_space(self):
        obs_space = super().get_observation_space()
        # Increase the observation space by the number of new observations added
        return obs_space + 2
    def compute_success(self, states):
        # the fork in the storage
        # xy position of the fork is within the storage box
        # z position of the fork is within the storage box
        xy_distance = torch.norm(states["fork_pos"][:, :2] - states["storage_box_pos"][:, :2], dim=-1)
        lower_z_of_fork = states["fork_pos"][:, 2] - states["fork_size"][:, 2] / 2
        upper_z_of_fork = states["fork_pos"][:, 2] + states["fork_size"][:, 2] / 2
        lower_z_of_box = states["storage_box_pos"][:, 2] - states["storage_box_size"][:, 2] / 2
        upper_z_of_box = states["storage_box_pos"][:, 2] + states["storage_box_size"][:, 2] / 2
        # fork should be inside the storage box's boundary in Z-axis
        z_condition = (lower_z_of_fork < upper_z_of_box) & (upper_z_of_fork > lower_z_of_box)
        # fork should be inside the storage box's boundary in XY-axis
        xy_condition = xy_distance < 0.01
        success = z_condition & xy_condition
        return success
    def compute_reward(self, actions, states):
        return reward_function(actions, states)
# REWARD FUNCTION
@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    reward = 1 - torch.tanh(8.0 * states["dist_to_fork"])
    return reward, {"dist_to_fork": reward}
'''

FIGURE_8 = '''
### Improved Reward Function
@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    """
    # Chain of Thoughts for reward designs:
    1. Grasp the garlic.
    2. Throw the garlic towards the bowl.
    3. Ensure the garlic reaches the bowl.
    # Reward Components:
    1. The distance between the gripper and the garlic.
    2. The garlic's distance to the bowl.
    3. The velocity of the garlic towards the bowl.
    4. The final position of the garlic being inside the bowl.
    """
    batch_size = states['eef_pos'].shape[0]
    rewards = torch.zeros(batch_size, device=states['eef_pos'].device, dtype=torch.float32)
    reward_components = {}
    # 1. Adjust Distance from gripper to garlic reward
    dist_eef_to_garlic = torch.norm(states['garlic_pos'] - states['eef_pos'], dim=-1)
    dist_grasp_reward = 1 - torch.tanh(8.0 * dist_eef_to_garlic) # Adjusting TANH temperature
    reward_components['dist_grasp_reward'] = dist_grasp_reward * 0.15 # Updated scale for emphasis
    # 2. Increased temperature for distance between garlic and bowl
    dist_garlic_to_bowl = 1 - torch.tanh(12.0 * states['dist_garlic_to_bowl']) # Increased temperature for better gradient
    reward_components['dist_garlic_to_bowl'] = dist_garlic_to_bowl * 0.25 # Increased scale to 0.25
    # 3. Velocity reward (slight temperature increase)
    garlic_vel = states['garlic_vel_linear']
    garlic_to_bowl_dir = states['bowl_pos'] - states['garlic_pos']
    garlic_to_bowl_dir = garlic_to_bowl_dir / torch.norm(garlic_to_bowl_dir, dim=-1, keepdim=True)
    vel_towards_bowl = torch.sum(garlic_vel * garlic_to_bowl_dir, dim=-1)
    vel_reward = torch.tanh(4.0 * vel_towards_bowl) # Slight adjustment in temperature
    reward_components['vel_reward'] = vel_reward * 0.30 # Increased scale to 0.30 for stronger influence
    # 4. Final Position Reward (revised and scaled)
    dist_xy_to_center = torch.norm(states['garlic_pos'][:, :2] - states['bowl_pos'][:, :2], dim=-1)
    upper_z_of_bowl = states["bowl_pos"][:, 2] + states["bowl_size"][:, 2] / 2
    lower_z_of_bowl = states["bowl_pos"][:, 2] - states["bowl_size"][:, 2] / 2
    garlic_in_bowl = ((dist_xy_to_center < (states['bowl_size'][:, 0] / 2)) & (states['garlic_pos'][:, 2] < upper_z_of_bowl) & (states['garlic_pos'][:, 2] > lower_z_of_bowl)).float()
    final_position_reward = garlic_in_bowl * 0.70 # Actually achievable state
    reward_components['final_position_reward'] = final_position_reward
    # Total Reward including penalties
    total_reward = dist_grasp_reward * 0.15 + dist_garlic_to_bowl * 0.25 + vel_reward * 0.30 + final_position_reward * 0.70
    step_penalty = torch.ones_like(total_reward) * 0.01
    rewards = total_reward - step_penalty
    reward_components['total_reward'] = total_reward
    reward_components['step_penalty'] = step_penalty
    return rewards, reward_components
'''

THROW = (
    """
import torch
from factory.tasks.task import Task

scene_info = {'task_class_name': 'ThrowGarlicIntoBowl', 'objects': ['garlic', 'bowl']}

class ThrowGarlicIntoBowl(Task):
    def __init__(self, envs, urdf_assets_root) -> None:
        super().__init__(envs, urdf_assets_root, scene_info)
        self.task_description = "throw garlic into bowl"
    def reset_objects_states(self, env_ids):
        return super().reset_objects_states(env_ids)
    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        states["dist_garlic_to_bowl"] = torch.norm(states["garlic_pos"] - states["bowl_pos"], dim=-1)
        obs_keys.append("dist_garlic_to_bowl")
        return obs_keys
    def get_observation_space(self):
        return super().get_observation_space() + 1
    def compute_success(self, states):
        return torch.norm(states["garlic_pos"] - states["bowl_pos"], dim=-1) < 0.05
    def compute_reward(self, actions, states):
        return reward_function(actions, states)
"""
    + FIGURE_8
)

CARD = """
import torch
from factory.tasks.task import Task

scene_info = {{'task_class_name': 'LiftCard', 'objects': ['card']}}

class LiftCard(Task):
    def __init__(self, envs, urdf_assets_root) -> None:
        super().__init__(envs, urdf_assets_root, scene_info)
        self.task_description = "lift card"
    def reset_objects_states(self, env_ids):
        return super().reset_objects_states(env_ids)
{parts}
    def compute_reward(self, actions, states):
        return reward_function(actions, states)
@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    height = states["card_pos"][:, 2] - states["table_height"]
    return height, {{"height": height}}
"""

FIGURE_11_1 = CARD.format(
    parts="""
    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        return obs_keys
    def get_observation_space(self):
        obs_space = super().get_observation_space()
        return obs_space\\

    def compute_success(self, states):
        card_lifted = (states['card_pos'][:, 2] - states['table_height']) > (torch.max(states['card_size']) / 2)
        success = card_lifted
        return success
"""
)
FIGURE_11_2 = CARD.format(
    parts="""
    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        dist_gripper_card = torch.norm(states["card_pos"] - states["eef_pos"], dim=-1)
        states["dist_gripper_card"] = dist_gripper_card
        obs_keys.append("dist_gripper_card")
        return obs_keys
    def get_observation_space(self):
        obs_space = super().get_observation_space()
        return obs_space + 1
    def compute_success(self, states):
        card_height_above_table = states['card_pos'][:, 2] - states['table_height']
        card_lifted = card_height_above_table > 0.2
        success = card_lifted & (states['card_vel_linear'].norm(dim=-1) < 0.01)
        return success
"""
)


@pytest.fixture(scope="module")
def scenes(scene_of, make_thing):
    box = ("storage_box", (0.3, 0.2, 0.1), (0.0, 0.3, 0.05))
    return {
        FIGURE_7: scene_of(
            "insert",
            make_thing("fork", (0.02, 0.18, 0.02), (0, 0, 0.01)),
            make_thing(*box, role="container"),
        ),
        THROW: scene_of(
            "throw_into",
            make_thing("garlic", (0.05, 0.05, 0.05), (0, 0, 0.025)),
            make_thing("bowl", (0.16, 0.16, 0.06), (0.2, 0.2, 0.03), role="container"),
        ),
        FIGURE_11_1: scene_of("lift_up", make_thing("card", (0.06, 0.09, 0.01), (0, 0, 0.005))),
        FIGURE_11_2: scene_of("lift_up", make_thing("card", (0.06, 0.09, 0.01), (0, 0, 0.005))),
    }


CODES = {
    "figure 7": FIGURE_7,
    "figure 8": THROW,
    "figure 11.1": FIGURE_11_1,
    "figure 11.2": FIGURE_11_2,
}


@pytest.mark.parametrize("code", CODES.values(), ids=CODES)
def test_it_passes_the_reader(code):
    check_code(code)


@pytest.mark.slow
def test_it_runs_in_the_child(scenes, scene_of):
    everything = {o.name: o for scene in scenes.values() for o in scene.objects}
    scene = scene_of("generic", *everything.values())

    results = smoke_run_all(list(CODES.values()), scene)

    assert [r.error for r in results] == [""] * 4
    assert [r.observation_dim for r in results] == [92, 91, 90, 91]


@pytest.mark.parametrize("code", CODES.values(), ids=CODES)
def test_every_state_it_reads_is_in_the_table_or_of_its_own_making(code, scenes):
    keys = {"read": set(), "made": set()}
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Subscript(value=ast.Name(id="states"), slice=ast.Constant(value=key)):
                keys["made" if isinstance(node.ctx, ast.Store) else "read"].add(key)
    documented = set(ROBOT_STATES)
    documented |= {f"{o.name}_{k}" for o in scenes[code].objects for k in OBJECT_STATES}

    assert len(keys["read"]) >= 2
    assert keys["read"] <= documented | keys["made"]


@pytest.mark.parametrize(
    ("code", "observation", "names"),
    [
        (FIGURE_7, 92, {"dist_to_fork"}),
        (
            THROW,
            91,
            {
                "dist_grasp_reward",
                "dist_garlic_to_bowl",
                "vel_reward",
                "final_position_reward",
                "total_reward",
                "step_penalty",
            },
        ),
        (FIGURE_11_1, 90, {"height"}),
        (FIGURE_11_2, 91, {"height"}),
    ],
    ids=CODES,
)
def test_it_is_simulated_unchanged(code, observation, names, scenes):
    bundle = TaskBundle(
        title="paper",
        description="paper",
        kind=scenes[code].kind,
        class_name="",
        code=code,
        scene=scenes[code],
    )
    env = BatchEnv(bundle, num_envs=4, seed=0, num_threads=1)

    results = [env.step(np.zeros((4, 7))) for _ in range(5)]

    assert results[-1].obs.shape == (4, observation)
    assert set(results[-1].components) == names
    assert not any(r.success.any() for r in results)
    assert all(np.isfinite(r.reward).all() for r in results)
    states = {k: v.numpy() for k, v in env.states().items()}
    if code == FIGURE_7:
        distance = np.linalg.norm(states["fork_pos"] - states["eef_pos"], axis=1)
        assert results[-1].task_reward == pytest.approx(1 - np.tanh(8 * distance), abs=1e-5)


def states_of(scene, **objects):
    """The scene at rest, with some objects elsewhere: name -> position and velocity."""
    probe = at_rest(scene)
    for name, (pos, velocity) in objects.items():
        probe.objects[name].pos = np.array([pos], float)
        probe.objects[name].vel_linear = np.array([velocity], float)
    return {k: torch.from_numpy(v) for k, v in probe.states().items()}


def loaded(code, scene):
    states = states_of(scene)
    return load_task(code, FakePlacer(states, [o.name for o in scene.objects]), scene)


def test_figure_7_counts_the_fork_within_a_centimetre_of_the_boxs_middle(scenes):
    task, scene = loaded(FIGURE_7, scenes[FIGURE_7]), scenes[FIGURE_7]
    still = (0.0, 0.0, 0.0)

    for x, z, expected in ((0.505, 0.05, True), (0.52, 0.05, False), (0.505, 0.3, False)):
        states = states_of(scene, fork=((x, 0.0, z), still), storage_box=((0.5, 0, 0.05), still))
        assert bool(task.succeeds(lambda s=states: s)[0]) is expected


def test_figure_8_pays_what_its_numbers_say(scenes):
    scene = scenes[THROW]
    task = loaded(THROW, scene)
    # Garlic 0.3 m straight above the bowl's middle, falling at 1 m/s; the hand is 0.1 m above the garlic.
    states = states_of(
        scene, garlic=((0.5, 0, 0.33), (0, 0, -1.0)), bowl=((0.5, 0, 0.03), (0, 0, 0))
    )
    states["eef_pos"] = torch.tensor([[0.5, 0.0, 0.43]])

    said = task.judge(lambda: states, torch.zeros(1, 7))

    reward, parts = said.reward, said.components

    grasp = 0.15 * (1 - np.tanh(0.8))
    near = 0.25 * (1 - np.tanh(12.0 * 0.3))
    fall = 0.30 * np.tanh(4.0)
    assert float(reward[0]) == pytest.approx(grasp + near + fall - 0.01, abs=1e-5)
    assert float(parts["dist_grasp_reward"][0]) == pytest.approx(grasp, abs=1e-5)
    assert float(parts["final_position_reward"][0]) == 0.0


def test_figure_11s_better_example_wants_the_card_high_and_still(scenes):
    scene = scenes[FIGURE_11_2]
    naive, better = loaded(FIGURE_11_1, scene), loaded(FIGURE_11_2, scene)
    flung = states_of(scene, card=((0.5, 0, 0.3), (1.0, 0, 0)))
    held = states_of(scene, card=((0.5, 0, 0.3), (0, 0, 0)))

    assert [bool(t.succeeds(lambda: dict(flung))[0]) for t in (naive, better)] == [True, False]
    assert [bool(t.succeeds(lambda: dict(held))[0]) for t in (naive, better)] == [True, True]
