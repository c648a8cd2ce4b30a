"""A page in headless Chromium, driven over the DevTools protocol on this machine."""

import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip
PATIENCE_S = 60.0


LEFT = ("Inspected target navigated or closed", "Execution context was destroyed", "Cannot find context")
"""What the browser answers where the page was left while an expression was computed."""


class PageLeftError(AssertionError):
    """The page was left before it answered."""


class BrowserPage:
    """One page; ``errors`` what its console complained of, ``requests`` every address that it asked for."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; events that come meanwhile are noted."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE_S))
            if answer.get("id") == number:
                if answer.get("error", {}).get("message", "").startswith(LEFT):
                    raise PageLeftError(answer)
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        method, what = event.get("method"), event.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(what["request"]["url"][:200])
        elif method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(what["exceptionDetails"])[:600])
        elif method == "Runtime.consoleAPICalled" and what["type"] in ("error", "assert"):
            self.errors.append(json.dumps(what["args"])[:600])
        elif method == "Log.entryAdded" and what["entry"]["level"] == "error":
            self.errors.append(json.dumps(what["entry"])[:600])

    def js(self, expression: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait until an expression is true in the page, or in the one that follows it."""
        end = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(PageLeftError):
                if self.js(expression):
                    return
            assert time.monotonic() < end, f"never true: {expression}; errors: {self.errors}"
            time.sleep(0.05)

    def open(self, path: Path, width: int, height: int = 900) -> None:
        """Open a file in a window of a size, and wait until it has loaded."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.until("document.readyState === 'complete' && location.protocol === 'file:'")

    def drag(self, x: float, y: float, by_x: float, by_y: float) -> None:
        """Drag the mouse with its left button."""
        self._mouse("mouseMoved", x, y, 0)
        self._mouse("mousePressed", x, y, 1)
        for k in range(1, 5):
            self._mouse("mouseMoved", x + k / 4 * by_x, y + k / 4 * by_y, 1)
        self._mouse("mouseReleased", x + by_x, y + by_y, 0)

    def click(self, selector: str) -> None:
        """Click the middle of an element, scrolled into view."""
        x, y, width, height = self.box(selector)
        self._mouse("mousePressed", x + width / 2, y + height / 2, 1)
        self._mouse("mouseReleased", x + width / 2, y + height / 2, 0)

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Return x, y, width and height of an element in the window, scrolled into view."""
        x, y, width, height = self.js(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            " e.scrollIntoView({block: 'center', behavior: 'instant'});"
            " const r = e.getBoundingClientRect(); return [r.x, r.y, r.width, r.height]; })()"
        )
        return x, y, width, height

    def _mouse(self, kind: str, x: float, y: float, buttons: int) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def screenshot(self, path: Path, whole: bool = True) -> None:
        """Write what is seen, or the whole page, as PNG."""
        path.write_bytes(b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"]))


@contextlib.contextmanager
def browser() -> Iterator[BrowserPage]:
    """Start Chromium with an empty profile; it ends with the block."""
    from websockets.sync.client import connect

    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            port_file = Path(profile) / "DevToolsActivePort"
            end = time.monotonic() + PATIENCE_S
            while not port_file.exists() or "\n" not in port_file.read_text():
                assert process.poll() is None, "Chromium ended at once"
                assert time.monotonic() < end, "Chromium does not answer"
                time.sleep(0.05)
            port = int(port_file.read_text().split()[0])
            with urlopen(f"http://127.0.0.1:{port}/json", timeout=PATIENCE_S) as answer:
                (page,) = [one for one in json.load(answer) if one["type"] == "page"][:1]
            with connect(page["webSocketDebuggerUrl"], max_size=None, open_timeout=PATIENCE_S) as socket:
                yield BrowserPage(socket)
        finally:
            process.terminate()
            process.wait(PATIENCE_S)
