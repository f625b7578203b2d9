"""The command line as a user meets it: a process, its output, its exit code."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit._terminal import console
from probe_kit.cli import PANELS, _show_warning, app, commands_of
from probe_kit.suite import Suite, load_suite

# The keys of `retention --format json` are part of the contract (architecture, command line).
KEYS = {
    "run": {"model", "mode", "suite"},
    "success": {
        "n_episodes",
        "n_items",
        "sr",
        "sr_original",
        "sr_swapped",
        "share_wrong",
        "share_outside",
        "regime",
    },
    "backbone": {"score", "ci", "peak", "at_most", "verdict", "layer", "p_fwe"},
    "action": {"score", "ci", "peak", "at_most", "verdict", "layer", "iteration"},
    "retention": {"value", "ci", "published", "defined", "note"},
    "controls": {"missing", "probe_minus_sr"},
}


def probe_kit(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "probe_kit", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, encoding="utf-8", cwd=cwd, check=False, timeout=300)


def in_process(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The same without the seconds in which a process starts; for what neither starts nor ends one."""
    with contextlib.chdir(cwd or Path.cwd()):
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return subprocess.CompletedProcess(arguments, result.exit_code, result.stdout, result.stderr)


def test_every_model_is_one_line_at_eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console.out, "_width", 80)
    listed = in_process("models").stdout.splitlines()
    assert max(map(len, listed)) <= 80
    rows = json.loads(in_process("models", "--json").stdout)
    assert len(listed) == len(rows) + 2, "a heading and a line below"
    assert all(line.startswith(row["model"]) for line, row in zip(listed[1:], rows, strict=False))


@pytest.mark.slow
def test_extract_train_retention_end_in_rows_with_the_contracts_keys(small_suite: Suite, tmp_path: Path) -> None:
    run = tmp_path / "run"
    extracted = in_process(
        "extract", "--model", "pi0-tiny", "--random-weights", "--suite", small_suite.folder,
        "--categories", "color", "--max-steps", 2, "--env-workers", 0, "--batch", 12, "--out", run,
    )  # fmt: skip
    assert extracted.returncode == 0, extracted.stderr
    assert "RANDOM" in extracted.stderr
    assert extracted.stdout.strip() == str(run)
    trained = in_process("train", run, "--permutations", 3)
    assert trained.returncode == 0, trained.stderr
    output_options = ("--html", tmp_path / "report.html", "--figures", tmp_path / "figures")
    printed = in_process("retention", run, "--format", "json", *output_options)
    assert printed.returncode == 0, printed.stderr
    rows = json.loads(printed.stdout)
    assert {row["category"] for row in rows} == {"color", "mean"}
    assert "data:image/svg+xml" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert {"run-layer-curves.png", "run-layer-curves.pdf"} <= {p.name for p in (tmp_path / "figures").iterdir()}
    assert all(row[part].keys() >= keys for row in rows for part, keys in KEYS.items())
    for style in ("table", "csv", "markdown", "latex"):
        assert "random" in in_process("retention", run, "--format", style).stdout.lower()
    again = in_process(
        "extract", "--model", "pi0-tiny", "--random-weights", "--suite", small_suite.folder,
        "--categories", "color", "--max-steps", 3, "--out", run,
    )  # fmt: skip
    assert again.returncode == 3
    assert "scene.max_steps: stored 2, asked 3" in again.stderr


def test_a_dry_run_prints_the_plan_and_writes_nothing(small_suite: Suite, tmp_path: Path) -> None:
    run = tmp_path / "run"
    result = in_process("extract", "--model", "expert", "--suite", small_suite.folder, "--out", run, "--dry-run")
    assert result.returncode == 0
    assert "48 (24 items in both layouts)" in result.stderr
    assert not run.exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["extract", "--model", "pi0-tyni"], 2, "Did you mean 'pi0-tiny'"),
        (["extract", "--model", "expert", "--categories", "colour"], 2, "Did you mean 'color'"),
        (["extract", "--model", "expert", "--suite", "nowhere"], 2, "nowhere"),
        (["extract", "--model", "expert", "--scene", "moon"], 2, "moon"),
        (["extract"], 2, "--model"),
        (["train", "nowhere"], 2, "is not a run"),
        (["retention", "nowhere"], 2, "is not a run"),
        (["retention", "nowhere", "--format", "xml"], 2, "xml"),
        (["models", "pi9"], 2, "unknown model 'pi9'"),
        (["extract", "--model", "pi0", "--checkpoint", "./nowhere"], 3, "does not exist"),
        (["suite", "build", "out", "--n", "7"], 2, "7"),
        (["train", "nowhere", "--permutations", "-3"], 2, "'--permutations': expected at least 0"),
        (["power", "--sites", "x"], 2, "Invalid value for '--sites': expected a whole number"),
        (["train", "nowhere", "--jobs", "0"], 2, "--jobs"),
        (["compare", "nowhere", "./nowhere/"], 2, "given twice"),
        (["compare", "a=one", "a=two", "--kind", "groups"], 2, "given twice"),
        (["retention", "nowhere", "--format", "csv", "--epsilons", "-1"], 2, "positive"),
        (["verify", "pi00", "nowhere"], 2, "Did you mean 'pi0'"),
        (["extract", "--model", "pi0-tiny", "--device", "nonsense"], 2, "cannot be used"),
        (["extract", "--model", "pi0-tiny", "--dtype", "int8"], 2, "'bfloat16'"),
        (["demo", "--out", "/dev/null/demo"], 2, "Give another path"),
    ],
)  # fmt: skip
def test_bad_input_is_a_clear_error_with_the_contracts_exit_code(
    arguments: list[str], code: int, message: str, small_suite: Suite, tmp_path: Path
) -> None:
    if arguments[0] == "extract" and "--suite" not in arguments and "--model" in arguments:
        arguments = [*arguments, "--suite", str(small_suite.folder)]
    answer = in_process(*arguments, cwd=tmp_path)
    assert answer.returncode == code, answer.stderr
    assert message in answer.stderr
    assert "Traceback" not in answer.stderr
    assert not list(tmp_path.iterdir())


def test_a_corrupt_picture_is_named_with_exit_code_1(small_suite: Suite, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(small_suite.folder, tmp_path / "suite"))
    next(copy.rglob("*.png")).write_bytes(b"not a picture")
    answer = in_process("extract", "--model", "expert", "--suite", copy, "--out", tmp_path / "run")
    assert answer.returncode == 1
    assert "changed" in answer.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_the_same_command_continues(small_suite: Suite, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [sys.executable, "-m", "probe_kit", "extract", "--model", "expert", "--out", str(run)]
    command += ["--suite", str(small_suite.folder), "--categories", "color", "--items", "4", "--max-steps", "30"]
    # A shell's background ignores it, and a child would inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = subprocess.Popen(command, stderr=subprocess.PIPE, encoding="utf-8")
    finally:
        signal.signal(signal.SIGINT, before)
    deadline = time.monotonic() + 60
    while not any(run.glob("commits/*.json")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 130, messages
    assert "run the same command to resume" in messages
    commit_times = {path.name: path.stat().st_mtime_ns for path in run.glob("commits/*.json")}
    assert 1 <= len(commit_times) < 8
    assert in_process(*command[3:]).returncode == 0
    now = {path.name: path.stat().st_mtime_ns for path in run.glob("commits/*.json")}
    assert len(now) == 8
    assert all(now[name] == stamp for name, stamp in commit_times.items())


def test_help_groups_all_commands_by_what_one_wants_to_do() -> None:
    import typer

    group = typer.main.get_command(app)
    names = [name for panel in PANELS.values() for name in panel]
    assert group.list_commands(None) == names  # type: ignore[attr-defined,arg-type]
    help_text = in_process("--help").stdout
    headings = [*(f"─ {panel} ─" for panel in PANELS), *(f"│ {name} " for name in names)]
    places = {heading: help_text.index(heading) for heading in headings}
    for panel, commands in PANELS.items():
        later_positions = [
            places[f"─ {other} ─"] for other in PANELS if places[f"─ {other} ─"] > places[f"─ {panel} ─"]
        ]
        end = min(later_positions, default=len(help_text))
        assert all(places[f"─ {panel} ─"] < places[f"│ {name} "] < end for name in commands)


def test_there_are_at_most_thirty_four_commands_with_those_of_groups() -> None:
    import typer

    paths = [path for path, _ in commands_of(typer.main.get_command(app), None)]
    assert len(paths) == len(set(paths)) <= 34, "merge a command into an option of its elder"


def test_a_warning_is_printed_once_also_where_a_library_catches_warnings_in_between(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Leaving `catch_warnings` makes Python forget which it has shown."""
    monkeypatch.setattr(warnings, "showwarning", _show_warning)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        monkeypatch.setattr(warnings, "showwarning", _show_warning)
        for text in ("the first one", "the first one", "the second one"):
            with warnings.catch_warnings():
                pass
            warnings.warn(text, stacklevel=1)
    message = capsys.readouterr().err
    assert (message.count("the first one"), message.count("the second one")) == (1, 1)


def test_the_version_is_that_of_the_package() -> None:
    import probe_kit as package

    assert in_process("--version").stdout == f"probe-kit {package.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "home"),
    [
        (["train", "x", "--html", "y"], "probe-kit diagnose`, `probe-kit retention`, `probe-kit compare"),
        (["--model", "pi0"], "probe-kit extract"),
        (["suite", "build", "x", "--epsilons", "1"], "probe-kit retention`, `probe-kit compare"),
        (["retention", "x", "--deep"], "probe-kit run verify"),
    ],
)
def test_an_option_of_another_command_says_which_one_has_it(arguments: list[str], home: str) -> None:
    answer = in_process(*arguments)
    assert answer.returncode == 2
    assert f"but of `{home}`" in " ".join(answer.stderr.replace("│", " ").split())


def test_a_folder_of_runs_lists_the_runs_inside_and_a_near_name_is_suggested(
    small_suite: Suite, tmp_path: Path
) -> None:
    extracted = in_process(
        "extract", "--model", "expert", "--suite", small_suite.folder, "--categories", "color", "--items", 2,
        "--max-steps", 1, "--env-workers", 0, "--out", tmp_path / "runs" / "mine",
    )  # fmt: skip
    assert extracted.returncode == 0, extracted.stderr
    shutil.copytree(tmp_path / "runs" / "mine", tmp_path / "runs" / "yours")
    for command in ("train", "retention", "run export --format h5", "run verify", "models --run"):
        answer = in_process(*command.split(), "runs", cwd=tmp_path)
        assert answer.returncode == 2, answer.stderr
        assert "It holds 2 runs: runs/mine, runs/yours" in answer.stderr, command
    assert "Did you mean runs/mine?" in in_process("train", "runs/mien", cwd=tmp_path).stderr
    assert "Make one with" in in_process("train", "elsewhere", cwd=tmp_path).stderr


def test_models_lists_families_and_scripted_policies_as_json() -> None:
    rows = json.loads(in_process("models", "--json").stdout)
    assert {row["model"] for row in rows} >= {"pi0-tiny", "pi0", "expert", "expert-mirrored"}


def test_suite_build_list_and_show_go_together(tmp_path: Path) -> None:
    built = in_process("suite", "build", tmp_path / "suite", "--categories", "color", "--n", 4)
    assert built.returncode == 0, built.stderr
    listed = in_process("suite", "show", tmp_path / "suite", "--counts", "--json")
    assert json.loads(listed.stdout)["items"] == {"color": 4}
    result = in_process("suite", "show", tmp_path / "suite", "--n", 2, "--json")
    items = json.loads(result.stdout)["items"]
    suite = load_suite(tmp_path / "suite")
    assert [item["item"] for item in items] == [item.item_id for item in suite.items[:2]]
    for shown_item, item in zip(items, suite.items, strict=False):
        assert shown_item["instruction"] == item.instruction
        assert Path(shown_item["correct"]) == item.picture(item.correct_side)
        assert Path(shown_item["wrong"]) != Path(shown_item["correct"])
        assert Path(shown_item["wrong"]).is_file()
    as_text = in_process("suite", "show", tmp_path / "suite", cwd=tmp_path).stdout
    assert as_text.count("Put the") == 4
    lines = [line.split(maxsplit=1) for line in as_text.splitlines() if line.startswith("  ")]
    pictures = [tmp_path / text for name, text in lines if name in ("correct", "wrong")]
    assert len(pictures) == 8
    assert all(path.is_file() for path in pictures), "a path can be copied from the terminal"


@pytest.mark.slow
def test_the_demo_makes_everything_it_promises(tmp_path: Path) -> None:
    answer = probe_kit("demo", "--out", tmp_path / "demo")
    assert answer.returncode == 0, answer.stderr
    rows = [re.split(r"\s{2,}", line.strip()) for line in answer.stdout.splitlines()]
    verdicts = {cells[0]: cells[-1] for cells in rows if len(cells) == 7}
    assert {name: verdicts[name] for name in ("Color", "State")} == {"Color": "used", "State": "not used"}
    (counting,) = (cells for cells in rows if cells[0] == "Counting" and len(cells) == 7)
    assert not any("✓" in cell for cell in counting), "Counting is not shown"
    assert re.fullmatch(r"Open +probe-kit view \S+run \S+run-vlm", answer.stdout.splitlines()[-1].strip())
    for name in ("run/run.json", "layer_curves.png", "table.md", "episode.gif", "report.html"):
        assert (tmp_path / "demo" / name).is_file()


def test_the_environment_of_a_test_is_not_the_users() -> None:
    assert "pytest" in os.environ["PROBE_KIT_CACHE"]
