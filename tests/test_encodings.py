"""Files are UTF-8 whatever the locale says, and output in the locale's own encoding loses nothing quietly."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from probe_kit.suite import Suite

ROOT = Path(__file__).parents[1]
OPENS = re.compile(r"(_text|open|NamedTemporaryFile)\(|text=|universal_newlines")
OURS = ("probe_kit", "tests", "scripts", "benchmarks", "docs")
COMMANDS = r"""
import io, json, locale, sys
from probe_kit.cli import main
shell, ended = sys.stdout, []
for words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    streams = [io.TextIOWrapper(io.BytesIO(), encoding=locale.getencoding()) for _ in range(2)]
    sys.stdout, sys.stderr = streams
    try:
        main()
    except SystemExit as end:
        code = end.code
    for stream in streams:
        stream.flush()
    ended.append((code, *(stream.buffer.getvalue().decode("latin-1") for stream in streams)))
print(json.dumps(ended), file=shell)
"""


def test_every_text_is_opened_with_its_encoding() -> None:
    """Ruff's rule sees what it knows to be a path; here are the calls on attributes and results as well."""
    silent = [
        f"{path.relative_to(ROOT)}:{call.lineno}: {ast.unparse(call)}"
        for folder in OURS
        for path in sorted((ROOT / folder).rglob("*.py"))
        for call in calls(path)
        if is_text(call)
        and not any(keyword.arg == "encoding" for keyword in call.keywords)
        and ast.unparse(call.func) != "package.read_text"  # of installed packages, which takes no encoding
    ]
    assert silent == []


def calls(path: Path) -> Iterator[ast.Call]:
    source = path.read_text(encoding="utf-8")
    if OPENS.search(source):  # most modules open nothing
        yield from (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))


def is_text(call: ast.Call) -> bool:
    """Whether this reads or writes text: by name, by a process's `encoding="utf-8"`, or by a mode without `b`."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    keywords = {keyword.arg: keyword.value for keyword in call.keywords}
    if name in ("read_text", "write_text"):
        return True
    if name in ("run", "Popen", "check_output"):
        return bool({"text", "universal_newlines"} & keywords.keys())
    values = [*call.args, keywords.get("mode")]
    modes = [value.value for value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)]
    owner = getattr(getattr(call.func, "value", None), "id", "")
    if name in ("open", "fdopen", "NamedTemporaryFile") and owner not in ("zarr", "tarfile", "av", "archive"):
        return any(mode and set(mode) <= set("rwax+t") for mode in modes)
    return False


def test_the_scan_sees_what_it_looks_for(tmp_path: Path) -> None:
    path = tmp_path / "silent.py"
    path.write_text(
        "a.b.read_text()\nrun(['x'], text=True)\nf(x).open('a')\nopen('a.txt', mode='w')\n", encoding="utf-8"
    )
    assert sum(map(is_text, calls(path))) == 4
    path.write_text("a.b.read_bytes()\nrun(['x'])\nf(x).open('rb')\nopen('a.txt', mode='wb')\n", encoding="utf-8")
    assert sum(map(is_text, calls(path))) == 0


@pytest.fixture(scope="module", params=["ASCII", pytest.param("ISO-8859-1", marks=pytest.mark.slow)])
def locale(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a machine whose locale is not UTF-8."""
    plain = {**os.environ, "PYTHONUTF8": "0", "PYTHONPATH": str(ROOT)}
    plain.pop("PYTHONIOENCODING", None)
    if request.param == "ASCII":
        return {**plain, "LC_ALL": "C"}
    folder = tmp_path_factory.mktemp("locales")
    if shutil.which("localedef") is None:
        pytest.skip("this system has no localedef to make a locale of Latin-1")
    command = ["localedef", "-i", "en_US", "-f", "ISO-8859-1", str(folder / "en_US.ISO-8859-1")]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("this system has no source of the locale en_US.ISO-8859-1")
    return {**plain, "LOCPATH": str(folder), "LC_ALL": "en_US.ISO-8859-1"}


@pytest.mark.slow
def test_pages_and_tables_are_utf_8_under_a_locale_that_is_not(
    locale: dict[str, str], small_suite: Suite, little_runs: Path, tmp_path: Path
) -> None:
    label = "Modèle π — 模型"
    run, other = (str(little_runs / name) for name in ("run", "other"))
    groups = ["--kind", "groups", f"{label}={run}", f"other={other}"]
    commands = [
        ["compare", *groups, "--html", str(tmp_path / "report.html"), "--format", "json"],
        ["compare", *groups, "--format", "csv"],
        ["suite", "validate", str(small_suite.folder)],
        ["suite", "build", str(tmp_path / "built"), "--categories", "color", "--n", "2"],
        ["run", "export", other, "--format", "h5", "--out", str(tmp_path / "run.h5")],
    ]
    completed = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMMANDS, json.dumps(commands)], env=locale, capture_output=True,
        encoding="latin-1", check=False,
    )  # fmt: skip
    assert completed.returncode == 0, completed.stderr
    answers = json.loads(completed.stdout)
    assert [code for code, *_ in answers] == [0] * len(commands), answers
    assert label in str(json.loads(answers[0][1]))
    output = answers[1][1]
    assert "\\u6a21\\u578b" in output or label in output.encode("latin-1").decode()
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert label in page
    assert "Ã" not in page
    assert "Â" not in page
    items = (tmp_path / "built" / "items" / "metadata.jsonl").read_text(encoding="utf-8")
    assert len(items.splitlines()) == 2
