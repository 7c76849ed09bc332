"""What each randomisation of recorded episodes is worth for a policy: each off in turn, judged in both simulators.

    python scripts/study_randomization.py --run outputs/demo --task lift_red_box --out outputs/study_randomization
    python scripts/study_randomization.py --out outputs/study_randomization --table --figure outputs/randomization.svg

Task and expert come from a finished run. Each line of `results.jsonl` is one policy in one place; lines that are there are
kept, so a stopped study goes on. The twin is a second simulator: no real robot was asked for any number.
"""

import argparse
import logging
import os
import sys
from dataclasses import replace
from pathlib import Path

from studies.randomization import SETTINGS, RandomizationStudy, RandomizationStudyConfig, key_of
from studies.results import make_missing, rate_of, results_to_show
from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.settings import load_settings
from v2p_data.pipeline.workers import only_run_in

CONFIG = Path(__file__).parents[1] / "configs" / "studies" / "randomization.yaml"


def main() -> None:
    """Read the command line, make what is missing, show what is there."""
    args = _arguments()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's threads get in each other's way
    logging.basicConfig(level=logging.ERROR)
    try:
        if not (args.table or args.figure):
            make_results(args)
        show(args)
    except V2PError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def make_results(args: argparse.Namespace) -> None:
    """Make the results that have no line yet, one after the other.

    Raises:
        V2PError: bad settings, no such task, or `--out` belongs to another study; or, after all others, that some could not
            be made.
    """
    given = {name: tuple(vars(args)[name]) for name in ("settings", "seeds") if vars(args)[name]}
    study = RandomizationStudy(
        cfg=replace(load_settings(args.config, RandomizationStudyConfig), **given),
        out=args.out,
        run=args.run,
        item=args.task,
        runtime=Runtime(root=args.out, device=args.device, num_threads=args.threads),
        tell=lambda words: print(words, file=sys.stderr, flush=True),
    )
    with only_run_in(args.out):
        make_missing(
            args.out,
            study.cfg.cells,
            key_of,
            lambda key: study.result(*key),
            lambda row: f"{row['setting']}, seed {row['seed']}, {row['place']}: {rate_of(row)}",
            study.identity,
        )


def show(args: argparse.Namespace) -> None:
    """Print the table, and write the figure where it is asked for.

    Raises:
        V2PError: there is no result yet.
    """
    from studies.randomization_table import table, write_figure

    rows = results_to_show(args.out)
    print(table(rows))
    if args.figure:
        write_figure(rows, args.figure)
        print(f"\nfigure: {args.figure}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--config", type=Path, default=CONFIG, help="sizes of the study")
    parser.add_argument("--run", type=Path, default=Path("outputs/demo"), help="run folder with task and expert")  # fmt: skip
    parser.add_argument("--task", default="lift_red_box", help="name of the task in that run")
    parser.add_argument("--out", type=Path, default=Path("outputs/study_randomization"))
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, help="instead of the configuration's")  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type=int, help="instead of the configuration's")
    parser.add_argument("--threads", type=int, default=1, help="of one stage")
    parser.add_argument("--device", default="cpu", help="where policies train")
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    parser.add_argument("--figure", type=Path, help="write the figure (.svg or .png) and stop")
    return parser.parse_args()


if __name__ == "__main__":
    main()
