import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.models.xiaomi import look, prompt, robot_of


def test_the_prompt_is_the_released_one_to_the_letter() -> None:
    assert prompt("put the cube on the star", "Base View") == (
        "<|im_start|>user\nThe following observations are captured from multiple views.\n"
        "# Base View\n<|vision_start|><|image_pad|><|vision_end|>\n"
        "Generate robot actions for the task:\nPut the cube on the star. /no_cot<|im_end|>\n"
        "<|im_start|>assistant\n<cot></cot><|im_end|>\n"
    )


def test_only_the_first_letter_changes_and_no_stop_is_doubled() -> None:
    assert "\nPut it on Mr. X's A. /no_cot" in prompt("put it on Mr. X's A.", "Base View")
    assert "\nWhich one? /no_cot" in prompt("which one?", "Base View")


@pytest.mark.parametrize(("robot", "shape"), [("bridge_delta", (256, 256, 3)), ("fractal_delta", (256, 320, 3))])
def test_the_rim_is_cut_off_and_the_size_kept(robot: str, shape: tuple[int, ...]) -> None:
    inside = np.full(shape, 90, np.uint8)
    inside[:4], inside[-4:], inside[:, :4], inside[:, -4:] = 255, 255, 255, 255
    seen = look(inside, robot_of(robot))
    assert seen.shape == shape
    assert (seen == 90).all()


def test_a_whole_frame_is_squeezed_not_cut() -> None:
    frame = np.zeros((480, 640, 3), np.uint8)
    frame[:, 320:] = 200
    seen = look(frame, robot_of("bridge_delta"))
    assert seen[:, :120].max() == 0
    assert seen[:, 136:].min() == 200


def test_the_states_of_the_two_robots() -> None:
    state = np.array([0.3, 0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.75], np.float32)
    np.testing.assert_array_equal(robot_of("bridge_delta").state(state), state)
    half = np.sqrt(0.5)
    fractal = robot_of("fractal_delta").state(state)
    np.testing.assert_allclose(fractal, [0.3, 0.1, 0.2, 0.0, half, 0.0, half, 0.25], atol=1e-6)
    assert fractal.dtype == np.float32


def test_a_robot_with_other_cameras_is_refused() -> None:
    with pytest.raises(UsageError, match="libero_all"):
        robot_of("libero_all")
