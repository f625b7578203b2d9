import json

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.statistics.significance import detectable
from probe_kit.train.power import items_for_width, items_needed, simulate


def test_power_grows_with_items_and_with_the_signal() -> None:
    few, many = simulate(24, 0.15, draws=60), simulate(150, 0.15, draws=60)
    assert few.chance < many.chance
    assert few.twin < many.twin
    assert simulate(150, 0.1, draws=60).twin < simulate(150, 0.25, draws=60).twin
    assert simulate(150, 0.25, draws=60).twin > 0.9


def test_without_a_signal_power_is_the_false_alarm_rate() -> None:
    found = simulate(60, 0.0, draws=200)
    assert max(found.chance, found.binding, found.twin) <= 0.05 + 3 * (0.05 * 0.95 / 200) ** 0.5


def test_what_a_control_could_have_seen_at_this_size() -> None:
    assert detectable(150) == pytest.approx(0.5 + (1.6449 + 0.8416) * (0.25 / 150) ** 0.5, abs=1e-4)
    assert detectable(24) > detectable(150) > 0.59
    with pytest.raises(UsageError, match="0 items"):
        detectable(0)


def test_the_items_needed_are_the_first_that_reach_the_power() -> None:
    assert items_needed(0.25, 0.8, (24, 150), draws=60) == 150
    assert items_needed(0.05, 0.99, (24,), draws=60) is None
    assert items_for_width(0.16) == 151  # 0.08 either side: the margin of 150 items
    for width in (0.0, 1.5):
        with pytest.raises(UsageError, match="expected a share"):
            items_for_width(width)


def test_sizes_and_signals_that_cannot_be_are_refused() -> None:
    with pytest.raises(UsageError, match="fewer than 5 groups"):
        simulate(8, 0.1)
    with pytest.raises(UsageError, match=r"from 0 to 0\.5"):
        simulate(24, 0.7)


def test_the_command_prints_every_number_of_items() -> None:
    found = CliRunner().invoke(app, ["power", "--items", "24,60", "--signal", "25", "--draws", "20", "--json"])
    assert found.exit_code == 0, found.output
    assert [row["items"] for row in json.loads(found.stdout)] == [24, 60]
    text = CliRunner().invoke(app, ["power", "--items", "24", "--signal", "25", "--draws", "20"]).stdout
    assert "against a twin" in text
    assert CliRunner().invoke(app, ["power", "--width", "16"]).stdout.startswith("151 items")
    assert CliRunner().invoke(app, ["power", "--items", "many"]).exit_code == 2


def test_two_questions_are_not_answered_by_one_of_them() -> None:
    found = CliRunner().invoke(app, ["power", "--width", "16", "--power", "80"])
    assert found.exit_code == 2
    assert "two questions" in found.output
