"""A damaged file of a run: each command that would read it says so in one sentence, or goes on and says so."""

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from toy_run import ITEM, REPO_ID, bundle, dataset_of, last_stage, made, record_of

from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.episodes.dataset.verify import verify
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import write_record
from v2p_data.pipeline.contents import list_files
from v2p_data.pipeline.runner import Runtime, Stage

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))
from damage import HARMS, JSON_HARMS, KINDS, Kind, delete, flip, harmed_copy, set_entry

QUICK = (
    *("--policy.preset", "small", "--policy.steps", "2", "--policy.batch-size", "8"),
    *("--distillation.rounds", "0"),
)
FEW = ("--evaluation.episodes", "2", "--evaluation.worlds", "2")
NAMES = {kind.name: kind for kind in KINDS}
OF_DATASETS = [k for k in KINDS if k.pattern.startswith("dataset/")]
SOME_JSON_HARMS = [k for k in JSON_HARMS if k != "nested too deeply"]


def make_scene(cfg, inputs, out: Path, runtime: Runtime) -> None:
    bundle().scene.save(out)


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "run_stages", made)


@pytest.fixture(scope="module")
def whole(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run from scene to evaluation; do not write into it."""
    root = Path(shutil.copytree(finished, tmp_path_factory.mktemp("whole") / "run"))
    made([Stage(name="scene", item=ITEM, config={}, make=make_scene)], Runtime(root=root))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands, "run_stages", made)
        assert run(["train", str(dataset_of(root)), *QUICK]) == 0
        assert run(["eval", str(policy_of(root)), *FEW]) == 0
    return root


@pytest.fixture
def root(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "run"))


def policy_of(root: Path) -> Path:
    (folder,) = root.glob("policy/*/policy")
    return folder


def said(capsys: pytest.CaptureFixture[str], *argv: object, code: int = 2) -> str:
    """Return the one sentence on stderr; the command must end with this code and without a traceback."""
    capsys.readouterr()
    assert run([str(a) for a in argv]) == code
    words = capsys.readouterr().err
    assert "Traceback" not in words
    lines = [line for line in words.splitlines() if line.startswith(f"v2p {argv[0]}: ")]
    assert len(lines) == (code == 2)
    return lines[0] if lines else ""


def is_still_a_list(path: Path) -> bool:
    """Tell whether a harm left a sound `run.json`: nothing else lists what is in it."""
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return False
    return (
        path.name == "run.json"
        and isinstance(data, list)
        and all(isinstance(d, dict) for d in data)
    )


def present(root: Path) -> Iterator[tuple[Kind, Path]]:
    """Yield one file of each kind that the run holds and its records list."""
    for kind in KINDS:
        if kind.is_listed and (files := kind.files(root)):
            yield kind, files[0]


def test_the_corpus_meets_this_run(whole: Path):
    found = {kind.name for kind, _ in present(whole)}

    assert len(found) >= 20
    assert {"expert weights", "staged episode", "dataset video", "policy weights"} <= found


def test_status_lists_what_is_damaged(capsys, root: Path):
    assert run(["status", str(root), "--check"]) == 0
    assert "damaged" not in capsys.readouterr().out
    for kind, path in present(root):
        whole = path.read_bytes()
        for name in ("flipped in the middle", "last byte lost", "deleted"):
            HARMS[name](path)

            assert run(["status", str(root), "--check"]) == 1
            (line,) = [x for x in capsys.readouterr().out.splitlines() if "damaged;" in x]
            assert str(path) in line, (kind.name, name)
            if name != "flipped in the middle":  # sizes tell without reading
                assert run(["status", str(root)]) == 0
                assert str(path) in capsys.readouterr().out, (kind.name, name)

            path.write_bytes(whole)
    assert run(["status", str(root), "--check"]) == 0


@pytest.mark.parametrize(
    "pattern", ["*/*/record.json", "run.json", "evaluation/*/evaluation.json"]
)
def test_status_and_report_go_on_and_name_the_file(capsys, root: Path, pattern: str):
    path = sorted(root.glob(pattern))[0]
    whole = path.read_text()
    for name, harm in (HARMS | JSON_HARMS).items():
        if name == "deleted" and pattern == "run.json":
            continue
        harm(path)
        if is_still_a_list(path):
            path.write_text(whole)
            continue

        assert run(["status", str(root), "--check"]) in (0, 1)
        words = capsys.readouterr()
        assert "damaged" in words.out, name
        assert str(path) in words.out, name
        assert "Traceback" not in words.err
        if name in ("cut to 50%", "a list", "deleted"):
            assert run(["report", str(root)]) == 0
            is_told = str(path) in (root / "report.html").read_text()
            assert is_told or name == "deleted", name

        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        path.unlink(missing_ok=True)
        path.write_text(whole)


@pytest.mark.parametrize("kind", OF_DATASETS, ids=lambda k: k.name)
@pytest.mark.parametrize(
    "harm", [flip(0.5), pytest.param(delete, marks=pytest.mark.long)], ids=["flipped", "deleted"]
)
def test_a_damaged_dataset_is_not_trained_on_pushed_or_edited(
    capsys, whole: Path, tmp_path: Path, kind: Kind, harm
):
    path = harmed_copy(whole, tmp_path / "run", kind.files(whole)[0], harm)
    dataset = dataset_of(tmp_path / "run")
    if path.name == "info.json" and not path.is_file():
        return  # then it is no dataset at all, which other tests are about
    before = sorted((tmp_path / "run" / "policy").iterdir())

    told = [
        said(capsys, "train", dataset, *QUICK, "--seed", "5"),
        said(capsys, "push", dataset, "--repo-id", REPO_ID),
        said(capsys, "drop", dataset, "--tasks", "x", "--out", tmp_path / "out"),
        said(capsys, "merge", dataset, dataset, "--out", tmp_path / "out", "--repo-id", REPO_ID),
    ]

    assert all(str(path) in words and "run again" in words for words in told), told
    assert not (tmp_path / "out").exists()
    whole_ones = [p for p in (tmp_path / "run" / "policy").iterdir() if p.suffix != ".partial"]
    assert sorted(whole_ones) == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", OF_DATASETS, ids=lambda k: k.name)
def test_verify_finds_every_flipped_file(capsys, whole: Path, tmp_path: Path, kind: Kind):
    path = harmed_copy(whole, tmp_path / "run", kind.files(whole)[0], flip(0.3))
    dataset = dataset_of(tmp_path / "run")

    try:
        code = run(["verify", str(dataset)])
    finally:
        words = capsys.readouterr()

    assert code == 1 or (code, path.name) == (2, "info.json")
    assert path.relative_to(dataset).as_posix() in words.out + words.err


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
@pytest.mark.parametrize("kind", ["expert weights", "staged episode"])
def test_no_dataset_is_made_of_what_is_damaged(
    agreeing_referee, whole: Path, tmp_path: Path, kind: str, harm
):
    """Two flipped bytes once gave another dataset under the same name, a lost episode one without it."""
    root = tmp_path / "run"
    path = harmed_copy(whole, root, NAMES[kind].files(whole)[0], harm)
    if kind == "expert weights":
        shutil.rmtree(root / "episodes")

    outcomes = made([last_stage("me/others")], Runtime(root=root))

    by_stage = {o.stage: o for o in outcomes.values()}
    hurt = by_stage["expert" if kind == "expert weights" else "episodes"]
    assert (hurt.status, hurt.reason) == ("failed", "damaged")
    assert str(path) in hurt.detail
    assert by_stage["dataset"].status == "blocked"
    assert not list(root.glob("dataset/others-*"))


def training(root: Path) -> tuple[object, ...]:
    return ("train", dataset_of(root), *QUICK, "--distillation.rounds", "1")


def judging(root: Path) -> tuple[object, ...]:
    return ("eval", policy_of(root), *FEW, "--seed", "3")


def judging_an_expert(root: Path) -> tuple[object, ...]:
    return ("eval", next(root.glob("expert/*")), *FEW)


def pushing(root: Path) -> tuple[object, ...]:
    return ("push", policy_of(root), "--repo-id", REPO_ID)


def sharing_tasks(root: Path) -> tuple[object, ...]:
    return ("push", root, "--repo-id", REPO_ID, "--envhub")


@pytest.mark.parametrize("harm", [flip(0.5), HARMS["cut to 50%"], delete])
@pytest.mark.parametrize(
    ("command", "kind"),
    [
        (training, "expert weights"),
        (training, "staged episode"),
        (training, "task code"),
        (judging, "policy weights"),
        (judging, "policy settings"),
        (judging, "processors"),
        (judging, "task code"),
        (judging_an_expert, "expert weights"),
        (judging_an_expert, "expert"),
        (pushing, "policy weights"),
        (sharing_tasks, "task code"),
    ],
)
def test_no_command_reads_what_is_damaged(
    capsys, whole: Path, tmp_path: Path, command, kind, harm
):
    path = harmed_copy(whole, tmp_path / "run", NAMES[kind].files(whole)[0], harm)

    assert path.name in said(capsys, *command(tmp_path / "run"))


@pytest.mark.parametrize("command", ["train", "eval", "explain", "distill"])
@pytest.mark.parametrize(
    "name", ["cut to 50%", "noise", "a folder", "a list", "nested too deeply"]
)
def test_a_damaged_record_is_named(capsys, root: Path, command: str, name: str):
    place = policy_of(root).parent if command == "eval" else dataset_of(root)
    (HARMS | JSON_HARMS)[name](place / "record.json")
    shown = {"eval": place / "policy"}.get(command, place)

    words = said(capsys, command, shown)

    assert str(place / "record.json") in words
    assert "run again: it is made anew" in words


@pytest.mark.parametrize("name", SOME_JSON_HARMS)
def test_metadata_without_a_record_is_looked_at_too(
    capsys, whole: Path, tmp_path: Path, name: str
):
    dataset = Path(shutil.copytree(dataset_of(whole), tmp_path / "mine"))
    (dataset / "record.json").unlink()
    JSON_HARMS[name](dataset / "meta/v2p.json")

    assert "v2p.json is damaged" in said(capsys, "explain", dataset)
    assert "v2p.json is damaged" in said(capsys, "push", dataset, "--repo-id", REPO_ID)
    assert "v2p.json is damaged" in said(
        capsys, "drop", dataset, "--tasks", "x", "--out", tmp_path / "out"
    )


def change(path: Path, key: str, value: object) -> None:
    set_entry(key, value)(path)


def first_episode(path: Path, **entries: object) -> None:
    about = json.loads(path.read_text())
    about["episodes"][0] |= entries
    path.write_text(json.dumps(about))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (lambda p: p.write_text(p.read_text()[:500]), "no JSON object"),
        (lambda p: p.unlink(), "v2p.json is missing"),
        (lambda p: change(p, "repo_id", 3), "'repo_id' is missing or of another kind"),
        (lambda p: change(p, "schema", 99), "newer version of v2p (schema 99"),
        (lambda p: change(p, "episodes", []), "tells of 0 episodes"),
        (lambda p: change(p, "palette", {}), "gives no grey for label"),
        (lambda p: first_episode(p, length=4), "says 4 frames"),
        (lambda p: first_episode(p, task="dance"), "frames of 'dance'"),
        (lambda p: first_episode(p, seed="x"), "'seed' of episode 0 is missing"),
        (lambda p: shutil.rmtree(p.parents[1] / "v2p"), "episodes were made in task 'toy'"),
        (lambda p: (p.parents[1] / "v2p/tasks/toy/task.py").unlink(), "v2p/tasks/toy/task.py"),
    ],
)
def test_verify_reads_our_own_metadata(whole: Path, tmp_path: Path, harm, words: str):
    dataset = Path(shutil.copytree(dataset_of(whole), tmp_path / "mine"))
    (dataset / "record.json").unlink()
    harm(dataset / "meta/v2p.json")

    try:
        found = " ".join(f"{p.where} {p.detail}" for p in verify(dataset).problems)
    except V2PError as error:
        found = str(error)

    assert words in found


def test_a_folder_in_the_place_of_the_last_outcomes_is_named(capsys, root: Path):
    (root / "run.json").unlink()
    (root / "run.json").mkdir()

    assert str(root / "run.json") in said(capsys, "train", dataset_of(root), *QUICK)


def test_files_of_a_dataset_that_its_owner_wrote_are_no_damage(root: Path):
    dataset = dataset_of(root)
    (dataset / "README.md").write_text("my own words")
    (dataset / "NOTES.md").write_text("more")

    outcomes = made([last_stage()], Runtime(root=root))

    assert {o.status for o in outcomes.values()} == {"kept"}


def test_a_record_lists_all_that_lies_in_the_folder(whole: Path):
    for path in whole.glob("*/*/record.json"):
        record = record_of(path.parent)
        assert record.files == list_files(path.parent)
        assert record.files or record.stage == "none"
        write_record(path.parent, record)  # the same again
        assert record_of(path.parent) == record
