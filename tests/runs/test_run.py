import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr

from probe_kit.errors import (
    NoProbesError,
    ProbeKitError,
    RunDamagedError,
    RunNotFoundError,
    UnknownSiteError,
)
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs import Run, open_run
from probe_kit.runs.arrays import decode_bfloat16
from probe_kit.train import load_results, train_probes


@pytest.fixture
def damaged(recorded_run: Run, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


def test_episodes_come_in_plan_order_with_labels_and_outcomes(recorded_run: Run) -> None:
    episodes = recorded_run.episodes
    assert len(episodes) == 48
    assert episodes["episode"].tolist() == list(range(48))
    assert set(episodes["category"]) == {"color", "shape"}
    assert (episodes.groupby("item_id")["layout"].nunique() == 2).all()
    assert (episodes.groupby("item_id")["side_correct"].nunique() == 2).all()
    assert episodes["cube_x"].between(0, 1).all()


def test_every_site_has_finite_rows_that_differ_between_episodes(recorded_run: Run) -> None:
    for stream, width in (("backbone", 96), ("expert", 64)):
        for site in recorded_run.sites(stream):
            column = recorded_run.column(site)
            assert column.shape == (48, width)
            assert column.dtype == np.float32
            assert np.isfinite(column).all()
    last = recorded_run.column(recorded_run.sites("backbone")[-1])
    assert np.abs(last - last[0]).max(axis=1)[1:].min() > 1e-4


def test_pooled_views_equal_what_the_stored_tokens_give(recorded_run: Run) -> None:
    """Up to the rounding of tokens to bfloat16."""
    for site in (Site("backbone", 2), Site("expert", 3, iteration=7)):
        for role in recorded_run.views(site.stream)[2:]:
            values, mask = recorded_run.tokens(site, role.removeprefix("mean:"))
            recomputed = (values * mask[..., None]).sum(1) / mask.sum(1, keepdims=True)
            np.testing.assert_allclose(recomputed, recorded_run.column(site, role), atol=0.02)


def test_padding_tokens_are_stored_as_zeros(recorded_run: Run) -> None:
    values, mask = recorded_run.tokens(Site("backbone", 3))
    assert not mask.all()
    assert (values[~mask] == 0).all()
    assert (np.abs(values[mask]).max(axis=-1) > 0).all()


def test_bfloat16_bits_decode_exactly() -> None:
    values = torch.randn(1000).to(torch.bfloat16)
    bits = values.view(torch.int16).numpy().view(np.uint16)
    np.testing.assert_array_equal(decode_bfloat16(bits), values.float().numpy())


def test_the_page_reads_a_run_with_plain_zarr_and_json(recorded_run: Run) -> None:
    page = (Path(__file__).parents[2] / "docs" / "storage.md").read_text(encoding="utf-8")
    code = next(block for block in page.split("```python\n") if "import zarr" in block).partition("```")[0]
    assert "probe_kit" not in code
    names: dict[str, Any] = {}
    exec(code.replace('"RUN"', repr(str(recorded_run.path))), names)
    column = [row[0, 3, 0] for row in names["rows"]]
    np.testing.assert_array_equal(column, recorded_run.column(Site("backbone", 3)))
    dataset = xr.open_zarr(recorded_run.path / "data.zarr", group="backbone", consolidated=False, chunks=None)
    assert dataset["pooled"].dims == ("episode", "call", "layer", "view", "feature")


def test_the_labelled_dataset_selects_by_name(recorded_run: Run) -> None:
    dataset = recorded_run.xarray()
    chosen = dataset["backbone_pooled"].sel(backbone_view="mean:language").isel(call=0, backbone_layer=2)
    np.testing.assert_array_equal(chosen, recorded_run.column(Site("backbone", 2), "mean:language"))
    assert dataset["category"].values.tolist() == recorded_run.episodes["category"].tolist()


@pytest.mark.parametrize(
    ("site", "view"),
    [(Site("backbone", 5), "mean"), (Site("vision", 0), "mean"), (Site("backbone", 0), "mean:state")],
)
def test_what_is_not_stored_is_named(recorded_run: Run, site: Site, view: str) -> None:
    with pytest.raises(UnknownSiteError):
        recorded_run.column(site, view)


@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_a_flipped_bit_is_an_error_and_never_a_number(damaged: Path) -> None:
    chunk = next((damaged / "data.zarr/backbone/pooled/c/3").rglob("0"))
    while chunk.is_dir():
        chunk = next(chunk.iterdir())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    shutil.rmtree(damaged / "columns.zarr")
    with pytest.raises(RunDamagedError, match=r"commits/00000003\.json"):
        open_run(damaged).column(Site("backbone", 0))


def test_a_missing_or_truncated_object_is_noticed_on_opening(damaged: Path) -> None:
    chunk = max((damaged / "data.zarr/expert/tokens/c/5").rglob("*"), key=lambda path: path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(RunDamagedError, match="were written"):
        open_run(damaged)
    chunk.unlink()
    with pytest.raises(RunDamagedError, match="is missing"):
        open_run(damaged)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunNotFoundError, match="probe-kit extract"):
        open_run(tmp_path)


def test_a_run_shows_the_first_items_of_some_categories(recorded_run: Run) -> None:
    part = recorded_run.only(["color"], 4)
    whole = recorded_run.episodes
    first = list(dict.fromkeys(whole.loc[whole["category"] == "color", "item_id"]))[:4]
    mine = whole["item_id"].isin(first).to_numpy()
    assert part.episodes["item_id"].unique().tolist() == first
    assert (part.planned, len(part.items)) == (8, 4)
    assert part.planned_items == recorded_run.planned_items  # by which its suite is found again
    for site in (Site("backbone", 2), Site("expert", 3, iteration=7)):
        np.testing.assert_array_equal(part.column(site), recorded_run.column(site)[mine])
        np.testing.assert_array_equal(part.tokens(site)[1], recorded_run.tokens(site)[1][mine])
    assert part.control_steps.tolist() == recorded_run.control_steps[mine].tolist()
    assert (part.judged("disc")["correct"].to_numpy() == recorded_run.judged("disc")["correct"][mine]).all()
    assert part.all_wordings is part
    assert part.only(items=2).episodes["item_id"].unique().tolist() == first[:2]
    assert recorded_run.only() is recorded_run


@pytest.mark.parametrize(
    ("categories", "items", "why"),
    [
        (["colour"], None, "unknown category 'colour'"),
        ([], None, "no category selected"),
        (None, 0, "items is 0"),
        (None, 14, r"plans 12 items of 'color'; give a number from 1 to 12"),
        (["shape"], 3, "role-exchanged twins"),
    ],
)
def test_a_selection_that_a_run_does_not_hold_is_refused(
    recorded_run: Run, categories: list[str] | None, items: int | None, why: str
) -> None:
    with pytest.raises(ProbeKitError, match=why):
        recorded_run.only(categories, items)


def test_a_part_of_a_run_has_probes_of_its_own(little_runs: Path, tmp_path: Path) -> None:
    run = open_run(shutil.copytree(little_runs / "run", tmp_path / "run"))
    part, stored = run.only(items=10), load_results(run).key
    with pytest.raises(NoProbesError, match="other episodes"):
        load_results(part)
    own = train_probes(part, permutations=0)
    assert (load_results(part).key, load_results(run).key) == (own.key, stored)
    assert len(own.curves["color", "mean"].episodes) == 20
