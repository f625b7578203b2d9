"""Every command of the README and of `docs/` exists as it is typed; the slow ones below run them, page by page."""

import ast
import contextlib
import importlib
import inspect
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from probe_kit.cli import app, commands_of
from probe_kit.errors import UsageError
from tests.support.documented import (
    NOT_COMMANDS,
    PAGES,
    ROOT,
    SHELLS,
    Block,
    Command,
    blocks,
    commands,
    mentioned,
    name_of,
)

TYPED = [command for page in PAGES for command in commands(page)]
OURS = [command for command in TYPED if command.ours]
GROUP = typer.main.get_command(app)
LEAVES = dict(commands_of(GROUP, None))
ANYWHERE = {
    option
    for leaf in LEAVES.values()
    for parameter in leaf.params
    for option in (*parameter.opts, *parameter.secondary_opts)
}

OTHER_PROGRAMS = {
    "cd": "enters this very checkout",
    "pytest": "is what runs this",
    ".": "activates the environment that this runs in",
    "export": "names the keys of an object store",
    "python": "runs a file or a module of this checkout; that it is there is checked",
}
"""Programs that are not ours, and why their lines are not typed by this test."""

OF_OTHERS = {
    "--help": "every program's",
    "--rename": "lerobot's --rename_map",
    "--help-all": "every command's",
    "--extra": "uv's",
    "--gpus": "docker's",
    "--check": "sha256sum's",
    "--length": "b2sum's",
    "--root": "those of lerobot's converter",
    "--push-to-hub": "those of lerobot's converter",
}
"""Options in the text that are no command's of ours, and no benchmark's."""
OF_BENCHMARKS = {
    option
    for script in (ROOT / "benchmarks").glob("*.py")
    for option in re.findall(r'"(--[a-z-]+)"', script.read_text(encoding="utf-8"))
}


def leaf_of(words: list[str]) -> tuple[Any, list[str]]:
    """The command that `words` name, and the words behind its name. Fails for a command that does not exist."""
    for size in (2, 1):
        if (path := " ".join(words[:size])) in LEAVES:
            return LEAVES[path], words[size:]
    raise AssertionError(f"there is no command `probe-kit {' '.join(words[:2])}`")


def options_of(leaf: Any) -> set[str]:
    return {option for parameter in leaf.params for option in (*parameter.opts, *parameter.secondary_opts)} | {
        "--help",
        "-h",
    }


def test_every_block_is_commands_or_python_or_listed_as_something_else() -> None:
    all_blocks = [block for page in PAGES for block in blocks(page)]
    assert len(all_blocks) > 40
    strange = [f"{b.page}:{b.line}" for b in all_blocks if b.language not in ("", "python", "toml", *SHELLS)]
    assert strange == []
    assert {block.listed for block in all_blocks if block.listed} == NOT_COMMANDS.keys()


def test_every_line_is_one_of_ours_or_of_a_program_that_is_named_with_the_reason() -> None:
    assert len(OURS) > 50
    programs = {command.words[0] for command in TYPED if not command.ours}
    assert programs == OTHER_PROGRAMS.keys()


@pytest.mark.parametrize("command", [c for c in TYPED if re.search(r"[*?\[]", c.text)], ids=str)
def test_no_shell_expands_a_line(command: Command) -> None:
    """Outside of quotes zsh refuses a pattern that no file matches; every shell replaces one that some match."""
    assert not re.search(r"[*?\[]", re.sub(r"'[^']*'", "", command.text))


def test_what_other_programs_are_given_is_there() -> None:
    """Files and modules of this checkout, and extras of this package."""
    extras = re.search(
        r"(?ms)^\[project\.optional-dependencies\]$(.*?)^\[", (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    )
    assert extras is not None
    known_extras = set(re.findall(r"(?m)^([\w-]+) = \[", extras[1]))
    for command in TYPED:
        program, *arguments = command.words
        assert set(re.findall(r"--extra ([\w-]+)", command.text)) <= known_extras, command
        if program == "python":
            script = ROOT / (arguments[1].replace(".", "/") + ".py" if arguments[0] == "-m" else arguments[0])
            assert script.is_file(), command
            options = [word for word in arguments[1:] if word.startswith("--")]
            assert [
                option for option in options if f'"{option}"' not in script.read_text(encoding="utf-8")
            ] == [], command


@pytest.mark.parametrize("command", OURS, ids=str)
def test_a_command_is_accepted_as_it_is_typed(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Name, arguments, options and their values: it ends only where it looks for a run, a suite or a model."""
    leaf, arguments = leaf_of(command.words[1:])
    leaf.make_context(leaf.name, list(arguments))
    if leaf.name in ("demo", "doctor", "models", "words"):
        return
    monkeypatch.setattr("probe_kit.runs.store._QUICK", timedelta(0))  # without keys a store never answers
    monkeypatch.setattr("probe_kit.extract.prepare", _stop_with, raising=False)
    monkeypatch.setattr("probe_kit.serve.server.open_server", _stop_with)
    monkeypatch.setattr(
        "probe_kit.extract.extraction.prepare_asks", lambda settings, _, **__: _stop_with(*settings)
    )
    with contextlib.chdir(tmp_path):
        answer = CliRunner().invoke(app, command.words[1:])
    message = " ".join(answer.stderr.split())
    if "--dry-run" in command.words and leaf.name == "run":  # of a study: it needs nothing that is not there
        assert answer.exit_code == 0, message
        assert list(tmp_path.iterdir()) == []
        return
    assert answer.exit_code in (2, 3), message
    assert re.search(LOOKED_FOR[leaf.name], message), message
    assert list(tmp_path.iterdir()) == []


LOOKED_FOR = {
    "extract": "accepted so far|kitchen is no LeRobotDataset",
    "show": "kitchen is no LeRobotDataset|Make one with",
    "check-environment": "there is no module kitchen",
    "ask": "accepted so far",
    "serve": "accepted so far|DIR|there is no such file",
    "view": "Make one with",
    "labels": "Make one with",
    "targets": "Make one with",
    "diagnose": "accepted so far|Make one with|kitchen is no LeRobotDataset|holds no|Not a model|words.txt",
    "train": "Make one with|AWS_ACCESS_KEY_ID",
    "intervene": "Make one with",
    "retention": "Make one with",
    "compare": "Make one with|is not a run",
    "export": "Make one with",
    "from-csv": "questions.csv",
    "convert": "no such|not a folder|does not exist|holds no|missing",
}
"""What a command complains of in an empty folder, when nothing is wrong with the command itself."""


def _stop_with(*arguments: Any, **_: Any) -> Any:
    """In place of loading a model: what can be wrong with the settings before."""
    from probe_kit.extract.extraction import check_meaningless
    from probe_kit.extract.parts import SCRIPTED
    from probe_kit.extract.settings import AskSettings, ExtractSettings
    from probe_kit.hooks.contract.declared import check_options
    from probe_kit.hooks.registry import find_family

    for settings in (candidate for candidate in arguments if isinstance(candidate, ExtractSettings | AskSettings)):
        check_meaningless(settings)
        followed = settings.followed() if isinstance(settings, ExtractSettings) else settings
        if followed.model.family not in SCRIPTED:
            family = find_family(followed.model.family, tuple(SCRIPTED))
            check_options(family.name, family.options, followed.model.options)
            assert family.abilities.acts != isinstance(settings, AskSettings)
    raise UsageError("accepted so far")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_and_options_that_the_text_mentions_exist(page: Path) -> None:
    for mention in mentioned(page):
        if re.match(r"(\./with-uv )?probe-kit [a-z]", mention.text):
            words = [word.partition("|")[0] for word in mention.words[1:]]
            if words[0] in ("suite", "run") and len(words) == 1:
                continue
            leaf, arguments = leaf_of(words)
            assert {word for word in arguments if word.startswith("-")} <= options_of(leaf), mention
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", mention.text):
            assert option in ANYWHERE | OF_BENCHMARKS | OF_OTHERS.keys(), mention


EXAMPLES = [block for page in PAGES for block in blocks(page) if block.language == "python"]


@pytest.mark.parametrize("block", EXAMPLES, ids=lambda block: f"{block.page}:{block.line}")
def test_an_example_in_python_imports_what_exists_and_names_options_that_exist(block: Block) -> None:
    """Of what is imported from probe_kit: the name, and every keyword that it is called with."""
    tree = ast.parse("\n".join(block.lines))
    namespace: dict[str, Any] = {"pk": importlib.import_module("probe_kit")}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("probe_kit"):
            module = importlib.import_module(str(node.module))
            namespace |= {name.asname or name.name: getattr(module, name.name) for name in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pk":
            assert hasattr(namespace["pk"], node.attr), node.attr
        if isinstance(node, ast.Call) and (called := _called(node.func, namespace)) is not None:
            parameters = inspect.signature(called).parameters.values()
            if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters):
                assert {keyword.arg for keyword in node.keywords} <= {
                    parameter.name for parameter in parameters
                }, ast.unparse(node)


def _called(function: ast.expr, namespace: dict[str, Any]) -> Any:
    """What is called, None if it is nothing of probe_kit's that the example imports."""
    if isinstance(function, ast.Name):
        return namespace.get(function.id)
    if (
        isinstance(function, ast.Attribute)
        and isinstance(function.value, ast.Name)
        and function.value.id in namespace
    ):
        return getattr(namespace[function.value.id], function.attr)
    return None


# -- typed for real ------------------------------------------------------------------------------------------

RUNS = {
    "docs/causal.md": ("RUN",),
    "docs/families.md": ("runs/pi0",),
    "docs/qwen-vla.md": ("RUN_XIAOMI", "RUN_INTERNVLA", "RUN_PI0"),
    "docs/report.md": ("runs/a", "runs/b"),
    "docs/storage.md": ("runs/pi0",),
    "docs/success-rate.md": ("RUN",),
    "docs/token-policies.md": ("RUN_OPENVLA", "RUN_PI0"),
    "docs/view.md": ("runs/mine",),
}
"""Runs that a page takes for granted, made of the embedded policy; all of a page are different runs."""

STAND_INS = {
    "README.md": {
        r"--items 24": "--items 12 --max-steps 12",
        r"train runs/mine": "train runs/mine --permutations 20",
    },
    "docs/asking.md": {
        r"--model qwen3-vl": "--model vlm-tiny --categories color --items 12",
        r"--model xiaomi-r0": "--model pi0-tiny --categories color --items 12 --max-steps 12",
        r"train runs/xiaomi": "train runs/xiaomi --permutations 20",
    },
    "docs/causal.md": {r"^(probe-kit intervene RUN)(?! --kind (interchange|erase))": r"\1 --items 2"},
    "docs/families.md": {
        r"--model pi0 --checkpoint lerobot/pi0_base": "--model pi0-tiny --categories color --items 12",
        r"train runs/pi0-base": "train runs/pi0-base --permutations 20",
    },
    "docs/storage.md": {
        r"backbone\.07": "backbone.02",
        r"tokens:image": "mean:image",
    },
    "docs/suite.md": {r"(--model pi0-tiny)": r"\1 --max-steps 4"},
}
"""By page, patterns of what is shortened or replaced by the embedded models; all else is typed as it stands."""

NOT_TYPED = {
    r"--vary|mine\.csv": "a run on recordings",
    r"runs/served": "a run of a client; tests/serve has one",
    r"^cd probe_kit": "this is that checkout",
    r"^\. \.venv": "this runs in that environment",
    r"^\./with-uv --extra": "the extras are installed here",
    r"with-uv probe-kit demo": "minutes; tests/test_cli.py types it",
    r"with-uv pytest": "is what runs this",
    r"^probe-kit view \S+$": "serves until Ctrl-C; tests/view/test_server.py has the server",
    r"^python -m probe_kit.hooks.families.internvla.checkpoint RUN OUT": "RUN is a training of InternVLA's",
    r"^export AWS_|s3://": "needs keys of an object store; tests/runs/test_locations.py has a server of its own",
    r"--model (pi0|magma|openvla|spatialvla|xiaomi-r0|internvla-m1)( |$)": "needs released weights (8 to 18 GB)",
    r"^probe-kit diagnose (pi0|runs/mine) ": "needs released weights, or minutes; tests/diagnose has both",
    r"suite convert vl-think --root BlindVLA|train runs/pi0 --untrained|compare runs/pi0 runs/pi0-random":
        "of files that this repository may not pass on, and of runs on them (docs/paper.md)",
    r"kitchen|runs/own": "needs a LeRobotDataset or an environment; tests/extract/recordings and "
        "tests/extract/own_environments have some",
    r"lerobot:libero": "needs a simulator",
    r"--pictures photos": "of a reader's own pictures; tests/extract/test_pictures.py has some",
    r"suite convert act2answer --root": "of files that this repository may not pass on",
}  # fmt: skip
"""Patterns of lines that are not typed, after the stand-ins, and why."""


def why_not(text: str) -> str | None:
    """Why a line is not typed; None if it is."""
    return next((reason for pattern, reason in NOT_TYPED.items() if re.search(pattern, text)), None)


def with_stand_ins(command: Command) -> str:
    text = command.text
    for pattern, short in STAND_INS.get(command.page, {}).items():
        text = re.sub(pattern, short, text)
    return text


TO_TYPE = {
    name_of(page): typed
    for page in PAGES
    if (typed := [command for command in commands(page) if why_not(with_stand_ins(command)) is None])
}


def test_every_shortened_replaced_or_skipped_line_is_still_on_the_pages() -> None:
    for page, patterns in STAND_INS.items():
        texts = [command.text for command in TYPED if command.page == page]
        assert [p for p in patterns if not any(re.search(p, text) for text in texts)] == []
    shortened = [with_stand_ins(command) for command in TYPED]
    assert [p for p in NOT_TYPED if not any(re.search(p, text) for text in shortened)] == []
    assert RUNS.keys() <= TO_TYPE.keys()
    assert sum(map(len, TO_TYPE.values())) > 30


class Terminal:
    """A folder and an environment with an empty cache, in which lines are typed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self.environment = os.environ | {
            "PATH": programs, "PROBE_KIT_CACHE": str(folder / "cache"), "HF_HUB_OFFLINE": "1", "HOME": str(folder),
        }  # fmt: skip

    def type(self, text: str) -> str:
        """Everything that the line prints. Fails if it does not end well."""
        ended = subprocess.run(
            ["bash", "-c", text],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            encoding="utf-8",
            check=False,
            timeout=1800,
        )
        assert ended.returncode == 0, f"{text}\n{ended.stdout}{ended.stderr}"
        assert "NOT run" not in ended.stderr or "suites/mine" in text, f"{text}\n{ended.stderr}"
        return ended.stdout + ended.stderr


@pytest.fixture(scope="module")
def make_folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Path]:
    """By number, runs with their probes, each of other settings, because a table refuses a copy of a run.

    Each is made once, when it is first asked for; the cache in which their suite was drawn is not the pages'.
    """
    terminal = Terminal(tmp_path_factory.mktemp("made"))

    @cache
    def make(number: int) -> Path:
        length = f"--categories color --items 12 --max-steps {12 - number}"
        terminal.type(f"probe-kit extract --model pi0-tiny {length} --out RUN-{number}")
        terminal.type(f"probe-kit train RUN-{number} --permutations 20")
        return terminal.folder / f"RUN-{number}"

    return make


@pytest.mark.slow
@pytest.mark.parametrize("page", TO_TYPE)
def test_the_commands_of_a_page_run_in_their_order_with_an_empty_cache(
    page: str, make_folder: Callable[[int], Path], tmp_path: Path
) -> None:
    terminal = Terminal(tmp_path)
    for number, name in enumerate(RUNS.get(page, ())):
        shutil.copytree(make_folder(number), tmp_path / name)
    if page == "docs/suite.md":
        _write_questions(tmp_path)
    for command in TO_TYPE[page]:
        if page == "docs/labels.md" and "own.csv" in command.text and not (tmp_path / "own.csv").exists():
            _write_labels(tmp_path)
        terminal.type(with_stand_ins(command))


def _write_labels(folder: Path) -> None:
    """Run the page's example that makes a table of labels."""
    (block,) = [b for b in blocks(ROOT / "docs/labels.md") if "to_csv" in "\n".join(b.lines)]
    subprocess.run([sys.executable, "-c", "\n".join(block.lines)], cwd=folder, check=True)


KNOWN = "Put the cube on the blue shape"


def _write_questions(folder: Path) -> None:
    """The page's table in words that the embedded policy knows, and a plain picture for each that it names."""
    from PIL import Image

    (block,) = [b for b in blocks(ROOT / "docs/suite.md") if b.listed]
    table = "\n".join(block.lines) + "\n"
    table = table.replace("ripe banana", "red shape").replace('"Put the cube on the apple, not the pear"', KNOWN)
    (folder / "questions.csv").write_text(table, encoding="utf-8")
    names = re.findall(r"[\w-]+\.(?:jpg|png)", "\n".join(block.lines))
    for number, name in enumerate(names):
        Image.new("RGB", (64, 64), (40 * number, 200 - 40 * number, 90)).save(folder / name)
