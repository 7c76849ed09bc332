"""A task folder from elsewhere is opened, or refused in one sentence that names the file; nothing else happens."""

import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from v2p_data.cli import run
from v2p_data.errors import V2PError
from v2p_data.scene.files import copy_folder, is_plain_path, own_file
from v2p_data.scene.scene import SCHEMA, Scene, SceneFile
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.robot.arms import RobotConfig
from v2p_data.sim.wrappers.gym_env import V2PEnv
from v2p_data.task.audit.audit import Audit
from v2p_data.task.robot_files import robot_files
from v2p_data.task.sandbox import time_limit, trial
from v2p_data.task.sandbox.smoke import smoke_run_all
from v2p_data.task.sandbox.time_limit import TaskCallError, TaskCodeTooSlowError, in_time
from v2p_data.task.schema import AuditEntry, RobotEntry, TaskFile
from v2p_data.task.task import TaskBundle

sys.path.insert(0, str(Path(__file__).parent))
import strangers

GOOD_CODE = strangers.code_with()
LATE = "if states['eef_pos'].shape[0] == 3:\n            {}"
"""What happens only in an environment of three worlds: the trial run has other numbers."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder that can be opened; its code counts as tried, so that refusals are those of the files."""
    folder = tmp_path_factory.mktemp("strangers")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("V2P_CACHE_DIR", str(folder / "cache"))
        made = strangers.good_task(folder / "good")
        bundle = TaskBundle.load(made)
        trial.note_passed(bundle.code, bundle.scene)
        yield made


@pytest.fixture
def spoiled(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "spoiled"))


def test_the_folder_that_all_are_made_of_can_be_opened_and_stepped(good: Path):
    env = V2PEnv(str(good))

    env.reset(seed=0)
    observation, *_ = env.step(np.zeros(7))

    assert observation["pixels"]["mask"].shape == (256, 256, 3)


@pytest.mark.parametrize("name", strangers.CASES)
def test_a_spoiled_folder_is_refused_in_one_sentence_that_names_the_file(name: str, spoiled: Path):
    strangers.CASES[name](spoiled)
    began = time.process_time()

    with pytest.raises(V2PError) as caught:
        V2PEnv(str(spoiled))

    assert str(spoiled) in str(caught.value)
    assert len(str(caught.value)) < 1500
    assert time.process_time() - began < 10


@pytest.mark.slow
def test_code_that_does_not_work_is_held_and_named_by_the_trial(tmp_path: Path):
    scene = strangers.good_scene(tmp_path)

    good, *bad = smoke_run_all([GOOD_CODE, *strangers.CODE.values()], scene, seconds_each=1.0)

    assert good.runnable
    assert [
        name for name, result in zip(strangers.CODE, bad, strict=True) if result.runnable
    ] == []
    assert all(result.error for result in bad)


@pytest.mark.slow
def test_code_of_a_folder_is_tried_in_the_child_before_it_runs_here_once(
    spoiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("V2P_CACHE_DIR", str(tmp_path / "cache"))
    (spoiled / "task.py").write_text(strangers.CODE["raises in success"])
    (spoiled / "record.json").write_text('{"stage": "task"}')

    with pytest.raises(V2PError, match=r"task\.py is not run here.*line 20: IndexError"):
        V2PEnv(str(spoiled))

    (spoiled / "task.py").write_text(GOOD_CODE)
    BatchEnv(TaskBundle.load(spoiled), num_envs=1, seed=0)
    monkeypatch.setattr(trial, "smoke_run", None)  # would fail if it were asked again
    BatchEnv(TaskBundle.load(spoiled), num_envs=1, seed=0)
    monkeypatch.setattr(trial, "_passed", set())  # another process
    BatchEnv(TaskBundle.load(spoiled), num_envs=1, seed=0)


@pytest.mark.parametrize(
    "file", ["task.json", "scene/scene.json", "task.py", "scene/meshes/cube.obj"]
)
def test_the_command_line_ends_with_exit_code_2(file: str, spoiled: Path, tmp_path: Path, capsys):
    (spoiled / file).unlink()
    (spoiled / file).symlink_to("/etc/passwd")

    code = run(["eval", "programs", "--tasks", str(spoiled), "--out", str(tmp_path / "run")])

    assert code == 2
    assert f"{spoiled / file} is a link" in " ".join(capsys.readouterr().err.split())


# --- the limit on calls ------------------------------------------------------------------------------------------


def opened(folder: Path, **lines: str) -> TaskBundle:
    """Return the task with lines in its methods that only three worlds meet; the trial has let them pass."""
    (folder / "task.py").write_text(strangers.code_with(**lines))
    bundle = TaskBundle.load(folder)
    trial.note_passed(bundle.code, bundle.scene)
    return bundle


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_limit, "LIMIT_S", 1.0)


@pytest.mark.parametrize(
    ("method", "line"),
    [
        ("init", "if self.envs.num_envs == 3:\n            busy(torch.zeros(1000))"),
        ("reset", "if len(env_ids) == 3:\n            busy(torch.zeros(1000))"),
        ("space", "if self.envs.num_envs == 3:\n            busy(torch.zeros(1000))"),
        *((m, LATE.format("busy(torch.zeros(1000))")) for m in ("success", "keys")),
        ("reward", LATE.format("busy(torch.zeros(1000))").replace("            ", "        ")),
    ],
)
def test_a_call_that_loops_ends_with_one_sentence(
    method: str, line: str, spoiled: Path, impatient: None
):
    bundle = opened(spoiled, **{method: line})

    with pytest.raises(TaskCodeTooSlowError, match="took more than 1 s and was ended"):
        BatchEnv(bundle, num_envs=3, seed=0).step(np.zeros((3, 7)))


def test_a_call_that_raises_late_is_a_sentence_with_its_line(spoiled: Path):
    bundle = opened(spoiled, success=LATE.format("torch.zeros(2)[5]"))

    with pytest.raises(
        TaskCallError, match="line 21 of the task's code, compute_success, raises IndexError"
    ):
        BatchEnv(bundle, num_envs=3, seed=0).step(np.zeros((3, 7)))


def loop() -> int:
    return sum(1 for _ in iter(int, 1))


def test_the_limit_holds_in_any_thread_and_spares_what_comes_next(impatient: None):
    said: list[str] = []

    def call() -> None:
        with pytest.raises(TaskCodeTooSlowError) as caught:
            in_time(loop)
        said.append(str(caught.value))
        for _ in range(200_000):  # an exception that came late would hit here
            pass

    thread = threading.Thread(target=call)
    thread.start()
    call()
    thread.join()

    assert len(said) == 2
    assert in_time(lambda: "done") == "done"


def test_the_limit_holds_in_a_fork(impatient: None):
    in_time(int)  # starts the watching thread, which a fork does not have
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            in_time(loop)
        except TaskCodeTooSlowError:
            code = 0
        finally:
            os._exit(code)

    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


# --- the schema and the files ----------------------------------------------------------------------------------


def test_the_files_have_the_fields_of_what_they_become():
    def names(kind: type) -> set[str]:
        return {f.name for f in fields(kind)}

    assert set(SceneFile.model_fields) == (
        names(Scene) - {"folder", "T_world_cams", "crop_px"}
    ) | {"version"}
    assert set(TaskFile.model_fields) == names(TaskBundle) - {"scene", "code", "folder"}
    assert set(RobotEntry.model_fields) == names(RobotConfig)
    assert set(AuditEntry.model_fields) == names(Audit) | {"acceptable"}
    assert get_args(SceneFile.model_fields["version"].annotation) == (SCHEMA,)


def test_reading_gives_back_what_was_written(good: Path, tmp_path: Path):
    bundle = TaskBundle.load(good)

    bundle.save(tmp_path / "again")

    again = TaskBundle.load(tmp_path / "again")
    assert again.scene.objects == bundle.scene.objects
    assert (again.code, again.audit, again.robot) == (bundle.code, bundle.audit, bundle.robot)
    for name in bundle.files():
        assert (tmp_path / "again" / name).read_bytes() == (good / name).read_bytes()


@pytest.mark.parametrize(
    "path", ["", "/a", "../a", "a/../b", "a//b", "./a", "a\\b", "C:a", "a\nb", "a" * 300]
)
def test_a_path_that_leaves_its_folder_or_hides_something_is_not_plain(path: str):
    assert not is_plain_path(path)
    assert is_plain_path("meshes/cube.obj")


def test_links_of_the_hubs_cache_are_followed_into_its_own_blobs_only(tmp_path: Path):
    repository = tmp_path / "models--a--b"
    folder = repository / "snapshots/0123"
    folder.mkdir(parents=True)
    (repository / "blobs").mkdir()
    (repository / "blobs/ab").write_text("{}")
    (tmp_path / "secret").write_text("secret")
    (repository / "blobs/cd").symlink_to(tmp_path / "secret")
    (folder / "good.json").symlink_to("../../blobs/ab")
    (folder / "bad.json").symlink_to("../../blobs/cd")
    (folder / "out.json").symlink_to(tmp_path / "secret")

    assert own_file(folder, "good.json", 100).read_text() == "{}"
    for name in ("bad.json", "out.json"):
        with pytest.raises(V2PError, match=f"{name} is a link"):
            own_file(folder, name, 100)


def test_a_folder_with_a_link_is_not_copied(good: Path, tmp_path: Path):
    source = Path(shutil.copytree(good, tmp_path / "source"))
    (source / "scene/notes.txt").symlink_to("/etc/passwd")

    with pytest.raises(V2PError, match=r"notes\.txt is a link"):
        copy_folder(source, tmp_path / "copy")

    assert not (tmp_path / "copy").exists()
    copy_folder(source, tmp_path / "copy", ignore=shutil.ignore_patterns("notes.txt"))
    assert (tmp_path / "copy/task.py").is_file()


@pytest.mark.parametrize(
    ("sides", "said"), [((30_000, 30_000), "largest of 900"), ((4_000, 4_000), "80 million")]
)
def test_pictures_of_an_arm_are_counted_before_they_are_decoded(tmp_path, sides, said):
    head = (
        b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4) + b"IHDR" + b"".join(s.to_bytes(4) for s in sides)
    )
    count = 1 if sides[0] > 4096 else 5
    for k in range(count):
        (tmp_path / f"{k}.png").write_bytes(head + bytes(9))
    names = "".join(f'<texture name="t{k}" type="2d" file="{k}.png"/>' for k in range(count))
    main = tmp_path / "arm.xml"
    main.write_text(f"<mujoco><asset>{names}</asset><worldbody/></mujoco>")

    with pytest.raises(V2PError, match=f"pictures of .*{said}"):
        robot_files(main)
