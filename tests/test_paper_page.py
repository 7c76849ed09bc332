"""What `docs/paper.md` says of the paper and of our code is so: figures, files, names."""

import ast
import functools
import re
from typing import Any

import pytest
import yaml

from paper_tables import papers_value
from results_table import ROOT

PAGE = (ROOT / "docs" / "paper.md").read_text()
ROWS = [
    [cell.strip() for cell in line.split("|")[1:-1]]
    for line in PAGE.splitlines()
    if re.match(r"\| \d+ \|", line)
]
ROW_NAMES = [row[0] for row in ROWS]
NUMBER = re.compile(r"(?<![\w.-])(\d[\d,]*(?:\.\d+)?)( %)?(?![\w-])")
PLACE = re.compile(r"`((?:\w+/)+\w+\.\w+)(?::([\w.]+))?`")


def figures_in(claim: str) -> list[float]:
    """Return the numbers of a claim, without those that name a table or a figure of the paper."""
    plain = re.sub(r"\b(tables?|figures?) \d+((, \d+)* (and|to) \d+)?", "", claim, flags=re.I)
    return [
        float(number.replace(",", "")) / (100 if percent else 1)
        for number, percent in NUMBER.findall(plain)
    ]


def values_of(where: str) -> list[float]:
    value = papers_value(where)
    return list(value) if isinstance(value, list) else [value]


@functools.cache
def names_in(path: str) -> set[str]:
    """Return what a Python file defines, members as `Class.member`, or the settings of a YAML file."""
    file = ROOT / path
    if file.suffix == ".yaml":
        return set(_settings(yaml.safe_load(file.read_text())))
    return set(_defined(ast.parse(file.read_text()).body, ""))


def _settings(data: Any, before: str = "") -> list[str]:
    if not isinstance(data, dict):
        return []
    return [
        name
        for key, value in data.items()
        for name in (f"{before}{key}", *_settings(value, f"{before}{key}."))
    ]


def _defined(body: list[ast.stmt], before: str) -> list[str]:
    found: list[str] = []
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.append(before + node.name)
        if isinstance(node, ast.ClassDef):
            found += _defined(node.body, f"{before}{node.name}.")
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        found += [before + target.id for target in targets if isinstance(target, ast.Name)]
    return found


def test_the_page_has_a_row_for_each_claim_of_the_reading():
    assert [str(k) for k in range(1, 104)] == ROW_NAMES


@pytest.mark.parametrize("row", ROWS, ids=ROW_NAMES)
def test_the_figures_of_a_claim_are_the_paper_s(row: list[str]):
    _, claim, where, *_ = row

    named = [value for key in re.findall(r"`(.+?)`", where) for value in values_of(key)]

    assert figures_in(claim) == pytest.approx(named)


@pytest.mark.parametrize("row", ROWS, ids=ROW_NAMES)
def test_every_file_and_name_of_a_row_exists(row: list[str]):
    here = row[3]
    places = PLACE.findall(" ".join(row))

    assert here == "-" or PLACE.sub("", here).strip(", ") == "", "write it as `path:name`"
    for path, name in places:
        assert (ROOT / path).is_file(), path
        assert not name or name in names_in(path), f"{path} has no {name}"


@pytest.mark.parametrize("row", ROWS, ids=ROW_NAMES)
def test_a_row_says_whether_it_is_the_same_and_if_not_why(row: list[str]):
    found = re.fullmatch(r"(same)\b.*|(?:partly|differs|missing): (.+)", row[4])

    assert found is not None, row[4]
    assert found[1] or len(found[2].split()) >= 3
    assert re.sub(r"<!--.*?-->", "", row[5]).strip()
    assert row[3] != "-" or row[4].startswith("missing")
