"""VLM runs: what is stored, what controls say, that they resume, and that they see what policies see."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from typer.testing import CliRunner, Result

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import InstructionError, SettingsMismatchError, UsageError
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run, prepare, prepare_asks
from probe_kit.extract.prompts import P1, P2, SEEN, Template
from probe_kit.extract.rollout.answer_controller import AnswerController
from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.extract.rollout.controllers import Turn
from probe_kit.extract.rollout.tasks import task_of
from probe_kit.hooks import AnswerModel, Prompt, Reading, Site
from probe_kit.retention import success_rate
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.suite import Suite
from tests.hooks.families.prismatic.checkpoints import write_checkpoint
from tests.support.position_models import PositionModel, always, likes

NOWHERE = EpisodeBuffers([], 1, with_tokens=False, pinned=False)
SMALL = SceneSpec(picture_size=(224, 224))
COLUMNS = {
    "outcome", "side_placed", "answer", "parse", "parse_tier", "said", "answer_swapped", "side_placed_swapped",
    "parse_swapped", "parse_tier_swapped",
    "outcome_swapped", "logit_left", "logit_right", "option_mass", "margin", "margin_swapped", "content",
    "letter_bias", "near_tie", "side_logits", "outcome_logits", "side_debiased", "outcome_debiased",
    "prompt_tokens", "picture_tokens", "question", "side_word", "first_frame_sha256", "visible_left",
    "visible_right",
}  # fmt: skip


@pytest.fixture(scope="module")
def settings(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> AskSettings:
    """A tiny Prismatic with random weights, asked about two items."""
    folder = write_checkpoint(tmp_path_factory.mktemp("vlm") / "tiny", model_type="prismatic")
    return AskSettings(
        "prismatic",
        str(folder),
        suite=small_suite.folder,
        categories=("color",),
        items=2,
        scene=SMALL,
        env_workers=0,
    )


@pytest.fixture(scope="module")
def answer_run(settings: AskSettings, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return ask_run(settings.changed(tokens="pooled"), tmp_path_factory.mktemp("asked") / "run")


# -- what is stored --------------------------------------------------------------------------------------


def test_every_episode_has_its_answer_and_the_run_is_whole(answer_run: Run) -> None:
    assert set(answer_run.episodes) >= COLUMNS
    assert len(answer_run.episodes) == 4
    assert answer_run.certificate["hooks_on_equals_hooks_off"]
    assert verify_run(answer_run.path, deep=True).ok
    question = answer_run.episodes["question"][0]
    assert question.startswith('Do you see the gray shape? If yes, specify where: "left" or "right".')
    ask = answer_run.settings["ask"]
    assert (ask["prompt"], ask["picture_size"], ask["template_sha256"]) == ("p1", "224x224", P1.sha256)
    assert answer_run.label == "prismatic · tiny · p1 · 224×224"


def test_a_question_by_letter_keeps_what_every_layer_would_answer(settings: AskSettings, answer_run: Run) -> None:
    """By the model's own final norm and head; the last layer is the stored margin."""
    model = task_of(settings).load(settings)
    margins = answer_run.lens_margins
    assert margins is not None
    assert margins.shape == (4, len(answer_run.sites("answer")))
    assert margins[:, -1] == pytest.approx(answer_run.episodes["margin"].to_numpy(), abs=1e-5)
    assert margins[:, :-1].std() > 0
    assert model.unembedding is not None
    letters = [model.tokenizer.encode(model.lead + letter)[-1] for letter in "AB"]  # type: ignore[attr-defined]
    for layer, site in enumerate(answer_run.sites("answer")):
        logits = model.unembedding.logits(torch.from_numpy(np.array(answer_run.column(site, "last")[:1])))
        assert margins[0, layer] == pytest.approx(float(logits[0, letters[0]] - logits[0, letters[1]]), abs=1e-6)


def test_its_streams_are_those_of_the_question_as_it_was_asked(answer_run: Run) -> None:
    assert list(answer_run.streams) == ["backbone", "answer"]
    assert answer_run.views("backbone") == ("mean", "last", "mean:image.primary", "mean:language")
    column = np.asarray(answer_run.column(Site("backbone", 2), "mean"))
    assert np.isfinite(column).all()
    assert column.std(axis=0).max() > 0
    assert (answer_run.episodes["picture_tokens"] == 4).all()


@pytest.mark.slow
def test_who_acts_in_the_same_scene_begins_with_the_same_frame(
    settings: AskSettings, answer_run: Run, tmp_path: Path
) -> None:
    short = SceneSpec(max_steps=1)  # at full size: pictures are made smaller behind the frame that is hashed
    acting = ExtractSettings("expert", suite=settings.source.suite, categories=("color",), items=2, scene=short)
    acted = extract_run(acting, tmp_path / "run").episodes
    for column in ("episode_id", "scene_seed", "first_frame_sha256", "visible_left"):
        assert acted[column].tolist() == answer_run.episodes[column].tolist(), column
    assert acted["first_frame_sha256"].nunique() == 2, "items of a pair share their pictures, exchanged"


@pytest.mark.parametrize("change", [{"prompt": SEEN}, {"picture": "none"}, {"query": "distractor"}, {"seed": 1}])
def test_other_questions_are_another_run(settings: AskSettings, answer_run: Run, change: dict) -> None:
    with pytest.raises(SettingsMismatchError):
        prepare(settings.changed(tokens="pooled", **change), answer_run.path)


@pytest.mark.slow
def test_a_batch_answers_alike(settings: AskSettings, answer_run: Run, tmp_path: Path) -> None:
    run = ask_run(settings.changed(batch=3), tmp_path / "run")
    np.testing.assert_allclose(run.episodes["margin"], answer_run.episodes["margin"], atol=1e-4)
    assert run.episodes["answer"].tolist() == answer_run.episodes["answer"].tolist()
    assert run.streams == {}


@pytest.mark.slow
def test_worker_processes_give_the_same_commits(settings: AskSettings, answer_run: Run, tmp_path: Path) -> None:
    run = ask_run(settings.changed(tokens="pooled", workers=2), tmp_path / "run")
    for path in sorted(answer_run.path.glob("commits/*.json")):
        assert (run.path / "commits" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_an_episode_that_cannot_be_asked_is_given_up_and_the_others_stay(
    settings: AskSettings, tmp_path: Path
) -> None:
    class Choosy(PositionModel):
        def read(self, questions: list[Prompt]) -> Reading:
            if any("red" in question.text for question in questions) and any(
                question.observation.image.any() for question in questions
            ):
                raise InstructionError("no red, please")
            return super().read(questions)

    extraction = prepare(settings, None, Choosy(likes("A"), always("A")))
    with pytest.raises(Exception, match="2 episodes failed twice"):
        extraction.run(tmp_path / "run")
    assert len(open_run(tmp_path / "run", allow_partial=True).episodes) == 2


# -- controls --------------------------------------------------------------------------------------------


def answers(settings: AskSettings, answer_model: AnswerModel | None = None) -> pd.DataFrame:
    """What the run's episodes would hold. Their frames are noise: which model answers needs no scene."""
    source: Any = settings.source.open()
    blank = source.example(source.instructions[0])
    model = task_of(settings).load(settings) if answer_model is None else answer_model
    controller = AnswerController(model, source, settings)
    noise = np.random.default_rng(0)
    turns = [
        Turn(replace(blank, image=noise.integers(0, 256, blank.image.shape, np.uint8)), row, 0, NOWHERE)
        for row in source.rows(settings.seed)
    ]
    outcomes = [dict(inference.columns) for turn in turns for inference in controller.infer([turn])]
    return pd.DataFrame([turn.row.to_json() | outcome for turn, outcome in zip(turns, outcomes, strict=True)])


@pytest.mark.parametrize(("option", "side", "bias"), [("A", "left", 1.0), ("B", "right", -1.0)])
def test_who_answers_by_letter_gives_as_many_right_as_wrong_and_a_letter_bias(
    settings: AskSettings, option: str, side: str, bias: float
) -> None:
    episodes = answers(settings, PositionModel(likes(option), always(option)))
    assert (episodes["side_placed"] == side).all()
    assert (episodes["side_placed_swapped"] != side).all()
    assert episodes["outcome"].value_counts().to_dict() == {"correct": 2, "wrong": 2}
    assert episodes["outcome_logits"].value_counts().to_dict() == {"correct": 2, "wrong": 2}
    assert (episodes["letter_bias"] == bias).all()
    assert (episodes["content"] == 0).all()
    assert (episodes["outcome_debiased"] == "oob").all(), "without a preference for a letter nothing is left"


def test_who_answers_by_side_has_no_letter_bias_and_is_right_as_often_as_wrong(settings: AskSettings) -> None:
    def left(text: str, option: str) -> float:
        return float(f"{option} left" in text)

    episodes = answers(settings, PositionModel(left, lambda text: "A" if "A left" in text else "B"))
    for column in ("outcome", "outcome_swapped", "outcome_logits", "outcome_debiased"):
        assert episodes[column].value_counts().to_dict() == {"correct": 2, "wrong": 2}
    assert (episodes["letter_bias"] == 0).all()
    assert (episodes["content"] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("prompt", [P1, P2, SEEN], ids=["p1", "p2", "seen"])
def test_without_a_picture_exactly_as_many_are_right_as_wrong(settings: AskSettings, prompt: Template) -> None:
    episodes = answers(settings.changed(picture="none", prompt=prompt, items=6))
    for column in ("outcome_logits", "outcome_debiased", "outcome"):
        counts = episodes[column].value_counts()
        assert counts.get("correct", 0) == counts.get("wrong", 0), column
    assert success_rate(episodes.assign(outcome=episodes["outcome_logits"])).sr == 0.5
    assert episodes.groupby("item_id")["margin"].nunique().eq(1).all(), "both layouts ask the same words"
    assert (episodes["picture_tokens"] == 0).all()


def test_side_by_side_shows_the_two_pictures_and_no_scene(settings: AskSettings) -> None:
    images = []

    class Watching(PositionModel):
        def read(self, questions: list[Prompt]) -> Reading:
            images.extend(question.observation.image for question in questions)
            return super().read(questions)

    answers(settings.changed(picture="side-by-side"), Watching(likes("A"), always("A")))
    original, swapped = images[1], images[3]  # behind a blank one, each in two orders
    assert original.shape == (224, 224, 3)
    assert (original[0] == 128).all()
    half = original.shape[1] // 2
    np.testing.assert_array_equal(original[:, :half], swapped[:, half:])


def test_the_distractor_lies_on_the_other_side(settings: AskSettings) -> None:
    episodes = answers(settings.changed(query="distractor"), PositionModel(likes("A"), always("A")))
    assert episodes["question"][0].startswith("Do you see the red shape?")
    right = episodes["side_correct"] == "right"
    assert (episodes["outcome"] == np.where(right, "correct", "wrong")).all()


def test_of_an_absent_object_right_is_no(settings: AskSettings) -> None:
    absent = settings.changed(query="absent", prompt=SEEN, items=4)
    honest = answers(absent, PositionModel(likes("No"), always("No.")))
    assert (honest[["outcome", "outcome_logits", "outcome_debiased"]] == "correct").all().all()
    eager = answers(absent, PositionModel(likes("Yes"), always("Yes, left.")))
    assert (eager[["outcome", "outcome_logits"]] == "wrong").all().all()
    assert (honest["question"] == eager["question"]).all()


# -- refusals --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            {"model": "pi0-tiny", "checkpoint": None, "options": {}},
            "acts and does not answer questions; choose among",
        ),
        ({"model": "expert", "checkpoint": None, "options": {}}, "acts and does not answer"),
        ({"query": "absent"}, "p1 does not ask for yes or no"),
        ({"picture": "video"}, "picture is 'video'; expected one of frame, side-by-side, none"),
        ({"query": "both"}, "query is 'both'"),
        ({"tokens": "some"}, "expected one of none, pooled, all"),
    ],
)
def test_ask_refuses_impossible_questions_before_a_model_is_loaded(
    settings: AskSettings, change: dict, match: str
) -> None:
    with pytest.raises(UsageError, match=match):
        prepare(settings.changed(**change))


@pytest.mark.slow
def test_several_runs_of_one_model_are_checked_before_the_first_is_asked(
    settings: AskSettings, answer_run: Run, tmp_path: Path
) -> None:
    ask_settings = [settings, settings.changed(prompt=P2)]
    with pytest.raises(SettingsMismatchError):
        next(prepare_asks(ask_settings, [tmp_path / "p1", answer_run.path]))
    prepared = list(prepare_asks(ask_settings, [tmp_path / "p1", tmp_path / "p2"]))
    assert prepared[0].controller.model is prepared[1].controller.model
    names = [prepared_ask.default_name().rpartition("-")[0] for prepared_ask in prepared]
    assert names == ["ask-prismatic-p1-224x224", "ask-prismatic-p2-224x224"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("vlm") / "tiny", model_type="prismatic")


def ask(suite: Suite, folder: Path, *arguments: str) -> Result:
    few = ["--suite", str(suite.folder), "--categories", "color", "--items", "2", "--env-workers", "0"]
    model = ["--model", "prismatic", "--checkpoint", str(folder)]
    return CliRunner().invoke(app, ["ask", *model, *few, *arguments])


@pytest.mark.slow
def test_a_run_per_prompt_and_size_is_planned_and_nothing_is_written(
    small_suite: Suite, folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "runs"
    sizes = ("--picture-size", "224x224,560x480")
    result = ask(small_suite, folder, "--prompt", "p2,seen", *sizes, "--out", str(out), "--dry-run")
    assert result.exit_code == 0, result.output
    for name in ("p2-224x224", "p2-560x480", "seen-224x224", "seen-560x480"):
        assert name in "".join(result.output.split())
    assert not out.exists()


@pytest.mark.slow
def test_it_says_how_answers_came_and_what_to_do_next(small_suite: Suite, folder: Path, tmp_path: Path) -> None:
    result = ask(small_suite, folder, "--prompt", "p1", "--picture", "none", "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == str(tmp_path / "p1-224x224-none")
    message = " ".join(result.stderr.split())
    assert "p1 · no picture: " in message
    assert "option mass 0." in message
    assert "next: probe-kit compare" in message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--prompt", "p3"), "no prompt 'p3'; known: seen, p1, p2"),
        (("--prompt", ","), "--prompt is empty"),
        (("--picture-size", "big"), "not WIDTHxHEIGHT"),
        (("--query", "absent", "--prompt", "p2"), "p2 does not ask for yes or no"),
        (("--batch", "0"), "batch is 0; expected at least 1"),
    ],
)
def test_ask_refuses_a_faulty_prompt_at_once(
    small_suite: Suite, folder: Path, arguments: tuple[str, ...], words: str
) -> None:
    result = ask(small_suite, folder, *arguments)
    assert result.exit_code == 2, result.output
    assert words in " ".join(result.stderr.split())
