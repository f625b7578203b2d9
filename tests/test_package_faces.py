"""What a package offers is found where a reader looks for it: `dir`, `help` and the completion of names."""

import pydoc
import re
import subprocess
import sys
from importlib import import_module
from inspect import ismodule
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(
    ".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "probe_kit").rglob("__init__.py")
)
LAZY = [
    package
    for package in PACKAGES
    if "lazy_names(" in (ROOT.joinpath(*package.split("."), "__init__.py")).read_text(encoding="utf-8")
]


def ask(code: str) -> str:
    """What a fresh interpreter prints."""
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True, cwd=ROOT
    )
    return completed.stdout.strip()


def test_the_packages_and_those_that_load_late_are_found() -> None:
    assert {"probe_kit", "probe_kit.hooks", "probe_kit.suite.generators"} <= set(PACKAGES)
    assert {"probe_kit", "probe_kit.train", "probe_kit.retention"} <= set(LAZY) < set(PACKAGES)


@pytest.mark.parametrize("package", PACKAGES)
def test_dir_holds_every_public_name_of_a_package(package: str) -> None:
    module = import_module(package)
    assert set(getattr(module, "__all__", ())) <= set(dir(module))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_and_every_name_of_dir_is_there(package: str) -> None:
    module = import_module(package)
    assert not [name for name in {*getattr(module, "__all__", ()), *dir(module)} if not hasattr(module, name)]


def test_dir_of_a_fresh_interpreter_holds_every_public_name_and_loads_nothing_heavy() -> None:
    """The packages of this process may hold names that other tests have imported."""
    heavy = ("torch", "lerobot", "transformers", "pybullet", "pandas", "zarr", "matplotlib")
    printed = ask(
        f"import sys, importlib\n"
        f"for package in {LAZY}:\n"
        f"    module = importlib.import_module(package)\n"
        f"    print(package, sorted(set(module.__all__) - set(dir(module))))\n"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    assert printed.splitlines() == [*(f"{package} []" for package in LAZY), "[]"]


@pytest.mark.parametrize("package", LAZY)
def test_help_lists_every_public_name(package: str) -> None:
    module = import_module(package)
    text = pydoc.plain(pydoc.render_doc(module))
    listed = text[re.search(r"\n(CLASSES|FUNCTIONS)\n", text).start() :]
    pattern = r"^    (class )?{}[(=: ]"  # a class, a function or a value that stands among the package's own
    names = [name for name in module.__all__ if not ismodule(getattr(module, name))]
    assert not [name for name in names if not re.search(pattern.format(name), listed, re.MULTILINE)]


@pytest.mark.slow
def test_the_names_are_completed_in_ipython_without_loading_torch() -> None:
    pytest.importorskip("IPython")
    printed = ask(
        "import sys, probe_kit\n"
        "from IPython.core.completer import provisionalcompleter\n"
        "from IPython.core.interactiveshell import InteractiveShell\n"
        "shell = InteractiveShell.instance()\n"
        "shell.user_ns['probe_kit'] = probe_kit\n"
        "with provisionalcompleter():\n"
        "    found = {one.text for one in shell.Completer.completions('probe_kit.', 10)}\n"
        "print(sorted(set(probe_kit.__all__) - found), 'torch' in sys.modules)"
    )
    assert printed.splitlines()[-1] == "[] False"
