"""A headless Chromium driven through a pair of pipes (its DevTools protocol): pages as pictures, without a package.

with Chromium() as browser:
    page = browser.open("file:///.../index.html", width=390, phone=True, dark=True)
    page.picture(Path("phone.png"))
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--hide-scrollbars", "--remote-debugging-pipe",
)  # fmt: skip
# Taller pages are cut: the picture must fit into memory.
TALLEST = 16_000


class ChromiumError(RuntimeError):
    """The browser is not there, has ended, or refused a command."""


def find_chromium() -> str | None:
    """The program, or None."""
    return next((path for name in PROGRAMS if (path := shutil.which(name))), None)


@dataclass
class Page:
    """One open page.

    errors  texts of console errors and exceptions so far
    """

    browser: Chromium
    session: str
    width: int
    errors: list[str] = field(default_factory=list)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One DevTools command."""
        return self.browser.call(method, parameters, self.session)

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression; promises are awaited. Raises ChromiumError when it throws."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise ChromiumError(f"{script[:80]}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def settle(self, seconds: float = 0.4) -> None:
        """Waits until pictures are decoded and two frames were painted, then `seconds` more."""
        self.run(
            "Promise.all([...document.images].map((i) => { i.loading = 'eager'; return i.decode().catch(() => 0); }))"
            ".then(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))))"
            f".then(() => new Promise((done) => setTimeout(done, {1000 * seconds:.0f})))"
        )

    def height(self) -> int:
        """Height of the whole page, CSS pixels."""
        return int(self.run("document.documentElement.scrollHeight"))

    def picture(
        self,
        path: Path,
        selector: str | None = None,
        margin: int = 0,
        area: tuple[float, float, float, float] | None = None,
    ) -> Path:
        """PNG of the page, of one element with some margin around it, or of an area (left, top, width, height)."""
        if area is not None:
            left, top, width, height = area
        elif selector is None:
            left, top, width, height = 0.0, 0.0, float(self.width), float(min(self.height(), TALLEST))
        else:
            place = self.run(
                f"(() => {{ const e = document.querySelector({json.dumps(selector)}); if (!e) return null;"
                "const r = e.getBoundingClientRect(); return [r.x + scrollX, r.y + scrollY, r.width, r.height]; })()"
            )
            if place is None:
                raise ChromiumError(f"nothing on the page matches {selector}")
            left, top, width, height = place
        clip = {"x": max(left - margin, 0), "y": max(top - margin, 0), "scale": 1}
        clip |= {"width": width + 2 * margin, "height": height + 2 * margin}
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(answer["data"]))
        return path

    def pdf(self, path: Path) -> Path:
        """The page as it is printed, A4."""
        paper = {"paperWidth": 8.27, "paperHeight": 11.69, "printBackground": True}
        path.write_bytes(base64.b64decode(self.call("Page.printToPDF", **paper)["data"]))
        return path

    def close(self) -> None:
        """Closes the page."""
        self.call("Page.close")


class Chromium:
    """A browser with a profile of its own, which is removed at the end. Raises ChromiumError without a program."""

    def __init__(self) -> None:
        program = find_chromium()
        if program is None:
            raise ChromiumError(f"none of {', '.join(PROGRAMS)} is installed; on Debian: apt-get install chromium")
        self.profile = tempfile.mkdtemp(prefix="chromium-")
        (child_in, here_out), (here_in, child_out) = os.pipe(), os.pipe()
        # The browser takes commands from its file 3 and answers on 4; numbers from 10 keep clear of these two.
        given = [fcntl.fcntl(number, fcntl.F_DUPFD, 10) for number in (child_in, child_out)]
        script = f'exec "$@" 3<&{given[0]} 4>&{given[1]}'
        command = ["bash", "-c", script, "bash", program, *OPTIONS, f"--user-data-dir={self.profile}"]
        self.process = subprocess.Popen(
            command, pass_fds=given, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for number in (child_in, child_out, *given):
            os.close(number)
        self.to_browser, self.from_browser = os.fdopen(here_out, "wb"), os.fdopen(here_in, "rb")
        self.number = 0
        self.rest = bytearray()
        self.pages: dict[str, Page] = {}
        self.events: list[dict[str, Any]] = []

    def __enter__(self) -> Chromium:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.to_browser.close()
        self.from_browser.close()
        shutil.rmtree(self.profile, ignore_errors=True)

    def open(self, url: str, width: int = 1280, height: int = 900, *, phone: bool = False, dark: bool = False) -> Page:
        """A loaded page. A phone has a touch screen and two device pixels per CSS pixel."""
        target = self.call("Target.createTarget", {"url": "about:blank"})["targetId"]
        session = self.call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        page = self.pages[session] = Page(self, session, width)
        for domain in ("Page", "Runtime", "Log"):
            page.call(f"{domain}.enable")
        scale = 2 if phone else 1
        page.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=phone
        )
        page.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.call("Emulation.setEmulatedMedia", features=[scheme])
        self.events.clear()
        page.call("Page.navigate", url=url)
        self.wait("Page.loadEventFired", session)
        page.settle()
        return page

    def call(self, method: str, parameters: dict[str, Any], session: str | None = None) -> dict[str, Any]:
        """Sends a command and gives its result; events that come meanwhile are kept."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        self.to_browser.write(json.dumps(message).encode() + b"\0")
        self.to_browser.flush()
        while True:
            answer = self.receive()
            if answer.get("id") == self.number:
                break
            self.happened(answer)
        if "error" in answer:
            raise ChromiumError(f"{method}: {answer['error'].get('message')}")
        result: dict[str, Any] = answer["result"]
        return result

    def wait(self, method: str, session: str) -> None:
        """Reads until an event has come."""
        while not any(event["method"] == method and event.get("sessionId") == session for event in self.events):
            self.happened(self.receive())

    def receive(self) -> dict[str, Any]:
        """The next message; messages end with a zero byte."""
        searched = 0
        while (end := self.rest.find(0, searched)) < 0:
            searched = len(self.rest)
            piece = os.read(self.from_browser.fileno(), 1 << 20)
            if not piece:
                raise ChromiumError("the browser has ended")
            self.rest += piece
        message: dict[str, Any] = json.loads(self.rest[:end])
        del self.rest[: end + 1]
        return message

    def happened(self, event: dict[str, Any]) -> None:
        """Keeps an event; errors go to their page."""
        self.events.append(event)
        page, told = self.pages.get(event.get("sessionId", "")), event.get("params", {})
        if page is None:
            return
        if event["method"] == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            page.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif event["method"] == "Log.entryAdded" and told["entry"]["level"] == "error":
            page.errors.append(f"{told['entry']['text']} {told['entry'].get('url', '')}".strip())
        elif event["method"] == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            page.errors.append(" ".join(str(part.get("value", part.get("description"))) for part in told["args"]))
