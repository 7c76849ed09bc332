"""How far a policy that learned to lift N objects from videos lifts others: the paper's figures 5 and 6 on our terms.

Training tasks come from drawn clips, and real ones where `--videos` gives some, through the engine; ten objects that no
training sees are judged, from the scans in `--unseen` or drawn. A cell (arm, N, seed) is one line in `results.jsonl`; a
stopped study goes on. `--table` shows what is there. `docs/study_lifting.md` explains arms and results.

    python scripts/study_lifting.py --config configs/studies/lifting_laptop.yaml --out
    outputs/study_lifting --unseen MESHES
"""

import argparse
import logging
import os
import sys
from dataclasses import replace
from pathlib import Path

from studies.cells import Key, Study, cells_of, key_of
from studies.config import ARMS, LiftingConfig
from studies.results import make_missing, results_to_show
from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.settings import load_settings
from v2p_data.pipeline.workers import only_run_in

CONFIG = Path(__file__).parents[1] / "configs" / "studies" / "lifting_laptop.yaml"


def main() -> None:
    """Read the command line, make what cells are missing, show what is there."""
    args = _arguments()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's threads get in each other's way
    logging.basicConfig(level=logging.ERROR)
    try:
        if not args.table:
            make_cells(args)
        show(args)
    except V2PError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def make_cells(args: argparse.Namespace) -> None:
    """Make the cells that have no line yet, one after the other.

    Raises:
        V2PError: bad settings or meshes; or, after all other cells, that some could not be made.
    """
    cfg = load_settings(args.config, LiftingConfig)
    given = {
        name: tuple(vars(args)[name]) for name in ("arms", "counts", "seeds") if vars(args)[name]
    }
    if not set(given.get("counts", ())) <= set(cfg.counts):
        # Sizes are those of the configuration's smallest N, whichever are asked for.
        raise V2PError(
            f"--counts {args.counts} are not all among the counts of {args.config}: {list(cfg.counts)}"
        )
    wanted: list[Key] = [
        (arm, n, seed)
        for arm, n, seed in cells_of(
            replace(cfg, **{k: given[k] for k in ("arms", "seeds") if k in given})
        )
        if not n or n in given.get("counts", cfg.counts)
    ]
    study = Study(
        cfg=cfg,
        out=args.out,
        runtime=Runtime(
            root=args.out, device=args.device, num_threads=args.threads, workers=args.workers
        ),
        unseen_folder=args.unseen,
        videos=args.videos,
        tell=lambda words: print(words, file=sys.stderr, flush=True),
    )
    with only_run_in(args.out):
        make_missing(
            args.out,
            wanted[: args.max_cells],
            key_of,
            lambda key: study.cell(*key),
            lambda row: (
                f"{row['arm']} N={row['n']} seed {row['seed']}: done in {row['wall_s']:.0f} s"
            ),
            study.identity,
            lambda key: "{} N={} seed {}".format(*key),
        )


def show(args: argparse.Namespace) -> None:
    """Print the table.

    Raises:
        V2PError: there is no result yet.
    """
    from studies.table import table

    rows = results_to_show(args.out)
    print(table(rows))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--config", type=Path, default=CONFIG, help="sizes of the study")
    parser.add_argument("--out", type=Path, default=Path("outputs/study_lifting"))
    parser.add_argument(
        "--unseen", type=Path, help="folder of scans, NAME/textured.obj each; drawn ones without"
    )
    parser.add_argument(
        "--videos", type=Path, help="folder of real clips with captions, which join the drawn ones"
    )
    parser.add_argument(
        "--arms", nargs="+", choices=list(ARMS), help="instead of the configuration's"
    )
    parser.add_argument("--counts", nargs="+", type=int, help="some of the configuration's N")
    parser.add_argument("--seeds", nargs="+", type=int, help="instead of the configuration's")
    parser.add_argument("--max-cells", type=int, help="stop after so many, done ones included")
    parser.add_argument("--workers", type=int, default=1, help="stages at the same time")
    parser.add_argument("--threads", type=int, default=1, help="of one stage")
    parser.add_argument("--device", default="cpu", help="where policies train")
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    return parser.parse_args()


if __name__ == "__main__":
    main()
