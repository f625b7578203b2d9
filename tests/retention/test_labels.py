"""Two runs never share a name in a table."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.retention import retention_table
from probe_kit.train import ArrayRun


def test_runs_of_one_name_are_told_apart(probed_run: Callable[..., ArrayRun], tmp_path: Path) -> None:
    one = probed_run({"color": ([0.5, 0.8], [[0.6]])})
    features = {key: np.ones_like(values) for key, values in one.features.items()}
    other = ArrayRun(tmp_path / "other", one.model, one.suite, one.episodes, features)
    table = retention_table([one, other])
    labels = {row.run.label for row in table.rows}
    assert len(labels) == 2
    assert all(label.startswith("pi0 · ") for label in labels)
    assert {row.run.model for row in table.rows} == {"pi0"}
    assert all(label in table.to_markdown() for label in labels)


def test_a_run_alone_keeps_its_name(probed_run: Callable[..., ArrayRun]) -> None:
    table = retention_table([probed_run({"color": ([0.5, 0.8], [[0.6]])})])
    assert {row.run.label for row in (*table.rows, *table.means)} == {"pi0"}


def test_labels_that_are_given_name_runs_in_tables_figures_and_differences(
    probed_run: Callable[..., ArrayRun],
) -> None:
    one, other = (probed_run({"color": ([0.5, 0.8], [[0.6]])}, name) for name in ("one", "other"))
    table = retention_table([one, other], labels={str(one.location): "π0", str(other.location): "π0 (SFT)"})
    assert [row.run.label for row in table.rows] == ["π0", "π0 (SFT)"]
    assert {(row.group, row.minus) for row in table.differences} == {("π0 (SFT)", "π0")}
    assert {own.label for own in table.results.values()} == {"π0", "π0 (SFT)"}
    assert one.label == "one"
    alike = retention_table([one, other], labels={str(other.location): "one"})
    assert len({row.run.label for row in alike.rows}) == 2
    with pytest.raises(UsageError, match="labels are given for elsewhere; the runs are"):
        retention_table([one], labels={"elsewhere": "π0"})
