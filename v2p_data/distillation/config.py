"""Settings of the distillation, without the libraries that train."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DistillationConfig:
    """How a policy learns from states of its own, which the expert labels and finishes."""

    rounds: int = 2
    """Rounds of training and collecting; 0: behaviour cloning of the demonstrations only, as in the paper."""
    episodes: int = 256
    """Handover episodes per task and round."""
    worlds: int = 128
    """Worlds that run at the same time; part of the recipe, because it decides which world is which."""
    takeover: tuple[float, float] = (0.05, 0.75)
    """When the expert takes over: earliest and latest moment, as shares of the task's horizon."""
    time_scale: float = 1.35
    """An episode may last this multiple of the task's horizon, so that late takeovers can end well."""
    first_steps: int = 2_000
    """Gradient steps on the demonstrations, before the first round."""
    round_steps: int = 2_000
    """Gradient steps before each further round, on all frames so far."""

    def __post_init__(self) -> None:
        if self.rounds < 0:
            raise ValueError(f"rounds is {self.rounds}; it must be 0 or more")
        if min(self.episodes, self.worlds, self.first_steps, self.round_steps) < 1:
            raise ValueError("episodes, worlds, first_steps and round_steps must be at least 1")
        earliest, latest = self.takeover
        if not 0 <= earliest <= latest <= self.time_scale:
            raise ValueError(
                f"takeover is {self.takeover}; need 0 <= earliest <= latest <= time_scale ({self.time_scale})"
            )
