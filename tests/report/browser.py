"""A browser for tests, headless, driven as a user does it, over WebDriver (which is HTTP and JSON)."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.runs.program import free_port

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")


class Browser:
    """An open window.

    Args:
        address: of chromedriver.
        width: of the window, in pixels.
    """

    def __init__(self, address: str, width: int) -> None:
        self._address = address
        options = {"binary": CHROMIUM, "args": ["--headless=new", "--no-sandbox", "--disable-gpu"]}
        logs = {"browser": "ALL", "performance": "ALL"}
        asked = {"capabilities": {"alwaysMatch": {"goog:chromeOptions": options, "goog:loggingPrefs": logs}}}
        self._address += f"/session/{_call('POST', address + '/session', asked)['sessionId']}"
        metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        self._call("/goog/cdp/execute", {"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics})

    def open(self, page: Path) -> float:
        """Opens a page; the seconds until it was loaded and its scripts had run."""
        began = time.perf_counter()
        self._call("/url", {"url": f"file://{page}"})
        return time.perf_counter() - began

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script returns."""
        return self._call("/execute/sync", {"script": script, "args": arguments})

    def wait(self, script: str) -> Any:
        """What a script returns once that is true.

        Raises:
            TimeoutError: it does not become so within a minute.
        """
        end = time.perf_counter() + 60
        while time.perf_counter() < end:
            if found := self.run(script):
                return found
            time.sleep(0.1)
        raise TimeoutError(script)

    def point(self, x: float, y: float, click: bool = False) -> None:
        """Moves the mouse there, in pixels of the window, and clicks."""
        moves: list[dict[str, Any]] = [{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 50}]
        if click:
            moves += [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        self._call("/actions", {"actions": [{"type": "pointer", "id": "mouse", "actions": moves}]})

    def click(self, selector: str) -> None:
        """Clicks in the middle of what a CSS selector finds first."""
        box = self.run(
            "const found = document.querySelector(arguments[0]); found.scrollIntoView({block: 'center'});"
            "const box = found.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]",
            selector,
        )
        self.point(*box, click=True)

    def said(self) -> list[str]:
        """The console's warnings and errors."""
        return [entry["message"] for entry in self._call("/se/log", {"type": "browser"})]

    def requested(self) -> list[str]:
        """The addresses of everything that was asked for."""
        events = [json.loads(e["message"])["message"] for e in self._call("/se/log", {"type": "performance"})]
        return [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]

    def _call(self, path: str, body: Any) -> Any:
        return _call("POST", self._address + path, body)


@contextlib.contextmanager
def browser(width: int) -> Iterator[Browser]:
    """A window that is closed in the end."""
    assert DRIVER is not None
    port = free_port()
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([DRIVER, f"--port={port}"], **quiet) as driver:
        address = f"http://127.0.0.1:{port}"
        try:
            for _ in range(100):
                with contextlib.suppress(OSError):
                    _call("GET", f"{address}/status", None)
                    break
                time.sleep(0.1)
            window = Browser(address, width)
            try:
                yield window
            finally:
                _call("DELETE", window._address, None)
        finally:
            driver.terminate()


def _call(method: str, url: str, body: Any) -> Any:
    content = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, content, {"Content-Type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=120) as answer:
        return json.loads(answer.read())["value"]
