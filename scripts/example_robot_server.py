"""A complete driver for `v2p deploy --robot.backend=network`, to be copied: it keeps the protocol of docs/deploy.md.

    python scripts/example_robot_server.py --task outputs/demo/task/lift_red_box-1a2b3c4d --port 7777

The arm here is the simulated one. Put the calls of a real arm's library into `Arm`; the rest
stays. One thread owns the arm; connections only hand requests to it. Without a target for
`DEADMAN_S` the arm holds, whatever became of the client.
"""

import argparse
import base64
import json
import queue
import signal
import socketserver
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from lerobot_policy_v2p.robot.simulated import SimulatedArm

VERSION, LONGEST_LINE = 1, 65536
STEP_S, DEADMAN_S, IDLE_S = 0.05, 0.25, 60.0


class Arm:
    """The simulated arm as a driver sees one: it moves towards a target and can be read."""

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm = arm
        self.goal: tuple[np.ndarray, Rotation, float] | None = None
        self.turned = self.rotation()

    def rotation(self) -> Rotation:
        return Rotation.from_quat([0, 1, 0, 0], scalar_first=True) * Rotation.from_rotvec(
            self.arm.state()[3:6]
        )

    def hello(self) -> dict[str, Any]:
        camera = self.arm.calibration()
        return {
            "robot": "simulated Franka",
            "finger_travel_m": self.arm.env.world.robot.finger_travel_m,
            "camera": {
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "K": camera.K.ravel().tolist(),
                "T_world_cam": camera.T_world_cam.ravel().tolist(),
            },
        }

    def read(self) -> dict[str, Any]:
        _, png = cv2.imencode(
            ".png", self.arm.picture()[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]
        )
        return {
            "pos_m": self.arm.state()[:3].tolist(),
            "quat_wxyz": self.rotation().as_quat(canonical=True, scalar_first=True).tolist(),
            "opening": self.arm.opening(),
            "joints_rad": self.arm.joints().tolist(),
            "force_n": self.arm.force_n(),
            "picture": base64.b64encode(png.tobytes()).decode(),
        }

    def step(self) -> None:
        """Let one control step pass."""
        action = np.zeros(7)
        state = self.arm.state()
        if self.goal is not None:
            scale = self.arm.action_scale
            pos, rotation, opening = self.goal
            travel = self.arm.env.world.robot.finger_travel_m
            action[:3] = (pos - state[:3] - state[7:10]) / scale.position_step_m
            action[3:6] = (rotation * self.turned.inv()).as_rotvec() / scale.rotation_step_rad
            action[6] = (state[10] - opening) * travel / scale.finger_step_m
            self.turned = rotation
        self.arm.carry_out(np.clip(action, -1, 1))

    def hold(self) -> None:
        self.goal = None


class RefusedError(ValueError):
    """A request that is not carried out; its words are the answer."""


def numbers(request: dict[str, Any], name: str, count: int) -> np.ndarray:
    value = request.get(name)
    flat = value if isinstance(value, list) else [value]
    if len(flat) != count or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and np.isfinite(v) for v in flat
    ):
        raise RefusedError(f"'{name}' must be {count} finite numbers")
    return np.array(flat, float)


def parsed(line: bytes) -> dict[str, Any]:
    request = json.loads(line)
    if not isinstance(request, dict) or request.get("v") != VERSION:
        raise RefusedError(f"this driver speaks version {VERSION} of the protocol")
    return request


def goal_of(request: dict[str, Any]) -> tuple[np.ndarray, Rotation, float]:
    quat = numbers(request, "quat_wxyz", 4)
    if not 0.99 < np.linalg.norm(quat) < 1.01:
        raise RefusedError("'quat_wxyz' must be a unit quaternion")
    opening = float(np.clip(numbers(request, "opening", 1)[0], 0, 1))
    return numbers(request, "pos_m", 3), Rotation.from_quat(quat, scalar_first=True), opening


def answer(arm: Arm, line: bytes) -> dict[str, Any]:
    """Return the answer to one line, whatever it holds."""
    head: dict[str, Any] = {"v": VERSION, "id": None}
    try:
        request = parsed(line)
        head["id"] = request.get("id")
        said: dict[str, Any] = {}
        match request.get("do"):
            case "hello":
                said = arm.hello()
            case "read":
                said = arm.read()
            case "hold":
                arm.hold()
            case "target":
                arm.goal = goal_of(request)
            case other:
                return {**head, "ok": False, "error": f"there is no request {other!r}"[:200]}
    except (ValueError, RecursionError) as error:
        return {**head, "ok": False, "error": str(error)[:200]}
    return {**head, "ok": True, **said}


class Connection(socketserver.StreamRequestHandler):
    timeout = IDLE_S

    def handle(self) -> None:
        requests: queue.Queue = self.server.requests  # type: ignore[attr-defined]
        replies: queue.Queue = queue.Queue()
        try:
            while line := self.rfile.readline(LONGEST_LINE):
                if not line.endswith(b"\n"):
                    break  # too long, or cut off
                requests.put((line, replies))
                self.wfile.write(json.dumps(replies.get()).encode() + b"\n")
        except OSError:
            pass
        requests.put((None, replies))


class Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = daemon_threads = True
    requests: "queue.Queue[tuple[bytes | None, queue.Queue]]"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", type=Path, required=True, help="task folder to simulate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=0, help="0 takes a free one")
    parser.add_argument(
        "--lockstep", action="store_true", help="time passes only when a target comes"
    )
    args = parser.parse_args()
    arm = Arm(SimulatedArm(V2PFrankaConfig(task_folder=str(args.task), seed=args.seed)))
    arm.read()  # the first picture takes seconds
    with Server((args.host, args.port), Connection) as server:
        server.requests = queue.Queue()
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(f"{server.server_address[0]}:{server.server_address[1]}", flush=True)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        serve(arm, server.requests, lockstep=args.lockstep)
    return 0


def serve(
    arm: Arm,
    requests: "queue.Queue",
    *,
    lockstep: bool,
    is_over: Callable[[], bool] = lambda: False,
) -> None:
    """Answer and move, in one thread."""
    due, told = time.monotonic() + STEP_S, time.monotonic()
    while not is_over():
        try:
            line, replies = requests.get(timeout=max(0.0, due - time.monotonic()))
        except queue.Empty:
            line, replies = None, None
        if line is not None and replies is not None:
            before = arm.goal
            replies.put(answer(arm, line))
            if arm.goal is not before:
                told = time.monotonic()
                if lockstep and arm.goal is not None:
                    arm.step()
        elif replies is not None:
            arm.hold()  # a client is gone
        if time.monotonic() >= due:
            due = max(due + STEP_S, time.monotonic())
            if time.monotonic() - told > DEADMAN_S:
                arm.hold()
            if not lockstep:
                arm.step()


if __name__ == "__main__":
    raise SystemExit(main())
