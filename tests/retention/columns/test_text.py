import io
import json
from collections.abc import Callable
from dataclasses import replace

import pytest
from rich.console import Console

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.train import ArrayRun, Controls, ControlScore, UntrainedScore, load_results, save_results


@pytest.fixture
def table(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    """Pictures that give the answer away, an instruction that does not, and an untrained network."""
    run = probed_run({"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]])})
    sites = ("backbone.01.residual", "expert.01.residual@0")
    controls = Controls(
        (
            ControlScore("pixels", "color", 0.75, (0.7, 0.8), 0.005, 0.5, 200),
            ControlScore("instruction", "color", 0.51, (0.45, 0.57), 0.4, 0.5, 200),
        ),
        tuple(
            UntrainedScore(
                "color", "mean", site, site, True, 0.9, 0.6, gain, (gain - 0.1, gain + 0.1), "pi0 (random weights)"
            )
            for site, gain in zip(sites, (0.3, 0.2), strict=True)
        ),
    )
    save_results(replace(load_results(run), controls=controls), run.path)
    return retention_table([run])


def test_a_baseline_above_chance_is_red_in_every_format(table: RetentionTable) -> None:
    console = Console(width=120, file=io.StringIO(), force_terminal=True, color_system="standard")
    console.print(table.to_rich("all"))
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "\x1b[1;31m75.0 above chance" in printed
    assert "31m51.0" not in printed
    assert "🔴 **75.0 above chance**" in table.to_markdown()
    assert r"\textcolor{red}{75.0 above chance}" in table.to_latex("all")


def test_json_has_controls_by_name_and_csv_a_column_each(table: RetentionTable) -> None:
    row = json.loads(table.to_json())[0]
    assert row["controls"]["baselines"] == {"pixels": 0.75, "instruction": 0.51}
    assert row["controls"]["leaks"] == ["pixels"]
    assert (
        row["controls"]["untrained"],
        row["backbone"]["minus_untrained"],
        row["action"]["minus_untrained"],
    ) == ("pi0 (random weights)", 0.3, 0.2)
    frame = table.to_frame()
    assert frame["controls.baselines.pixels"].tolist() == [0.75, 0.75]
    assert frame["action.minus_untrained_ci_high"][0] == pytest.approx(0.3)


def test_controls_take_no_room_where_there_are_none(probed_run: Callable[..., ArrayRun]) -> None:
    bare = retention_table([probed_run({"color": ([0.9], [[0.7]])})])
    assert "Controls" not in bare.to_markdown() + bare.to_latex("all")
