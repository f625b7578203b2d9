"""A data set of one task: its spellings are one value, and the words of other tasks make the instruction vary."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.diagnose.diagnosis import diagnose_run
from probe_kit.diagnose.measure import DONORS, InputExchange
from probe_kit.diagnose.results import Diagnosis, exit_code
from probe_kit.errors import InstructionError, UsageError
from probe_kit.extract import ExtractSettings, LeRobotSource, extract_run
from probe_kit.extract.sources.inputs import Frame, normal_form
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene import ImageSwap, InstructionSwap, run_intervention
from probe_kit.intervene.further_instructions import check_further_instructions, read_instructions
from probe_kit.runs import Run
from tests.support.lerobot_recordings import write_recording

ONE_TASK = ["Put the cube on the red shape", "put the cube on the red shape ."]
OTHERS = ["Put the cube on the blue shape", "Put the cube on the green shape", "Put the cube on the yellow shape"]


def frames(texts: Sequence[str], count: int = 24, groups: int = 12) -> list[Frame]:
    rng = np.random.default_rng(0)
    return [
        Frame.of(
            f"{number}",
            Observation(
                np.full((8, 8, 3), rng.integers(256), np.uint8),
                rng.normal(size=2).astype(np.float32),
                texts[number % groups % len(texts)],
            ),
            f"group {number % groups}",
            number,
        )
        for number in range(count)
    ]


def obey(observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
    """Actions that follow the words, however they are spelt, and the picture a little."""
    forms = {normal_form(text): value for value, text in enumerate((*ONE_TASK[:1], *OTHERS))}
    values = [
        3.0 * forms.get(normal_form(observation.instruction), -1.0) + observation.image.mean() / 100
        for observation in observations
    ]
    return np.array(values, np.float32)[:, None, None] * np.ones((1, 2, 1), np.float32) + 0 * len(seeds)


def test_an_obedient_policy_with_one_task_in_two_spellings_is_not_called_deaf() -> None:
    measured = InputExchange(obey, frames(ONE_TASK)).measure()
    words = measured[0]
    assert words.verdict == "not varied"
    assert all(repr(text) in words.reason for text in ONE_TASK)
    assert "--instructions FILE" in words.reason
    assert exit_code(measured, ["picture"]) == 0
    assert exit_code(measured, ["instruction"]) == 1, "it was required and not tested"


def test_words_of_other_tasks_show_that_the_policy_obeys_and_what_is_varied_stays_as_it_is() -> None:
    observed_frames = frames(ONE_TASK)
    alone, with_words = InputExchange(obey, observed_frames), InputExchange(obey, observed_frames, words=OTHERS)
    words, picture, _ = with_words.measure()
    assert words.verdict == "decides"
    assert words.n_pairs == DONORS * len(observed_frames), "each further task, with several pictures"
    assert words.control == 0, "another spelling changes nothing"
    assert (picture.share, picture.n_pairs) == (alone.measure(["picture"])[0].share, alone.measure()[1].n_pairs)
    donors = {
        with_words.candidates("instruction")[donor].instruction for _, donor in with_words.donors("instruction")
    }
    assert donors == set(OTHERS), "no donor holds another spelling of the task"


def test_two_tasks_of_which_one_has_two_spellings_are_exchanged_for_each_other_alone() -> None:
    exchange = InputExchange(obey, frames([*ONE_TASK, OTHERS[0]]))
    forms = [normal_form(frame.instruction) for frame in exchange.frames]
    assert exchange.donors("instruction")
    assert all(forms[index] != forms[donor] for index, donor in exchange.donors("instruction"))


def test_pictures_that_differ_by_noise_and_states_by_rounding_are_not_varied() -> None:
    rng, observed_frames = np.random.default_rng(1), frames(OTHERS)
    for number, frame in enumerate(observed_frames):
        picture = np.clip(120 + rng.integers(-1, 2, (16, 16, 3)), 0, 255).astype(np.uint8)
        state = np.array([0.5, 0.25], np.float32)
        state[0] = np.nextafter(state[0], np.float32(number % 2))
        observation = Observation(picture, state, frame.instruction)
        observed_frames[number] = Frame.of(frame.name, observation, frame.group, frame.seed)
    words, picture_input, state_input = InputExchange(obey, observed_frames).measure()
    assert words.verdict == "decides"
    assert (picture_input.verdict, state_input.verdict) == ("not varied", "not varied")
    assert "what the control" in picture_input.reason


@pytest.mark.parametrize(
    ("name", "text", "texts"),
    [
        ("words.txt", "Lift it\nPush, then pull it\n\n", ["Lift it", "Push, then pull it"]),
        ("words.csv", "task;instruction\n1;Lift it\n2;Push it\n", ["Lift it", "Push it"]),
        ("words", "instruction\tid\nLift it\t1\n", ["Lift it"]),
        ("words.txt", "\ufeffHebe es\r\nSchiebe es\r\n", ["Hebe es", "Schiebe es"]),
    ],
)
def test_instructions_are_lines_or_a_column_of_a_table(
    name: str, text: str, texts: list[str], tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    assert list(read_instructions(tmp_path / name)) == texts


@pytest.mark.parametrize(
    ("name", "text", "mention"),
    [
        ("words.txt", "", "has 0 instructions"),
        ("words.txt", "Lift it\n\nPush it\n", r"line 2 is '', which names no task"),
        ("words.txt", "Lift it\n...\n", r"line 2 is '...', which names no task"),
        ("words.txt", "Lift it\nPush it\nlift  it.\n", r"line 3 is 'lift  it.', and .*line 1 is 'Lift it'"),
        ("words.csv", "text\nLift it\n", "expected a column instruction"),
        ("words.csv", "instruction,id\n,2\n", "which names no task"),
    ],
)
def test_instructions_that_name_no_task_or_one_twice_are_refused_with_their_line(
    name: str, text: str, mention: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=mention):
        read_instructions(tmp_path / name)


def test_the_task_of_the_frames_in_another_spelling_is_no_other_task() -> None:
    check_further_instructions(OTHERS, ONE_TASK)
    with pytest.raises(UsageError, match=r"which is the task 'put the cube on the red shape \.' of these frames"):
        check_further_instructions(["PUT THE CUBE ON THE RED SHAPE!"], ONE_TASK[1:])


# -- recordings -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight episodes of three frames, of one task in two spellings."""
    pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="the extra `datasets` is not installed")
    folder, rng = tmp_path_factory.mktemp("one-task") / "data", np.random.default_rng(0)
    state = np.array([0.3934, 0.0225, 0.0765, -0.0039, 0.0567, -0.0192, 0, 0.6449], np.float32)
    episodes = [
        [
            Observation(
                rng.integers(0, 256, (96, 96, 3)).astype(np.uint8),
                state + np.float32(0.001 * (3 * episode + frame)),
                ONE_TASK[episode % 2],
            )
            for frame in range(3)
        ]
        for episode in range(8)
    ]
    return write_recording(folder, episodes)


def words_file(folder: Path, texts: Sequence[str] = OTHERS) -> Path:
    file = folder / "words.txt"
    file.write_text("\n".join(texts), encoding="utf-8")
    return file


def run_command(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["diagnose", *map(str, arguments)], env={"COLUMNS": "200"})


@pytest.mark.slow
def test_a_diagnosis_captures_the_frames_that_it_uses_and_gives_the_numbers_of_one_that_captured_all(
    recorded: Path, tmp_path: Path
) -> None:
    new = ("--dataset", recorded, "--frames", 9, "--no-inside", "--instructions", words_file(tmp_path))
    answer = run_command("pi0-tiny", *new, "--out", tmp_path / "few", "--format", "json")
    assert answer.exit_code in (0, 1), answer.output
    few = json.loads(answer.stdout)
    assert "9 frames, instruction, picture, state" in answer.stderr, "the cost, before anything is captured"
    captured = pk_run(tmp_path / "few")
    assert len(captured.episodes) == 9
    assert captured.episodes["group_id"].nunique() == 8
    source = LeRobotSource(str(recorded))
    every = extract_run(ExtractSettings("pi0-tiny", source=source), tmp_path / "all")
    assert every.episodes["frames"].sum() == 24
    full_diagnosis = diagnose_run(every, frames=9, inside=False, instructions=OTHERS)
    assert numbers_of(few) == numbers_of(full_diagnosis.to_json())
    assert full_diagnosis.settings["instructions"] == OTHERS
    assert full_diagnosis.key != diagnose_run(every, frames=9, inside=False).key


def pk_run(folder: Path) -> Run:
    import probe_kit as pk

    return pk.open_run(folder)


def numbers_of(diagnosis: dict[str, Any]) -> list[Any]:
    return [
        [entry["name"], entry["share"], entry["control"], entry["every"], entry["p"]]
        for entry in diagnosis["inputs"]
    ]


@pytest.mark.slow
def test_one_task_in_two_spellings_is_said_with_the_remedy_and_no_policy_is_called_deaf(
    recorded: Path, tmp_path: Path
) -> None:
    new = ("--dataset", recorded, "--frames", 8, "--no-inside", "--out", tmp_path / "run")
    answer = run_command("pi0-tiny", *new, "--dry-run")
    assert answer.exit_code == 0, answer.output
    assert "are one instruction" in answer.stderr
    assert "Give the words of other tasks: --instructions FILE" in answer.stderr
    answer = run_command("pi0-tiny", *new, "--format", "json")
    words = json.loads(answer.stdout)["inputs"][0]
    assert (words["name"], words["verdict"]) == ("instruction", "not varied")


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--dry-run",)], ids=["run", "plan"])
@pytest.mark.parametrize(
    ("texts", "more", "mention"),
    [
        (ONE_TASK[1:], (), "which is the task"),
        (["Rearrange the quuxes"], (), "'quuxes'"),
        (OTHERS, ("--target", "side.correct"), "is of another source"),
        (OTHERS, ("--html", "."), "is a folder; give the name of a file"),
        (OTHERS, ("--episodes", "0:4"), "frames of 4 groups; a diagnosis needs at least 6"),
        (OTHERS, ("--target", "dataset.state.s0", "--episodes", "0:4"), "groups"),
    ],
)
def test_what_can_be_refused_without_weights_is_refused_before_them(
    texts: list[str],
    more: tuple[str, ...],
    mention: str,
    options: tuple[str, ...],
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("no model is loaded")

    monkeypatch.setattr("probe_kit.hooks.load_policy", never)
    new = ("--dataset", recorded, "--instructions", words_file(tmp_path, texts), "--out", tmp_path / "run")
    answer = run_command("pi0-tiny", *new, *more, *options)
    assert answer.exit_code != 0
    assert mention in " ".join(answer.output.split()), answer.output
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_an_exchange_of_instructions_takes_the_words_and_names_them_where_it_cannot_vary(
    recorded: Path, tmp_path: Path
) -> None:
    run = extract_run(ExtractSettings("pi0-tiny", source=LeRobotSource(str(recorded), every=3)), tmp_path / "run")
    with pytest.raises(UsageError, match=r"are one instruction.*--instructions FILE"):
        run_intervention(run, ImageSwap(vary="instruction"))
    result = run_intervention(run, InstructionSwap(instructions=tuple(OTHERS)))
    assert result.settings["instructions"] == OTHERS
    (row,) = result.effects
    assert (row.vary, row.changed) == ("instruction", 1.0)
    with pytest.raises(UsageError, match="the picture is exchanged; add --vary instruction"):
        run_intervention(run, ImageSwap(instructions=tuple(OTHERS)))
    with pytest.raises(UsageError, match="which is the task"):
        run_intervention(run, InstructionSwap(instructions=(ONE_TASK[1],)))
    with pytest.raises(InstructionError, match="quuxes"):
        run_intervention(run, InstructionSwap(instructions=("Rearrange the quuxes",)))


def test_a_diagnosis_names_its_weights_source_and_settings(tmp_path: Path) -> None:
    from probe_kit.diagnose.page import write_page
    from probe_kit.diagnose.results import diagnosis_table

    inputs = InputExchange(obey, frames(OTHERS)).measure()
    settings = {"frames": 24, "inputs": [], "inside": False, "seed": 0, "instructions": OTHERS}
    diagnosis = Diagnosis(
        "abc", "mine", 24, 12, inputs, weights_sha256="0123456789abcdef", checkpoint="tuned/080000",
        source="kitchen#1234", settings=settings,
    )  # fmt: skip
    notes = " ".join(diagnosis_table(diagnosis).notes)
    for part in ("weights 0123456789ab of checkpoint tuned/080000", "kitchen#1234", "seed 0", "3 further", "abc"):
        assert part in notes
    assert Diagnosis.from_json(json.loads(json.dumps(diagnosis.to_json()))) == diagnosis
    write_page(diagnosis, tmp_path / "why.html")
    page = (tmp_path / "why.html").read_text(encoding="utf-8")
    assert "weights 0123456789ab of checkpoint tuned/080000" in page
    assert all(page.count(note.split("(")[0][:40]) == 1 for note in diagnosis_table(diagnosis).notes), (
        "each sentence once"
    )
