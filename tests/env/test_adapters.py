"""Observations in the formats of other toolkits, and pictures as a GIF."""

import numpy as np
import pytest
from PIL import Image

from probe_kit.env.scripted import save_gif, to_lerobot, to_openpi


@pytest.fixture
def observation():
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (480, 640, 3), np.uint8)
    return {"pixels": {"image": image}, "agent_pos": random.random(8, np.float32)}


def test_names_and_values_equal_those_lerobot_makes_itself(observation):
    theirs = pytest.importorskip("lerobot.envs.utils").preprocess_observation(observation)
    ours = to_lerobot(observation)
    assert set(ours) == set(theirs)
    for name, value in ours.items():
        np.testing.assert_array_equal(value[None], theirs[name].numpy())


def test_batches_of_a_vector_environment_keep_their_first_dimension():
    batch = {"pixels": {"image": np.zeros((4, 480, 640, 3), np.uint8)}, "agent_pos": np.zeros((4, 8))}
    shapes = {name: value.shape for name, value in to_lerobot(batch).items()}
    assert shapes == {"observation.images.image": (4, 3, 480, 640), "observation.state": (4, 8)}


def test_openpi_gets_the_whole_picture_padded_to_a_square(observation):
    observation["pixels"]["image"][:] = 200
    request = to_openpi(observation, "Put the cube on the cat")
    image = request["observation/image"]
    assert (image.shape, image.dtype) == ((224, 224, 3), np.uint8)
    rows = image.any(axis=(1, 2))
    assert (rows.sum(), rows[:28].any(), rows[-28:].any()) == (168, False, False)
    assert request["prompt"] == "Put the cube on the cat"
    np.testing.assert_array_equal(request["observation/state"], observation["agent_pos"])


def test_a_recording_has_every_picture_and_plays_in_real_time(tmp_path):
    pictures = [np.full((48, 64, 3), shade, np.uint8) for shade in (0, 90, 180, 250)]
    save_gif(tmp_path / "episode.gif", pictures, fps=5)
    with Image.open(tmp_path / "episode.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"], gif.info["loop"]) == (4, (64, 48), 200, 0)
        gif.seek(2)
        assert gif.convert("RGB").getpixel((5, 5)) == (180, 180, 180)


def test_a_recording_of_nothing_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no pictures"):
        save_gif(tmp_path / "empty.gif", [])
    assert not (tmp_path / "empty.gif").exists()
