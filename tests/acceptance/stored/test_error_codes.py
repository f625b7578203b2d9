"""Errors of docs/errors.md: each situation ends with the documented class on stderr and its exit code."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

import probe_kit as pk
from tests.acceptance.product import ROOT, probe_kit, probe_kit_process
from tests.acceptance.stored.conftest import StoredRuns


def documented() -> dict[str, int]:
    """Exit codes of error classes, from the tables of docs/errors.md."""
    page = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    return {name: int(code) for name, code in re.findall(r"^\| `(\w+Error)` \| (\d+) \|", page, re.MULTILINE)}


@dataclass(frozen=True)
class Room:
    """The folders of a test. runs: shared runs, which it does not change. folder: an empty one of its own."""

    runs: StoredRuns
    folder: Path

    def copy(self, run: Path) -> Path:
        return Path(shutil.copytree(run, self.folder / "copy"))


def played(room: Room, *more: object, model: str = "idle") -> tuple[object, ...]:
    """A short extract of a scripted policy into the folder."""
    settings = (
        "--model",
        model,
        "--categories",
        "color",
        "--items",
        "2",
        "--max-steps",
        "1",
        "--env-workers",
        "0",
    )
    return ("extract", *settings, *more, "--out", room.folder / "run")


def other_settings(room: Room) -> tuple[object, ...]:
    probe_kit(*played(room))
    return played(room, "--seed", "9")


def damaged(room: Room) -> tuple[object, ...]:
    copy = room.copy(room.runs.expert)
    commit = next((copy / "commits").iterdir())
    commit.write_bytes(commit.read_bytes().replace(b"correct", b"wrongly"))
    return ("retention", copy)


def incomplete(room: Room) -> tuple[object, ...]:
    copy = room.copy(room.runs.expert)
    next((copy / "commits").iterdir()).unlink()
    shutil.rmtree(copy / "sealed", ignore_errors=True)
    shutil.rmtree(copy / "columns.zarr", ignore_errors=True)
    return ("retention", copy)


def without_activations(room: Room) -> tuple[object, ...]:
    probe_kit("run", "copy", room.runs.untrained, room.folder / "light")
    return ("train", room.folder / "light", "--seed", "7", "--controls", "none")


def changed_suite(room: Room) -> tuple[object, ...]:
    probe_kit("suite", "build", room.folder / "suite", "--categories", "color", "--n", "2")
    next((room.folder / "suite").rglob("*.png")).write_bytes(b"not a picture")
    return played(room, "--suite", room.folder / "suite")


def suite_that_moved(room: Room) -> tuple[object, ...]:
    probe_kit("suite", "build", room.folder / "suite", "--categories", "color", "--n", "2", "--seed", "4")
    settings = ("--model", "pi0-tiny", "--max-steps", "1", "--env-workers", "0")
    probe_kit("extract", *settings, "--suite", room.folder / "suite", "--out", room.folder / "run")
    shutil.rmtree(room.folder / "suite")
    return ("intervene", room.folder / "run")


def other_frames(room: Room) -> tuple[object, ...]:
    settings = (
        "--model",
        "vlm-tiny",
        "--categories",
        "color",
        "--items",
        "2",
        "--prompt",
        "p1",
        "--scene",
        "frontal",
    )
    probe_kit("ask", *settings, "--out", room.folder / "asked")
    asked = next((room.folder / "asked").glob("*/run.json")).parent
    return ("compare", asked, room.runs.trained, "--kind", "stages")


def too_few_groups(room: Room) -> tuple[object, ...]:
    settings = ("--model", "pi0-tiny", "--no-act", "--categories", "color", "--items", "4", "--env-workers", "0")
    probe_kit("extract", *settings, "--out", room.folder / "run")
    return ("train", room.folder / "run", "--controls", "none")


def no_data_set(room: Room) -> tuple[object, ...]:
    (room.folder / "data").mkdir()
    return ("extract", "--model", "pi0-tiny", "--dataset", room.folder / "data", "--out", room.folder / "run")


def half_a_checkpoint(room: Room) -> tuple[object, ...]:
    """A checkpoint folder that holds weights of nothing."""
    folder = room.folder / "checkpoint"
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"type": "pi0"}), encoding="utf-8")
    return ("extract", "--model", "pi0", "--checkpoint", folder, "--out", room.folder / "run", "--items", "2")


def unknown_word(room: Room) -> tuple[object, ...]:
    from PIL import Image

    for number, colour in enumerate(("red", "blue")):
        Image.linear_gradient("L").resize((128, 128)).rotate(90 * number).save(room.folder / f"{colour}.png")
    lines = "instruction,correct,wrong\nPut the cube on the zeppelin,red.png,blue.png\n"
    (room.folder / "mine.csv").write_text(lines, encoding="utf-8")
    probe_kit(
        "suite", "from-csv", room.folder / "mine.csv", "--out", room.folder / "suite", "--license", "CC0-1.0"
    )
    settings = ("--model", "pi0-tiny", "--suite", room.folder / "suite", "--max-steps", "1", "--env-workers", "0")
    return ("extract", *settings, "--out", room.folder / "run")


def steered(room: Room, site: str) -> tuple[object, ...]:
    return ("intervene", room.runs.trained, "--kind", "steer", "--sites", site, "--roles", "language")


SITUATIONS: dict[str, tuple[str, Callable[[Room], tuple[object, ...]], str]] = {
    "an odd number of items": ("UsageError", lambda room: played(room, "--items", "3"), "even"),
    "one run twice": ("UsageError", lambda room: ("compare", room.runs.idle, room.runs.idle), "twice"),
    "a misspelled model": ("UnknownModelError", lambda room: played(room, model="pi0-tyni"), "pi0-tiny"),
    "a misspelled category": (
        "UnknownCategoryError", lambda room: played(room, "--categories", "colour"), "color"
    ),
    "a category that was not played": (
        "UnknownCategoryError", lambda room: ("train", room.runs.untrained, "--categories", "state"), "color"
    ),
    "a layer that does not exist": ("UnknownSiteError", lambda room: steered(room, "backbone.99"), "backbone"),
    "an intervention in a run that only answered": (
        "UsageError", lambda room: ("intervene", room.runs.asked), "asked"
    ),
    "a folder without a run": ("RunNotFoundError", lambda room: ("retention", room.folder), "run"),
    "retention of a label before train": (
        "NoProbesError", lambda room: ("retention", room.runs.untrained, "--target", "drawer"), "train"
    ),
    "pictures of a suite that moved": ("SuiteNotFoundError", suite_that_moved, "--suite"),
    "a zone that overlaps its neighbour": (
        "SceneError", lambda room: played(room, "--epsilon", "0.5"), "epsilon"
    ),
    "a picture that was changed": ("SuiteError", changed_suite, "changed"),
    "a changed commit": ("RunDamagedError", damaged, "commits"),
    "a lost commit": ("RunIncompleteError", incomplete, "extract"),
    "too few items for probes": ("TooFewGroupsError", too_few_groups, "items"),
    "a word that the tokenizer does not know": ("InstructionError", unknown_word, "zeppelin"),
    "other settings in a folder": ("SettingsMismatchError", other_settings, "seed"),
    "a copy without activations": ("ActivationsLeftOutError", without_activations, "copy"),
    "a VLM that saw other frames": ("OtherFramesError", other_frames, "frames"),
    "a checkpoint that does not exist": (
        "CheckpointError",
        lambda room: ("extract", "--model", "pi0", "--checkpoint", room.folder / "nowhere", "--items", "2"),
        "exist",
    ),
    "a checkpoint folder without weights": ("WeightsError", half_a_checkpoint, "weights"),
    "a folder that is no data set": ("RecordingError", no_data_set, "data"),
}  # fmt: skip


@pytest.mark.parametrize("situation", SITUATIONS)
def test_a_documented_error_has_its_class_its_exit_code_and_a_remedy(
    situation: str, runs: StoredRuns, tmp_path: Path
) -> None:
    name, prepare, word = SITUATIONS[situation]
    typed = prepare(Room(runs, tmp_path))
    answer = probe_kit(*typed, code=None)
    assert f"{name}:" in answer.err, answer.text
    assert answer.code == documented()[name], answer.text
    assert word.casefold() in answer.err.casefold()
    assert "Traceback" not in answer.text
    assert not answer.out.strip() or "extract" in str(typed[0]), "an error prints no table"


def test_python_raises_what_the_command_line_prints(tmp_path: Path) -> None:
    with pytest.raises(pk.ProbeKitError) as raised:
        pk.open_run(tmp_path)
    answer = probe_kit("run", "show", tmp_path, code=2)
    assert type(raised.value).__name__ == "RunNotFoundError"
    assert type(raised.value).__name__ in answer.err
    with pytest.raises(pk.ProbeKitError, match="epsilon"):
        pk.SceneSpec.preset("act2answer", epsilon=0.5)


def test_a_path_of_the_wrong_kind_is_wrong_usage(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("text", encoding="utf-8")
    for typed in (("retention", file), ("suite", "list", file), ("demo", "--out", file / "below")):
        answer = probe_kit(*typed, code=None)
        assert answer.code in (1, 2) if typed[0] == "suite" else answer.code == 2, answer.text
        assert "Traceback" not in answer.text
        assert "InternalError" not in answer.text


def test_the_installed_program_exits_with_the_documented_codes(tmp_path: Path) -> None:
    """The console script itself: a refused option, and an error of the product."""
    answer = probe_kit_process("retention", "nowhere", code=2, folder=tmp_path)
    assert "RunNotFoundError" in answer.err
    assert not answer.out


def test_escape_sequences_of_outside_text_never_reach_the_terminal(runs: StoredRuns, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(runs.expert, tmp_path / "copy"))
    labelled = probe_kit("run", "show", copy, "--label", "red\x1b[31m", code=None)
    table = probe_kit("retention", copy)
    missing = probe_kit("retention", f"{tmp_path}/\x1b[2Jnowhere", code=2)
    for answer in (labelled, table, missing):
        assert "\x1b" not in answer.out + answer.err


def test_an_error_of_the_simulated_world_names_the_environments_author(tmp_path: Path) -> None:
    """An environment of one's own that raises is exit code 3, by name."""
    module = tmp_path / "broken_world.py"
    module.write_text(
        "class World:\n    def __init__(self):\n        raise RuntimeError('no such robot')\n", encoding="utf-8"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        typed = ("extract", "--model", "pi0-tiny", "--env", "broken_world:World", "--out", tmp_path / "run")
        answer = probe_kit(*typed, code=3)
    assert "OwnEnvironmentError" in answer.err
    assert "no such robot" in answer.text
