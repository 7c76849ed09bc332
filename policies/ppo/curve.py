"""The learning curve: a CSV that survives a kill, and its picture."""

import csv
from pathlib import Path

CURVE_FILE = "curve.csv"
PICTURE_FILE = "curve.png"

Row = dict[str, int | float]


def append_row(path: Path, row: Row) -> None:
    """Append one line to the CSV; the first line written names the columns."""
    is_new = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        if is_new:
            writer.writeheader()
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})


def read_rows(path: Path) -> list[Row]:
    """Return the rows; a last line that a kill cut short is left out."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
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
