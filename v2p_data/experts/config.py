"""Settings of the expert stage."""

from dataclasses import dataclass, field
from typing import Literal

from policies.ppo.config import ImitationConfig, PPOConfig
from v2p_data.sim.env.physics import Backend


@dataclass(frozen=True, kw_only=True)
class ExpertConfig:
    """How an expert is trained and judged."""

    start: Literal["pretrained", "program", "none", "as_program"] = "pretrained"
    """`pretrained`: the expert of the package that knows many objects; it is the task's expert where it succeeds
    often enough, else PPO goes on from it. `program`: imitation of a scripted program first.
    `none`: PPO from nothing, as in the paper; ten times slower where it works at all.
    `as_program`: no network learns the task; the best program itself demonstrates and labels, alike
    for all objects, and is named as what it is."""
    pretrained_is_enough: float = 0.9
    """A pretrained expert that succeeds this often at the task is its expert; above 1, PPO always goes on from it."""
    least_pretrained_success: float = 0.3
    """PPO goes on from a pretrained expert that succeeds this often; below, a program teaches."""
    least_teacher_success: float = 0.1
    """A program that succeeds less often teaches nothing."""
    trial_worlds: int = 64
    """Worlds in which programs and taught policies are tried."""
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    num_envs: int = 512
    """Worlds that learn at the same time; the flat optimum on two cores is 256 to 1024."""
    backend: Backend = "cpu"
    """Where PPO's worlds are simulated: `warp` is for the GPU of `--device` and 8192 worlds; all else stays on
    the CPU."""
    taught_bonus_factor: float = 100.0
    """After imitation a step of success pays so many times its usual bonus: what is left to learn
    is success and its time, not how to get there."""
    compare_worlds: int = 256
    """Episodes at the fine time step that the taught policy and PPO's both play; the better one becomes the expert."""
    eval_episodes: int = 64
    """Episodes at the fine time step that judge the finished expert, on seeds of their own."""
    min_success: float = 0.3
    """Experts below this make too few demonstrations to be worth the wait."""

    def __post_init__(self) -> None:
        for name in ("min_success", "least_pretrained_success"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
