"""A headless browser for tests, driven as a user drives it, over WebDriver (HTTP and JSON)."""

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
    """Hold an open window.

    Args:
        address: the address of chromedriver.
        width: width of the window, in pixels.
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
        """Open a page; return the seconds until it was loaded and its scripts had run."""
        began = time.perf_counter()
        self._call("/url", {"url": f"file://{page}"})
        return time.perf_counter() - began

    def run(self, script: str, *arguments: Any) -> Any:
        """Run a script and return what it returns."""
        return self._call("/execute/sync", {"script": script, "args": arguments})

    def wait(self, script: str) -> Any:
        """Run a script until what it returns is true, and return that.

        Raises:
            TimeoutError: it does not become true within a minute.
        """
        end = time.perf_counter() + 60
        while time.perf_counter() < end:
            if found := self.run(script):
                return found
            time.sleep(0.1)
        raise TimeoutError(script)

    def point(self, x: float, y: float, click: bool = False) -> None:
        """Move the mouse to a point, in pixels of the window, and click there if asked to."""
        moves: list[dict[str, Any]] = [{"type": "pointerMove", "x": round(x), "y": round(y), "format_duration": 50}]
        if click:
            moves += [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        self._call("/actions", {"actions": [{"type": "pointer", "id": "mouse", "actions": moves}]})

    def click(self, selector: str) -> None:
        """Click in the middle of the first element that a CSS selector finds."""
        box = self.run(
            "const found = document.querySelector(arguments[0]); found.scrollIntoView({block: 'center'});"
            "const box = found.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]",
            selector,
        )
        self.point(*box, click=True)

    def press(self, key: str) -> None:
        """Press a key and let it go."""
        strokes = [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]
        self._call("/actions", {"actions": [{"type": "key", "id": "keyboard", "actions": strokes}]})

    def console(self) -> list[str]:
        """Return the console's warnings and errors."""
        return [entry["message"] for entry in self._call("/se/log", {"type": "browser"})]

    def requested(self) -> list[str]:
        """Return the addresses of all requests."""
        events = [json.loads(e["message"])["message"] for e in self._call("/se/log", {"type": "performance"})]
        return [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]

    def close(self) -> None:
        """Close the window."""
        _call("DELETE", self._address, None)

    def _call(self, path: str, body: Any) -> Any:
        return _call("POST", self._address + path, body)


@contextlib.contextmanager
def running_driver() -> Iterator[str]:
    """Start chromedriver, yield its address once it answers, and stop it in the end."""
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
            yield address
        finally:
            driver.terminate()


@contextlib.contextmanager
def browser(address: str, width: int) -> Iterator[Browser]:
    """Open a window of a running chromedriver, and close it in the end.

    Args:
        address: the address of chromedriver.
        width: width of the window, in pixels.
    """
    window = Browser(address, width)
    try:
        yield window
    finally:
        window.close()


def _call(method: str, url: str, body: Any) -> Any:
    content = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, content, {"Content-Type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=120) as answer:
        return json.loads(answer.read())["value"]
