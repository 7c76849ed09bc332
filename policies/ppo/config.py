"""Settings of actor, imitation and PPO, without the libraries that train, which load slowly."""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class ActorConfig:
    """Shape of the policy and limits of its Gaussian."""

    hidden: tuple[int, ...] = (128, 128)
    """Width of the tanh layers, for the actor and for the critic."""
    init_std: float = 0.6
    """Standard deviation of the exploration at the start, in units of the action range."""
    min_std: float = 0.1
    """Exploration never shrinks below this; the deterministic policy is unaffected."""
    mean_bound: float = 1.5
    """Means stay within +-this, so that every part of [-1, 1] keeps being sampled."""
    gripper_mean_bound: float = 0.8
    """Same for the last action: an unbounded gripper mean drifts to 2 and a release is never sampled again."""
    gripper_min_std: float = 0.6
    """Least standard deviation of the last action, for the same reason."""
    obs_clip: float = 5.0
    """Normalised observations are clipped to +-this."""

    def __post_init__(self) -> None:
        if not 0 < self.min_std <= self.init_std:
            raise ValueError(
                f"need 0 < min_std <= init_std, got {self.min_std} and {self.init_std}"
            )


@dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """How long, and how much is left to the learner."""

    rounds: int = 14
    """At most; the teacher moves all worlds in the first and ever fewer in the later ones."""
    least_rounds: int = 5
    """From then on the learner is tried after each round."""
    target_success: float = 0.98
    """A learner that succeeds this often has learned enough; else the round with the highest success counts."""
    round_steps: int = 32
    """Control steps per world and round."""
    teacher_rounds: int = 8
    """Until this round the teacher's share falls to its least."""
    epochs: int = 6
    """Passes over everything seen so far, after each round."""
    last_epochs: int = 0
    """Passes after the last round, while the learning rate falls to a tenth."""
    minibatch: int = 1024
    learning_rate: float = 1e-3
    noise: float = 0.2
    """Standard deviation added to actions, so that the teacher is seen recovering."""
    least_teacher: float = 0.1
    """Share of the worlds that the teacher always keeps: who fails early never sees how a task ends."""
    num_threads: int = 1
    actor: ActorConfig = field(
        default_factory=lambda: ActorConfig(min_std=0.05, gripper_min_std=0.3)
    )
    """With less noise than from scratch: what releases and what grasps is known already."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """The recipe. With the defaults, lifting a box was learned in 0.43 million steps: 66 s of one core."""

    total_steps: int = 1_000_000
    """Control steps over all worlds; the recipe's budget: about 150 s on one core to itself."""
    max_seconds: float = 600.0
    """Wall-clock safety net, added up over resumptions; a run it stops depends on the machine."""
    target_success: float = 0.98
    """Training goes on to this success of the deterministic worlds before a plateau may end it."""
    plateau_steps: int = 100_000
    """It stops then, if so many control steps, and eight batches, have brought no better success or time to success."""
    plateau_gain: float = 0.005
    """What counts as better: so much more success, or a time to success that is shorter by ten
    times this share of an episode."""
    window_episodes: int = 128
    """The success rates are taken over this many last episodes (two rounds of the deterministic worlds)."""
    min_window_episodes: int = 64
    """With fewer episodes there is no rate yet."""
    num_deterministic: int = 64
    """Worlds that act without exploration and never enter the loss."""
    batch_time: int = 16
    """Control steps per world between two updates."""
    epochs: int = 4
    minibatch: int = 1024
    learning_rate: float = 1e-3
    """At the start; from then on it follows the KL divergence."""
    min_learning_rate: float = 1e-4
    max_learning_rate: float = 3e-3
    kl_low: float = 0.015
    """Below, the learning rate grows by a half."""
    kl_high: float = 0.03
    """Above, it shrinks by a third."""
    decline: float = 0.25
    """A policy that started warm and has fallen this far below its best success is not trained any further."""
    kl_stop: float = 0.06
    """Above, the remaining epochs of this batch are skipped."""
    gamma: float = 0.97
    """A horizon of about 1.7 s at 20 Hz."""
    gae_lambda: float = 0.9
    clip: float = 0.2
    max_grad_norm: float = 1.0
    warm_start_std: float = 0.15
    """Exploration of a policy that starts from another expert's weights."""
    warm_start_learning_rate: float = 2e-4
    """At the start of such a training."""
    warm_start_critic_batches: int = 6
    """So many batches teach only the value after a warm start: a value that knows nothing spoils a good policy."""
    checkpoint_seconds: float = 10.0
    """A kill loses at most about this much work."""
    num_threads: int = 1
    """Threads of torch. Two cost a factor three when another process shares the cores."""
    actor: ActorConfig = field(default_factory=ActorConfig)

    def __post_init__(self) -> None:
        if not 0 < self.min_window_episodes <= self.window_episodes:
            raise ValueError(
                "need 0 < min_window_episodes <= window_episodes, "
                f"got {self.min_window_episodes} and {self.window_episodes}"
            )
        if self.plateau_steps < 1 or self.plateau_gain < 0:
            raise ValueError(
                "need plateau_steps >= 1 and plateau_gain >= 0, "
                f"got {self.plateau_steps} and {self.plateau_gain}"
            )
        if not self.min_learning_rate <= self.learning_rate <= self.max_learning_rate:
            raise ValueError(
                "need min_learning_rate <= learning_rate <= max_learning_rate, "
                f"got {self.min_learning_rate}, {self.learning_rate}, {self.max_learning_rate}"
            )
