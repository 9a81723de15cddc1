"""A headless Chromium, driven through its DevTools pipe: no further package, no port, no
network."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

FLAGS = [
    *(
        "--headless=new",
        "--no-sandbox",
        "--remote-debugging-pipe",
        "--hide-scrollbars",
        "--no-first-run",
    ),
    *(
        f"--disable-{part}"
        for part in ("gpu", "quic", "sync", "dev-shm-usage", "background-networking")
    ),
    "--disable-component-update",
]
TROUBLE = (
    "Runtime.exceptionThrown",
    "Runtime.consoleAPICalled",
    "Log.entryAdded",
    "Page.javascriptDialogOpening",
)


class Page:
    """One tab: `go`, `run` JavaScript, `pdf`; `messages` holds console errors and exceptions."""

    def __init__(self, read: int, write: int) -> None:
        self.reader, self.write = os.fdopen(read, "rb", buffering=0), write
        self.rest = b""
        self.count = 0
        self.session: str | None = None
        self.messages: list[str] = []
        self.requests: list[str] = []
        self.loaded = False
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        self.count += 1
        message: dict[str, Any] = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.rest:
            chunk = self.reader.read(1 << 20)
            assert chunk, "Chromium went away"
            self.rest += chunk
        line, self.rest = self.rest.split(b"\0", 1)
        event = json.loads(line)
        method, parameters = event.get("method"), event.get("params", {})
        self.loaded |= method == "Page.loadEventFired"
        if method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif method in TROUBLE:
            self.messages.append(f"{method}: {parameters}")
        return event

    def go(self, path: Path, width: int = 1280, height: int = 900, *, phone: bool = False) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )
        self.loaded = False
        self.call("Page.navigate", url=path.resolve().as_uri())
        while not self.loaded:
            self._next()

    def run(self, script: str) -> Any:
        result = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def pdf(self) -> bytes:
        answer = self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
        return base64.b64decode(answer["data"])


@pytest.fixture(scope="session")
def browser() -> Iterator[Page]:
    """A page of a headless Chromium, whose pipe is on descriptors 3 and 4; skips where there is
    none."""
    program = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if program is None:
        pytest.skip("there is no Chromium")
    # Chromium reads descriptor 3 and writes 4: ours are kept above, so that the shell's
    # redirections cannot meet them.
    low = [*os.pipe(), *os.pipe()]
    to_read, to_write, from_read, from_write = (
        fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 10) for fd in low
    )
    with tempfile.TemporaryDirectory(
        prefix="ipe-bench-chromium-", ignore_cleanup_errors=True
    ) as profile:
        script = f'exec "$@" 3<&{to_read} 4>&{from_write} {to_read}<&- {from_write}>&-'
        command = ["bash", "-c", script, "bash", program, *FLAGS, f"--user-data-dir={profile}"]
        process = subprocess.Popen(
            command,
            pass_fds=(to_read, from_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in (*low, to_read, from_write):
            os.close(fd)
        try:
            page = Page(from_read, to_write)
            yield page
            page.reader.close()
        finally:
            process.terminate()
            process.wait(timeout=30)
            os.close(to_write)
