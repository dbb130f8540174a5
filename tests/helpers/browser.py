"""A real headless Chromium for tests, through chromedriver's WebDriver protocol; standard library only."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def missing() -> str | None:
    """Why no browser can be started here, or None."""
    if _binary() is None:
        return "no Chromium is installed (Debian: apt install chromium)"
    if shutil.which("chromedriver") is None:
        return "no chromedriver is installed (Debian: apt install chromium-driver)"
    return None


def _binary() -> str | None:
    return next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )


class Browser:
    def __init__(self, base: str, session: str) -> None:
        self.url = f"{base}/session/{session}"

    def call(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        return _request(method, f"{self.url}/{path}", body)

    def open(self, page: Path) -> None:
        self.call("POST", "url", {"url": page.resolve().as_uri()})

    def script(self, code: str, *args: Any) -> Any:
        return self.call("POST", "execute/sync", {"script": code, "args": list(args)})

    def wait_for(self, condition: str, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not self.script(f"return Boolean({condition})"):
            if time.monotonic() > end:
                raise TimeoutError(f"in {seconds} s it did not become true: {condition}")
            time.sleep(0.05)

    def click(self, selector: str) -> None:
        found = self.call("POST", "element", {"using": "css selector", "value": selector})
        self.call("POST", f"element/{next(iter(found.values()))}/click", {})

    def screenshot(self) -> bytes:
        return base64.b64decode(self.call("GET", "screenshot"))

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        """scale: pixels of a screenshot in one of the page."""
        self.devtools(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )

    def pdf(self) -> bytes:
        return base64.b64decode(
            self.call("POST", "print", {"background": True, "page": {"width": 21.0, "height": 29.7}})
        )

    def devtools(self, command: str, **params: Any) -> Any:
        return self.call("POST", "goog/cdp/execute", {"cmd": command, "params": params})

    def log(self, kind: str) -> list[dict[str, Any]]:
        """Entries of the console ("browser") or of the network ("performance") since the last call."""
        return self.call("POST", "se/log", {"type": kind})

    def requests(self) -> list[str]:
        """Addresses that were asked for since the last call."""
        messages = [json.loads(entry["message"])["message"] for entry in self.log("performance")]
        return [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]


@contextmanager
def chromium(width: int = 1400, height: int = 900) -> Iterator[Browser]:
    """A browser with software WebGL, all console messages and network requests logged."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    driver = subprocess.Popen(
        [shutil.which("chromedriver") or "chromedriver", f"--port={port}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    base = f"http://127.0.0.1:{port}"
    browser = None
    try:
        _until_ready(base)
        options = {
            "binary": _binary(),
            "args": [
                "--headless=new",
                "--no-sandbox",
                "--disable-dev-shm-usage",
                "--use-gl=angle",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                f"--window-size={width},{height}",
            ],
        }
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"}}
        made = _request("POST", f"{base}/session", {"capabilities": {"alwaysMatch": wanted}})
        browser = Browser(base, made["sessionId"])
        browser.resize(width, height)
        yield browser
    finally:
        if browser is not None:
            _request("DELETE", browser.url, None)
        driver.terminate()
        driver.wait(timeout=10)


def _until_ready(base: str, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while True:
        try:
            if _request("GET", f"{base}/status", None)["ready"]:
                return
        except OSError:
            pass
        if time.monotonic() > end:
            raise TimeoutError(f"chromedriver did not answer within {seconds} s")
        time.sleep(0.05)


def _request(method: str, url: str, body: dict[str, Any] | None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data=data, method=method, headers={"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=120) as answer:
        return json.loads(answer.read())["value"]
