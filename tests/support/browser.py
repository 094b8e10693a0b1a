"""A headless Chromium, driven over its DevTools websocket."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import signal
import subprocess
import tempfile
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import needs
from clock import PATIENCE_S, until

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
)


def chromium() -> str:
    """Where Chromium is; skips the test where it is not."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    needs.missing("Chromium is not installed: make debian")


# viser's note that there is no GPU lies over the scene until somebody closes it.
_NO_NOTES = """addEventListener('DOMContentLoaded', () => document.head.insertAdjacentHTML(
    'beforeend', '<style>.mantine-Notification-root { display: none !important }</style>'))"""


class Browser:
    """One page in a browser of its own; a context manager that ends it."""

    def __init__(self, width: int = 1280, height: int = 800) -> None:
        self._folder = tempfile.mkdtemp(prefix="browser-")
        self._ids = 0
        command = [chromium(), *FLAGS, f"--user-data-dir={self._folder}"]
        self._process = subprocess.Popen(
            [*command, f"--window-size={width},{height}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            self._socket = self._connect()
            self.resize(width, height)
            self.call("Page.enable")
            self.call("Page.addScriptToEvaluateOnNewDocument", source=_NO_NOTES)
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._end()

    def _connect(self) -> Any:
        from websockets.sync.client import connect

        port_file = Path(self._folder) / "DevToolsActivePort"
        until(lambda: port_file.exists() and port_file.read_text().count("\n") >= 1, "Chromium")
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(
            f"http://127.0.0.1:{port}/json/list", timeout=PATIENCE_S
        ) as answer:
            pages = [target for target in json.load(answer) if target["type"] == "page"]
        return connect(pages[0]["webSocketDebuggerUrl"], max_size=2**26, proxy=None)

    def _end(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(10)
        shutil.rmtree(self._folder, ignore_errors=True)

    def call(self, method: str, **params: Any) -> dict:
        """One DevTools command and its answer."""
        self._ids += 1
        self._socket.send(json.dumps({"id": self._ids, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE_S))
            if answer.get("id") == self._ids:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def resize(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def text(self) -> str:
        """What the page says, hidden text left out."""
        script = "document.body ? document.body.innerText : ''"
        return self.call("Runtime.evaluate", expression=script)["result"]["value"]

    def picture(self) -> np.ndarray:
        """The page as it looks: (h, w, 3), uint8."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Where the first such element is: left, top, width, height, in pixels of the page."""
        script = f"""(r => [r.x, r.y, r.width, r.height])(
            document.querySelector({json.dumps(selector)}).getBoundingClientRect())"""
        rectangle = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        left, top, width, height = rectangle["result"]["value"]
        return left, top, width, height

    def click(self, x: float, y: float) -> None:
        for kind, buttons in (("mouseMoved", 0), ("mousePressed", 1), ("mouseReleased", 0)):
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="none" if kind == "mouseMoved" else "left",
                buttons=buttons,
                clickCount=0 if kind == "mouseMoved" else 1,
            )

    def press(self, key: str, times: int = 1) -> None:
        """Press a key, which the keyboard repeats while it is held."""
        for number in range(times):
            about = {"key": key, "text": key, "autoRepeat": number > 0}
            self.call("Input.dispatchKeyEvent", type="keyDown", **about)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def click_text(self, text: str) -> None:
        """Click the middle of the button that says this, rather than of one that says more."""
        script = f"""(() => {{ const says = [...document.querySelectorAll('button')].filter(
                b => b.innerText.includes({json.dumps(text)}));
            says.sort((a, b) => a.innerText.length - b.innerText.length);
            for (const b of says) {{
                b.scrollIntoView({{block: 'nearest'}}); const r = b.getBoundingClientRect();
                return [r.x + r.width / 2, r.y + r.height / 2]; }} }})()"""
        place = self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"]
        assert "value" in place, f"no button says {text!r}"
        self.click(*place["value"])


def of_first_tumor(picture: np.ndarray) -> np.ndarray:
    """Which pixels have the hue of the first tumor, seen through kidney or not: orange. A banner of
    a poor estimate has it too."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r - b > 50) & (g - b > 0.38 * (r - b)) & (g - b < 0.85 * (r - b))
