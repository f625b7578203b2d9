from probe_kit.models.magma import shipped_statistics


def test_the_shipped_statistics_are_the_clients_to_the_last_digit() -> None:
    """Known places of the table that the evaluation client holds in its code; rounded ones would not do."""
    action = shipped_statistics()["bridge_orig"]["action"]
    assert (action["q01"][5], action["q99"][0]) == (-0.20718276381492615, 0.028309678435325586)
    assert [len(action[name]) for name in ("q01", "q99", "mask")] == [7, 7, 7]
    assert action["mask"] == [True] * 6 + [False]
