"""What the clients of LIBERO, DROID, ALOHA and Bridge send, mapped to the observation of a model."""

from typing import Any

import numpy as np
import pytest

from probe_kit.errors import ObservationError, UsageError
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.extract.sources.served_source import ServedSource
from probe_kit.serve.codec import pack, unpack

RNG = np.random.default_rng(0)
FRONT, WRIST = (RNG.integers(0, 256, (224, 224, 3), np.uint8) for _ in range(2))
NUMBERS = RNG.normal(size=14)
LIBERO = {
    "observation/image": FRONT, "observation/wrist_image": WRIST,
    "observation/state": NUMBERS[:8], "prompt": "open it",
}  # fmt: skip
DROID = {
    "observation/exterior_image_1_left": FRONT, "observation/wrist_image_left": WRIST,
    "observation/joint_position": NUMBERS[:7], "observation/gripper_position": NUMBERS[7:8], "prompt": b"open it",
}  # fmt: skip
ALOHA = {
    "images": {"cam_high": np.moveaxis(FRONT, 2, 0), "cam_left_wrist": np.moveaxis(WRIST, 2, 0)},
    "state": NUMBERS,
}
BRIDGE = {"observation/image": FRONT, "prompt": "open it"}


def source(model: tuple[str, ...] = ("base", "wrist"), **choices: Any) -> ServedSource:
    opened = ServedSource.open(ServedSettings(**choices), False)
    opened.model_cameras = model
    return opened


@pytest.mark.parametrize(
    ("sent", "choices", "state"),
    [
        (
            LIBERO,
            {
                "cameras": ["base=observation/image", "wrist=observation/wrist_image"],
                "state": "observation/state",
            },
            NUMBERS[:8],
        ),
        (
            DROID,
            {
                "cameras": ["base=observation/exterior_image_1_left", "wrist=observation/wrist_image_left"],
                "state": "observation/joint_position,observation/gripper_position",
            },
            NUMBERS[:8],
        ),
        (
            ALOHA,
            {
                "cameras": ["base=images/cam_high", "wrist=images/cam_left_wrist"], "state": "state",
                "instruction": "open it",
            },
            NUMBERS,
        ),
    ],
    ids=["libero", "droid", "aloha"],
)  # fmt: skip
def test_an_observation_is_mapped_as_its_client_builds_it(
    sent: dict[str, Any], choices: dict[str, Any], state: np.ndarray
) -> None:
    received = source(**choices).receive(unpack(pack(sent)))
    observation = received.observation
    assert (observation.image == FRONT).all()
    assert (observation.cameras["wrist"] == WRIST).all()
    assert observation.state.tobytes() == state.astype(np.float32).tobytes()
    assert observation.instruction == "open it"
    assert observation.image.flags.writeable


def test_bridges_client_sends_no_state_and_is_refused_by_name_where_one_is_read() -> None:
    with pytest.raises(ObservationError, match="no state 'observation/state'"):
        source(("base",), state="observation/state").receive(BRIDGE)
    without = source(("base",), cameras={"base": "observation/image"}).receive(BRIDGE)
    assert not without.observation.state.any()


def test_one_camera_gets_the_only_picture_and_equal_names_their_own() -> None:
    assert (source(("base",)).receive(BRIDGE).observation.image == FRONT).all()
    mapped = source(("cam_high", "cam_left_wrist"), instruction="open it").receive(ALOHA)
    assert (mapped.observation.cameras["cam_left_wrist"] == WRIST).all()
    with pytest.raises(ObservationError, match="the observation has observation/image, observation/wrist_image"):
        source(("base",)).receive(LIBERO)


def test_pictures_are_rotated_for_the_model_and_kept_as_they_arrived() -> None:
    turned = source(("base",), cameras={"base": "observation/image"}, rotations=["base=90"]).receive(BRIDGE)
    assert (turned.observation.image == np.rot90(FRONT)).all()
    assert (turned.pictures["base"] == FRONT).all()


@pytest.mark.parametrize(
    "choices",
    [
        {"cameras": ["base=a", "base=b"]},
        {"cameras": ["base=a", "wrist=a"]},
        {"state": "a,a,b", "cameras": ["base"]},
        {"instruction": " "},
        {"source_name": ""},
        {"pause": 0},
        {"every": 0},
        {"rule": "always"},
    ],
    ids=str,
)
def test_settings_that_no_server_can_have_are_refused(choices: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        ServedSettings(**choices)
