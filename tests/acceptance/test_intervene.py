"""`probe-kit intervene`, every kind, on a few questions of the embedded policy.

The policy decides by one block's keys and values (`kv.02`), and nothing reads its last backbone layer.
"""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import probe_kit as pk
from tests.acceptance.product import Answer, probe_kit

FEW = ("--items", "2", "--format", "json")
KINDS: dict[str, tuple[str, ...]] = {
    "image-swap": ("--items", "12", "--format", "json"),
    "instruction-swap": FEW,
    "interchange": (*FEW, "--sites", "backbone.03,kv.02", "--roles", "all"),
    "joint": (*FEW, "--sites", "kv.01,kv.02", "--roles", "image,language"),
    "attribution": (*FEW, "--sites", "kv.*", "--roles", "image", "--controls", "1"),
    "steer": (*FEW, "--sites", "backbone.02", "--roles", "image", "--coefficients", "2", "--controls", "1"),
    "closed-loop": (*FEW, "--sites", "backbone.02", "--direction", "none", "--controls", "0"),
    "erase": ("--items", "6", "--format", "json", "--sites", "backbone.02", "--controls", "1"),
    "attention": FEW,
}


@pytest.fixture(scope="module")
def intervened(played: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(played, tmp_path_factory.mktemp("intervened") / "run"))


@pytest.fixture(scope="module")
def answers() -> dict[str, Answer]:
    """What each kind printed, made when it is first needed."""
    return {}


def effects(kind: str, run: Path, answers: dict[str, Answer]) -> list[dict[str, Any]]:
    """The rows that a kind prints as JSON. Each kind is run once."""
    if kind not in answers:
        answers[kind] = probe_kit("intervene", run, "--kind", kind, *KINDS[kind])
    rows = answers[kind].json()["effects"]
    assert rows
    assert {row["category"] for row in rows} == {"color"}
    stored = pk.load_effects(pk.open_run(run), kind=kind)
    assert stored.kind == kind
    assert len(stored.table) == len(rows)
    assert set(stored.table.columns) == set(rows[0])
    return list(rows)


def test_these_are_the_kinds_that_the_command_lists() -> None:
    listed = probe_kit("intervene", "--help").text
    for kind in KINDS:
        assert re.search(rf"\b{kind}\b", listed), kind


def test_swapped_images_show_that_the_policy_uses_the_answer(intervened: Path, answers: dict[str, Answer]) -> None:
    (row,) = effects("image-swap", intervened, answers)
    assert (row["n_episodes"], row["n_items"], row["n_groups"]) == (24, 12, 6)
    assert row["follow_rate"] == 1
    assert row["reversal_rate"] == 0
    assert row["reach_share"] == pytest.approx(1, abs=0.1)
    assert row["net_follow_rate_ci_low"] <= row["net_follow_rate"] <= row["net_follow_rate_ci_high"]
    assert row["reach_share_ci_low"] <= row["reach_share"] <= row["reach_share_ci_high"]
    assert row["follow_p"] == pytest.approx(2**-6), "an exact sign test of six groups"
    assert row["verdict"] == "used"


@pytest.mark.slow
def test_a_swapped_instruction_changes_the_action_too(intervened: Path, answers: dict[str, Answer]) -> None:
    (row,) = effects("instruction-swap", intervened, answers)
    assert row["instruction_changed"] == row["images_changed"] == 1
    assert row["instruction"] > 0.2, "metres: half the table"
    assert row["noise"] < 0.05 * row["instruction"]


def test_patched_keys_and_values_carry_the_answer_and_the_last_layer_is_not_read(
    intervened: Path, answers: dict[str, Answer]
) -> None:
    rows = {row["sites"]: row for row in effects("interchange", intervened, answers)}
    unread, read = rows["backbone.03"], rows["kv.02"]
    assert unread["max_action_change"] == 0
    assert unread["fires"] > unread["no_op_fires"] == 0, "tokens moved all the same"
    assert unread["relative_change"] > 0.01
    assert read["net"] == 1
    assert read["mean_displacement"] > 0.2


@pytest.mark.slow
def test_joint_places_are_patched_alone_and_together(intervened: Path, answers: dict[str, Answer]) -> None:
    rows = effects("joint", intervened, answers)
    cells = [row["cells"] for row in rows if row["part"] == "cell"]
    assert len(cells) == len(set(cells)) == 4
    assert {(block, role) for cell in cells for block, role in [cell.split()]} == {
        (block, role) for block in ("kv.01", "kv.02") for role in ("image", "language")
    }


@pytest.mark.slow
def test_attribution_screens_places_and_patches_its_anchors_exactly(
    intervened: Path, answers: dict[str, Answer]
) -> None:
    rows = effects("attribution", intervened, answers)
    assert any(row["is_anchor"] for row in rows)
    assert {row["sites"] for row in rows if not row["is_anchor"]} >= {"kv.00", "kv.01", "kv.02"}


@pytest.mark.slow
def test_steering_without_strength_changes_nothing_and_with_it_moves_tokens_as_far_as_its_control(
    intervened: Path, answers: dict[str, Answer]
) -> None:
    rows = effects("steer", intervened, answers)
    (without,) = (row for row in rows if float(row["coefficient"]) == 0)
    assert without["max_action_change"] == without["relative_change"] == 0
    moved = [row for row in rows if float(row["coefficient"]) == 2]
    assert sorted(row["is_control"] for row in moved) == [False, True]
    assert all(row["max_action_change"] > 0 for row in moved)
    assert moved[0]["relative_change"] == pytest.approx(moved[1]["relative_change"], rel=1e-3)


@pytest.mark.slow
def test_in_a_closed_loop_the_patched_policy_places_the_cube_on_the_other_side(
    intervened: Path, answers: dict[str, Answer]
) -> None:
    rows = {row["sites"]: row for row in effects("closed-loop", intervened, answers)}
    assert rows["clean"]["correct"] == 1
    assert rows["clean"]["max_action_change"] == 0
    assert rows["image_swap"]["wrong"] == 1
    assert rows["backbone.02"]["wrong"] == 1
    assert rows["backbone.02"]["fires"] > 0


@pytest.mark.slow
def test_an_erased_answer_is_compared_with_an_equally_large_random_subspace(
    intervened: Path, answers: dict[str, Answer]
) -> None:
    rows = {row["direction"]: row for row in effects("erase", intervened, answers)}
    assert rows["none"]["max_action_change"] == 0
    (control,) = (row for row in rows.values() if row["is_control"])
    (erased,) = (row for name, row in rows.items() if name != "none" and not row["is_control"])
    assert erased["max_action_change"] > control["max_action_change"] > 0
    assert erased["right"] < erased["right_before"] == 1
    assert control["right"] == 1


@pytest.mark.slow
def test_shares_of_attention_are_shares(intervened: Path, answers: dict[str, Answer]) -> None:
    rows = effects("attention", intervened, answers)
    shares = np.array([row["share"] for row in rows])
    assert ((shares >= 0) & (shares <= 1 + 1e-6)).all()
    assert {row["role"] for row in rows} > {"all"}
    assert {row["block"] for row in rows} == {0, 1, 2}
    assert len({row["iteration"] for row in rows}) == 10


def test_the_same_command_loads_what_is_stored_and_python_gives_the_same_numbers(
    intervened: Path, answers: dict[str, Answer]
) -> None:
    (first,) = effects("image-swap", intervened, answers)
    again = probe_kit("intervene", intervened, *KINDS["image-swap"])
    (second,) = again.json()["effects"]
    measured = [name for name, value in first.items() if isinstance(value, int | float)]
    assert len(measured) > 10
    assert [second[name] for name in measured] == [first[name] for name in measured]
    result = pk.run_intervention(pk.open_run(intervened), pk.ImageSwap(), pk.ReplayFiles())
    assert result.table["reach_share"].tolist() == pytest.approx([first["reach_share"]], rel=1e-12)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--kind", "wish"), "image-swap"),
        (("--kind", "interchange", "--sites", "backbone.09"), "backbone"),
        (("--kind", "interchange", "--sites", "spine.*"), "spine"),
        (("--kind", "steer", "--sites", "backbone.02"), "roles"),
        (("--categories", "colour"), "color"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(intervened: Path, words: tuple[str, ...], named: str) -> None:
    refused = probe_kit("intervene", intervened, *words, code=None)
    assert refused.code in (2, 3)
    assert named in refused.text
