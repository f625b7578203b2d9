"""What needs no weights is refused before torch is imported: all such mistakes, in one light process."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit._terminal.console import out
from probe_kit.cli import app
from probe_kit.demo.commands import print_demo
from probe_kit.demo.pipeline import Demo
from probe_kit.intervene import load_effects
from probe_kit.intervene.commands import print_result
from probe_kit.retention import retention_table
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite
from tests.support.distributions import install

ONE_AFTER_THE_OTHER = """
import contextlib, io, json, sys
from probe_kit.cli import app
answers = []
for arguments in json.load(sys.stdin):
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            app(arguments)
        except SystemExit as error:
            code = error.code
    heavy = [name for name in ("torch", "lerobot", "transformers", "pybullet") if name in sys.modules]
    answers.append([code, said.getvalue(), heavy])
json.dump(answers, sys.stdout)
"""
EXTRACT = "extract --model"
CASES = {
    f"{EXTRACT} pi0-tyni": (2, "Did you mean 'pi0-tiny'"),
    f"{EXTRACT} pi0 --checkpoint ./nowhere": (3, "does not exist"),
    f"{EXTRACT} pi0 --checkpoint empty": (3, "config.json is missing"),
    f"{EXTRACT} pi0 --checkpoint of-another-model": (3, "holds a 'act' model; expected pi0"),
    f"{EXTRACT} smolvla --checkpoint damaged": (3, "is not JSON"),
    f"{EXTRACT} pi0 --checkpoint without-weights": (3, "neither model.safetensors"),
    f"{EXTRACT} pi0 --checkpoint with-a-shard-missing": (3, "b.safetensors of model.safetensors.index.json"),
    f"{EXTRACT} prismatic": (2, "answers and does not act"),
    f"{EXTRACT} pi0-tiny --device nonsense": (2, "This machine has cpu"),
    f"{EXTRACT} pi0-tiny --dtype int8": (2, "is not one of"),
    f"{EXTRACT} pi0-tiny -M foo=3": (2, "no model option foo"),
    f"{EXTRACT} pi0-tiny --weights-seed 3": (2, "random weights"),
    f"{EXTRACT} pi0-tiny --scene moon": (2, "moon"),
    f"{EXTRACT} pi0-tiny --suite nowhere": (2, "is not a suite"),
    f"{EXTRACT} pi0-tiny --suite SUITE --categories colour": (2, "Did you mean 'color'"),
    f"{EXTRACT} pi0-tiny --suite SUITE --out file/run": (2, "is not a folder"),
    f"{EXTRACT} pi0-tiny --suite SUITE --seed 7 --max-steps 3 --out a-run": (
        3,
        "scene.max_steps: stored 2, asked 3",
    ),
    "verify pi0 nowhere": (2, "is not a golden reference"),
    "verify pi0 reference": (3, "holds a 'smolvla' model"),
    "verify pi0-tiny --keys nowhere": (2, "cannot be verified"),
    "verify pi0 --keys nowhere": (2, "does not exist"),
    "train nowhere": (2, "is not a run"),
    "train a-run --device nonsense": (2, "This machine has cpu"),
    "retention nowhere": (2, "is not a run"),
    "run verify nowhere": (2, "is not a run"),
    "run export nowhere --format h5": (2, "is not a run"),
    "models --run nowhere": (2, "is not a run"),
}


@pytest.fixture(scope="module")
def folder(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints with something missing, a reference of another model, and a run that is there."""
    folder = tmp_path_factory.mktemp("early")

    def make_folder(name: str, **files: str) -> Path:
        (folder / name).mkdir(parents=True)
        for file, content in files.items():
            (folder / name / file.replace("__", ".")).write_text(content, encoding="utf-8")
        return folder / name

    make_folder("empty")
    make_folder("of-another-model", config__json='{"type": "act"}')
    make_folder("damaged", config__json="{")
    make_folder("without-weights", config__json='{"type": "pi0"}')
    shards = {"weight_map": {"one": "a.safetensors", "two": "b.safetensors"}}
    checkpoint = make_folder("with-a-shard-missing", config__json='{"type": "pi0"}', a__safetensors="")
    (checkpoint / "model.safetensors.index.json").write_text(json.dumps(shards), encoding="utf-8")
    np.savez(make_folder("reference") / "reference.npz", out_actions=np.zeros(2, np.float32))
    make_folder("reference/checkpoint", config__json='{"type": "smolvla"}')
    (folder / "file").touch()
    from probe_kit.env import SceneSpec
    from probe_kit.extract import ExtractSettings, extract_run

    settings = ExtractSettings(
        "expert", suite=small_suite.folder, categories=("color",), items=2, seed=7, scene=SceneSpec(max_steps=2),
        env_workers=0,
    )  # fmt: skip
    extract_run(settings, folder / "a-run")
    return folder


@pytest.fixture(scope="module")
def answers(folder: Path, small_suite: Suite) -> dict[str, tuple[int, str, list[str]]]:
    commands = (*CASES, "models")
    arguments = [[word.replace("SUITE", str(small_suite.folder)) for word in line.split()] for line in commands]
    completed = subprocess.run(
        [sys.executable, "-c", ONE_AFTER_THE_OTHER], input=json.dumps(arguments), cwd=folder, encoding="utf-8",
        capture_output=True, check=True, timeout=300,
    )  # fmt: skip
    return dict(zip(commands, (tuple(answer) for answer in json.loads(completed.stdout)), strict=True))


@pytest.mark.parametrize("case", CASES)
def test_a_mistake_that_needs_no_weights_is_named_before_anything_heavy_is_loaded(
    case: str, answers: dict[str, tuple[int, str, list[str]]]
) -> None:
    code, message = CASES[case]
    printed_message = answers[case][1].replace("\n", " ")
    assert (answers[case][0], answers[case][2]) == (code, []), printed_message
    assert message in printed_message


def test_the_list_of_models_loads_nothing_heavy(answers: dict[str, tuple[int, str, list[str]]]) -> None:
    code, printed, loaded = answers["models"]
    assert (code, loaded) == (0, []), printed


def test_families_say_what_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    from probe_kit.hooks import family
    from probe_kit.hooks.registry import known_families

    monkeypatch.setattr(family, "find_spec", lambda name: None if name == "timm" else name)
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *_: None)
    families = known_families()
    assert families["pi0-tiny"].missing() == ""
    assert families["pi0"].missing() == "download of juexzz/INTACT-pi0-finetune-bridge, google/paligemma-3b-pt-224"
    assert families["openvla"].missing() == "extra openvla and download of openvla/openvla-7b"
    assert families["prismatic"].missing().startswith("extra openvla and download of TRI-ML/prismatic-vlms/prism-")


def test_a_cached_config_without_weights_is_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    from probe_kit.hooks.registry import known_families as families

    (tmp_path / "config.json").touch()
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *_: str(tmp_path / "config.json"))
    assert families()["pi0"].missing() == "download of juexzz/INTACT-pi0-finetune-bridge"
    (tmp_path / "model.safetensors").touch()
    assert families()["pi0"].missing() == ""


def test_a_family_without_its_extra_is_refused_with_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.errors import MissingExtraError
    from probe_kit.hooks import family
    from probe_kit.hooks.registry import known_families as families

    monkeypatch.setattr(family, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"needs timm.*install.*openvla"):
        families()["openvla"].check("somewhere")


WIDTHS = (80, 100, 120, 200)
LAST = 40
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def run(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shutil.copytree(little_runs / "run", tmp_path_factory.mktemp("printed") / "run")


def command(*arguments: str) -> str:
    answer = CliRunner().invoke(app, list(arguments))
    assert answer.exit_code == 0, answer.output
    return answer.stdout


def demo(run: Path) -> None:
    opened = open_run(run)
    print_demo(Demo(run.parent, opened, opened, retention_table([opened])))


PRINTED: dict[str, Callable[[Path], str | None]] = {
    "demo": demo,
    "train": lambda run: command("train", str(run), "--permutations", "2", "--views", "mean,last"),
    "train every call": lambda run: command("train", str(run), "--permutations", "2", "--call", "all"),
    "retention": lambda run: command("retention", str(run)),
    "intervene": lambda run: print_result(load_effects(open_run(run))),
}


def printed(name: str, run: Path, width: int, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(out, "_width", width)
    capsys.readouterr()
    return PRINTED[name](run) or capsys.readouterr().out


def tables_in(text: str) -> int:
    """Tables by the rules under their headings."""
    return len(re.findall(r"^─{20,} *$", text, re.MULTILINE))


@pytest.mark.parametrize(
    "width", [WIDTHS[0], *(pytest.param(width, marks=pytest.mark.slow) for width in WIDTHS[1:])]
)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "demo")) for name in PRINTED]
)
def test_a_command_prints_one_table_and_ends_on_a_sentence(
    name: str, width: int, run: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, opens, viewer = printed(name, run, width, capsys, monkeypatch).partition("\nOpen ")
    assert bool(opens) == (name == "demo"), "the demo alone adds the command that opens the viewer"
    assert viewer.strip().startswith("probe-kit view ") or not opens
    assert tables_in(text) == 1, text
    assert max(map(len, text.split("category")[1].splitlines())) <= width
    *_, last = re.split(r"\nColor (?:\(| )", text)
    assert re.search(r"\.$|\nnext: probe-kit \w+", last.strip()), (
        "a sentence about the only category is last, then a command"
    )
    assert len(last.splitlines()) < LAST


@pytest.mark.slow
@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("name", ["train", "intervene"])
def test_columns_that_do_not_fit_are_named_and_details_prints_them(
    name: str, width: int, run: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = " ".join(printed(name, run, width, capsys, monkeypatch).split())
    (left_out,) = re.findall(r"[Ww]ith --details or more room: ([^.]*?)\.? Color ", short) or [""]
    details: dict[str, Callable[[], str | None]] = {
        "train": lambda: command("train", str(run), "--permutations", "2", "--views", "mean,last", "--details"),
        "intervene": lambda: print_result(load_effects(open_run(run)), details=True),
    }
    output = details[name]() or capsys.readouterr().out
    assert left_out or width > 80, short
    for heading in filter(None, left_out.split(", ")):
        assert heading in " ".join(output.split())


@pytest.mark.slow
def test_the_demo_fits_summary_and_sentences_on_its_last_lines(
    run: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for width in WIDTHS:
        lines = printed("demo", run, width, capsys, monkeypatch).splitlines()[-LAST:]
        assert any(line.startswith("Summary: ") for line in lines)
        assert any(re.match(r"Color  \w.*: ", line) for line in lines)


HEAVY = """
import torch
from probe_kit.hooks import Family

FAMILY = Family("heavy-vla", "imports torch", None, "heavy_vla:load", needs_checkpoint=True)
"""
BROKEN = "raise SystemExit('not today')\n"
EACH = """
import sys
from typer.testing import CliRunner
from probe_kit.cli import app

for line in sys.stdin.read().splitlines():
    done = CliRunner().invoke(app, line.split("\\t"))
    print(done.exit_code, [name for name in ("torch", "heavy_vla", "broken_vla") if name in sys.modules])
print(CliRunner().invoke(app, ["models"]).stdout)
"""


@pytest.mark.slow
def test_no_command_that_needs_no_model_imports_torch_or_a_third_party(
    recorded_run: Run, small_suite: Suite, tmp_path: Path
) -> None:
    """One process runs all commands, as each would be run."""
    for name, text in (("heavy", HEAVY), ("broken", BROKEN)):
        folder = install(tmp_path / name, f"{name}-vla", f"{name}_vla:FAMILY")
        (folder / f"{name}_vla.py").write_text(text, encoding="utf-8")
    suite, run = str(small_suite.folder), str(recorded_run.path)
    commands = [
        ("--help",), ("models",), ("models", "--json"), ("models", "pi0-tiny"), ("extract", "--help"),
        ("suite", "show", "--counts", suite), ("suite", "show", suite),
        ("run", "show", run), ("run", "verify", run),
        ("extract", "--model", "no-such-model", "--dry-run"), ("new-adapter", "heavy-vla"),
    ]  # fmt: skip
    paths = [str(tmp_path / "heavy"), str(tmp_path / "broken"), os.environ.get("PYTHONPATH", "")]
    completed = subprocess.run(
        [sys.executable, "-c", EACH], input="\n".join("\t".join(words) for words in commands), cwd=tmp_path,
        capture_output=True, encoding="utf-8", check=True, timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
    )  # fmt: skip
    answers = completed.stdout.splitlines()
    expected = [0] * (len(commands) - 2) + [2, 2]
    assert answers[: len(commands)] == [f"{code} []" for code in expected], completed.stdout + completed.stderr
    listed = [line.split()[0] for line in answers[len(commands) :] if line]
    assert {"heavy-vla", "broken-vla", "pi0-tiny"} <= set(listed)
    assert "BrokenFamilyWarning" not in completed.stderr
