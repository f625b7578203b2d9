"""A real Chromium, driven through its debugging pipe: pages are opened, clicked and read as a user does.

The pipe is Chromium's own protocol (JSON messages that end with a zero byte); it needs no further library.
"""

import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from base64 import b64decode
from pathlib import Path
from typing import Any, Self

CHROMIUM = shutil.which("chromium")
WHY_SKIPPED = "no chromium (Debian: apt install chromium)"
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--remote-debugging-pipe",
    "--no-default-browser-check", "--force-color-profile=srgb",
)  # fmt: skip
_PATIENCE = 60
"""Seconds until what a test waits for has to be true; other tests may use the same cores."""
_KEYS = {" ": "Space", "Tab": "Tab", "Enter": "Enter", "Home": "Home", "End": "End"}
_CODES = {"Tab": 9, "Enter": 13, " ": 32, "End": 35, "Home": 36, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39,
          "ArrowDown": 40}  # fmt: skip


class Browser:
    """A Chromium process with its own profile. `complaints`: errors of any page's console, and failed requests."""

    def __init__(self, profile: Path) -> None:
        ends, self._out = os.pipe()
        self._in, begins = os.pipe()
        theirs_in, theirs_out = (fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (ends, begins))
        os.close(ends)
        os.close(begins)
        command = ["bash", "-c", f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}', "bash", str(CHROMIUM), *_FLAGS]
        self._process = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(theirs_in)
        os.close(theirs_out)
        self._sent, self._unread = 0, b""
        self.complaints: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(30)
        os.close(self._out)
        os.close(self._in)

    def page(self, width: int = 1400, height: int = 1000, dark: bool = False) -> "Page":
        """A fresh page in a context of its own, without cookies or memory of others."""
        context = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, session)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.resize(width, height)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        page.call("Emulation.setEmulatedMedia", features=scheme)
        return page

    def call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """The result of one command of the protocol. Raises AssertionError with Chromium's words."""
        self._sent += 1
        message = {"id": self._sent, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._sent:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            ready, _, _ = select.select([self._in], [], [], 2 * _PATIENCE)
            assert ready, "chromium does not answer"
            more = os.read(self._in, 1 << 20)
            assert more, "chromium ended"
            self._unread += more
        message, _, self._unread = self._unread.partition(b"\0")
        event: dict[str, Any] = json.loads(message)
        self._note(event.get("method"), event.get("params", {}))
        return event

    def _note(self, event: str | None, details: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(details["exceptionDetails"])[:600])
        elif event == "Log.entryAdded" and details["entry"]["level"] in ("error", "warning"):
            self.complaints.append(f"{details['entry']['text']} {details['entry'].get('url', '')}")
        elif event == "Runtime.consoleAPICalled" and details["type"] in ("error", "warning", "assert"):
            self.complaints.append(json.dumps(details["args"])[:600])


_READY = "document.readyState === 'complete' && !document.querySelector('.loading')"


class Page:
    """One page."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol."""
        return self._browser.call(method, self._session, **parameters)

    def resize(self, width: int, height: int = 1000) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )

    def open(self, address: str) -> None:
        """Go to an address, and wait until the viewer shows no “Loading”.

        An address with a token leads to the viewer's page, and from there a person goes to a place in it.
        """
        entrance, mark, fragment = address.partition("#")
        if "?token=" in entrance:
            self.call("Page.navigate", url=entrance)
            self.wait(f"location.search === '' && {_READY}")
            address = str(self.read("location.href")).partition("#")[0] + mark + fragment
        self.call("Page.navigate", url=address)
        self.wait(_READY)

    def read(self, expression: str) -> Any:
        """The value of an expression in the page; it may wait."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, json.dumps(answer["exceptionDetails"])[:800]
        return answer["result"].get("value")

    def wait(self, expression: str) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + _PATIENCE
        while not self._is_true(expression):
            assert time.monotonic() < end, (
                f"never true: {expression}\n{self.read('document.body.innerText')[:1500]}"
            )
            time.sleep(0.03)

    def _is_true(self, expression: str) -> bool:
        try:
            answer = self.call("Runtime.evaluate", expression=f"Boolean({expression})", returnByValue=True)
        except AssertionError as error:
            if "navigated" in str(error):  # the page changes while it is asked
                return False
            raise
        return bool(answer["result"].get("value"))

    def settle(self) -> None:
        """Wait until what the page has begun to draw is drawn."""
        self.read(
            "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))))"
        )

    def click(self, selector: str) -> None:
        """Click the middle of the first element of a selector with the mouse."""
        self.wait(f"document.querySelector({json.dumps(selector)})")
        x, y = self._middle(selector)
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        self.settle()

    def _middle(self, selector: str) -> tuple[float, float]:
        x, y = self.read(
            f"(() => {{ const one = document.querySelector({json.dumps(selector)}); "
            "one.scrollIntoView({block: 'center', behavior: 'instant'}); const b = one.getBoundingClientRect(); "
            "return [b.left + b.width / 2, b.top + b.height / 2]; })()"
        )
        return x, y

    def hover(self, selector: str) -> None:
        """Move the mouse over the first element of a selector."""
        x, y = self._middle(selector)
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.settle()

    def hover_at(self, selector: str, x: float, y: float) -> None:
        """Move the mouse to shares of the width and height of the first element of a selector."""
        self._middle(selector)
        left, top, width, height = self.read(
            f"(() => {{ const b = document.querySelector({json.dumps(selector)}).getBoundingClientRect(); "
            "return [b.left, b.top, b.width, b.height]; })()"
        )
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=left + x * width, y=top + y * height)
        self.settle()

    def drag(self, selector: str, share: float) -> None:
        """Press in the middle of an element, and drag to `share` of its width."""
        x, y = self._middle(selector)
        left, width = self.read(
            f"(() => {{ const b = document.querySelector({json.dumps(selector)}).getBoundingClientRect(); "
            "return [b.left, b.width]; })()"
        )
        steps = [
            ("mousePressed", x),
            ("mouseMoved", left + share * width),
            ("mouseReleased", left + share * width),
        ]
        for kind, at in steps:
            self.call("Input.dispatchMouseEvent", type=kind, x=at, y=y, button="left", buttons=1, clickCount=1)
        self.settle()

    def press(self, key: str) -> None:
        """Press and release a key by its name, such as `ArrowRight` or `j`."""
        code = _CODES.get(key, ord(key.upper()) if len(key) == 1 else 0)
        key_fields = {"key": key, "code": _KEYS.get(key, key), "windowsVirtualKeyCode": code}
        text = {"Enter": "\r"}.get(key, key if len(key) == 1 else "")
        self.call("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", text=text, **key_fields)
        self.call("Input.dispatchKeyEvent", type="keyUp", **key_fields)
        self.settle()

    def choose(self, selector: str, value: str) -> None:
        """Set a control to a value, as choosing or typing does."""
        self.read(
            f"(() => {{ const one = document.querySelector({json.dumps(selector)}); "
            f"one.value = {json.dumps(value)}; "
            "one.dispatchEvent(new Event(one.tagName === 'SELECT' ? 'change' : 'input', {bubbles: true})); })()"
        )
        self.settle()

    def picture(self, path: Path | None = None, full_page: bool = True) -> bytes:
        """A PNG of the page."""
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=full_page)
        content = b64decode(shot["data"])
        if path is not None:
            path.write_bytes(content)
        return content
