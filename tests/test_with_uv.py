"""`./with-uv`, on machines with a uv, with an old one, and with none."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RECORDING = '#!/bin/sh\nif [ "$1" = --version ]; then echo "uv {version}"; exit; fi\necho "{name} $*"\n'
PIP = """#!/bin/sh
[ "$2" = pip ] || exit 1
[ "$3" = --version ] && exit
for word; do [ "$before" = --target ] && target=$word; before=$word; done
mkdir -p "$target/bin" && cp "{fetched}" "$target/bin/uv"
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the script and an environment that is there already."""
    folder = tmp_path / "check out"
    (folder / ".venv").mkdir(parents=True)
    (folder / ".venv" / "pyvenv.cfg").touch()
    shutil.copy(ROOT / "with-uv", folder)
    return folder


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(0o755)
    return path


def bare_machine(folder: Path) -> Path:
    """A folder of programs that every machine has, and no others; `sh` is found by its path."""
    for name in ("dirname", "grep", "sort", "head", "paste", "mkdir", "cp", "cat"):
        program = shutil.which(name)
        assert program
        (folder / name).symlink_to(program)
    return folder


def with_uv(checkout: Path, programs: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [checkout / "with-uv", *arguments], env={"PATH": str(programs)}, cwd=checkout.parent, encoding="utf-8",
        capture_output=True, stdin=subprocess.DEVNULL, check=False, timeout=300,
    )  # fmt: skip


@pytest.fixture
def programs(tmp_path: Path) -> Path:
    (tmp_path / "bin").mkdir()
    return bare_machine(tmp_path / "bin")


def test_a_uv_on_the_path_runs_the_command_in_the_project_from_any_folder(checkout: Path, programs: Path) -> None:
    executable(programs / "uv", RECORDING.format(version="0.9.8", name="theirs"))
    completed = with_uv(checkout, programs, "pytest", "-x", "a b")
    assert (completed.returncode, completed.stdout) == (0, f"theirs run --project {checkout} pytest -x a b\n")
    assert completed.stderr == ""


def test_what_developers_need_is_left_out_of_what_users_run(checkout: Path, programs: Path) -> None:
    executable(programs / "uv", RECORDING.format(version="0.9.8", name="theirs"))
    assert " --no-dev probe-kit demo" in with_uv(checkout, programs, "probe-kit", "demo").stdout
    assert "--no-dev" not in with_uv(checkout, programs, "pytest").stdout
    extras = ("--extra", "remote", "--no-extra=datasets", "-v")
    assert (
        f" --no-dev {' '.join(extras)} probe-kit demo"
        in with_uv(checkout, programs, *extras, "probe-kit", "demo").stdout
    )
    assert "--no-dev" not in with_uv(checkout, programs, *extras, "pytest", "-k", "probe-kit").stdout
    assert "--no-dev" not in with_uv(checkout, programs, "--extra", "probe-kit", "pytest").stdout


@pytest.mark.parametrize("old", [None, "0.4.30", "0.8.3"])
def test_where_uv_is_missing_or_too_old_pip_fetches_one_into_the_folder(
    old: str | None, checkout: Path, programs: Path, tmp_path: Path
) -> None:
    if old:
        executable(programs / "uv", RECORDING.format(version=old, name="old"))
    fetched = executable(tmp_path / "fetched", RECORDING.format(version="0.10.0", name="ours"))
    executable(programs / "python3", PIP.format(fetched=fetched))
    for _ in range(2):  # fetched once, found again
        completed = with_uv(checkout, programs, "pytest")
        assert completed.stdout == f"ours run --project {checkout} pytest\n", completed.stderr
    assert "fetching" not in completed.stderr
    assert (checkout / ".uv" / "bin" / "uv").is_file()


def test_a_machine_with_neither_uv_nor_pip_is_told_what_to_install(checkout: Path, programs: Path) -> None:
    completed = with_uv(checkout, programs, "pytest")
    assert completed.returncode == 1
    assert "install one of them" in completed.stderr


def test_a_missing_compiler_is_named_before_anything_is_compiled(checkout: Path, programs: Path) -> None:
    executable(programs / "uv", RECORDING.format(version="0.9.8", name="theirs"))
    shutil.rmtree(checkout / ".venv")
    assert "no C++ compiler found" in with_uv(checkout, programs, "pytest").stderr
    executable(programs / "c++", "#!/bin/sh\n")
    assert "no C++ compiler found" not in with_uv(checkout, programs, "pytest").stderr


def test_a_python_without_headers_is_passed_over_for_one_of_uvs_own(checkout: Path, programs: Path) -> None:
    shutil.rmtree(checkout / ".venv")
    headless = executable(programs / "python3.12", "#!/bin/sh\nexit 1\n")
    executable(
        programs / "uv",
        f'#!/bin/sh\ncase $1 in --version) echo "uv 0.9.8";; python) echo {headless};; '
        '*) echo "preference $UV_PYTHON_PREFERENCE";; esac\n',
    )
    assert with_uv(checkout, programs, "pytest").stdout == "preference only-managed\n"


def test_the_readmes_two_commands_and_the_script_of_ci_are_the_same() -> None:
    (block,) = re.findall(
        r"## Two commands\n+```\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    lines = [line.partition("#")[0].strip() for line in block.splitlines() if line.strip()]
    folder, demo, tests = lines
    assert folder == "cd probe_kit"
    assert demo == "./with-uv probe-kit demo"
    assert tests == (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()[-1]


@pytest.mark.slow
def test_pip_really_fetches_a_uv_that_runs(checkout: Path, programs: Path) -> None:
    executable(programs / "python3", f'#!/bin/sh\nexec "{sys._base_executable}" "$@"\n')  # type: ignore[attr-defined]
    script = checkout / "with-uv"
    plain = script.read_text(encoding="utf-8").replace(
        'exec "$uv" run --project "$here" "$@"', 'exec "$uv" --version'
    )
    script.write_text(plain, encoding="utf-8")
    environment = {**{k: v for k, v in os.environ.items() if k.startswith("PIP_")}, "PATH": str(programs)}
    completed = subprocess.run(
        [script, "pytest"], env=environment, capture_output=True, encoding="utf-8", check=False
    )
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.startswith("uv ")
