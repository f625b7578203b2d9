import numpy as np
import pytest

from probe_kit.models.internvla import dino_pixels, look, prompt


def test_the_prompt_is_qwens_chat_with_the_picture_first_and_the_instruction_in_lower_case() -> None:
    assert prompt("Put the Cube on the star", None) == (
        "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
        "<|im_start|>user\n<|vision_start|><|image_pad|><|vision_end|>put the cube on the star<|im_end|>\n"
        "<|im_start|>assistant\n"
    )
    assert "<|vision_end|>Your task is go. Then.<|im_end|>" in prompt("Go", "Your task is {instruction}. Then.")


def test_a_frame_is_squeezed_by_area() -> None:
    frame = np.zeros((448, 448, 3), np.uint8)
    frame[::2, ::2] = 200
    assert look(frame, None).shape == (224, 224, 3)
    assert (look(frame, None) == 50).all()
    assert look(frame, (112, 56)).shape == (56, 112, 3)


@pytest.mark.parametrize(
    ("shape", "expected"), [((224, 224), (56, 56)), ((100, 50), (112, 56)), ((56, 90), (56, 90))]
)
def test_the_shorter_side_of_dinos_picture_is_fixed(shape: tuple[int, int], expected: tuple[int, int]) -> None:
    white = np.full((*shape, 3), 255, np.uint8)
    pixels = dino_pixels(white, 56)
    assert tuple(pixels.shape) == (3, *expected)
    np.testing.assert_allclose(pixels[:, 0, 0], [(1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225])
