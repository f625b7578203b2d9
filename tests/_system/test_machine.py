"""The machine: devices, cores and scheduling."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from probe_kit._system import machine
from probe_kit._system.machine import check_device_name, same_scheduling, what_is_here
from probe_kit.errors import UsageError


@pytest.mark.parametrize("device", ["nonsense", "cpu:", "cuda:x", "", "meta", "CUDA"])
def test_what_is_no_device_is_refused_with_what_there_is(device: str) -> None:
    with pytest.raises(UsageError, match=r"none of cpu, cuda.*This machine has cpu \(\d+ cores?\)"):
        check_device_name(device)


def test_a_gpu_is_refused_only_where_there_surely_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_GPU_NODES", ("no-such-file*",))
    monkeypatch.setattr(machine.sys, "platform", "linux")
    with pytest.raises(UsageError, match="no such device"):
        check_device_name("cuda:0")
    monkeypatch.setattr(machine, "_GPU_NODES", ("null",))
    check_device_name("cuda:0")
    monkeypatch.setattr(machine, "_GPU_NODES", ())
    monkeypatch.setattr(machine.sys, "platform", "win32")
    check_device_name("cuda")
    check_device_name("cpu")


def test_nothing_of_it_imports_torch() -> None:
    code = (
        "import sys; from probe_kit._system.machine import check_device_name, what_is_here; "
        "check_device_name('cpu'); print(what_is_here(), 'torch' in sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True).stdout
    assert re.match(r"This machine has cpu \(\d+ cores?\).* False", shown)


def test_with_torch_there_it_names_what_torch_finds() -> None:
    import torch

    assert ("cuda:0" in what_is_here()) == torch.cuda.is_available()


pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no scheduling policies here")


@pytest.mark.parametrize("fails", [False, True])
def test_a_thread_that_a_library_makes_a_batch_one_is_normal_again(fails: bool) -> None:
    policy = os.sched_getscheduler(0)
    try:
        with same_scheduling():
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
            if fails:
                raise KeyError
    except KeyError:
        pass
    assert os.sched_getscheduler(0) == policy


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only of root")
@pytest.mark.filterwarnings("ignore")
def test_encoding_av1_makes_a_thread_of_root_a_real_time_one_otherwise(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with same_scheduling():
        with av.open(str(tmp_path / "film.mp4"), "w") as film:
            stream = film.add_stream("libsvtav1", 5, width=64, height=64, pix_fmt="yuv420p")
            film.mux(stream.encode(av.VideoFrame(64, 64, "yuv420p")) + stream.encode())
        during = os.sched_getscheduler(0)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    if during == os.SCHED_OTHER:
        pytest.skip("this machine gives no thread real time")
