"""The product as its users have it: the command line, and the names of `probe_kit.__all__`.

The tests of this folder import nothing else of the package, so that they stay valid when its rooms are rebuilt.
"""

import contextlib
import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, build_opener

from probe_kit.__main__ import main

ROOT = Path(__file__).parents[2]
ENDING = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class Answer:
    """The output of a command: exit code, stdout and stderr."""

    command: str
    code: int
    out: str
    err: str

    @property
    def text(self) -> str:
        """All that the user reads, with single spaces: where lines break is the terminal's affair."""
        return " ".join((self.out + "\n" + self.err).split())

    def json(self) -> Any:
        """The value that stdout holds."""
        return json.loads(self.out)

    def rows(self) -> list[dict[str, str]]:
        """The table that stdout holds as CSV, a dictionary per row."""
        return list(csv.DictReader(io.StringIO(self.out)))

    def ended(self, code: int) -> "Answer":
        """Fail with all of the output unless the command ended with `code`."""
        assert self.code == code, f"{self.command}\nended with {self.code}, not {code}\n{self.out}\n{self.err}"
        return self


def probe_kit(*words: object, code: int | None = 0) -> Answer:
    """Type `probe-kit WORDS` in this process, through the function that the console script calls.

    Fails unless the command ends with `code`; None accepts every exit code. Warnings are notes, as for users.
    """
    typed = ["probe-kit", *map(str, words)]
    out, err = io.StringIO(), io.StringIO()
    arguments, handlers = sys.argv, {number: signal.getsignal(number) for number in ENDING}
    ended: object = 0
    try:
        sys.argv = typed
        with warnings.catch_warnings(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            warnings.resetwarnings()
            for hidden in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
                warnings.simplefilter("ignore", hidden)
            try:
                main()
            except SystemExit as end:
                ended = end.code
    finally:
        sys.argv = arguments
        for number, handler in handlers.items():
            signal.signal(number, handler)
    ended = 0 if ended is None else ended if isinstance(ended, int) else 1
    answer = Answer(" ".join(typed), int(ended), out.getvalue(), err.getvalue())
    return answer if code is None else answer.ended(code)


def console_script() -> Path:
    """The installed program of this environment."""
    return Path(sys.executable).with_name("probe-kit")


def environment(**more: str) -> dict[str, str]:
    """The variables of a new process: programs of this environment first, no network, `more` on top."""
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": programs, "HF_HUB_OFFLINE": "1", **more}


def probe_kit_process(
    *words: object, code: int | None = 0, folder: Path | None = None, timeout: float = 600, **more: str
) -> Answer:
    """Type `probe-kit WORDS` as a process of its own, in `folder`, with the variables `more`. Seconds of start."""
    typed = [str(console_script()), *map(str, words)]
    ended = subprocess.run(
        typed,
        cwd=folder,
        env=environment(**more),
        capture_output=True,
        encoding="utf-8",
        check=False,
        timeout=timeout,
    )
    answer = Answer(" ".join(typed), ended.returncode, ended.stdout, ended.stderr)
    return answer if code is None else answer.ended(code)


def address_of(viewer: "subprocess.Popen[str]") -> str:
    """Return the address that `probe-kit view` prints, with its token."""
    assert viewer.stdout is not None
    read = ""
    while (address := re.search(r"http://[^\s]+", read)) is None:
        line = viewer.stdout.readline()
        assert line, f"the viewer ended: {read}"
        read += line
    return address.group()


def served_page(address: str) -> str:
    """Return the page of the viewer, which a browser reaches with the cookie of the first answer."""
    browser, end = build_opener(HTTPCookieProcessor()), time.monotonic() + 60
    while True:
        try:
            for page in (address, address.partition("?")[0]):
                with browser.open(page, timeout=30) as answer:
                    content = str(answer.read().decode("utf-8"))
            return content
        except HTTPError:
            raise
        except OSError:
            assert time.monotonic() < end, "the viewer does not answer"
            time.sleep(0.2)


def lines_of(page: str, heading: str) -> list[str]:
    """The commands of the first fenced block below `heading` in a page, such as `README.md`, without comments."""
    text = (ROOT / page).read_text(encoding="utf-8")
    _, _, below = text.partition(f"\n{heading}\n")
    assert below, f"{page} has no heading {heading!r}"
    _, _, block = below.partition("```")
    _, _, block = block.partition("\n")
    block, _, _ = block.partition("```")
    lines = [line.partition("  #")[0].strip().removeprefix("$ ") for line in block.splitlines()]
    return [line for line in lines if line]


def all_in(text: str, words: Sequence[str]) -> bool:
    """Whether every one of `words` occurs in `text`, in any case of letters."""
    return all(word.casefold() in text.casefold() for word in words)
