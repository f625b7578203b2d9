"""Policies of every layout through environment, store, probes and one table: their streams, roles and options."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

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
from tests.hooks.families.internvla import checkpoints as internvla_checkpoints
from tests.hooks.families.magma import checkpoints as magma_checkpoints
from tests.hooks.families.prismatic import checkpoints as prismatic_checkpoints
from tests.hooks.families.spatialvla import checkpoints as spatialvla_checkpoints
from tests.hooks.families.xiaomi import checkpoints as xiaomi_checkpoints

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:the model put out tokens")]
PICTURE, WORDS = "mean:image.primary", "mean:language"
STEPS = 2


@dataclass(frozen=True)
class Case:
    """A family. columns: views and width by site, all of which a run has. other: an option of another run."""

    family: str
    write: Callable[[Path], Path]
    streams: tuple[str, ...]
    columns: Mapping[Site, tuple[tuple[str, ...], int]]
    other: tuple[str, str]
    options: Mapping[str, Any] = field(default_factory=dict)


PRISMATIC = prismatic_checkpoints.config_values()["norm_stats"]
CASES = {
    "magma": Case(
        "magma",
        magma_checkpoints.write_checkpoint,
        ("backbone", "action"),
        {
            Site("backbone", 3): (("mean", "last", PICTURE, "mean:separator", WORDS), 64),
            Site("action", 3, iteration=6): (("mean", "mean:action"), 64),
        },
        ("shrink", "0"),
        {"unnorm_key": "bridge_orig"},
    ),
    "openvla": Case(
        "openvla",
        partial(
            prismatic_checkpoints.write_checkpoint,
            norm_stats=PRISMATIC | {"mine": PRISMATIC["bridge_orig"]},
        ),
        ("backbone", "action"),
        {
            Site("backbone", 2): (("mean", PICTURE, WORDS), 32),
            Site("action", 2, iteration=6): (("mean", "mean:action"), 32),
        },
        ("unnorm_key", "mine"),
        {"unnorm_key": "bridge_orig"},
    ),
    "spatialvla": Case(
        "spatialvla",
        spatialvla_checkpoints.write_checkpoint,
        ("backbone", "action"),
        {
            Site("backbone", 2): (("mean", PICTURE, WORDS), 32),
            Site("action", 3, iteration=2): (("mean", "mean:action"), 32),
        },
        ("camera", "default"),
    ),
    "xiaomi-r0": Case(
        "xiaomi-r0",
        xiaomi_checkpoints.write_checkpoint,
        ("backbone", "expert"),
        {
            Site("backbone", 4): (("mean", "last", PICTURE, WORDS), 48),
            Site("expert", 2, iteration=1): (("mean", "mean:state", "mean:action"), 64),
        },
        ("steps", "3"),
        {"steps": 2, "robot": "bridge_delta"},
    ),
    "internvla-m1": Case(
        "internvla-m1",
        internvla_checkpoints.write_checkpoint,
        ("backbone", "bridge", "expert", "expert_unconditional"),
        {
            Site("backbone", 4): (("mean", "last", PICTURE, WORDS), 48),
            Site("bridge", 2): (("mean", "mean:query"), 32),
            Site("expert", 3, iteration=1): (("mean:condition", "mean:action"), 32),
        },
        ("guidance", "2.0"),
        {"steps": 2, "unnorm_key": "bridge_dataset"},
    ),
}


def settings(suite: Suite, case: Case, folder: Path, items: int = 2, **more: Any) -> ExtractSettings:
    return ExtractSettings(
        case.family, str(folder), suite=suite.folder, categories=("color",), items=items,
        scene=SceneSpec(max_steps=STEPS), env_workers=0, **{"options": dict(case.options), **more},
    )  # fmt: skip


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: case.write(tmp_path_factory.mktemp(name)) for name, case in CASES.items()}


@pytest.fixture(scope="module")
def wordy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of Magma that put out anything but actions."""
    return magma_checkpoints.write_checkpoint(tmp_path_factory.mktemp("wordy"), steered=False)


@pytest.mark.parametrize("name", CASES)
def test_a_run_has_the_streams_and_roles_of_its_family_and_other_options_are_another_run(
    name: str, checkpoints: dict[str, Path], small_suite: Suite, tmp_path: Path
) -> None:
    case = CASES[name]
    requested = settings(small_suite, case, checkpoints[name])
    run = extract_run(requested, tmp_path / "run")
    assert tuple(run.streams) == case.streams
    assert run.certificate["hooks_on_equals_hooks_off"]
    for site, (views, width) in case.columns.items():
        assert site in run.sites(site.stream)
        for view in views:
            column = np.asarray(run.column(site, view))
            assert column.shape == (4, width)
            assert np.isfinite(column).all()
            assert column.std(axis=0).max() > 0, (site, view)
    option, value = case.other
    with pytest.raises(SettingsMismatchError, match=rf"policy\.{option}"):
        extract_run(requested.changed(options={**case.options, option: value}), tmp_path / "run")


def test_families_stand_in_one_table_with_the_steps_that_were_no_action(
    checkpoints: dict[str, Path], wordy: Path, small_suite: Suite, tmp_path: Path
) -> None:
    """The half of InternVLA without a condition is stored, and no probe, peak or retention uses it."""
    every = {name: settings(small_suite, case, checkpoints[name], items=12) for name, case in CASES.items()}
    every["wordy"] = settings(small_suite, CASES["magma"], wordy, items=12)
    every["pi0-tiny"] = every["magma"].changed(model="pi0-tiny", checkpoint=None, options={})
    runs = {name: extract_run(requested, tmp_path / name) for name, requested in every.items()}
    for name, run in runs.items():
        probed = {str(site).partition(".")[0] for site in train_probes(run, permutations=0).scores["site"]}
        assert probed == {*run.streams} - {"expert_unconditional"}, name
    rows = {
        row.run.location: row
        for row in retention_table(list(runs.values())).rows
        if row.category == "color" and row.view == "mean"
    }
    row_of = {name: rows[str(run.location)] for name, run in runs.items()}
    assert {name: row.run.action_stream for name, row in row_of.items()} == {
        **dict.fromkeys(("magma", "wordy", "openvla", "spatialvla"), "action"),
        **dict.fromkeys(("xiaomi-r0", "internvla-m1", "pi0-tiny"), "expert"),
    }
    assert all(row.backbone.score is not None and row.action.score is not None for row in row_of.values())
    assert all(row.success.n_items == 12 for row in row_of.values())
    assert [row_of[name].success.share_invalid_action for name in ("magma", "wordy", "pi0-tiny")] == [0, 1, None]
    assert "invalid actions %" in retention_table(list(runs.values())).to_markdown()


@pytest.fixture(scope="module")
def talking(small_suite: Suite, wordy: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    requested = settings(small_suite, CASES["magma"], wordy, tokens="all")
    return extract_run(requested, tmp_path_factory.mktemp("runs") / "talking")


def test_steps_without_an_action_are_counted_per_episode(talking: Run) -> None:
    assert talking.episodes["inferences"].tolist() == [STEPS] * 4
    assert talking.episodes["flagged_steps"].tolist() == [STEPS] * 4
    assert (talking.episodes["outcome"] == "oob").all()


def test_tokens_are_stored_by_role(talking: Run) -> None:
    """256 pixels make 2 x 2 crops of 64: a map of 4 x 4 places and a separator behind each of its rows."""
    site = Site("backbone", 0)
    for role, count in (("image", 16), ("separator", 4)):
        values, mask = talking.tokens(site, role=role)
        assert mask.sum(axis=1).tolist() == [count] * 4
        assert np.abs(values[mask]).max() > 0


def test_a_batch_that_changes_numbers_and_a_model_that_does_not_act_are_refused_before_anything(
    checkpoints: dict[str, Path], small_suite: Suite, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="at most 1"):
        extract_run(
            settings(small_suite, CASES["internvla-m1"], checkpoints["internvla-m1"], batch=2), tmp_path / "run"
        )
    vlm = prismatic_checkpoints.write_checkpoint(tmp_path / "vlm", model_type="prismatic")
    case = dataclasses.replace(CASES["openvla"], family="prismatic")
    with pytest.raises(UsageError, match="does not act"):
        extract_run(settings(small_suite, case, vlm), tmp_path / "run")
    assert not (tmp_path / "run").exists()
