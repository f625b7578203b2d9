"""Values of an input: what differs by no more than its control is one value, and no exchange."""

from collections.abc import Sequence
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from probe_kit.extract.sources.inputs import (
    Frame,
    InputComparison,
    describe_spellings,
    draw_donors,
    normal_form,
    values_of_texts,
)
from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite.pictures import through_jpeg

RED = "Put the cube on the red shape"


def frames(observations: Sequence[Observation], other_words: str = "") -> list[Frame]:
    built_frames = [
        Frame.of(f"{at}", observation, f"group {at}", at) for at, observation in enumerate(observations)
    ]
    if other_words:
        built_frames[0] = Frame(
            "0",
            "group 0",
            0,
            built_frames[0].instruction,
            built_frames[0].state,
            built_frames[0].observe,
            other_words=other_words,
        )
    return built_frames


def observed(picture: np.ndarray | None = None, state: float = 0.0, words: str = RED) -> Observation:
    image = np.zeros((16, 16, 3), np.uint8) if picture is None else picture
    return Observation(image, np.array([state, 1.0], np.float32), words)


def differ(first: Observation, second: Observation, vary: str) -> bool:
    return InputComparison.of(frames([first, second]), vary).differ(0, 1)


def room(block: int = 30) -> np.ndarray:
    """A picture with edges and colors, and a block whose place is given."""
    picture = np.full((64, 64, 3), (200, 180, 150), np.uint8)
    picture[40:, :] = (90, 60, 40)
    picture[20:28, block : block + 8] = (200, 30, 30)
    return picture


def compressed(picture: np.ndarray, quality: int) -> np.ndarray:
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality)
    return np.asarray(Image.open(buffer))


@pytest.mark.parametrize(
    "other",
    [
        "put the cube on the red shape",
        "Put the cube on the red shape .",
        "PUT THE CUBE, on the red shape!",
        " Put  the\u00a0cube on the\tred shape\n",
        "Ｐut the cube on the red shape",
        "Put\u200b the cube on the red-shape…",
        "put_the_cube_on_the_red_shape",
    ],
)
def test_texts_that_differ_in_case_space_punctuation_or_form_are_one_instruction(other: str) -> None:
    assert normal_form(other) == normal_form(RED)
    assert not differ(observed(), observed(words=other), "instruction")
    assert draw_donors(frames([observed(), observed(words=other)]), "instruction", np.random.default_rng(0)) == []
    (sentence,) = describe_spellings([RED, other, RED])
    assert repr(other) in sentence


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("red", "blue"),
        ("1.5 cm", "15 cm"),
        ("turn -5", "turn 5"),
        ("cups 1 2", "cups 12"),
        ("cafe", "café"),
        ("की", "क"),
    ],
)
def test_texts_that_differ_in_a_word_a_number_or_a_letter_are_two_instructions(text: str, other: str) -> None:
    assert normal_form(text) != normal_form(other)
    assert describe_spellings([text, other]) == []


def test_forms_of_unicode_and_letters_with_marks_are_equal() -> None:
    assert normal_form("caf\u00e9") == normal_form("cafe\u0301")
    assert normal_form("STRASSE") == normal_form("straße")
    assert normal_form("press `A`") == normal_form("press ´A´") == normal_form("Press “a”.")
    assert normal_form("move −5 cm") == normal_form("move -5 cm") != normal_form("move 5 cm")
    assert normal_form("cups 2–3") == normal_form("cups 2-3")


def test_other_words_of_one_meaning_are_one_value_with_the_task_that_they_stand_for() -> None:
    texts = [RED, "Set the block on the red tile", "Put the cube on the blue shape"]
    assert values_of_texts(texts, [(RED, texts[1])]).tolist() == [0, 0, 1]
    episode_frames = frames([observed(words=text) for text in texts], other_words=texts[1])
    assert {
        donor for _, donor in draw_donors(episode_frames, "instruction", np.random.default_rng(0), 3, [0])
    } == {2}


@pytest.mark.parametrize("quality", [95, 90, 75])
def test_a_picture_that_was_compressed_again_is_no_other_picture_and_a_moved_block_is_one(quality: int) -> None:
    clean = room()
    assert not differ(observed(clean), observed(compressed(clean, quality)), "picture")
    assert not differ(observed(clean), observed(through_jpeg(clean)), "picture")
    assert differ(observed(clean), observed(room(33)), "picture")
    assert differ(observed(compressed(clean, quality)), observed(compressed(room(33), quality)), "picture")


def test_noise_of_a_sensor_is_no_other_picture_and_pictures_of_noise_are() -> None:
    rng = np.random.default_rng(0)
    noisy = [np.clip(room() + rng.integers(-2, 3, (64, 64, 3)), 0, 255).astype(np.uint8) for _ in range(2)]
    assert not differ(observed(noisy[0]), observed(noisy[1]), "picture")
    drawn = [rng.integers(0, 256, (64, 64, 3)).astype(np.uint8) for _ in range(2)]
    assert differ(observed(drawn[0]), observed(drawn[1]), "picture")
    assert differ(observed(np.zeros((4, 4, 3), np.uint8)), observed(np.zeros((9, 4, 3), np.uint8)), "picture")


def test_states_one_step_of_the_control_apart_are_one_value() -> None:
    """The control moves a state by a hundredth of its spread."""
    states = [0.0, 0.01, 1.0, 1.01, 2.0]
    episode_frames = frames([observed(state=state * 100) for state in states])
    compared = InputComparison.of(episode_frames, "state")
    assert compared.values(5).tolist() == [0, 0, 1, 1, 2]
    assert {donor for _, donor in draw_donors(episode_frames, "state", np.random.default_rng(0), 5, [0])} == {
        2,
        3,
        4,
    }
    near = np.nextafter(np.float32(0.4), np.float32(1))
    assert not differ(observed(state=0.4), observed(state=float(near)), "state")
    assert differ(observed(state=0.4), observed(state=0.401), "state")


def test_frames_with_further_words_are_donors_with_their_own_pictures_and_states() -> None:
    episode_frames = frames([observed(state=float(at)) for at in range(3)])
    donor = episode_frames[1].with_instruction("Lift it")
    assert (donor.group, donor.observation.instruction) == (episode_frames[1].group, "Lift it")
    assert donor.observation.image is episode_frames[1].observation.image
    assert draw_donors([*episode_frames, donor], "instruction", np.random.default_rng(0), 1, [0]) == [(0, 3)]
