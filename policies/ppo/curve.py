"""The learning curve: a CSV that survives a kill, its picture, and its mirror for TensorBoard."""

import csv
import math
import time
from pathlib import Path

CURVE_FILE = "curve.csv"
PICTURE_FILE = "curve.png"
EVENT_FILES = "events.out.tfevents.*"
"""TensorBoard's naming. They hold times and the machine's name: never make them part of a fingerprint."""

Row = dict[str, int | float]


def append_row(path: Path, row: Row) -> None:
    """Append one line to the CSV; the first line written names the columns."""
    is_new = not path.is_file()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        if is_new:
            writer.writeheader()
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})


def read_rows(path: Path) -> list[Row]:
    """Return the rows; a last line that a kill cut short is left out."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: float(v) for k, v in row.items()} for row in rows if all(row.values())]


def cut_after(path: Path, steps: int) -> None:
    """Drop rows beyond `steps`: training goes on from there and writes them again."""
    rows = [row for row in read_rows(path) if row["steps"] <= steps]
    path.unlink(missing_ok=True)
    for row in rows:
        append_row(path, {k: int(v) if k in {"steps", "iteration"} else v for k, v in row.items()})


def plot_curve(path: Path, picture: Path) -> None:
    """Draw success and return over control steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = read_rows(path)
    steps = [row["steps"] / 1e6 for row in rows]
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot(steps, [row["success_deterministic"] for row in rows], label="deterministic")
    top.plot(steps, [row["success_stochastic"] for row in rows], label="exploring", alpha=0.6)
    top.set(ylabel="success", ylim=(-0.02, 1.02))
    top.legend(loc="upper left")
    bottom.plot(steps, [row["return"] for row in rows])
    bottom.set(xlabel="control steps [million]", ylabel="return per episode")
    figure.savefig(picture, dpi=100)


class EventMirror:
    """The rows of the CSV as TensorBoard scalars over control steps: `tensorboard --logdir <any parent folder>`.

    The CSV is the truth. Opening the mirror writes all its rows into a new event file and empties the old ones,
    so that a resumed training, whose CSV was cut to the checkpoint, shows every step once.
    """

    def __init__(self, curve: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        for old in curve.parent.glob(EVENT_FILES):
            old.write_bytes(
                b""
            )  # not deleted: a TensorBoard that is watching would wait for it forever
        rows = read_rows(curve)
        # Times as if all of it had been trained in one go: "relative" in TensorBoard is seconds of training.
        self.began = time.time() - (rows[-1]["seconds"] if rows else 0.0)
        # Whoever is watching drops what it has read so far.
        self.writer = SummaryWriter(str(curve.parent), purge_step=0)
        for row in rows:
            self.add(row)

    def add(self, row: Row) -> None:
        """Write one row at once; a rate that does not exist yet (NaN) is left out."""
        for column, value in row.items():
            if column != "steps" and math.isfinite(value):
                self.writer.add_scalar(
                    tag_of(column), value, int(row["steps"]), walltime=self.began + row["seconds"]
                )
        self.writer.flush()

    def close(self) -> None:
        self.writer.close()


def tag_of(column: str) -> str:
    """Return TensorBoard's name of a column; what stands before the slash groups the charts."""
    group, _, rest = column.partition("_")
    return f"{group}/{rest}" if group in {"success", "reward"} else f"training/{column}"
