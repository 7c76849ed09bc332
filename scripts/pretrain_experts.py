"""Learn the experts that are shipped: one a kind of task, over many random objects.

python scripts/pretrain_experts.py --out outputs/pretraining --kinds lift_up insert   # learn
python scripts/pretrain_experts.py --out outputs/pretraining --ship                   # choose, write into the package
python scripts/pretrain_experts.py --out outputs/pretraining --judge                  # once, on other tasks
"""

import argparse
from pathlib import Path

from pretraining.judging import judge_kind
from pretraining.learning import learn_kind
from pretraining.shipping import ship
from studies.results import append_result, results_in
from v2p_data.kinds import KINDS


def main() -> None:
    """Learn, ship or judge the kinds that are asked for; what has a record or a line is kept."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/pretraining"))
    parser.add_argument("--kinds", nargs="*", default=[k for k in KINDS if k != "generic"])
    parser.add_argument("--tasks", type=int, default=40, help="to learn; half of them to judge")
    parser.add_argument("--worlds", type=int, default=12, help="of each task")
    parser.add_argument("--steps", type=int, default=0, help="of PPO after imitation")
    parser.add_argument("--alone", action="store_true", help="PPO from the reward alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ship", nargs="*", type=Path, help="folders of runs to choose from")
    parser.add_argument("--judge", action="store_true")
    parser.add_argument("--episodes", type=int, default=10, help="of each task that judges")
    args = parser.parse_args()
    if args.ship is not None:
        ship(args.ship or [args.out])
        return
    for kind in args.kinds:
        if args.judge:
            if kind not in {row["kind"] for row in results_in(args.out)}:
                append_result(
                    args.out,
                    judge_kind(
                        kind,
                        args.out,
                        tasks=args.tasks // 2,
                        episodes=args.episodes,
                        seed=args.seed,
                    ),
                )
            continue
        out = args.out / (f"{kind}-alone" if args.alone else kind)
        if not (out / "record.json").is_file():
            learn_kind(
                kind,
                out,
                num_tasks=args.tasks,
                each=args.worlds,
                steps=args.steps,
                alone=args.alone,
                seed=args.seed,
            )


if __name__ == "__main__":
    main()
