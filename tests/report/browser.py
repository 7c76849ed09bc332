"""A headless Chromium that tests drive over a pipe, in Chrome's DevTools protocol: no package is needed for it."""

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    None,
)
"""None where this machine has none: tests that need it are skipped."""


class Browser:
    """One page, from the start of the `with` block to its end."""

    def __init__(self, home: Path, size_px: tuple[int, int] = (1440, 900)) -> None:
        self.home, self.size_px = home, size_px
        self._count = 0

    def __enter__(self) -> "Browser":
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        width, height = self.size_px

        def wired() -> None:
            # Chromium reads commands from 3 and writes answers to 4.
            reads, writes = os.dup(to_browser), os.dup(from_browser)
            os.dup2(reads, 3)
            os.dup2(writes, 4)

        self._process = subprocess.Popen(
            [
                *(
                    str(CHROMIUM),
                    "--headless=new",
                    "--no-sandbox",
                    "--disable-gpu",
                    "--mute-audio",
                ),
                *("--remote-debugging-pipe", f"--user-data-dir={self.home}", "--no-first-run"),
                *(
                    "--disable-background-networking",
                    "--disable-component-update",
                    "--hide-scrollbars",
                ),
                *(f"--window-size={width},{height}", "about:blank"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            close_fds=False,
            preexec_fn=wired,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._buffer = b""
        pages = self._call("Target.getTargets")["targetInfos"]
        page = next(p["targetId"] for p in pages if p["type"] == "page")
        self._session = self._call("Target.attachToTarget", targetId=page, flatten=True)[
            "sessionId"
        ]
        self.call("Page.enable")
        self.call("Runtime.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Return the page's answer to a command of the protocol."""
        return self._call(method, session=self._session, **parameters)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.wait_for(
            f"location.href === {json.dumps(address)} && document.readyState === 'complete'"
        )

    def value(self, script: str) -> Any:
        """Return what a script in the page evaluates to."""
        said = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    def wait_for(self, script: str, timeout_s: float = 30.0) -> Any:
        """Return the script's value once it is true."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            if value := self.value(script):
                return value
            time.sleep(0.05)
        raise AssertionError(f"not within {timeout_s} s: {script}")

    def press(self, key: str) -> None:
        text = key if len(key) == 1 else ""
        for kind in ("keyDown", "keyUp"):
            typed = text if kind == "keyDown" else ""
            self.call("Input.dispatchKeyEvent", type=kind, key=key, text=typed)

    def drag(self, *spots: tuple[float, float]) -> None:
        """Press at the first spot, go through the others, let go at the last."""
        for x, y in spots[:1]:
            self._mouse("mousePressed", x, y)
        for x, y in spots[1:]:
            self._mouse("mouseMoved", x, y)
        self._mouse("mouseReleased", *spots[-1])

    def screenshot(self, path: Path) -> None:
        path.write_bytes(
            base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        )

    def _mouse(self, kind: str, x: float, y: float) -> None:
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1
        )

    def _call(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        self._count += 1
        said: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if session:
            said["sessionId"] = session
        os.write(self._write, json.dumps(said).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                chunk = os.read(self._read, 1 << 16)
                assert chunk, "the browser is gone"
                self._buffer += chunk
            message, _, self._buffer = self._buffer.partition(b"\0")
            answer = json.loads(message)
            if answer.get("id") == self._count:
                assert "error" not in answer, answer["error"]
                return answer["result"]
