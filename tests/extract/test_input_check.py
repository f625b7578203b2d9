"""The input check in certificates: `extract` finds a deaf and a blind policy by its first observation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import IgnoredInputsError, InstructionError
from probe_kit.extract import AskSettings, ExtractSettings, LeRobotSource, ask_run, prepare
from probe_kit.extract.rollout.controllers import vary_observation
from probe_kit.extract.sources.inputs import NEAREST, PICTURE, Frame, draw_donors, same_input
from probe_kit.hooks import Edit, Observation, Policy, Site, Tap
from probe_kit.hooks.families.pi0.adapter import load_pi0_tiny
from probe_kit.runs import Run
from probe_kit.runs.provenance import input_notes
from tests.hooks.families.prismatic.checkpoints import write_checkpoint
from tests.support.lerobot_recordings import CAMERA, write_recording
from tests.support.organisms import Edit as WeightEdit
from tests.support.organisms import make_blind, make_deaf
from tests.support.position_models import Liking, PositionModel, always, likes

SETTINGS = ExtractSettings(
    "pi0-tiny", categories=("color",), items=2, scene=SceneSpec(max_steps=4), capture_only=True, env_workers=0
)
BOTH = {"picture": "output", "instruction": "output"}


def edited(*edits: WeightEdit) -> Policy:
    """The embedded policy with edited weights."""
    policy = load_pi0_tiny()
    with torch.no_grad():
        for edit in edits:
            edit(policy)
    return policy


def extracted(folder: Path, policy: Policy, settings: ExtractSettings = SETTINGS) -> Run:
    return prepare(settings, model=policy).run(folder)


def test_a_sound_policy_is_certified_without_a_note(tmp_path: Path, pi0_tiny: Policy) -> None:
    run = extracted(tmp_path / "run", pi0_tiny)
    assert run.certificate["input_check"] == BOTH
    assert not input_notes(run.certificate)
    assert "inputs" not in CliRunner().invoke(app, ["run", "show", str(run.path)]).output


@pytest.mark.slow
@pytest.mark.parametrize(("edit", "lost"), [(make_blind, "picture"), (make_deaf, "instruction")])
def test_a_blind_and_a_deaf_policy_are_noted(edit: WeightEdit, lost: str, tmp_path: Path) -> None:
    run = extracted(tmp_path / "run", edited(edit))
    assert run.certificate["input_check"] == {**BOTH, lost: "nothing"}
    output = " ".join(CliRunner().invoke(app, ["run", "show", str(run.path)]).output.split())
    assert f"another {lost} changes no number of the first output" in output


def test_a_policy_that_is_blind_and_deaf_stops_before_anything_is_committed(tmp_path: Path) -> None:
    policy = edited(make_blind, make_deaf)
    with pytest.raises(IgnoredInputsError, match=r"another picture and another instruction .*probe-kit diagnose"):
        extracted(tmp_path / "run", policy)
    run = extracted(tmp_path / "run", policy, SETTINGS.changed(accept_ignored_inputs=True))
    assert run.certificate["input_check"] == dict.fromkeys(BOTH, "nothing")
    output = " ".join(CliRunner().invoke(app, ["run", "show", str(run.path)]).output.split())
    for lost in BOTH:
        assert f"another {lost} changes no number of the first output" in output
    assert len(input_notes(run.certificate)) == 2


@pytest.mark.slow
def test_a_run_with_edits_is_checked_with_them(tmp_path: Path, pi0_tiny: Policy) -> None:
    silenced = Edit("zero", tuple(site for site in pi0_tiny.sites() if site.stream == "backbone"))
    settings = SETTINGS.changed(edits=(silenced,), accept_ignored_inputs=True)
    run = extracted(tmp_path / "run", pi0_tiny, settings)
    assert run.certificate["input_check"] == {"picture": "nothing", "instruction": "nothing"}


@pytest.mark.slow
def test_an_input_that_a_family_declares_absent_is_not_tested(tmp_path: Path) -> None:
    policy = edited(make_deaf)
    policy.absent_inputs = frozenset({"instruction"})
    assert extracted(tmp_path / "run", policy).certificate["input_check"] == {"picture": "output"}


@pytest.mark.slow
def test_recordings_of_one_instruction_are_checked_too(tmp_path: Path) -> None:
    pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="the extra `datasets` is not installed")
    observed = prepare(SETTINGS).source.example("Put the cube on the red shape")
    picture = np.random.default_rng(0).integers(0, 256, observed.image.shape, np.uint8)
    frame = Observation(picture, observed.state, observed.instruction)
    write_recording(tmp_path / "frames", [[frame], [frame]])
    source = LeRobotSource(str(tmp_path / "frames"), cameras={"base": CAMERA})
    settings = ExtractSettings("pi0-tiny", source=source, accept_units=True)
    assert extracted(tmp_path / "sound", load_pi0_tiny(), settings).certificate["input_check"] == BOTH
    deaf = extracted(tmp_path / "deaf", edited(make_deaf), settings)
    assert deaf.certificate["input_check"] == {**BOTH, "instruction": "nothing"}


@pytest.mark.slow
def test_questions_are_checked_by_the_logits_of_their_answers(small_suite: Any, tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path / "tiny", model_type="prismatic")
    settings = AskSettings(
        "prismatic", str(folder), suite=small_suite.folder, categories=("color",), items=2,
        scene=SceneSpec(picture_size=(224, 224)), env_workers=0,
    )  # fmt: skip
    assert ask_run(settings, tmp_path / "shown").certificate["input_check"] == BOTH
    unseen = ask_run(settings.changed(picture="none"), tmp_path / "unseen")
    assert unseen.certificate["input_check"] == {"instruction": "output"}


class Uncapturable(PositionModel):
    """Declares both inputs, and has no layer that can be captured."""

    absent_inputs = frozenset()

    def tap(self, site: Site) -> Tap:
        raise NotImplementedError(site)


def by_length(question: str, option: str) -> float:
    return float(len(question) if option == "A" else 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("liking", "reaches"),
    [
        (by_length, {"picture": "not the output", "instruction": "output"}),
        (likes("A"), {"picture": "not the output", "instruction": "not the output"}),
    ],
)
def test_a_run_that_stores_nothing_is_checked_by_outputs_alone(
    liking: Liking, reaches: dict[str, str], small_suite: Any, tmp_path: Path
) -> None:
    settings = AskSettings(
        "stub", suite=small_suite.folder, categories=("color",), items=2, env_workers=0, accept_ignored_inputs=True
    )
    run = prepare(settings, None, Uncapturable(liking, always("A"))).run(tmp_path / "run")
    assert run.certificate["input_check"] == reaches
    assert "another picture changes no number of the first output" in input_notes(run.certificate)


@pytest.mark.slow
def test_a_scripted_answer_that_reads_nothing_is_refused_without_a_word_of_layers(
    small_suite: Any, tmp_path: Path
) -> None:
    settings = AskSettings("stub", suite=small_suite.folder, categories=("color",), items=2, env_workers=0)
    with pytest.raises(IgnoredInputsError, match=r"changed no number of the first output of stub; expected"):
        prepare(settings, None, Uncapturable(likes("A"), always("A"))).run(tmp_path / "run")


# -- what is changed --------------------------------------------------------------------------------------


def observation(instruction: str, image: "np.ndarray[Any, Any] | None" = None) -> Observation:
    picture = np.random.default_rng(0).integers(0, 256, (4, 4, 3), np.uint8) if image is None else image
    return Observation(picture, np.zeros(8, np.float32), instruction)


def letters(text: str) -> tuple[int, ...]:
    if "?" in text:
        raise InstructionError("no question is an instruction")
    return tuple(text.encode())


def test_other_words_of_as_many_tokens_are_tried_first_and_then_all_others() -> None:
    variants = vary_observation(observation("lift it"), ["drop it now", "lift it", "push it", "what?"], letters)
    texts = [variant.instruction for variant in variants["instruction"]]
    assert texts == ["push it", "it lift", "drop it now", "what?"]


def test_a_single_word_without_alternatives_and_a_picture_of_one_colour_are_not_varied() -> None:
    plain = np.full((4, 4, 3), 7, np.uint8)
    variants = vary_observation(observation("push", plain), ["push"], letters)
    assert {name: list(observations) for name, observations in variants.items()} == {
        "picture": [],
        "instruction": [],
    }


def test_a_blank_picture_changes_nothing_but_the_picture() -> None:
    clean = observation("lift it")
    (blank,) = vary_observation(clean, [], letters)["picture"]
    assert not same_input(clean, blank, PICTURE)
    assert len(np.unique(blank.image.reshape(-1, 3), axis=0)) == 1
    assert (blank.instruction, blank.state.tolist()) == (clean.instruction, clean.state.tolist())


def test_another_spelling_of_an_instruction_is_no_other_instruction() -> None:
    (words, *_) = vary_observation(observation("lift it"), ["Lift it.", "LIFT  IT", "push it"], letters)[
        "instruction"
    ]
    assert words.instruction == "push it"


GROUPS = 12


def frames(count: int = 24, spread: Sequence[float] = (1.0, 100.0)) -> list[Frame]:
    """Frames of few words, pictures and states, so that some are the same; two of each group."""
    rng = np.random.default_rng(0)
    return [
        Frame.of(
            f"frame {number}",
            Observation(
                np.full((2, 2, 3), 200 * rng.integers(2), np.uint8),
                (rng.normal(size=2) * spread).astype(np.float32),
                str(rng.choice(["lift", "push"])),
            ),
            f"group {number % GROUPS}",
            number,
        )
        for number in range(count)
    ]


def drawn(frames: Sequence[Frame], draws: int) -> set[int]:
    """The donors of the picture of the first frame, over several draws."""
    generators = map(np.random.default_rng, range(draws))
    return {donor for rng in generators for _, donor in draw_donors(frames, "picture", rng, of=[0])}


def plain(colour: int) -> Observation:
    shade = (10 * (colour % 25), 10 * (colour // 25), 0)  # far enough apart to be two pictures
    return Observation(np.full((2, 2, 3), shade, np.uint8), np.zeros(1, np.float32), "go")


@pytest.mark.parametrize("vary", ["instruction", "picture", "state"])
def test_a_donor_is_of_another_group_and_holds_another_value(vary: str) -> None:
    episode_frames = frames()
    pairs = draw_donors(episode_frames, vary, np.random.default_rng(0), 3)
    assert {frame for frame, _ in pairs} == set(range(len(episode_frames)))
    assert len(pairs) == len(set(pairs)) == 3 * len(episode_frames)
    for frame, donor in pairs:
        assert episode_frames[frame].group != episode_frames[donor].group
        assert not same_input(episode_frames[frame].observation, episode_frames[donor].observation, vary)


def test_the_donor_of_a_picture_is_one_of_the_nearest_in_spreads_of_every_number_of_the_state() -> None:
    episode_frames = frames(60)
    states = np.stack([frame.state for frame in episode_frames])
    scaled = states / states.std(axis=0)
    candidates = [
        number
        for number, frame in enumerate(episode_frames)
        if frame.group != episode_frames[0].group
        and not same_input(frame.observation, episode_frames[0].observation, "picture")
    ]
    nearest = sorted(candidates, key=lambda number: float(np.linalg.norm(scaled[number] - scaled[0])))[:NEAREST]
    assert drawn(episode_frames, 40) == set(nearest)


def test_frames_that_are_equally_near_are_all_drawn() -> None:
    episode_frames = [Frame.of(str(number), plain(number), str(number), 0) for number in range(3 * NEAREST)]
    assert drawn(episode_frames, 300) == set(range(1, 3 * NEAREST))


def test_a_picture_beyond_the_nearest_is_never_read() -> None:
    """Pictures of recordings are decoded one by one."""
    read: list[int] = []

    def observe(frame: Frame) -> Observation:
        read.append(frame.number)
        return plain(frame.number)

    episode_frames = [
        Frame(f"{at}", f"{at}", 0, "go", np.array([float(at)]), observe, number=at) for at in range(100)
    ]
    ((_, donor),) = draw_donors(episode_frames, "picture", np.random.default_rng(0), of=[0])
    assert donor in range(1, NEAREST + 1)
    assert set(read) == set(range(NEAREST + 1))


def test_a_frame_without_a_donor_is_left_out() -> None:
    episode_frames = [Frame.of(str(number), plain(0), str(number), 0) for number in range(3)]
    for vary in ("instruction", "picture", "state"):
        assert draw_donors(episode_frames, vary, np.random.default_rng(0)) == []
