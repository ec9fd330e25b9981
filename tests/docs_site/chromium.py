"""A Chromium that is controlled through the Chrome DevTools protocol, over two pipes.

Pipes need no WebSocket, so that the standard library is enough, and no port of the machine.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
MISSING = (
    f"none of {', '.join(NAMES)} is on the PATH; install one from your system's packages, as with"
    " 'apt-get install chromium', 'dnf install chromium' or 'brew install chromium'"
)
PATIENCE = 60.0
"""Seconds after which a browser that does not answer is an error."""

_FLAGS = (
    "--headless=new",
    "--remote-debugging-pipe",
    # It opens our own pages only, and containers often cannot start the sandbox.
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--disable-sync",
    "--mute-audio",
)
# The browser reads commands from its file 3, and writes answers to its file 4.
_LAUNCH = (
    "import os, sys; read, write = map(int, sys.argv[1:3]); os.dup2(read, 3); os.dup2(write, 4);"
    " os.execv(sys.argv[3], sys.argv[3:])"
)
_FREE = 10
"""Files from this number on do not collide with 3 and 4."""


def executable() -> str | None:
    """Return the path of a Chromium or Chrome; None if there is none on the PATH."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class BrowserError(RuntimeError):
    """The browser refused a command, ended, or does not answer."""


class Browser:
    """A browser process, which ends with the `with` block.

    Args:
        path: of the program.
    """

    def __init__(self, path: str) -> None:
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        down, self._commands = _pipe()
        self._answers, up = _pipe()
        arguments = [path, *_FLAGS, f"--user-data-dir={self._profile.name}", "about:blank"]
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _LAUNCH, str(down), str(up), *arguments],
            pass_fds=(down, up),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(down)
        os.close(up)
        self._rest, self._last = b"", 0
        self._messages: deque[dict[str, Any]] = deque()

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.command("Browser.close")
            self._process.wait(PATIENCE)
        except (BrowserError, OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._commands)
        os.close(self._answers)
        self._profile.cleanup()

    def command(self, method: str, session: str | None = None, **parameters: Any) -> Any:
        """Send a command, and return its result.

        Raises:
            BrowserError: It failed.
        """
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        answer = self._wait(lambda found: found.get("id") == self._last, method)
        if "error" in answer:
            raise BrowserError(f"{method}: {answer['error']}")
        return answer["result"]

    def event(self, method: str, session: str) -> dict[str, Any]:
        """Wait for an event of a page, and return its parameters."""
        found = self._wait(
            lambda each: each.get("method") == method and each.get("sessionId") == session, method
        )
        return found["params"]

    def events(self) -> list[dict[str, Any]]:
        """Return the events that came since the last call, and that nothing waited for."""
        found = list(self._messages)
        self._messages.clear()
        return found

    def page(self, dark: bool = False) -> Page:
        """Open an empty page, with storage of its own.

        Args:
            dark: whether the user prefers dark pages.
        """
        context = self.command("Target.createBrowserContext")["browserContextId"]
        target = self.command(
            "Target.createTarget", url="about:blank", browserContextId=context, newWindow=True
        )["targetId"]
        session = self.command("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        return Page(self, session, dark)

    def _wait(self, wanted: Callable[[dict[str, Any]], bool], name: str) -> dict[str, Any]:
        for message in self._messages:
            if wanted(message):
                self._messages.remove(message)
                return message
        end = time.monotonic() + PATIENCE
        while True:
            for message in self._received(end, name):
                # What came in the same piece after the wanted one is kept for later.
                self._messages.append(message)
            for message in self._messages:
                if wanted(message):
                    self._messages.remove(message)
                    return message

    def _received(self, end: float, name: str) -> list[dict[str, Any]]:
        ready, _, _ = select.select([self._answers], [], [], max(0.0, end - time.monotonic()))
        if not ready:
            raise BrowserError(f"no answer to {name} in {PATIENCE:g} s")
        piece = os.read(self._answers, 1 << 20)
        if not piece:
            raise BrowserError(f"the browser ended while {name} was waited for")
        *whole, self._rest = (self._rest + piece).split(b"\0")
        return [json.loads(text) for text in whole]


class Page:
    """A page of a browser.

    Args:
        browser: that shows it.
        session: of the protocol.
        dark: whether the user prefers dark pages.
    """

    def __init__(self, browser: Browser, session: str, dark: bool) -> None:
        self._browser, self._session = browser, session
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.command(f"{domain}.enable")
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", features=[scheme])

    def command(self, method: str, **parameters: Any) -> Any:
        """Send a command to the page, and return its result."""
        return self._browser.command(method, self._session, **parameters)

    def resize(self, width: int) -> None:
        """Show the page on a screen of a width in CSS pixels."""
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=900,
            deviceScaleFactor=1,
            mobile=width < 600,
        )

    def open(self, url: str) -> list[str]:
        """Open an address, wait until it is loaded, and return what went wrong."""
        self._browser.events()
        answer = self.command("Page.navigate", url=url)
        if "errorText" in answer:
            return [f"cannot be opened: {answer['errorText']}"]
        self._browser.event("Page.loadEventFired", self._session)
        return []

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression, or of its promise.

        Raises:
            BrowserError: It throws.
        """
        answer = self.command(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", details).get("description", str(details)))
        return answer["result"].get("value")

    def complaints(self, origin: str) -> list[str]:
        """Return console errors, failed requests and requests to other places since `open`.

        Args:
            origin: of the pages that may be asked for.
        """
        found, urls = [], {}
        for message in self._browser.events():
            if message.get("sessionId") != self._session:
                continue
            event, method = message["params"], message["method"]
            if method == "Network.requestWillBeSent":
                urls[event["requestId"]] = url = event["request"]["url"]
                if not url.startswith((origin, "data:", "blob:")):
                    found.append(f"asks for {url}")
            elif method == "Network.responseReceived" and event["response"]["status"] >= 400:
                found.append(f"{event['response']['status']}: {event['response']['url']}")
            elif method == "Network.loadingFailed" and not event.get("canceled"):
                found.append(f"{event['errorText']}: {urls.get(event['requestId'])}")
            elif method == "Runtime.exceptionThrown":
                details = event["exceptionDetails"]
                found.append(details.get("exception", {}).get("description", details["text"]))
            elif method == "Runtime.consoleAPICalled" and event["type"] in ("error", "assert"):
                found.append(f"console: {[each.get('value') for each in event['args']]}")
            elif method == "Log.entryAdded" and event["entry"]["level"] == "error":
                found.append(f"log: {event['entry']['text']} {event['entry'].get('url', '')}")
        return found


def _pipe() -> tuple[int, int]:
    read, write = os.pipe()
    high = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, _FREE) for end in (read, write)]
    os.close(read)
    os.close(write)
    return high[0], high[1]
