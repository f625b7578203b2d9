"""The machine: devices, cores and scheduling."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from probe_kit._system import imports, machine
from probe_kit._system.counting import plural
from probe_kit._system.imports import install_command, install_folder_command
from probe_kit._system.machine import check_device_name, same_scheduling, what_is_here
from probe_kit.errors import UsageError


@pytest.mark.parametrize("device", ["nonsense", "cpu:", "cuda:x", "", "meta", "CUDA"])
def test_an_unknown_device_is_refused_with_the_devices_of_the_machine(device: str) -> None:
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
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True).stdout
    assert re.match(r"This machine has cpu \(\d+ cores?\).* False", output)


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


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (1, "table", "1 table"),
        (0, "run", "0 runs"),
        (1, "category", "1 category"),
        (2, "category", "2 categories"),
        (3, "key", "3 keys"),
        (2, "GPU", "2 GPUs"),
        (3440, "independent group", "3,440 independent groups"),
    ],
)
def test_a_noun_is_in_the_plural_unless_there_is_one(number: int, noun: str, text: str) -> None:
    assert plural(number, noun) == text


PACKAGE = Path(imports.__file__).parents[1]


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imports, "_is_of_checkout", lambda: False)


def test_in_the_environment_of_a_checkout_with_uv_installs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(imports, "_ROOT", tmp_path)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
    (tmp_path / "with-uv").touch()
    monkeypatch.chdir(tmp_path)
    assert install_command() == "./with-uv probe-kit doctor"
    assert install_command("ray") == "./with-uv --extra ray probe-kit doctor"
    assert install_command(rebuild="pybullet") == "./with-uv --reinstall-package pybullet probe-kit doctor"
    monkeypatch.chdir("/")
    assert install_command("ray") == f"{tmp_path / 'with-uv'} --extra ray probe-kit doctor"


def test_a_checkout_in_the_environment_of_another_project_is_not_changed_by_with_uv(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(imports, "_ROOT", tmp_path / "probe_kit")
    (tmp_path / "probe_kit").mkdir()
    (tmp_path / "probe_kit" / "with-uv").touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "other"))
    assert "with-uv" not in install_command("ray")


@pytest.mark.usefixtures("elsewhere")
def test_pip_is_named_only_where_the_running_python_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/env/bin/python")
    monkeypatch.setattr(imports.shutil, "which", lambda _: "/env/bin/python")
    monkeypatch.setattr(imports, "find_spec", lambda _: object())
    assert install_command("ray") == "python -m pip install 'probe-kit[ray]'"
    monkeypatch.setattr(imports, "find_spec", lambda _: None)
    assert install_command("ray") == "uv pip install --python python 'probe-kit[ray]'"
    assert install_command(rebuild="pybullet") == (
        "uv pip install --python python --reinstall --no-build-isolation pybullet"
    )


@pytest.mark.usefixtures("elsewhere")
def test_the_python_that_runs_is_named_by_its_path_where_a_shell_finds_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "executable", "/my env/bin/python")
    monkeypatch.setattr(imports.shutil, "which", lambda _: "/usr/bin/python")
    monkeypatch.setattr(imports, "find_spec", lambda _: None)
    assert install_command() == "uv pip install --python '/my env/bin/python' probe-kit"


@pytest.mark.usefixtures("elsewhere")
def test_a_package_of_the_users_own_is_installed_by_the_installer_that_the_environment_has(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "executable", "/env/bin/python")
    monkeypatch.setattr(imports.shutil, "which", lambda name: "/env/bin/python" if name == "python" else None)
    monkeypatch.setattr(imports, "find_spec", lambda _: object())
    assert install_folder_command(Path("my vla")) == "python -m pip install -e 'my vla'"
    monkeypatch.setattr(imports, "find_spec", lambda _: None)
    monkeypatch.setattr(imports, "_ROOT", tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert install_folder_command(Path("my-vla")) == "uv pip install --python python -e my-vla"
    (tmp_path / ".uv" / "bin").mkdir(parents=True)
    (tmp_path / ".uv" / "bin" / "uv").touch()
    assert install_folder_command(Path("my-vla")) == f"{tmp_path}/.uv/bin/uv pip install --python python -e my-vla"


def test_no_message_names_an_installer_of_its_own() -> None:
    imports_file = Path(imports.__file__)
    mentions = [
        f"{path.relative_to(PACKAGE)}:{number}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if path != imports_file
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(r"\b(uv|pip3?) (pip |sync|install|add)", line)
    ]
    assert not mentions
