"""How a reward was refined: what a model is shown before it is asked for a better one, as the paper's prompts do.

Both rewards were trained with as written, on `example_tasks.GRASP_A_BLOCK`, by the recipe of the reward search: 200,000
control steps in 256 worlds on one seed. What was seen is what `reward.feedback` said of the first one.
"""

from dataclasses import dataclass

from v2p_data.task.llm.example_tasks import GRASP_A_BLOCK
from v2p_data.task.sandbox.splice import reward_source

HOVERING = """@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    distance = torch.norm(states["block_pos"] - states["eef_pos"], dim=-1)
    height = states["block_pos"][:, 2] - states["block_start_pos"][:, 2]
    reward_components = {}
    reward_components["reach"] = 0.9 * (1 - torch.tanh(2.0 * distance))
    reward_components["raise"] = 0.1 * (height / 0.05).clamp(0.0, 1.0)
    reward_components["effort"] = -0.05 * (actions**2).sum(dim=-1)
    total = 100.0 * (reward_components["reach"] + reward_components["raise"] + reward_components["effort"])
    return total, reward_components
"""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """A reward, what training with it showed, and the reward that was written from that."""

    task: str
    before: str
    seen: str
    thoughts: str
    after: str
    came_to: str
    """One sentence on what training with the new reward showed."""


REFINEMENTS = (
    Refinement(
        task="grasp the block; success is that both pads touch it, it is 3 cm up, and it is still",
        before=HOVERING,
        seen="""\
success rate: 0.000 (0 of 64 episodes; success at some step in 0.000)
episode length: 3.00 s
time to success: never
success rate in the course of training: 0.0000, 0.0000, 0.0000, 0.0000

reach: share of the total magnitude 0.967
  all trajectories:        mean 0.7984, std 0.0518, min 0.4161, max 0.8482
  successful trajectories: none
  failed trajectories:     mean 0.7984, std 0.0518, min 0.4161, max 0.8482
  correlation with success: per step undefined, per episode undefined
  saturated: 0.04 of steps at its maximum, 0.00 at its minimum; rises by 0.0537 within an episode
  mean in the course of training: 0.5338, 0.5851, 0.7028, 0.7357, 0.7494, 0.7635, 0.7638, 0.7703, 0.7743, 0.7777

raise: share of the total magnitude 0.001
  all trajectories:        mean 0.0009, std 0.0037, min 0.0000, max 0.0491
  successful trajectories: none
  failed trajectories:     mean 0.0009, std 0.0037, min 0.0000, max 0.0491
  correlation with success: per step undefined, per episode undefined
  saturated: 0.00 of steps at its maximum, 0.92 at its minimum; rises by -0.0002 within an episode
  mean in the course of training: 0.0000, 0.0001, 0.0008, 0.0012, 0.0010, 0.0010, 0.0010, 0.0012, 0.0010, 0.0014

effort: share of the total magnitude 0.032
  all trajectories:        mean -0.0263, std 0.0261, min -0.1711, max -0.0019
  successful trajectories: none
  failed trajectories:     mean -0.0263, std 0.0261, min -0.1711, max -0.0019
  correlation with success: per step undefined, per episode undefined
  saturated: 0.14 of steps at its maximum, 0.00 at its minimum; rises by 0.0374 within an episode
  mean in the course of training: -0.1053, -0.1075, -0.1072, -0.1082, -0.1101, -0.1093, -0.1068, -0.1057, -0.1004, -0.1010

total: share of the total magnitude 1.000
  all trajectories:        mean 77.2985, std 7.5705, min 25.2404, max 83.5703
  successful trajectories: none
  failed trajectories:     mean 77.2985, std 7.5705, min 25.2404, max 83.5703
  correlation with success: per step undefined, per episode undefined
  saturated: 0.17 of steps at its maximum, 0.00 at its minimum; rises by 9.0860 within an episode

block: the gripper came within 4.2 cm of its centre; share of episodes in which it was reached 1.00, touched 0.92, grasped 0.28, raised 0.00; it moved by 3.1 cm
""",
        thoughts=(
            "Nothing succeeded, so the reward is designed anew. reach has 97 % of the magnitude "
            "and rises to 0.8 of its 0.9: "
            "the gripper hovers at the block and is paid for staying there, which makes it a "
            "place to park. raise is at its "
            "minimum in 92 % of steps: the block is touched in 92 % of episodes and raised in "
            "none, so nothing pulls from "
            "being there to lifting, and what little raising pays can be had by flinging. effort "
            "costs exploration more than "
            "raise can ever bring. So: reach becomes a fifth, with a steeper slope near the "
            "block; a component for grasping "
            "is the missing step; raising gets most of the weight and counts in the gripper only; "
            "effort falls to a tenth."
        ),
        after=reward_source(GRASP_A_BLOCK),
        came_to="With it a policy succeeded in 61 of 64 episodes after as many steps as before.",
    ),
)
