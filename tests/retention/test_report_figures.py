"""A display declares its own figures; nothing else knows it."""

import sys
from collections.abc import Callable
from importlib import invalidate_caches
from pathlib import Path

import pytest

from probe_kit.retention import displays, retention_table
from probe_kit.retention.displays import collect_figures
from probe_kit.retention.displays.report_figures import save_figures
from probe_kit.train import ArrayRun

EXAMPLE = """
from probe_kit.retention.displays.base.report_figure import ReportFigure

PLACE = 0


def report_figures(source):
    for one in source.runs:
        yield ReportFigure(
            f"{one.stem}-lengths", "Lengths", "behaviour", "Steps.", one.position, lambda: _drawn(one.run)
        )


def _drawn(run):
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots()
    axes.plot([len(run.episodes)])
    return figure
"""


def test_a_new_display_is_one_file(
    probed_run: Callable[..., ArrayRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worked example of CONTRIBUTING: a module of the folder that says what it draws."""
    run = probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])})
    table = retention_table([run])
    before = [figure.name for figure in collect_figures([run], table)]
    folder = tmp_path / "more"
    folder.mkdir()
    (folder / "episode_lengths.py").write_text(EXAMPLE, encoding="utf-8")
    monkeypatch.setattr(displays, "__path__", [*displays.__path__, str(folder)])
    invalidate_caches()
    figures = collect_figures([run], table)
    monkeypatch.delitem(sys.modules, "probe_kit.retention.displays.episode_lengths")
    assert [figure.name for figure in figures if figure.name not in before] == ["pi0-lengths"]
    (saved,) = save_figures([figure for figure in figures if figure.name == "pi0-lengths"], tmp_path / "figures")
    assert saved.stat().st_size > 0


def test_figures_of_all_runs_come_first_and_then_run_by_run(probed_run: Callable[..., ArrayRun]) -> None:
    runs = [probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])}, name) for name in ("one", "other")]
    places = [figure.run for figure in collect_figures(runs, retention_table(runs))]
    assert places == sorted(places, key=lambda run: -1 if run is None else run)
    assert {None, 0, 1} == set(places)
