import pytest

from probe_kit.errors import CheckpointError
from probe_kit.models.qwen import image_slots


def test_every_picture_gets_its_own_number_of_tokens() -> None:
    assert image_slots([1, 9, 2, 9, 3], 9, [3, 1]) == [1, 9, 9, 9, 2, 9, 3]


def test_another_number_of_slots_than_pictures_is_an_error() -> None:
    with pytest.raises(CheckpointError, match="2 image tokens"):
        image_slots([9, 9], 9, [4])
