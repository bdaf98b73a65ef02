"""A headless Chromium, driven by its debugging protocol: opens a file, runs scripts in it, draws pictures of it."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
ABOVE = 14  # pixels
START_S, ANSWER_S = 60.0, 60.0
SHOWN = "document.documentElement?.dataset.ready === 'yes'"


def browser() -> str | None:
    """The program; None where there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Page:
    """One page of a running browser."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection, self._numbers = connection, itertools.count(1)
        self.requests: list[str] = []  # addresses of everything that the page asked for
        self.complaints: list[str] = []  # errors of its scripts, and what its policy refused
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> Any:
        """One call of the protocol."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._connection.recv(timeout=ANSWER_S))
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message)

    def _note(self, message: Mapping[str, Any]) -> None:
        params = message.get("params", {})
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(params["request"]["url"])
            case "Runtime.exceptionThrown":
                details = params["exceptionDetails"]
                self.complaints.append(details.get("exception", {}).get("description") or details["text"])
            case "Log.entryAdded" if params["entry"]["level"] == "error":
                self.complaints.append(params["entry"]["text"])

    def open(self, path: Path, width: int = 1400, height: int = 900, scheme: str = "light") -> None:
        """Open a report, and wait until its plots are drawn."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.wait(SHOWN)
        self.pause()

    def wait(self, condition: str) -> None:
        """Wait until an expression is true."""
        until = time.monotonic() + ANSWER_S
        while not self.value(condition):
            if time.monotonic() > until:
                raise TimeoutError(f"{condition}; {self.complaints}")
            time.sleep(0.05)

    def pause(self) -> None:
        """Wait until all that is due has been drawn."""
        self.value("new Promise(done => setTimeout(() => requestAnimationFrame(() => setTimeout(done, 300)), 300))")

    def value(self, expression: str) -> Any:
        """The value of an expression, awaited."""
        result = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def picture(self, path: Path, first: str, around: str, height: int) -> None:
        """Write a PNG, from the top of one element down, as wide as the one around it."""
        top, x, width = self.value(
            f"(() => {{ const b = document.querySelector('{around}').getBoundingClientRect();"
            f" return [document.querySelector('{first}').getBoundingClientRect().y + scrollY - {ABOVE}, b.x, b.width]; }})()"
        )
        self.value("document.querySelector('.top').style.position = 'static'")
        clip = {"x": x, "y": top, "width": width, "height": height, "scale": 1}
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        path.write_bytes(base64.b64decode(shot["data"]))

    def drag(self, start: tuple[float, float], stop: tuple[float, float]) -> None:
        """Drag the mouse with its left button."""
        for kind, (x, y), buttons in (("mouseMoved", start, 0), ("mousePressed", start, 1), ("mouseMoved", stop, 1),
                                      ("mouseReleased", stop, 0)):  # fmt: skip
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)
        self.pause()

    def move(self, x: float, y: float) -> None:
        """Move the mouse."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.pause()


@contextmanager
def opened() -> Iterator[Page]:
    """A page of a browser that ends with the block."""
    program = browser()
    assert program is not None
    with TemporaryDirectory(prefix="fusiond-browser-", ignore_cleanup_errors=True) as folder:
        flags = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-port=0",
                 "--disable-dev-shm-usage", "--no-first-run", "--disable-background-networking",
                 f"--user-data-dir={folder}")  # fmt: skip
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen([program, *flags, "about:blank"], **silent) as process:
            try:
                with connect(_address(Path(folder), process), max_size=None, proxy=None) as connection:
                    yield Page(connection)
            finally:
                process.terminate()


def _address(folder: Path, process: subprocess.Popen[bytes]) -> str:
    """The address of the first page."""
    until = time.monotonic() + START_S
    told = folder / "DevToolsActivePort"
    while not (told.exists() and "\n" in told.read_text(encoding="ascii")):
        if process.poll() is not None or time.monotonic() > until:
            raise RuntimeError(f"the browser did not start: {process.poll()}")
        time.sleep(0.05)
    port, way = told.read_text(encoding="ascii").split("\n")[:2]
    with connect(f"ws://127.0.0.1:{port}{way}", max_size=None, proxy=None) as connection:
        connection.send(json.dumps({"id": 1, "method": "Target.getTargets"}))
        targets = json.loads(connection.recv(timeout=ANSWER_S))["result"]["targetInfos"]
    page = next(target for target in targets if target["type"] == "page")
    return f"ws://127.0.0.1:{port}/devtools/page/{page['targetId']}"
