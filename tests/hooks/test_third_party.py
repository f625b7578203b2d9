"""No Python code of a checkpoint runs, whatever its configuration names and whatever is typed at a question."""

import ast
import io
import json
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import transformers

import probe_kit
from probe_kit.errors import (
    CheckpointError,
    InstructionError,
    MissingExtraError,
    PolicyFailedError,
    ProbeKitError,
    UsageError,
    WeightsError,
)
from probe_kit.hooks.checkpoints.third_party import while_acting, while_loading, with_origin
from probe_kit.hooks.registry import find_family
from probe_kit.hooks.testing import example_observations
from probe_kit.models.checkpoint_files import load_pretrained
from tests.support.every_checkpoint import WRITERS, families
from tests.support.parsed import package_nodes

PACKAGE = Path(probe_kit.__file__).parent
WITHOUT_AUTO_MAP = {"PreTrainedConfig", "PeftConfig"}
"""Classes of lerobot and peft that know no `auto_map`."""
AUTO_CLASSES = (
    "AutoConfig", "AutoTokenizer", "AutoProcessor", "AutoImageProcessor", "AutoVideoProcessor", "AutoModel",
    "AutoFeatureExtractor", "AutoModelForCausalLM", "AutoModelForImageTextToText",
)  # fmt: skip
TOKENIZER = ("tokenizer_config.json",)
PROCESSORS = ("preprocessor_config.json", "processor_config.json", "video_preprocessor_config.json")
FILES = {"tokenizer": TOKENIZER, "processor": PROCESSORS, "configuration": ("config.json",)}
CLASS_KEYS = ("tokenizer_class", "processor_class", "image_processor_type", "video_processor_type")
QUESTIONS = {"pi0": "the cube on the red", "smolvla": "the cube on the red"}


def plant(folder: Path, marker: Path, names: Sequence[str], unknown_classes: bool) -> int:
    """Let files of these names below `folder` name Python code that writes `marker`; the number of those files.

    Beside every tokenizer.json a tokenizer_config.json is made where there is none. unknown_classes: also give
    classes that transformers does not have, for which it asks whether to run the code.
    """
    code = f"open({str(marker)!r}, 'w').close()\nclass Thing: pass\n"
    tokenizer_files = {path.parent / TOKENIZER[0] for path in folder.rglob("tokenizer.json")}
    files = {path for path in (*folder.rglob("*.json"), *tokenizer_files) if path.name in names}
    for path in files:
        content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        entry = dict.fromkeys(AUTO_CLASSES, "evil.Thing") | {"AutoTokenizer": ["evil.Thing", "evil.Thing"]}
        content["auto_map"] = entry
        if unknown_classes:
            content |= {key: "Thing" for key in CLASS_KEYS if key in content or key == "tokenizer_class"}
        path.write_text(json.dumps(content), encoding="utf-8")
        (path.parent / "evil.py").write_text(code, encoding="utf-8")
    return len(files)


@pytest.fixture
def consent(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """A terminal on which every question is answered with yes; the number of answers that were read."""
    answers = io.StringIO("y\n" * 100)
    monkeypatch.setattr(sys, "stdin", answers)
    return lambda: answers.tell() // 2


@pytest.mark.parametrize("unknown_classes", [False, True], ids=["classes of transformers", "unknown classes"])
@pytest.mark.parametrize(
    "names",
    [
        pytest.param([name for names in FILES.values() for name in names], id="every file"),
        *(pytest.param(names, id=file, marks=pytest.mark.slow) for file, names in FILES.items()),
    ],
)
@pytest.mark.parametrize("family", families())
@pytest.mark.filterwarnings("ignore")
def test_a_checkpoint_that_names_python_code_acts_without_it_or_is_refused(
    family: str, names: Sequence[str], unknown_classes: bool, tmp_path: Path, consent: Callable[[], int]
) -> None:
    write, options = WRITERS[family]
    marker = tmp_path / "ran"
    checkpoint = write(tmp_path / "made")
    if not plant(tmp_path / "made", marker, names, unknown_classes):
        pytest.skip("its checkpoint has no such file")
    entry = find_family(family)
    try:
        model = entry.load(str(checkpoint), options=options)
        if entry.abilities.acts:
            cameras = [need.removeprefix("camera.") for need in model.card.needs if need.startswith("camera.")]
            model.act(example_observations([QUESTIONS.get(family, "put the cube on the star")], cameras), [0])
    except MissingExtraError as error:
        pytest.skip(str(error))
    except CheckpointError:
        pass
    assert not marker.exists()
    assert consent() == 0


def test_the_planted_code_would_run_with_consent(tmp_path: Path, consent: Callable[[], int]) -> None:
    """Otherwise the test above could not fail."""
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "tokenizer_config.json").write_text("{}", encoding="utf-8")
    marker = tmp_path / "ran"
    assert plant(folder, marker, TOKENIZER, unknown_classes=True) == 1
    with pytest.raises(Exception):  # noqa: B017, PT011 - the planted class is no tokenizer
        transformers.AutoTokenizer.from_pretrained(str(folder))
    assert (marker.exists(), consent()) == (True, 1)
    marker.unlink()
    with pytest.raises(CheckpointError, match=r"auto_map.*runs no code of a checkpoint"):
        load_pretrained(transformers.AutoTokenizer, folder)
    assert (marker.exists(), consent()) == (False, 1)


def _calls() -> list[tuple[str, ast.Call, ast.Attribute]]:
    return [
        (f"{path.relative_to(PACKAGE)}:{node.lineno}", node, node.func)
        for path, node in package_nodes(ast.Call)
        if isinstance(node.func, ast.Attribute)
    ]


def _refuses_code(call: ast.Call) -> bool:
    return any(
        keyword.arg == "trust_remote_code"
        and isinstance(keyword.value, ast.Constant)
        and keyword.value.value is False
        for keyword in call.keywords
    )


def _class_of(function: ast.Attribute) -> str:
    return ast.unparse(function.value).rpartition(".")[2]


def test_every_call_that_can_run_code_of_a_checkpoint_refuses_it() -> None:
    loading = [
        (where, call, _class_of(function))
        for where, call, function in _calls()
        if function.attr == "from_pretrained"
        or (function.attr.startswith("from_") and "Auto" in _class_of(function))
    ]
    assert loading
    lacking = [where for where, call, name in loading if name not in WITHOUT_AUTO_MAP and not _refuses_code(call)]
    assert not lacking, "use probe_kit.models.checkpoint_files.load_pretrained"


def test_no_call_allows_code_of_a_checkpoint() -> None:
    allowing = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path, node in package_nodes(ast.keyword)
        if node.arg == "trust_remote_code"
        and not (isinstance(node.value, ast.Constant) and node.value.value is False)
    ]
    assert not allowing


@pytest.mark.parametrize("context", [while_loading, while_acting], ids=["loading", "acting"])
@pytest.mark.parametrize("kind", [CheckpointError, WeightsError, InstructionError])
def test_an_error_about_a_checkpoint_names_its_family_and_its_folder(
    context: Callable[[str, str], AbstractContextManager[None]], kind: type[ProbeKitError]
) -> None:
    expected = r"^pi0 from /models/mine: normalisation 7 is not one of MEAN_STD$"
    with pytest.raises(kind, match=expected) as raised, context("pi0", "/models/mine"):
        raise kind("normalisation 7 is not one of MEAN_STD")
    assert type(raised.value) is kind


@pytest.mark.parametrize(
    ("reason", "expected"),
    [
        ("/models/mine/config.json is missing", "pi0: /models/mine/config.json is missing"),
        ("pi0 has no such key", "/models/mine: pi0 has no such key"),
        ("pi0-tiny has no such key", "pi0 from /models/mine: pi0-tiny has no such key"),
        ("pi0 cannot be loaded from /models/mine: x", "pi0 cannot be loaded from /models/mine: x"),
    ],
)
def test_what_a_message_names_already_is_not_said_twice(reason: str, expected: str) -> None:
    assert with_origin(reason, "pi0", "/models/mine") == expected
    assert with_origin(expected, "pi0", "/models/mine") == expected


def test_a_slash_at_the_end_makes_no_other_folder() -> None:
    assert with_origin("pi0: /models/mine/x is gone", "pi0", "/models/mine/") == "pi0: /models/mine/x is gone"


def test_a_folder_called_like_the_model_is_not_its_name() -> None:
    expected = with_origin("/golden/pi0/checkpoint/config.json is missing", "pi0", "/golden/pi0/checkpoint")
    assert expected == "pi0: /golden/pi0/checkpoint/config.json is missing"


def test_other_errors_of_ours_are_left_as_they_are() -> None:
    with pytest.raises(UsageError, match=r"^device 'x' cannot be used$"), while_loading("pi0", "/models/mine"):
        raise UsageError("device 'x' cannot be used")


def test_errors_of_others_and_an_end_of_the_process_are_named() -> None:
    with (
        pytest.raises(CheckpointError, match=r"pi0 cannot be loaded from /x: KeyError: 'a'"),
        while_loading("pi0", "/x"),
    ):
        raise KeyError("a")
    with pytest.raises(PolicyFailedError, match=r"sys\.exit\(3\)"), while_loading("pi0", "/x"):
        raise SystemExit(3)
    with pytest.raises(PolicyFailedError, match=r"pi0 failed while it acted: KeyError"), while_acting("pi0", "/x"):
        raise KeyError("a")


def test_a_library_that_is_only_there_does_not_speak_while_a_model_loads(caplog: pytest.LogCaptureFixture) -> None:
    """Libraries import bitsandbytes wherever it is installed, and it complains where there is no GPU."""
    theirs = logging.getLogger("bitsandbytes.cextension")
    with while_loading("pi0", "/x"):
        theirs.warning("compiled without GPU support")
        theirs.error("broken")
    theirs.warning("afterwards")
    assert [record.message for record in caplog.records] == ["broken", "afterwards"]
