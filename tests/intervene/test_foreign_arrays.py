"""Stored arrays of an intervention that say something else than they can are damage, and named by their file."""

from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import RunDamagedError
from probe_kit.intervene.kinds.attention import AttentionShares, PatchAttention
from probe_kit.intervene.outcomes import ConditionOutcomes
from probe_kit.intervene.stored import EPISODES, Measurement

NAMES = np.array(["a", "b", "c"])
RECORDS: dict[type, dict[str, Any]] = {
    ConditionOutcomes: {
        "conditions": np.array(["clean", "image_swap"]), "episodes": NAMES, "items": NAMES, "groups": NAMES,
        "categories": NAMES, "sides": NAMES, "displacement": np.zeros((2, 3)), "edit_log": np.zeros((2, 3, 5)),
        "max_action_change": np.zeros((2, 3)), "replay_error": np.zeros(3), "toward": np.zeros((2, 3)),
    },
    AttentionShares: {
        "roles": NAMES[:2], "episodes": NAMES, "groups": NAMES, "categories": NAMES, "sides": NAMES,
        "calls": np.arange(3), "mass": np.zeros((3, 4, 1, 2, 2), np.float32),
    },
    PatchAttention: {
        "episodes": NAMES, "calls": np.arange(3), "weights": np.zeros((3, 4, 2), np.float16),
        "cameras": NAMES[:2], "boxes": np.zeros((2, 4), np.float32),
    },
}  # fmt: skip


def measurement(content: bytes) -> Measurement:
    run = SimpleNamespace(location="RUN", seed_text="seed")
    return Measurement(run, {"kind": "image_swap"}, lambda _: content, (EPISODES,), "0123")  # type: ignore[arg-type]


def packed(arrays: dict[str, Any], **options: Any) -> bytes:
    file = BytesIO()
    np.savez(file, **options, **arrays)
    return file.getvalue()


def read(record: type, content: bytes) -> dict[str, Any]:
    return measurement(content).arrays(EPISODES, record, record.AXES)  # type: ignore[attr-defined]


FORGED = {
    "other lengths": lambda array: np.concatenate([array, array]),
    "an axis more": lambda array: array[None],
    "no axes": lambda array: array.reshape(-1)[0],
    "objects": lambda array: np.full(array.shape, None, object),
    "another type": lambda array: np.zeros(array.shape, "f8" if array.dtype.kind != "f" else "c16"),
    "bytes": lambda array: np.zeros(array.shape, "S4"),
}


@pytest.mark.parametrize("record", RECORDS)
def test_arrays_as_they_were_written_are_read(record: type) -> None:
    assert read(record, packed(RECORDS[record])).keys() == RECORDS[record].keys()


@pytest.mark.parametrize("record", RECORDS)
@pytest.mark.parametrize("forge", FORGED)
def test_a_forged_array_is_damage_by_name(record: type, forge: str) -> None:
    for name, array in RECORDS[record].items():
        content = packed({**RECORDS[record], name: FORGED[forge](array)})
        with pytest.raises(RunDamagedError, match=f"RUN/interventions/0123/{EPISODES} "):
            read(record, content)


@pytest.mark.parametrize("content", [b"", b"no archive", packed({"episodes": NAMES})[:-30], packed({"x": NAMES})])
def test_a_file_of_no_such_arrays_is_damage_by_name(content: bytes) -> None:
    with pytest.raises(RunDamagedError, match=f"RUN/interventions/0123/{EPISODES} "):
        _ = measurement(content).outcomes


def test_outcomes_whose_first_condition_is_not_the_clean_one_are_damage() -> None:
    arrays = RECORDS[ConditionOutcomes]
    assert measurement(packed(arrays)).outcomes.conditions == ("clean", "image_swap")
    for names in (["image_swap", "clean"], ["x", "y"]):
        with pytest.raises(RunDamagedError, match="as its first condition; expected 'clean'"):
            _ = measurement(packed({**arrays, "conditions": np.array(names)})).outcomes
