"""The command that a message tells people to type is one that the running Python can run."""

import re
import sys
from pathlib import Path

import pytest

from probe_kit._system import imports
from probe_kit._system.imports import install_command, install_folder_command

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
    own = Path(imports.__file__)
    found = [
        f"{path.relative_to(PACKAGE)}:{number}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if path != own
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(r"\b(uv|pip3?) (pip |sync|install|add)", line)
    ]
    assert not found
