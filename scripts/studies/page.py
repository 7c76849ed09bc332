"""The study as one HTML file without a script: tables, figure, and films of successes and failures."""

import base64
import re
import tempfile
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from v2p_data.report.media import MediaBudget, film_uri

from .cells import FILMS_FOLDER
from .config import ARMS
from .figure import write_figure
from .fits import Row, by_count
from .table import (
    costs_table,
    differences_table,
    failures_table,
    laws_text,
    objects_table,
    paper_text,
    rates_table,
)

MAX_BYTES = 20_000_000
FILM_PX, FILM_FRAMES = 160, 120
_TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'">
<title>What nobody trained on</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: 13px; margin: 1rem 0 }
td, th { border: 1px solid #8888; padding: .2rem .5rem; text-align: left } img { max-width: 100% }
.films { display: flex; flex-wrap: wrap; gap: .8rem } figure { margin: 0; width: 160px; font-size: 12px }
video { width: 160px; image-rendering: pixelated }
</style></head><body>
<h1>What nobody trained on</h1>
<p>Policies learned on N objects and were judged on ten others. {{ paper }}</p>
<ul>{% for arm, words in arms.items() %}<li><b>{{ arm }}</b>: {{ words }}</li>{% endfor %}</ul>
<img src="{{ figure }}" alt="Success and failure against N, success per object, kinds of failure: see the tables">
{% for title, part in parts %}<h2>{{ title }}</h2><div class="wide">{{ part }}</div>{% endfor %}
<h2>Films</h2>
{% for title, films in groups %}<h3>{{ title }}</h3><div class="films">{% for film in films %}
<figure><video src="{{ film.uri }}" controls muted loop preload="none"></video><figcaption>{{ film.words }}</figcaption></figure>
{% endfor %}</div>{% endfor %}
{% if left_out %}<p>{{ left_out }} more films did not fit; they lie in the study's folder.</p>{% endif %}
</body></html>
"""


def write_page(rows: list[Row], out: Path, path: Path) -> None:
    """Write the page of a study.

    Args:
        rows: its lines.
        out: its folder, where the films are.
        path: the page.
    """
    budget = MediaBudget(max_bytes=MAX_BYTES)
    groups = []
    for arm in ARMS:
        for n, cells in list(by_count(rows, arm).items())[-1:]:
            folder = out / FILMS_FOLDER / f"{arm}_{n}_{cells[0]['seed']}"
            films = [
                {"uri": Markup(uri), "words": f"{film.parent.name}: {film.stem.split('_')[0]}"}
                for film in sorted(folder.glob("*/*.mp4"))
                if (uri := budget.admit(film_uri(film, FILM_PX, FILM_FRAMES), film.name))
            ]
            if films:
                groups.append((f"{arm}, N = {n}" if n else arm, films))
    parts = {
        "Success on unseen objects": rates_table(rows),
        "Per object": objects_table(rows),
        "Laws": laws_text(rows),
        "Arms compared": differences_table(rows),
        "Failures": failures_table(rows),
        "What it took": costs_table(rows),
    }
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "figure.svg"
        write_figure(rows, picture)
        figure = "data:image/svg+xml;base64," + base64.b64encode(picture.read_bytes()).decode()
    page = jinja2.Environment(autoescape=True).from_string(_TEMPLATE)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        page.render(
            paper=paper_text(rows),
            arms=ARMS,
            figure=Markup(figure),
            parts=[(title, as_html(text)) for title, text in parts.items() if text],
            groups=groups,
            left_out=len(budget.left_out),
        )
    )


def as_html(text: str) -> Markup:
    """Return a Markdown table, or lines that begin with a dash, as HTML."""
    lines = text.splitlines()
    if not lines[0].startswith("|"):
        items = [f"<li>{escape(line.removeprefix('- '))}</li>" for line in lines]
        return Markup("<ul>" + "".join(items) + "</ul>")
    cells = [re.split(r" *\| *", line.strip("| ")) for line in lines if not line.startswith("|-")]
    head, *body = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in cells]
    rows = "".join(f"<tr>{row}</tr>" for row in body)
    return Markup(f"<table><tr>{head.replace('td>', 'th>')}</tr>{rows}</table>")
