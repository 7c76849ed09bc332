"""What is given away: it names no place and no user of its maker, and others can judge a pushed policy by its name."""

import getpass
import json
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hub_server import TOKEN, Hub, running_hub
from toy_run import ENGINE, ITEM, dataset_of, made, make_expert, make_task, record_of

from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.episodes.dataset.packing import copy_tasks
from v2p_data.episodes.hub.hub import fetch_policy
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import provenance
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.stages import dataset_stage, episodes_stage

MAKER = "ann_of_green_gables"
QUICK = (
    *("--policy.preset", "small", "--policy.steps", "2", "--policy.batch-size", "8"),
    *("--distillation.rounds", "1", "--distillation.episodes", "2", "--distillation.worlds", "2"),
    *("--distillation.first-steps", "2"),
)
FEW = ("--evaluation.episodes", "2", "--evaluation.worlds", "2")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run up to its policy, made with absolute paths wherever one can be given."""
    from toy_run import agree

    from v2p_data.episodes import rollouts
    from v2p_data.sim.env import verdict

    root = tmp_path_factory.mktemp(MAKER) / "my runs" / "run"
    with pytest.MonkeyPatch.context() as patch:
        for module in (verdict, rollouts):
            patch.setattr(module, "referee_verdict", agree)
        patch.setattr(commands, "run_stages", made)
        patch.setattr(
            sys, "argv", [f"/home/{MAKER}/bin/v2p", "generate", f"{root}/videos", f"--out={root}"]
        )
        provenance.cache_clear()
        worker = {"worker": shlex.join([f"{root}/venv/bin/python", f"{root}/worker.py"])}
        task = Stage(name="task", item=ITEM, config=worker, make=make_task)
        learned = Stage(
            name="expert", item=ITEM, config=worker, inputs={"task": task}, make=make_expert
        )
        stage = dataset_stage([episodes_stage(task, learned, ENGINE)], "user/toys")
        outcomes = made([stage], Runtime(root=root))
        assert all(o.is_usable for o in outcomes.values()), outcomes
        assert run(["train", str(stage.folder(root)), *QUICK]) == 0
        yield root
    provenance.cache_clear()


@pytest.fixture
def online(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    with running_hub() as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub_cache"))
        monkeypatch.setattr(commands, "run_stages", made)
        yield hub


def policy_of(root: Path) -> Path:
    (folder,) = root.glob("policy/*/policy")
    return folder


def tells_of_its_maker(files: dict[str, bytes], root: Path) -> list[str]:
    """Return the files that name the run's place, the home folder or the user."""
    secrets = [
        MAKER,
        str(root),
        root.parent.name,
        str(Path.home()) + "/",
        f"/{getpass.getuser()}/",
    ]
    return [name for name, data in files.items() if any(s.encode() in data for s in secrets)]


def test_the_record_at_home_keeps_the_whole_command(root: Path):
    assert f"--out={root}" in record_of(dataset_of(root)).provenance["argv"]


def test_a_pushed_dataset_names_no_place_and_no_user(root: Path, online: Hub):
    assert run(["push", str(dataset_of(root)), "--repo-id", "user/toys"]) == 0

    files = online.repos["datasets/user/toys"].files
    assert {"meta/v2p.json", "README.md", f"v2p/tasks/{ITEM}/task.json"} <= set(files)
    assert tells_of_its_maker(files, root) == []
    about = json.loads(files["meta/v2p.json"])["provenance"]
    assert about["argv"] == ["v2p", "generate", "videos", "--out=run"]
    recipe = about["items"][ITEM]["inputs"]["task"]["recipe"]
    assert recipe["config"]["worker"] == "'python' 'worker.py'"


def test_a_pushed_policy_names_no_place_and_no_user(root: Path, online: Hub):
    assert run(["push", str(policy_of(root)), "--repo-id", "user/policy"]) == 0

    files = online.repos["models/user/policy"].files
    assert {"config.json", "model.safetensors", "train_config.json", "README.md"} <= set(files)
    assert tells_of_its_maker(files, root) == []
    assert json.loads(files["train_config.json"])["dataset"]["root"] == (
        dataset_of(root).relative_to(root).as_posix()
    )


def test_pushed_tasks_name_no_place_and_no_user(root: Path, online: Hub):
    assert run(["push", str(root), "--repo-id", "user/tasks", "--envhub"]) == 0

    files = online.repos["models/user/tasks"].files
    own = {k: v for k, v in files.items() if not k.startswith("v2p_data/")}
    assert f"tasks/{ITEM}-{MAKER}" not in own
    assert tells_of_its_maker(own, root) == []


def test_a_dataset_of_an_earlier_version_loses_its_places_when_it_is_pushed(
    root: Path, tmp_path: Path, online: Hub
):
    dataset = Path(shutil.copytree(dataset_of(root), tmp_path / "old"))
    (dataset / "record.json").unlink()
    path = dataset / "meta/v2p.json"
    about = json.loads(path.read_text())
    about["provenance"]["argv"] = ["v2p", "generate", f"/home/{MAKER}/videos"]
    path.write_text(json.dumps(about))

    assert run(["push", str(dataset), "--repo-id", "user/toys"]) == 0

    assert tells_of_its_maker(online.repos["datasets/user/toys"].files, root) == []


def test_a_carried_task_of_another_arm_holds_its_files_name_only(root: Path, tmp_path: Path):
    task = Path(shutil.copytree(next((root / "task").iterdir()), tmp_path / "task"))
    described = json.loads((task / "task.json").read_text())
    described["robot"] = {"path": f"/home/{MAKER}/arms/arm.xml", "eef_site": "tool"}
    (task / "task.json").write_text(json.dumps(described))

    copy_tasks({"toy": task}, tmp_path / "dataset")

    copied = json.loads((tmp_path / "dataset/v2p/tasks/toy/task.json").read_text())
    assert copied["robot"] == {"path": "arm.xml", "eef_site": "tool"}
    assert {**copied, "robot": 0} == {**described, "robot": 0}


# --- judging by name -----------------------------------------------------------------------------------------


def test_a_pushed_policy_is_judged_as_its_card_says(
    capsys, agreeing_referee, root: Path, online: Hub, tmp_path: Path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert run(["push", str(policy_of(root)), "--repo-id", "user/policy"]) == 0
    assert run(["push", str(dataset_of(root)), "--repo-id", "user/toys"]) == 0
    card = online.repos["models/user/policy"].files["README.md"].decode()
    fetch, judge, _ = card.split("```")[1].splitlines()[1:]
    assert shlex.split(fetch)[:3] == ["hf", "download", "user/toys"]
    for name, data in online.repos["datasets/user/toys"].files.items():
        if name.startswith("v2p/tasks/"):  # what the first command fetches
            (tmp_path / "dataset" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "dataset" / name).write_bytes(data)
    capsys.readouterr()

    assert run([*shlex.split(judge)[1:], *FEW]) == 0

    said = capsys.readouterr().out
    assert f"{ITEM}  unseen" in said
    (made_here,) = (tmp_path / "outputs/policy/evaluation").iterdir()
    assert made_here.name.startswith("policy-")
    assert (made_here / "evaluation.json").is_file()


def test_a_name_that_is_neither_a_folder_nor_on_the_hub_is_named(capsys, online: Hub):
    assert run(["eval", "user/nobody", "--tasks", "x"]) == 2

    words = capsys.readouterr().err
    assert "there is no folder user/nobody, and" in words
    assert "cannot fetch 'user/nobody': it is not there" in words


def test_a_repository_without_a_policy_is_named(capsys, root: Path, online: Hub):
    assert run(["push", str(root), "--repo-id", "user/tasks", "--envhub"]) == 0

    with pytest.raises(
        V2PError, match=r"'user/tasks' is no LeRobot policy: it holds no config.json"
    ):
        fetch_policy("user/tasks")


def test_without_a_line_to_the_hub_that_is_said(capsys, monkeypatch: pytest.MonkeyPatch, tmp_path):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:1")
    monkeypatch.delenv("HF_TOKEN", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))

    with pytest.raises(V2PError, match=r"cannot reach http://127.0.0.1:1"):
        fetch_policy("user/policy", waits_s=())
