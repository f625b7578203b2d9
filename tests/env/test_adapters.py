import numpy as np
import pytest

from probe_kit.env.adapters import to_lerobot, to_openpi


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
