"""Drift between runs of made features, of which it is known what was kept, moved, forgotten and learned."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.study import (
    LoadedStudy,
    conduct_study,
    fit_probes,
    load_study,
    make_figures,
    make_table,
    pack_study,
    plan_study,
)
from probe_kit.study.drift import CategoryDrift, drift_table, measure_drift, why_alone
from probe_kit.suite import build_suite
from probe_kit.train import ArrayRun, load_results, train_probes
from tests.retention.asked_runs import ASK, SaidRun, episodes

pytestmark = pytest.mark.slow

ITEMS, WIDTH = 24, 8
TRUTH = {
    "kept": "kept",
    "shifted": "kept",
    "turned": "transfer not shown",
    "forgotten": "forgotten",
    "learned": "learned",
    "never": "not shown in either",
}


def table_of(categories: list[str]) -> pd.DataFrame:
    return episodes({name: np.ones((ITEMS, 2), bool) for name in categories})


def features(table: pd.DataFrame, after: bool, seed: int = 1) -> dict[tuple[Site, str], np.ndarray]:
    """Two layers; the side of the answer lies along an axis in categories that know it."""
    draw = np.random.default_rng(seed + after)
    side = np.where(table["side_correct"] == "left", 1.0, -1.0)
    category = table["category"].to_numpy()
    strength, axis = np.zeros((2, len(table)))
    strength[np.isin(category, ["kept", "shifted", "turned", "learned" if after else "forgotten"])] = 3
    axis[(category == "turned") & after] = 5
    arrays = {}
    for layer in range(2):
        values = draw.normal(size=(len(table), WIDTH))
        values[np.arange(len(table)), axis.astype(int)] += strength * side
        if after:
            values[category == "shifted"] = values[category == "shifted"] * 4 + 40
        arrays[Site("backbone", layer), "mean"] = values
    return arrays


def run_of(folder: Path, after: bool, categories: list[str], **changed: object) -> ArrayRun:
    table = table_of(categories)
    array_run = ArrayRun(
        folder, "after" if after else "before", "suite@1#0123456789ab", table, features(table, after)
    )
    return array_run if not changed else SaidRun(**{**vars(array_run), **changed})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[ArrayRun, ArrayRun]:
    folder = tmp_path_factory.mktemp("drift")
    runs = [run_of(folder / str(after), after, list(TRUTH)) for after in (False, True)]
    for run in runs:
        train_probes(run, permutations=39, jobs=1, controls=())
    return runs[0], runs[1]


@pytest.fixture(scope="module")
def drift_by_category(pair: tuple[ArrayRun, ArrayRun]) -> dict[str, CategoryDrift]:
    return {category_drift.category: category_drift for category_drift in measure_drift(*pair)}


def test_the_verdict_of_every_category_is_what_was_made(drift_by_category: dict[str, CategoryDrift]) -> None:
    assert {name: category_drift.verdict for name, category_drift in drift_by_category.items()} == TRUTH


def test_an_offset_alone_breaks_transfer_until_features_are_recentred(
    drift_by_category: dict[str, CategoryDrift],
) -> None:
    kept_site, shifted = (
        drift_by_category[name].sites[drift_by_category[name].best] for name in ("kept", "shifted")
    )
    assert kept_site.raw > 0.95
    assert kept_site.recentred > 0.95
    assert shifted.raw < 0.7
    assert shifted.recentred > 0.95


def test_a_run_against_itself_transfers_as_it_decodes(pair: tuple[ArrayRun, ArrayRun]) -> None:
    run, _ = pair
    for category_drift in measure_drift(run, run):
        curve = category_drift.sites[category_drift.best]
        assert curve.raw == curve.raw_back == curve.recentred
        assert curve.cka == pytest.approx(1)
        assert category_drift.verdict in ("kept", "not shown in either")
        if curve.cosine is not None:
            assert curve.cosine == pytest.approx(1)
            assert curve.weighted == pytest.approx(1)


def test_transferred_decisions_are_those_of_the_probe_that_never_saw_the_episode(
    pair: tuple[ArrayRun, ArrayRun], drift_by_category: dict[str, CategoryDrift]
) -> None:
    """By hand, episode by episode, from the stored weights."""
    run, other = pair
    results = load_results(run)
    curve, site = results.curves["kept", "mean"], drift_by_category["kept"].sites[1].site
    direction, values = results.direction("kept", "mean", site), other.column(site, "mean").astype(float)
    row_of = {name: row for row, name in enumerate(other.episodes["episode_id"])}
    right = [
        (values[row_of[name]] @ direction.weights[fold].astype(float) + direction.intercepts[fold] > 0) == is_left
        for name, fold, is_left in zip(curve.episodes, curve.fold_of, curve.labels, strict=True)
    ]
    assert drift_by_category["kept"].sites[1].raw == np.mean(right)


def test_directions_are_compared_only_where_both_sides_have_signal(
    drift_by_category: dict[str, CategoryDrift],
) -> None:
    for name in ("forgotten", "learned", "never"):
        assert all(site.cosine is None for site in drift_by_category[name].sites)
    assert 0.7 < drift_by_category["kept"].sites[0].cosine <= 1
    turned = drift_by_category["turned"].sites[0]
    assert abs(turned.cosine) < 0.5 < turned.ceiling


def test_the_table_leads_with_transfer_and_says_what_each_verdict_means(
    drift_by_category: dict[str, CategoryDrift],
) -> None:
    table = drift_table({("before", "after"): list(drift_by_category.values())}, "training", "mean")
    assert table.title == "Drift: training"
    rows = {cells[1].lower(): dict(zip(table.columns, cells, strict=True)) for cells in table.texts}
    assert list(rows["kept"].values())[:3] == ["before → after", "Kept", "kept"]
    assert rows["forgotten"]["cosine (ceiling)"] == "–", "no cosine without signal on both sides"
    assert "forgotten: signal in the first alone" in "; ".join(table.notes)
    assert "it is no measure of loss" in "; ".join(table.notes)
    assert len(table.numbers) == len(TRUTH) * 3, "one of the category, one of each layer"
    verdicts = {number["category"]: number["verdict"] for number in table.numbers if "verdict" in number}
    assert verdicts == TRUTH


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"settings": {"ask": ASK}}, "other words"),
        ({"settings": {}}, ""),
        ({"frames": "other"}, "other frames"),
        ({"frames": None}, "frames unknown"),
    ],
)
def test_other_words_or_frames_give_own_accuracies_only(
    pair: tuple[ArrayRun, ArrayRun], changed: dict, why: str
) -> None:
    run, other = pair
    table = run.episodes
    if "frames" in changed:
        frame = changed["frames"]
        table = table.drop(columns="first_frame_sha256")
        table = table if frame is None else table.assign(first_frame_sha256=frame)
    strange = SaidRun(
        run.path, run.model, run.suite, table.assign(parse="letter") if "settings" in changed else table,
        run.features, settings=changed.get("settings", {}),
    )  # fmt: skip
    assert why_alone(strange, other) == why
    if why and "frames" in changed:
        (first_drift, *_) = measure_drift(strange, other)
        assert (first_drift.sites, first_drift.verdict) == ((), "not clear")
        drift = drift_table({("before", "after"): [first_drift]}, "training", "mean")
        assert drift.title == f"Drift: training ({why})"
        assert drift.texts[0][6:] == ("–",) * 8


def test_two_runs_that_answer_by_letter_have_the_lens_of_every_layer(pair: tuple[ArrayRun, ArrayRun]) -> None:
    """Before, the last layer alone answers; after, both do, and one answer of four is a tie."""
    before, after = pair
    side = np.where(before.episodes["side_correct"] == "left", 1.0, -1.0)
    sides = [
        SaidRun(run.path, run.model, run.suite, run.episodes, run.features, lens_margins=margins)
        for run, margins in (
            (before, np.stack([-side, side], axis=1)),
            (after, np.stack([side, np.where(np.arange(side.size) % 4 == 0, 0, side)], axis=1)),
        )
    ]
    (first_drift, *_) = drifts = measure_drift(sides[0], sides[1])
    assert [site.lens for site in first_drift.sites] == [(0, 1), (1, 0.875)]
    table = drift_table({("before", "after"): drifts}, "training", "mean")
    assert table.columns[-2:] == ("lens before %", "lens after %")
    assert [heading.group for heading in table.headings[-2:]] == ["logit lens"] * 2
    assert "the model's own final norm and head" in "; ".join(table.notes)
    assert [number["lens_after"] for number in table.numbers if number.get("site")][:2] == [1, 0.875]
    (plain, *_) = measure_drift(sides[0], after)
    assert all(site.lens is None for site in plain.sites), "one side has none"
    assert "logit lens" not in [
        heading.group for heading in drift_table({("a", "b"): [plain]}, "t", "mean").headings
    ]


def test_backbones_of_another_width_are_refused(pair: tuple[ArrayRun, ArrayRun], tmp_path: Path) -> None:
    run, _ = pair
    wide = {column_key: np.hstack([values, values]) for column_key, values in run.features.items()}
    other = ArrayRun(tmp_path, "wide", run.suite, run.episodes, wide)
    train_probes(other, permutations=0, jobs=1, controls=())
    with pytest.raises(UsageError, match="no site of the backbone with one name and width in common"):
        measure_drift(run, other)


KNOWN_TEXT = """
schema = 1
name = "known"
out = "{out}"

[suite]
path = "{suite}"

[models.base]
family = "pi0-tiny"

[models.early]
family = "pi0-tiny-early"

[conditions.captured]
no_act = true

[[runs]]
name = "main"
models = ["base", "early"]
conditions = ["captured"]

[probes.main]
runs = ["main"]
views = ["mean:language"]
permutations = 79
controls = ["random-features"]

[drift.training]
pairs = [["early", "base"]]
view = "mean:language"

[tables.drift]
kind = "drift"
drift = "training"
"""
KNOWN_TRUTH = {"color": "kept", "state": "kept", "counting": "not shown in either"}
DRAWS = 3


def test_training_keeps_what_it_used_and_forgets_traffic(tmp_path: Path) -> None:
    """What is left of Traffic falls in every draw of items; 24 of them show a remainder in one draw at most."""
    forgotten = [traffic_verdict(seed, tmp_path / str(seed)) == "forgotten" for seed in range(DRAWS)]
    assert sum(forgotten) >= DRAWS - 1


def traffic_verdict(seed: int, folder: Path) -> str:
    """The verdict on Traffic in one draw of items, whose other verdicts are known."""
    suite = build_suite(folder / "suite", [*KNOWN_TRUTH, "traffic"], items_per_category=24, seed=seed)
    file = folder / "study.toml"
    file.write_text(KNOWN_TEXT.format(out=folder / "out", suite=suite.folder), encoding="utf-8")
    study = load_study(file)
    assert conduct_study(plan_study(study)) == []
    assert fit_probes(plan_study(study)) == []
    records = {record["category"]: record for record in make_table(study, "drift").numbers if "verdict" in record}
    assert {name: records[name]["verdict"] for name in KNOWN_TRUTH} == KNOWN_TRUTH
    assert records["traffic"]["difference_ci"][1] < 0
    return str(records["traffic"]["verdict"])


TEXT = """
schema = 1
name = "drift"
out = "{out}"
scene = "act2answer"

[suite]
categories = ["Color", "Counting"]
items = 16

[models.base]
family = "pi0-tiny"

[models.early]
family = "pi0-tiny-early"

[models.vlm]
family = "vlm-tiny"

[asks.words]
prompt = "instruction"
picture_size = "640x480"

[asks.question]
prompt = "p2"
picture_size = "640x480"

[conditions.captured]
no_act = true

[[runs]]
name = "main"
models = ["base", "early"]
conditions = ["captured"]

[[runs]]
name = "words"
models = ["vlm"]
asks = ["words", "question"]
tokens = "pooled"

[probes.main]
runs = ["main", "words"]
views = ["mean", "mean:language"]
permutations = 39

[drift.training]
pairs = [["early", "base"], ["base", "base/captured"]]

[drift.vlm]
pairs = [["vlm/words", "early"], ["vlm/question", "early"]]

[drift.language]
pairs = [["vlm/words", "early"]]
view = "mean:language"

[tables.vlm]
kind = "drift"
drift = "vlm"

[tables.language]
kind = "drift"
drift = "language"

[tables.drift]
kind = "drift"
drift = "training"

[tables.counting]
kind = "drift"
drift = "training"
categories = ["counting"]

[figures.curves]
kind = "curves"
runs = ["main"]
categories = ["color"]
"""


def test_a_file_names_pairs_and_an_archive_prints_their_table_without_activations(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    file.write_text(TEXT.format(out=tmp_path / "out"), encoding="utf-8")
    study = load_study(file)
    assert conduct_study(plan_study(study)) == []
    assert fit_probes(plan_study(study)) == []
    table = make_table(study, "drift")
    assert [cells[:2] for cells in table.texts] == [
        ("early → base", "Color"), ("early → base", "Counting"),
        ("base → base", "Color"), ("base → base", "Counting"),
    ]  # fmt: skip
    color, counting = table.texts[2:]
    assert (color[2], counting[2]) == ("kept", "not shown in either")
    cell_by_heading = dict(zip(table.columns, color, strict=True))
    assert cell_by_heading["forth %"] == cell_by_heading["back %"] == cell_by_heading["recentred %"], (
        "a run transfers to itself as it decodes"
    )
    assert cell_by_heading["CKA"] == "1.00"
    _check_vlm(study)
    counting_rows = make_table(study, "counting").texts
    assert [cells[1] for cells in counting_rows] == ["Counting", "Counting"]
    assert counting_rows[0] == table.texts[1], "probes are those of the whole runs"
    (curves,) = make_figures(study, "curves")
    with curves.drawn() as figure:
        titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert [title.partition(":")[0] for title in titles] == ["Color", "Color"], "backbone and action"
    pack_study(study, tmp_path / "study.zip")
    assert make_table(load_study(tmp_path / "study.zip"), "drift").texts == table.texts


def _check_vlm(study: LoadedStudy) -> None:
    """The early policy has the VLM's weights: with its words, picture and tokens, nothing differs."""
    numbers = make_table(study, "vlm").numbers
    sites = [record for record in numbers if "cka" in record]
    assert {record["before"].partition(" ")[0] for record in sites} == {"vlm"}
    assert len(sites) == 2 * 4, "of the pair with the policies' words alone"
    assert min(record["cka"] for record in sites) >= 0.999
    verdict_rows = {
        record["category"]: record for record in numbers if "verdict" in record and not record["why_alone"]
    }
    assert verdict_rows["color"]["verdict"] == "kept"
    assert [record["why_alone"] for record in numbers if "verdict" in record] == [
        None,
        None,
        "other words",
        "other words",
    ]
    apart = [record["why_alone"] for record in make_table(study, "language").numbers]
    assert apart == ["other tokens"] * 2, "the last token is no word to the VLM"
