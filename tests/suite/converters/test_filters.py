import numpy as np
import pytest
from PIL import Image

from probe_kit.suite.converters import ConvertOptions
from probe_kit.suite.converters.rewriting import picture_problem, text_problem
from probe_kit.suite.pictures import look_of

OPTIONS = ConvertOptions()


def noise(width: int, height: int) -> Image.Image:
    pixels = np.random.default_rng(0).integers(0, 256, (height // 20 + 1, width // 20 + 1, 3), dtype=np.uint8)
    return Image.fromarray(pixels).resize((width, height), Image.Resampling.BICUBIC)


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (noise(120, 100), None),
        (noise(120, 99), "picture too small"),
        (noise(251, 100), "picture too long"),
        (Image.new("RGB", (120, 120), "red"), "picture nearly blank"),
    ],
)
def test_pictures_are_judged_by_size_shape_and_contrast(image: Image.Image, problem: str | None) -> None:
    assert picture_problem(image, OPTIONS) == problem


def test_a_source_of_small_pictures_may_have_its_own_limit() -> None:
    assert picture_problem(noise(48, 48), OPTIONS, least_side=48) is None


def test_fine_detail_is_lost_on_a_tile_and_coarse_detail_is_not() -> None:
    options = ConvertOptions(legible_at=40)
    fine = Image.fromarray(np.random.default_rng(0).integers(0, 256, (400, 400, 3), dtype=np.uint8))
    assert picture_problem(fine, options) == "picture not legible on a tile"
    assert picture_problem(noise(100, 100), options) is None


def test_a_re_encoded_picture_looks_the_same_and_another_colour_does_not() -> None:
    picture = noise(200, 200)
    smaller = picture.resize((150, 150))
    red, green, blue = picture.split()
    assert look_of(picture).same_as(look_of(smaller))
    assert not look_of(picture).same_as(look_of(Image.merge("RGB", (blue, green, red))))


@pytest.mark.parametrize(
    ("instruction", "problem"),
    [
        ("Put the cube on the red shape", None),
        ("Put the cube on the " + "very " * 8 + "red shape", "instruction has too many words"),
        ("Put the cube on the " + "x" * 61, "instruction too long"),
        ("Put the cube. Then stop", "instruction is more than one sentence"),
        ("Put the cube on the red shape.", "instruction ends with a period"),
        ("Put the cube on the café", "instruction is not plain ASCII"),
        ("Put the cube on the left shape", "instruction names a side"),
    ],
)
def test_instructions_are_short_plain_single_sentences(instruction: str, problem: str | None) -> None:
    assert text_problem(instruction, "red shape", OPTIONS) == problem


def test_other_alphabets_are_allowed_on_request() -> None:
    assert text_problem("Put the cube on the café", "café", ConvertOptions(allow_unicode=True)) is None
