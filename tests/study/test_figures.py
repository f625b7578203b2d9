"""Named figures of a study."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.retention import retention_table
from probe_kit.study import LoadedStudy, make_figures
from probe_kit.study.rates import domain_scores
from probe_kit.study.report import draw_overview
from tests.retention.asked_runs import acted


def test_the_overview_has_a_panel_per_domain_and_a_bar_per_system_on_one_scale(tmp_path: Path) -> None:
    right = {
        "color": np.ones((20, 2), bool),
        "shape": np.tile([True, False], (20, 1)),
        "traffic": np.zeros((20, 2), bool),
    }
    table = retention_table(
        [acted(tmp_path / "one", right, "one"), acted(tmp_path / "two", right, "two")], pairs=()
    )
    assert domain_scores(table) == {
        "physical": {"one": 50.0, "two": 50.0},
        "normative": {"one": -100.0, "two": -100.0},
    }
    figure = draw_overview(table)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in shown] == ["physical", "normative"]
    assert {axes.get_xlim() for axes in shown} == {(-105.0, 105.0)}
    bars = [[p.get_width() for p in axes.patches if isinstance(p, Rectangle)] for axes in shown]
    assert bars == [[50.0, 50.0], [-100.0, -100.0]]


def test_the_overview_says_what_has_no_episodes_and_takes_names_as_they_are(tmp_path: Path) -> None:
    right, name = np.ones((20, 2), bool), r"a $\frac{1$ b $5^^$"
    both = acted(tmp_path / "both", {"color": right, "traffic": right}, name)
    table = retention_table([both, acted(tmp_path / "one", {"color": right}, "one")], pairs=())
    figure = draw_overview(table)
    physical, normative = (axes for axes in figure.axes if axes.get_visible())
    assert [[text.get_text() for text in axes.texts] for axes in (physical, normative)] == [[], ["no episodes"]]
    figure.savefig(tmp_path / "overview.svg")
    assert name in [text.get_text() for text in physical.get_yticklabels()]


@pytest.mark.slow
def test_figures_are_drawn_by_name_from_stored_runs(played: LoadedStudy, tmp_path: Path) -> None:
    out = tmp_path / "figures"
    made = CliRunner().invoke(app, ["study", "figure", str(played.file), "sides", "--out", str(out)])
    assert made.exit_code == 0, made.output
    assert sorted(path.name for path in out.iterdir()) == ["sides.pdf", "sides.png"]
    assert made.stdout.strip() == str(out / "sides.png")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("dose", "was steered. Steer one with `probe-kit intervene"),
        ("overveiw", "unknown figure 'overveiw'; known: overview, .* Did you mean 'overview'"),
    ],
)
def test_what_no_run_has_is_named_with_the_command_that_makes_it(
    played: LoadedStudy, name: str, said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        make_figures(played, name)
