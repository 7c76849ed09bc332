"""A cluster of three raylets on this machine; every raylet has room for one task."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import RECORD_FILE
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.pipeline.workers import only_run_in, run_stages

sys.path.insert(0, str(Path(__file__).parent))
from raylets import NODE, running_cluster
from sample_stages import BEGUN, GO_ON, Recipe, chain, make_noted

ROOT = Path(__file__).parents[2]
TIMES = ("seconds", "provenance", "checksum")
"""Of a record: when and where it was made, and the checksum over that; not what it is."""


@pytest.fixture(scope="module")
def cluster():
    with running_cluster(3) as cluster:
        yield cluster


def noted(item: str, waits: bool = False, trouble: str = "") -> Stage:
    """Return two stages that note when they begin; the first one may wait or go wrong."""
    two = chain(Recipe(waits=waits, trouble=trouble), Recipe(text="b"), item=item)
    one = replace(two.inputs["one"], make=make_noted)
    return replace(two, inputs={"one": one}, make=make_noted)


def run(stages: list[Stage], root: Path, **runtime) -> dict[tuple[str, str], str]:
    with only_run_in(root):
        outcomes = run_stages(stages, Runtime(root=root, **runtime), lambda event: None)
    return {(o.stage, o.item): o.reason or o.status for o in outcomes.values()}


def made_here(stages: list[Stage], root: Path) -> Path:
    """Make stages by one worker process, without waiting; return where."""
    root.mkdir()
    (root / GO_ON).touch()
    run(stages, root, workers=1)
    return root


def content(root: Path) -> dict[str, object]:
    """Return every file of every result, of records what is no time and no place."""
    found: dict[str, object] = {}
    for path in sorted(p for name in ("one", "two") for p in (root / name).rglob("*")):
        if path.is_file():
            told = path.read_bytes()
            if path.name == RECORD_FILE:
                told = {k: v for k, v in json.loads(told).items() if k not in TIMES}
            found[str(path.relative_to(root))] = told
    return found


def times_begun(root: Path) -> Counter[str]:
    return Counter(line.split()[0] for line in (root / BEGUN).read_text().splitlines())


def wait_for(what, seconds: float = 300.0) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
def test_one_worker_two_workers_and_a_cluster_make_the_same_bytes(cluster, tmp_path):
    stages = [noted("a"), noted("b"), noted("c", trouble="reject")]
    one = run(stages, tmp_path / "one", workers=1)
    two = run(stages, tmp_path / "two", workers=2)
    ray = run(stages, tmp_path / "ray", workers=0, engine="ray", address=cluster.address)

    assert one == two == ray
    assert ray["two", "a"] == "made"
    assert content(tmp_path / "one") == content(tmp_path / "two") == content(tmp_path / "ray")
    assert set(times_begun(tmp_path / "ray").values()) == {1}
    for record in (tmp_path / "ray").glob(f"*/*/{RECORD_FILE}"):
        assert json.loads(record.read_text())["provenance"]["argv"][1:] == sys.argv[1:]


@pytest.mark.slow
def test_a_task_that_always_crashes_fails_alone_and_what_a_stage_reports_is_not_tried_again(
    cluster, tmp_path
):
    crashes, raises, good = noted("x", trouble="crash"), noted("y", trouble="raise"), noted("z")

    found = run(
        [crashes, raises, good.inputs["one"]], tmp_path, engine="ray", address=cluster.address
    )

    assert found["one", "x"] == found["two", "x"] == "crashed"
    assert found["one", "y"] == "RuntimeError"
    assert found["one", "z"] == "made"
    begun = times_begun(tmp_path)
    assert begun[crashes.inputs["one"].folder_name] == 3
    assert begun[raises.inputs["one"].folder_name] == 1
    log = tmp_path / "logs" / f"one-{raises.inputs['one'].folder_name}.log"
    assert "boom" in log.read_text()


@pytest.mark.slow
def test_a_task_that_hangs_is_ended_after_its_time_and_not_begun_again(cluster, tmp_path):
    hangs = noted("hangs", waits=True).inputs["one"]

    found = run([hangs], tmp_path, engine="ray", address=cluster.address, limit_s=2.0)

    assert found["one", "hangs"] == "too_long"
    assert times_begun(tmp_path)[hangs.folder_name] == 1


@pytest.mark.slow
@pytest.mark.long
def test_a_run_whose_driver_is_killed_goes_on_where_it_was(cluster, tmp_path):
    script = tmp_path / "driver.py"
    script.write_text(
        textwrap.dedent(f"""
        import sys
        from pathlib import Path
        sys.path[:0] = [{str(ROOT)!r}, {str(Path(__file__).parent)!r}]
        from test_ray import noted, run
        run([noted("quick"), noted("slow", waits=True)], Path(sys.argv[1]), engine="ray", address=sys.argv[2])
        """)
    )
    root = tmp_path / "run"
    stages = [noted("quick"), noted("slow", waits=True)]
    quick, slow = stages[0], stages[1].inputs["one"]
    driver = subprocess.Popen([sys.executable, script, root, cluster.address])
    wait_for(lambda: (quick.folder(root) / RECORD_FILE).exists())
    wait_for(lambda: times_begun(root)[slow.folder_name] == 1)
    driver.kill()
    driver.wait()

    (root / GO_ON).touch()
    found = run(stages, root, engine="ray", address=cluster.address)

    assert set(found.values()) == {"kept", "made"}
    assert times_begun(root) == {
        quick.inputs["one"].folder_name: 1,
        quick.folder_name: 1,
        slow.folder_name: 2,
        stages[1].folder_name: 1,
    }
    assert content(root) == content(made_here(stages, tmp_path / "local"))


@pytest.mark.slow
@pytest.mark.long
def test_a_killed_raylet_costs_what_it_was_making_and_nothing_else(cluster, tmp_path):
    victim = cluster.add_node(**NODE)
    raylet = victim.all_processes["raylet"][0].process
    stages = [noted(item, waits=True).inputs["one"] for item in "abcd"]
    killed: list[str] = []

    def kill(event) -> None:
        """Kill the raylet as soon as one of its tasks has begun."""
        if event.kind != "started":
            return
        if not killed and event.stage.item == "d":
            wait_for(lambda: any(line.endswith(f" {raylet.pid}") for line in lines()))
            killed.extend(line.split()[0] for line in lines() if line.endswith(f" {raylet.pid}"))
            os.kill(raylet.pid, signal.SIGKILL)
            (tmp_path / GO_ON).touch()

    def lines() -> list[str]:
        path = tmp_path / BEGUN
        return path.read_text().splitlines() if path.exists() else []

    with only_run_in(tmp_path):
        runtime = Runtime(root=tmp_path, engine="ray", address=cluster.address, workers=4)
        outcomes = run_stages(stages, runtime, kill)
    cluster.remove_node(victim, allow_graceful=False)

    assert {o.status for o in outcomes.values()} == {"made"}
    begun = times_begun(tmp_path)
    assert killed
    assert {name for name, times in begun.items() if times == 2} == set(killed)
    assert set(begun.values()) == {1, 2}
    assert content(tmp_path) == content(made_here(stages, tmp_path / "local"))


@pytest.mark.slow
def test_a_cluster_without_a_gpu_says_so_before_anything_waits_for_one(cluster, tmp_path):
    stage = replace(noted("a").inputs["one"], on_device=True)

    with pytest.raises(V2PError, match=r"no node of the Ray cluster at .* has a GPU"):
        run([stage], tmp_path, device="cuda", engine="ray", address=cluster.address)


def test_an_address_without_a_cluster_is_named_within_ten_seconds(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    began = time.monotonic()

    with pytest.raises(V2PError, match=f"no Ray cluster answers at {address}"):
        run([noted("a")], tmp_path, engine="ray", address=address)

    assert time.monotonic() - began < 10


def test_without_ray_one_sentence_says_how_to_install_it(tmp_path):
    code = "import sys; sys.modules['ray'] = None; from v2p_data.cli import main; main()"
    videos = ROOT / "datasets" / "sample_videos"
    words = ["scene", videos, "--out", tmp_path, "--engine=ray"]

    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True, check=False
    )

    assert done.returncode == 2
    assert "'make setup'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["kuberay.yaml", "skypilot.yaml"])
def test_launch_files_are_yaml(name):
    documents = list(yaml.safe_load_all((ROOT / "docs" / "scale" / name).read_text()))

    assert "v2p generate" in json.dumps(documents)


def test_the_launch_file_for_slurm_is_a_shell_script():
    bash = shutil.which("bash")
    assert bash is not None
    assert subprocess.run([bash, "-n", ROOT / "docs/scale/slurm.sh"], check=False).returncode == 0
