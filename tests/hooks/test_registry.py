import pytest

from probe_kit.errors import CheckpointError, UnknownModelError
from probe_kit.hooks import families, load_policy


def test_an_unknown_model_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownModelError, match="Did you mean 'pi0-tiny'"):
        load_policy("pi0-tyni")


def test_the_embedded_default_says_that_its_weights_are_random() -> None:
    assert "random weights" in families()["pi0-tiny"].notes
    assert load_policy("pi0-tiny").card.random_weights


def test_a_checkpoint_folder_that_is_not_there_is_refused() -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        load_policy("pi0", "./nowhere")
