"""The client's side of the protocol between us and a driver of a real arm: JSON lines over TCP (docs/deploy.md).

A request `{"v": 1, "id": 7, "do": "read"}` has one answer with the same id. Every wait has an end, every line a longest
length, every number is checked: whatever a driver sends, the outcome is an answer or one sentence.
"""

import base64
import binascii
import contextlib
import json
import socket
import sys
import threading
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.sim.env.targets import ToolPose

VERSION = 1
LONGEST_LINE = 2**21
"""Bytes: a picture of 256 x 256 as PNG is at most a tenth of that."""


@dataclass(frozen=True, kw_only=True)
class Hello:
    """What a driver says of its arm."""

    finger_travel_m: float
    """Travel of one finger from closed to open."""
    camera: Camera


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One reading."""

    tool: ToolPose
    """Its z axis points out of the gripper, y along its opening."""
    joints_rad: Float[np.ndarray, "7"]
    force_n: float | None
    picture: UInt8[np.ndarray, "h w 3"]


class Driver:
    """A connection to a driver.

    Args:
        address: HOST:PORT.
        timeout_s: for each answer.

    Raises:
        V2PError: nobody is there.
    """

    def __init__(self, address: str, timeout_s: float) -> None:
        self.address, self.timeout_s = address, timeout_s
        self._lock = threading.Lock()
        self._next_id = 0
        self._socket: socket.socket | None = _connected(address, timeout_s)
        self._lines = self._socket.makefile("rb")

    def hello(self) -> Hello:
        """Return what the driver says of its arm."""
        said = self.ask("hello")
        camera = said.get("camera")
        if not isinstance(camera, dict):
            raise self._wrong("'camera' is missing in the answer to 'hello'")
        width, height = (int(self._numbers(camera, k, 1)[0]) for k in ("width_px", "height_px"))
        travel = float(self._numbers(said, "finger_travel_m", 1)[0])
        if not (0 < width <= 4096 and 0 < height <= 4096 and 0.005 < travel < 0.2):
            raise self._wrong(
                f"a picture of {width} x {height} pixels and fingers that travel {travel} m are not possible"
            )
        return Hello(
            finger_travel_m=travel,
            camera=Camera(
                width_px=width,
                height_px=height,
                K=self._numbers(camera, "K", 9).reshape(3, 3),
                T_world_cam=self._numbers(camera, "T_world_cam", 16).reshape(4, 4),
            ),
        )

    def read(self, size_px: tuple[int, int]) -> Sample:
        """Return a reading whose picture has this height and width."""
        said = self.ask("read")
        quat = self._numbers(said, "quat_wxyz", 4)
        if not 0.99 < np.linalg.norm(quat) < 1.01:
            raise self._wrong(f"'quat_wxyz' {quat.tolist()} is no unit quaternion")
        force = said.get("force_n")
        return Sample(
            tool=ToolPose(
                pos=self._numbers(said, "pos_m", 3),
                rotation=Rotation.from_quat(quat, scalar_first=True),
                opening=float(np.clip(self._numbers(said, "opening", 1)[0], 0.0, 1.0)),
            ),
            joints_rad=self._numbers(said, "joints_rad", 7),
            force_n=None if force is None else float(self._numbers(said, "force_n", 1)[0]),
            picture=self._picture(said.get("picture"), size_px),
        )

    def target(self, tool: ToolPose) -> None:
        """Tell the arm where to bring the tool."""
        quat = tool.rotation.as_quat(canonical=True, scalar_first=True)
        self.ask("target", pos_m=tool.pos.tolist(), quat_wxyz=quat.tolist(), opening=tool.opening)

    def hold(self) -> None:
        """Tell the arm to stay, over a connection of its own, as another request may be waiting."""
        with contextlib.suppress(V2PError):
            second = Driver(self.address, self.timeout_s)
            try:
                second.ask("hold")
            finally:
                second.close()

    def close(self) -> None:
        """End the connection; the driver then holds the arm."""
        if self._socket is not None:
            self._lines.close()
            self._socket.close()
            self._socket = None

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        """Return the answer to a request.

        Raises:
            V2PError: the driver is gone, too slow, refuses, or answers what the protocol does not know.
        """
        with self._lock:
            if self._socket is None:
                raise V2PError(f"the connection to the robot's driver at {self.address} is closed")
            self._next_id += 1
            request = {"v": VERSION, "id": self._next_id, "do": do, **fields}
            try:
                self._socket.sendall(json.dumps(request).encode() + b"\n")
                line = self._lines.readline(LONGEST_LINE)
            except TimeoutError as error:
                self.close()
                raise V2PError(
                    f"the robot's driver at {self.address} did not answer '{do}' within "
                    f"{self.timeout_s:g} s; look after"
                    " the robot, start the driver again, and try once more"
                ) from error
            except OSError as error:
                self.close()
                raise self._gone(error.strerror or str(error)) from error
            if not line.endswith(b"\n"):
                self.close()
                if len(line) == LONGEST_LINE:
                    raise self._wrong(f"a line is longer than {LONGEST_LINE} bytes")
                raise self._gone("it closed the connection")
        return self._answer(line, request)

    def _answer(self, line: bytes, request: dict[str, Any]) -> dict[str, Any]:
        try:
            said = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise self._wrong(f"an answer is no JSON: {line[:60]!r}") from error
        if not isinstance(said, dict):
            raise self._wrong(f"an answer is no JSON object: {line[:60]!r}")
        if said.get("v") != VERSION:
            raise self._wrong(
                f"it speaks version {said.get('v')!r}, and this is version {VERSION}"
            )
        if said.get("id") != request["id"]:
            raise self._wrong(f"it answers request {said.get('id')!r} instead of {request['id']}")
        if said.get("ok") is not True:
            raise V2PError(
                f"the robot's driver at {self.address} refuses '{request['do']}': "
                f"{said.get('error', 'no reason given')}"
            )
        return said

    def _numbers(self, said: dict[str, Any], name: str, count: int) -> np.ndarray:
        value = said.get(name)
        flat = value if isinstance(value, list) else [value]
        good = len(flat) == count and all(
            isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= sys.float_info.max
            for v in flat
        )
        if not good:
            raise self._wrong(f"'{name}' must be {count} finite numbers, got {str(value)[:80]}")
        return np.array(flat, float)

    def _picture(self, text: object, size_px: tuple[int, int]) -> np.ndarray:
        try:
            packed = np.frombuffer(base64.b64decode(str(text), validate=True), np.uint8)
            image = cv2.imdecode(packed, cv2.IMREAD_COLOR) if len(packed) else None
        except (binascii.Error, cv2.error):
            image = None
        if image is None:
            raise self._wrong("'picture' is no PNG or JPEG in base64")
        if image.shape[:2] != size_px:
            raise self._wrong(
                f"a picture has {image.shape[1]} x {image.shape[0]} pixels, and 'hello' said "
                f"{size_px[1]} x {size_px[0]}"
            )
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _wrong(self, what: str) -> V2PError:
        return V2PError(
            f"the robot's driver at {self.address} does not keep to the protocol: {what}; see docs/deploy.md"
        )

    def _gone(self, why: str) -> V2PError:
        return V2PError(
            f"the robot's driver at {self.address} is gone ({why}); look after the robot and start the driver again"
        )


def _connected(address: str, timeout_s: float) -> socket.socket:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise V2PError(
            f"a driver's address is HOST:PORT, such as 192.168.1.5:7777; got '{address}'"
        )
    try:
        connection = socket.create_connection((host, int(port)), timeout_s)
    except OSError as error:
        raise V2PError(
            f"no driver answers at {address} ({error.strerror or error}); start it, or correct --robot.address"
        ) from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection
