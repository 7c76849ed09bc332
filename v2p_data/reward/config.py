"""Settings of the reward search: what is searched (identity of the result) and how its processes are run (never)."""

from dataclasses import dataclass
from typing import Literal

Method = Literal["v2p", "eureka", "robogen", "code_as_policy"]
Part = Literal["visual", "tracking", "pick", "iteration", "samples"]


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """What is searched, and with how many control steps."""

    iterations: int = 0
    """Rounds of rewards, 0: no search; the paper takes 5, and 8 for hard tasks."""
    method: Method = "v2p"
    """The paper's method or one of the peers it compares itself with."""
    without: tuple[Part, ...] = ()
    """Switches off parts as in the paper's ablations (tables 3 and 7): what the writer sees of the video (`visual`) or
    of its tracked poses (`tracking`), the audited pick of the success (`pick`), later rounds (`iteration`), all
    rewards of a round but one (`samples`)."""
    candidates: int = 8
    """Rewards per round (the paper's number)."""
    steps: int = 400_000
    """Control steps of a candidate that trains to the end: lifting a box takes about so many from nothing."""
    rungs: tuple[float, ...] = (0.1, 0.2, 0.4, 1.0)
    """Shares of `steps` after which the worse part of a round's candidates stops; multiples of the first one. With
    five rounds of eight, these cost less than a third of training all to the end, confirmation included."""
    keep: float = 0.5
    """Share of the candidates that goes on after a rung, rounded down, at least one."""
    gate: float = 0.05
    """Only who is at most so far behind the best one of all rounds, at the same step, trains to the end."""
    start: Literal["nothing", "taught"] = "nothing"
    """What candidates train from: `nothing` as in the paper, or what imitating a scripted program taught."""
    taught_rounds: int = 14
    """Rounds of imitation at most, for `taught`; fewer leave more to the reward."""
    num_envs: int = 256
    """Worlds in which a candidate trains."""
    eval_worlds: int = 64
    """Episodes per evaluation; one takes place after each `rungs[0] * steps` steps, on seeds of its own."""
    evaluations: int = 3
    """The last so many evaluations count, by their mean: the best single one would be luck."""
    target_success: float = 0.95
    """A candidate stops where its evaluations reach this, and then the search does after its rung."""
    elites: int = 2
    """Best candidates of all rounds so far that the next round is written from."""
    confirm_seeds: int = 3
    """The choice is trained on so many seeds in all."""
    bonus_ratio: float = 1.0
    """What a step of success earns in training, in full rewards: a reward adds up to 1 just before success, times
    100. Of the experts too. The paper's lambda of 100 is 100 here; docs/rewards.md has the measurement."""

    def __post_init__(self) -> None:
        first = self.rungs[0] if self.rungs else 0.0
        ratios = [rung / first for rung in self.rungs] if first > 0 else []
        if (
            not ratios
            or list(self.rungs) != sorted(set(self.rungs))
            or self.rungs[-1] != 1.0
            or any(abs(r - round(r)) > 1e-6 for r in ratios)
        ):
            raise ValueError(
                f"rungs must rise to 1.0 in multiples of the first one, got {self.rungs}"
            )
        counts = {
            "candidates": self.candidates,
            "steps": self.steps,
            "num_envs": self.num_envs,
            "eval_worlds": self.eval_worlds,
            "evaluations": self.evaluations,
            "elites": self.elites,
            "confirm_seeds": self.confirm_seeds,
        }
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if not 0 <= self.bonus_ratio < float("inf"):
            raise ValueError(f"bonus_ratio must be 0 or more, got {self.bonus_ratio}")
        if self.iterations < 0 or not 0 < self.keep < 1:
            raise ValueError(
                f"need iterations >= 0 and 0 < keep < 1, got {self.iterations} and {self.keep}"
            )

    @property
    def marks(self) -> tuple[int, ...]:
        """The rungs, counted in evaluations."""
        return tuple(round(rung / self.rungs[0]) for rung in self.rungs)

    @property
    def num_iterations(self) -> int:
        """Rounds that the method and the switches leave."""
        return min(self.iterations, 1) if self._is_one_round else self.iterations

    @property
    def num_candidates(self) -> int:
        """Rewards per round that the method and the switches leave."""
        is_one = self.method == "robogen" or "samples" in self.without
        return 1 if is_one else self.candidates

    @property
    def paid_bonus_ratio(self) -> float:
        """The ratio that training uses: RoboGen knows no success and pays nothing for it."""
        return 0.0 if self.method == "robogen" else self.bonus_ratio

    @property
    def _is_one_round(self) -> bool:
        return self.method == "robogen" or "iteration" in self.without

    def steps_at_most(self) -> int:
        """Return the control steps of training that the whole search takes at most, confirmation included."""
        alive, before, round_share = self.num_candidates, 0.0, 0.0
        for rung in self.rungs:
            round_share += alive * (rung - before)
            alive, before = max(1, int(alive * self.keep)), rung
        shares = self.num_iterations * round_share + self.confirm_seeds - 1
        return round(self.steps * shares)

    def steps_without_halving(self) -> int:
        """Return the control steps of training every candidate to the end."""
        return self.steps * self.num_candidates * self.num_iterations


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one candidate's process may use; a candidate beyond them has failed, and the search goes on."""

    hang_s: float = 120.0
    """Without a finished batch or evaluation for so long it hangs."""
    wall_s: float = 3600.0
    """From one rung to the next."""
    memory_mb: int = 4096
    """Address space on top of what loading the libraries takes."""
