"""The network driver: the example server in a process of its own, and servers that do not keep to the protocol."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from v2p_data.deployment.limits import LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Onlooker, Run
from v2p_data.deployment.protocol import LONGEST_LINE, Driver
from v2p_data.deployment.rig import Rig
from v2p_data.deployment.sight import Sight
from v2p_data.errors import V2PError

ROOT = Path(__file__).parents[2]
PATIENT = LimitsConfig(max_silence_ms=60_000.0)
CAMERA = {
    "width_px": 256,
    "height_px": 256,
    "K": [300, 0, 128, 0, 300, 128, 0, 0, 1],
    "T_world_cam": np.eye(4).ravel().tolist(),
}


class Served:
    """A running example server."""

    def __init__(self, task: Path, *flags: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "scripts/example_robot_server.py", "--task", str(task), *flags],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture(scope="module")
def server(task_folder, seeing_robot):
    """Return a server whose time passes only when a target comes.

    `seeing_robot` has skipped where there is no OpenGL.
    """
    served = Served(task_folder, "--lockstep")
    yield served
    served.end()


def robot_at(address, tmp_path, **settings):
    from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
    from lerobot_policy_v2p.robot.v2p_franka import V2PFranka

    settings = {"pictures": "rgb", "timeout_s": 20.0, **settings}
    robot = V2PFranka(
        V2PFrankaConfig(backend="network", address=address, calibration_dir=tmp_path, **settings)
    )
    robot.connect()
    return robot


def test_a_driver_reads_and_moves_like_the_arm_behind_it(
    server, seeing_robot, restarted, tmp_path
):
    restarted(seeing_robot)
    robot = robot_at(server.address, tmp_path)

    far, near = Rig(robot).read(), Rig(seeing_robot).read()
    np.testing.assert_allclose(far.state[:7], near.state[:7], atol=1e-5)
    np.testing.assert_array_equal(far.picture, near.picture)
    np.testing.assert_allclose(far.joints_rad, near.joints_rad, atol=1e-9)
    np.testing.assert_allclose(
        robot.calibration().T_world_cam, seeing_robot.calibration().T_world_cam
    )
    for action in ([0.5, 0.2, -0.3, 0, 0, 0.4, 1.0], [0.5, 0.2, -0.3, 0, 0, 0.4, 1.0], [0] * 7):
        Rig(robot).act(np.array(action, float))
        far = Rig(robot).read()
    assert far.tool_pos[0] == pytest.approx(near.tool_pos[0] + 0.03, abs=0.012)
    assert far.tool_pos[1] == pytest.approx(near.tool_pos[1] + 0.012, abs=0.01)
    assert far.state[5] - near.state[5] == pytest.approx(
        -0.16, abs=0.06
    )  # about its own axis, down
    assert far.opening < near.opening - 0.1
    assert far.force_n < 20
    robot.disconnect()


def test_the_loop_runs_over_the_network_and_a_limit_holds_there_too(
    server, seeing_robot, restarted, click_on, steady, tmp_path
):
    robot = robot_at(server.address, tmp_path)
    places = []
    restarted(seeing_robot)
    sight = Sight(robot.calibration(), [click_on(seeing_robot)])
    limits = LimitsConfig(max_silence_ms=60_000.0, max_speed_m_s=0.1)

    cfg = LoopConfig(max_seconds=0.5, slow=True)
    noting = Onlooker(on_step=lambda reading, seen: places.append(reading.tool_pos))

    rig = Rig(robot, limits, sight)
    outcome = Run(rig, steady(0, 0, 1, 0, 0, 0, 0), cfg, noting).go()

    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) * 20
    assert (outcome.ending, outcome.acted["speed"]) == ("time", 10)
    assert 0.05 < speeds.max() < 0.13
    robot.disconnect()


def test_a_real_arm_takes_no_more_than_twenty_actions_a_second_from_lerobots_tools(
    server, seeing_robot, restarted, click_on, tmp_path
):
    restarted(seeing_robot)
    u, v = click_on(seeing_robot)
    robot = robot_at(server.address, tmp_path, pictures="mask", clicks=f"{u:g},{v:g}")
    robot.get_observation()
    still = dict.fromkeys(robot.action_features, 0.0)
    began = time.monotonic()
    for _ in range(5):
        robot.send_action(still)

    assert time.monotonic() - began > 4 * 0.05
    with pytest.raises(V2PError, match="no number"):
        robot.send_action(still | {"delta_z.pos": float("nan")})
    robot.disconnect()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"garbage\n", "Expecting value"),
        (b"[1, 2]\n", "speaks version 1"),
        (b'{"v": 2, "id": 1, "do": "read"}\n', "speaks version 1"),
        (b'{"v": 1, "id": 1, "do": "explode"}\n', "there is no request 'explode'"),
        (b'{"v": 1, "id": 1, "do": "target", "pos_m": [1, 2]}\n', "'quat_wxyz' must be 4"),
        (
            b'{"v": 1, "id": 1, "do": "target", "quat_wxyz": [0, 1, 0, 0], "opening": 1, "pos_m": [NaN, 0, 0]}\n',
            "'pos_m' must be 3 finite numbers",
        ),
        (b"[" * 60000 + b"\n", ""),
    ],
)
def test_the_server_answers_what_it_does_not_understand_and_stays(server, line, words):
    host, port = server.address.split(":")
    with socket.create_connection((host, int(port)), 20) as connection:
        connection.sendall(line)
        said = json.loads(connection.makefile("rb").readline())
        assert said["ok"] is False
        assert words in said["error"]
        connection.sendall(b'{"v": 1, "id": 5, "do": "hold"}\n')
        assert json.loads(connection.makefile("rb").readline()) == {"v": 1, "id": 5, "ok": True}


def test_the_server_drops_a_line_that_does_not_end(server):
    host, port = server.address.split(":")
    with socket.create_connection((host, int(port)), 20) as connection:
        connection.sendall(b"x" * 70000)
        assert connection.makefile("rb").read() == b""


@pytest.fixture
def odd_driver():
    """Return a maker of servers that answer every request with the given bytes, `%d` being the request's id."""
    made = []

    def make(answer: bytes | None) -> str:
        listening = socket.create_server(("127.0.0.1", 0))
        made.append(listening)

        def serve() -> None:
            connection, _ = listening.accept()
            with contextlib.suppress(OSError), connection, connection.makefile("rb") as lines:
                made.append(connection)
                for line in lines:
                    if answer is None:
                        return
                    number = json.loads(line)["id"]
                    connection.sendall(answer.replace(b"%d", str(number).encode()))

        threading.Thread(target=serve, daemon=True).start()
        return f"127.0.0.1:{listening.getsockname()[1]}"

    yield make
    for thing in made:
        thing.close()


def told(address, do="hello", timeout_s=0.5):
    driver = Driver(address, timeout_s)
    with pytest.raises(V2PError) as error:
        getattr(driver, do)(*([(256, 256)] if do == "read" else []))
    driver.close()
    assert address in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


GOOD = {
    "v": 1,
    "ok": True,
    "pos_m": [0.5, 0, 0.2],
    "quat_wxyz": [0, 1, 0, 0],
    "opening": 1,
    "joints_rad": [0] * 7,
    "force_n": None,
    "picture": "",
    "finger_travel_m": 0.04,
    "camera": CAMERA,
}


def with_(**fields) -> bytes:
    return (
        json.dumps({**GOOD, **fields, "id": 77}).replace('"id": 77', '"id": %d').encode() + b"\n"
    )


@pytest.mark.parametrize(
    ("answer", "do", "words"),
    [
        (b"hello there\n", "hello", "an answer is no JSON"),
        (b"[]\n", "hello", "an answer is no JSON object"),
        (b'{"v": 3, "id": %d, "ok": true}\n', "hello", "speaks version 3, and this is version 1"),
        (b'{"v": 1, "id": 0, "ok": true}\n', "hello", "answers request 0 instead of 1"),
        (
            b'{"v": 1, "id": %d, "ok": false, "error": "brakes"}\n',
            "hello",
            "refuses 'hello': brakes",
        ),
        (with_(camera=None), "hello", "'camera' is missing"),
        (with_(camera={**CAMERA, "K": [1, 2]}), "hello", "'K' must be 9 finite numbers"),
        (with_(finger_travel_m=4), "hello", "are not possible"),
        (with_(pos_m=[0.5, None, 0.2]), "read", "'pos_m' must be 3 finite numbers"),
        (with_(joints_rad=[float("inf")] * 7), "read", "'joints_rad' must be 7 finite numbers"),
        (with_(force_n=10**400), "read", "'force_n' must be 1 finite number"),
        (with_(quat_wxyz=[1, 1, 0, 0]), "read", "no unit quaternion"),
        (with_(picture="%%%"), "read", "no PNG or JPEG"),
        (None, "hello", "is gone"),
        (b"", "hello", "did not answer 'hello' within 0.5 s"),
        (b"a" * (LONGEST_LINE + 70000), "hello", "a line is longer than"),
    ],
)
def test_a_driver_that_does_not_keep_to_the_protocol_is_told_so(odd_driver, answer, do, words):
    assert words in told(odd_driver(answer), do, 5.0 if answer else 0.5)


def test_an_address_that_is_none_and_one_where_nobody_is(odd_driver):
    for address, words in (("localhost", "is HOST:PORT"), ("127.0.0.1:9", "no driver answers")):
        with pytest.raises(V2PError, match=words):
            Driver(address, 1.0)


def test_a_driver_that_stops_answering_ends_the_run_with_one_sentence(
    server, seeing_robot, restarted, click_on, steady, tmp_path
):
    """The last test: it ends the server that all others talk to."""
    robot = robot_at(server.address, tmp_path)
    steps = []
    restarted(seeing_robot)
    sight = Sight(robot.calibration(), [click_on(seeing_robot)])
    robot.arm.driver.timeout_s = 4.0
    robot.arm.driver._socket.settimeout(4.0)

    def freeze(reading, seen):
        steps.append(reading)
        if len(steps) == 5:
            os.kill(server.process.pid, signal.SIGSTOP)

    cfg, freezing = LoopConfig(max_seconds=20.0, slow=True), Onlooker(on_step=freeze)
    rig = Rig(robot, PATIENT, sight)
    outcome = Run(rig, steady(0, 0, 0, 0, 0, 0, 0), cfg, freezing).go()
    server.end()

    assert outcome.ending == "robot"
    assert outcome.steps == 5
    assert "did not answer 'read' within 4 s" in outcome.sentence
    assert "\n" not in outcome.sentence
    with pytest.raises(V2PError, match="no driver answers"):
        Driver(server.address, 1.0)
