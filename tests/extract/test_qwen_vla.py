"""Policies with a diffusion head and a flow transformer of their own: environment, store, probes, one table."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import SettingsMismatchError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.runs import Run
from probe_kit.suite import Suite
from probe_kit.train import train_probes
from tests.support import internvla_checkpoints, xiaomi_checkpoints

pytestmark = pytest.mark.slow

EPISODES = 8


def settings(
    model: str, suite: Suite, checkpoint: Path | None = None, items: int = EPISODES // 2, **more: object
) -> ExtractSettings:
    return ExtractSettings(
        model,
        None if checkpoint is None else str(checkpoint),
        suite=suite.folder,
        categories=("color",),
        items=items,
        scene=SceneSpec(max_steps=1),
        env_workers=0,
        **more,
    )


@pytest.fixture(scope="module")
def xiaomi_settings(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> ExtractSettings:
    folder = xiaomi_checkpoints.write_checkpoint(tmp_path_factory.mktemp("xiaomi"))
    return settings("xiaomi-r0", small_suite, folder, batch=2, options={"steps": 2, "robot": "bridge_delta"})


@pytest.fixture(scope="module")
def xiaomi(xiaomi_settings: ExtractSettings, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return extract_run(xiaomi_settings, tmp_path_factory.mktemp("runs") / "xiaomi")


@pytest.fixture(scope="module")
def internvla_settings(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> ExtractSettings:
    folder = internvla_checkpoints.write_checkpoint(tmp_path_factory.mktemp("internvla"))
    return settings("internvla-m1", small_suite, folder, options={"steps": 2, "unnorm_key": "bridge_dataset"})


@pytest.fixture(scope="module")
def internvla(internvla_settings: ExtractSettings, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return extract_run(internvla_settings, tmp_path_factory.mktemp("runs") / "internvla")


def check_columns(run: Run, site: Site, views: tuple[str, ...], width: int) -> None:
    for view in views:
        column = np.asarray(run.column(site, view))
        assert column.shape == (EPISODES, width)
        assert np.isfinite(column).all()
        assert column.std(axis=0).max() > 0


def test_a_run_of_xiaomi_has_its_streams_and_roles(xiaomi: Run) -> None:
    assert list(xiaomi.streams) == ["backbone", "expert"]
    assert len(xiaomi.sites("expert")) == 3 * 2
    assert xiaomi.certificate["hooks_on_equals_hooks_off"]
    check_columns(xiaomi, Site("backbone", 4), ("mean", "last", "mean:image.primary", "mean:language"), 48)
    check_columns(xiaomi, Site("expert", 2, iteration=1), ("mean", "mean:state", "mean:action"), 64)


def test_a_run_of_internvla_has_its_streams_and_roles(internvla: Run) -> None:
    assert list(internvla.streams) == ["backbone", "bridge", "expert", "expert_unconditional"]
    assert internvla.certificate["hooks_on_equals_hooks_off"]
    check_columns(internvla, Site("backbone", 4), ("mean", "last", "mean:image.primary", "mean:language"), 48)
    check_columns(internvla, Site("bridge", 2), ("mean", "mean:query"), 32)
    check_columns(internvla, Site("expert", 3, iteration=1), ("mean:condition", "mean:action"), 32)


def test_internvla_refuses_a_batch_before_it_begins(internvla_settings: ExtractSettings, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at most 1"):
        extract_run(internvla_settings.changed(batch=2), tmp_path / "run")


def test_other_options_are_another_run(internvla_settings: ExtractSettings, internvla: Run) -> None:
    with pytest.raises(SettingsMismatchError, match="guidance"):
        extract_run(
            internvla_settings.changed(options={**internvla_settings.model.options, "guidance": 2.0}),
            Path(str(internvla.location)),
        )


@pytest.mark.slow
def test_they_stand_in_one_table_beside_another_family(
    xiaomi_settings: ExtractSettings, internvla_settings: ExtractSettings, small_suite: Suite, tmp_path: Path
) -> None:
    """The half without a condition is stored, and no probe, peak or retention uses it."""
    chosen = (settings("pi0-tiny", small_suite), xiaomi_settings, internvla_settings)
    runs = [extract_run(one.changed(items=12), tmp_path / one.model.family) for one in chosen]
    for run in runs:
        probed = {str(site).partition(".")[0] for site in train_probes(run, permutations=0).scores["site"]}
        assert {"backbone", "expert"} <= probed
        assert "expert_unconditional" not in probed
    rows = {
        row.run.location: row
        for row in retention_table(runs).rows
        if row.category == "color" and row.view == "mean"
    }
    assert [rows[str(run.location)].run.action_stream for run in runs] == ["expert"] * 3
    assert all(rows[str(run.location)].backbone.score is not None for run in runs)
    assert all(rows[str(run.location)].action.score is not None for run in runs)
