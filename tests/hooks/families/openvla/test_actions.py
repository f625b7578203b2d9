import numpy as np
import pytest

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.openvla.adapter import ActionTokens
from probe_kit.hooks.families.shared.action_statistics import ActionStatistics

TOKENS = ActionTokens(vocabulary=32000, bins=256)


def entry(**changes: object) -> dict[str, object]:
    return {"action": {"q01": [-2.0, 0.0], "q99": [4.0, 1.0], "mask": [True, False]} | changes}


def test_ids_count_down_from_the_end_of_the_vocabulary() -> None:
    values = TOKENS.values(np.array([31999, 31872, 31744]))
    np.testing.assert_allclose(values, [-1 + 1 / 255, 0.0, 1 - 1 / 255], atol=1e-12)


def test_encoding_as_in_training_and_decoding_stays_within_half_a_bin() -> None:
    """Training digitises the action against 256 edges and subtracts the number from the vocabulary."""
    actions = np.linspace(-1, 1, 1001)
    ids = 32000 - np.digitize(actions, np.linspace(-1, 1, 256))
    assert TOKENS.is_action(ids).all()
    assert np.abs(TOKENS.values(ids) - actions).max() <= 1 / 255 + 1e-12


def test_ids_that_name_no_bin_are_known_as_such_and_count_as_the_nearest() -> None:
    ids = np.array([5, 31743, 32010])
    assert not TOKENS.is_action(ids).any()
    np.testing.assert_allclose(TOKENS.values(ids), [1 - 1 / 255, 1 - 1 / 255, -1 + 1 / 255])


def test_masked_dimensions_stay_as_decoded_and_others_span_their_quantiles() -> None:
    statistics = ActionStatistics.choose({"mine": entry()}, None)
    np.testing.assert_allclose(
        statistics.restore(np.array([[-1, -1], [0, 0.5], [1, 1]])), [[-2, -1], [1, 0.5], [4, 1]]
    )


def test_the_only_data_set_needs_no_name_and_several_have_to_be_chosen_from() -> None:
    known = {"bridge_orig": entry(), "other": entry()}
    assert ActionStatistics.choose(known, "other").key == "other"
    with pytest.raises(UsageError, match="with -M unnorm_key=NAME: bridge_orig, other"):
        ActionStatistics.choose(known, None)


@pytest.mark.parametrize(
    ("statistics", "message"),
    [
        ({}, "no physical unit"),
        ({"mine": {"action": {"q01": [0.0]}}}, "lack q99"),
        ({"mine": entry(q99=[1.0])}, "one finite number"),
        ({"mine": entry(q99=[1.0, float("nan")])}, "one finite number"),
    ],
)
def test_statistics_that_cannot_be_used_are_an_error(statistics: dict, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        ActionStatistics.choose(statistics, None)
