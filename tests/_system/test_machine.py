import re
import subprocess
import sys

import pytest

from probe_kit._system import machine
from probe_kit._system.machine import check_device_name, what_is_here
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
