import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks import Family, Option
from probe_kit.hooks.contract.declared import check_options, read_pairs

DECLARED = (
    Option("size", int, "Of something.", "8", choices=(8, 16)),
    Option("crop", bool, "Whether.", "false"),
    Option("scale", float, "How much."),
    Option("prompt", str, "Which."),
)


def test_texts_become_values_of_the_declared_kind() -> None:
    given = read_pairs(["size=16", "crop=Yes", "scale=2", "prompt=a=b"])
    assert check_options("mine", DECLARED, given) == {"size": 16, "crop": True, "scale": 2.0, "prompt": "a=b"}


def test_values_that_have_the_kind_already_pass_and_whole_numbers_are_numbers() -> None:
    found = check_options("mine", DECLARED, {"size": 8, "crop": False, "scale": 3})
    assert found == {"size": 8, "crop": False, "scale": 3.0}
    assert type(found["scale"]) is float


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sice": "8"}, "no model option sice; it has crop, prompt, scale, size. Did you mean size"),
        ({"size": "9"}, "expected one of 8, 16"),
        ({"size": "eight"}, "expected a whole number"),
        ({"size": True}, "expected a whole number"),
        ({"crop": "maybe"}, "expected true or false"),
        ({"crop": 1}, "expected true or false"),
        ({"prompt": 3}, "expected text"),
    ],
)
def test_what_was_not_declared_is_refused(given: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_options("mine", DECLARED, given)


@pytest.mark.parametrize("pair", ["size", "=8", "  =8"])
def test_a_pair_without_key_and_value_is_refused(pair: str) -> None:
    with pytest.raises(UsageError, match="not KEY=VALUE"):
        read_pairs([pair])


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="given twice"):
        read_pairs(["size=8", "size=16"])


def test_a_family_of_the_former_contract_is_told_what_to_change() -> None:
    with pytest.raises(UsageError, match=r"Option\('unnorm_key', str"):
        Family("mine", "of 0.2", None, "mine:load", options=("unnorm_key",))  # type: ignore[arg-type]
