"""Environments of clients, whose packages exclude ours, and servers of processes of their own."""

import os
import shutil
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.made_once import made_once

ROOT = Path(__file__).parents[2]


def client_python(
    factory: pytest.TempPathFactory, name: str, packages: Sequence[str], check: str, with_ours: bool = False
) -> Path:
    """A Python with packages of the registry, made once; the test is skipped by their names where it cannot be.

    Args:
        factory: pytest's own.
        name: The name of the environment.
        packages: Requirements.
        check: Code that fails where the packages do not work.
        with_ours: Whether the packages of this Python are there too.
    """

    def make(folder: Path) -> None:
        subprocess.run([sys.executable, "-m", "venv", str(folder / "client")], check=True, timeout=200)
        python = folder / "client" / "bin" / "python"
        if with_ours:
            (site,) = (folder / "client" / "lib").glob("python*/site-packages")
            lines = [
                f"import site; site.addsitedir({path!r})" for path in (sysconfig.get_path("purelib"), str(ROOT))
            ]
            (site / "probe-kit-of-tests.pth").write_text("\n".join(lines), encoding="utf-8")
        uv = None if with_ours else shutil.which("uv")  # uv looks at no path file
        tool = (
            [uv, "pip", "install", "--python", str(python)] if uv else [str(python), "-m", "pip", "install", "-q"]
        )
        subprocess.run([*tool, *packages], check=False, capture_output=True, timeout=500)

    python = made_once(factory, name, make) / "client" / "bin" / "python"
    checked = subprocess.run([python, "-c", check], check=False, capture_output=True, timeout=200, env=drawing())
    if checked.returncode:
        pytest.skip(f"{', '.join(packages)} cannot be installed, or do not work here")
    return python


def drawing(variables: Mapping[str, str] | None = None) -> dict[str, str]:
    """The variables of a process that may draw pictures without a screen."""
    return {"MUJOCO_GL": "egl", **os.environ, "PYTHONUNBUFFERED": "1", **(variables or {})}


@contextmanager
def server_process(out: Path, *options: str, python: Path | None = None) -> Iterator[tuple["Process", str]]:
    """A server of its own process, which ended when the body is left, and its address; of pi0-tiny by default."""
    model = () if "--model" in options else ("--model", "pi0-tiny")
    command = [str(python or sys.executable), "-m", "probe_kit", "serve", *model, "--out", str(out)]
    server = Process([*command, *options], stdout=subprocess.PIPE, text=True, encoding="utf-8", env=drawing())
    assert server.stdout is not None
    try:
        yield server, server.stdout.readline().strip()
    finally:
        if server.poll() is None:
            server.send_signal(signal.SIGINT)
        server.wait(300)


Process = subprocess.Popen[str]
