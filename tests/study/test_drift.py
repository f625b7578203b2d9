"""Drift between runs of made features, of which it is known what was kept, moved, forgotten and learned."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.study.drift import CategoryDrift, drift_table, measure_drift, why_alone
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
    found = {}
    for layer in range(2):
        values = draw.normal(size=(len(table), WIDTH))
        values[np.arange(len(table)), axis.astype(int)] += strength * side
        if after:
            values[category == "shifted"] = values[category == "shifted"] * 4 + 40
        found[Site("backbone", layer), "mean"] = values
    return found


def run_of(folder: Path, after: bool, categories: list[str], **changed: object) -> ArrayRun:
    table = table_of(categories)
    made = ArrayRun(folder, "after" if after else "before", "suite@1#0123456789ab", table, features(table, after))
    return made if not changed else SaidRun(**{**vars(made), **changed})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[ArrayRun, ArrayRun]:
    folder = tmp_path_factory.mktemp("drift")
    runs = [run_of(folder / str(after), after, list(TRUTH)) for after in (False, True)]
    for run in runs:
        train_probes(run, permutations=39, jobs=1, controls=())
    return runs[0], runs[1]


@pytest.fixture(scope="module")
def found(pair: tuple[ArrayRun, ArrayRun]) -> dict[str, CategoryDrift]:
    return {one.category: one for one in measure_drift(*pair)}


def test_the_verdict_of_every_category_is_what_was_made(found: dict[str, CategoryDrift]) -> None:
    assert {name: one.verdict for name, one in found.items()} == TRUTH


def test_an_offset_alone_breaks_transfer_until_features_are_recentred(found: dict[str, CategoryDrift]) -> None:
    kept, shifted = (found[name].sites[found[name].best] for name in ("kept", "shifted"))
    assert kept.raw > 0.95
    assert kept.recentred > 0.95
    assert shifted.raw < 0.7
    assert shifted.recentred > 0.95


def test_a_run_against_itself_transfers_as_it_decodes(pair: tuple[ArrayRun, ArrayRun]) -> None:
    run, _ = pair
    for one in measure_drift(run, run):
        curve = one.sites[one.best]
        assert curve.raw == curve.raw_back == curve.recentred
        assert curve.cka == pytest.approx(1)
        assert one.verdict in ("kept", "not shown in either")
        if curve.agreement is not None:
            assert curve.agreement.raw == pytest.approx(1)
            assert curve.agreement.weighted == pytest.approx(1)


def test_transferred_decisions_are_those_of_the_probe_that_never_saw_the_episode(
    pair: tuple[ArrayRun, ArrayRun], found: dict[str, CategoryDrift]
) -> None:
    """By hand, episode by episode, from the stored weights."""
    run, other = pair
    results = load_results(run)
    curve, site = results.curves["kept", "mean"], found["kept"].sites[1].site
    direction, values = results.direction("kept", "mean", site), other.column(site, "mean").astype(float)
    row_of = {name: row for row, name in enumerate(other.episodes["episode_id"])}
    right = [
        (values[row_of[name]] @ direction.weights[fold].astype(float) + direction.intercepts[fold] > 0) == left
        for name, fold, left in zip(curve.episodes, curve.fold_of, curve.labels, strict=True)
    ]
    assert found["kept"].sites[1].raw == np.mean(right)


def test_directions_are_compared_only_where_both_sides_have_signal(found: dict[str, CategoryDrift]) -> None:
    for name in ("forgotten", "learned", "never"):
        assert all(site.agreement is None for site in found[name].sites)
    kept = found["kept"].sites[0].agreement
    assert kept is not None
    assert 0.7 < kept.raw <= 1
    turned = found["turned"].sites[0].agreement
    assert turned is not None
    assert abs(turned.raw) < 0.5 < turned.ceiling


def test_the_table_leads_with_transfer_and_says_what_each_verdict_means(found: dict[str, CategoryDrift]) -> None:
    made = drift_table({("before", "after"): list(found.values())}, "training", "mean")
    assert made.title == "Drift: training"
    rows = {cells[1].lower(): dict(zip(made.columns, cells, strict=True)) for cells in made.texts}
    assert list(rows["kept"].values())[:3] == ["before → after", "Kept", "kept"]
    assert rows["forgotten"]["cosine (ceiling)"] == "–", "no cosine without signal on both sides"
    assert "forgotten: signal in the first alone" in "; ".join(made.notes)
    assert "it is no measure of loss" in "; ".join(made.notes)
    assert len(made.numbers) == len(TRUTH) * 3, "one of the category, one of each layer"
    verdicts = {number["category"]: number["verdict"] for number in made.numbers if "verdict" in number}
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
        (kept, *_) = measure_drift(strange, other)
        assert (kept.sites, kept.verdict) == ((), "not clear")
        made = drift_table({("before", "after"): [kept]}, "training", "mean")
        assert made.title == f"Drift: training ({why})"
        assert made.texts[0][6:] == ("–",) * 8


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
    (kept, *_) = found = measure_drift(sides[0], sides[1])
    assert [site.lens for site in kept.sites] == [(0, 1), (1, 0.875)]
    made = drift_table({("before", "after"): found}, "training", "mean")
    assert made.columns[-2:] == ("lens before %", "lens after %")
    assert [one.group for one in made.headings[-2:]] == ["logit lens"] * 2
    assert "the model's own final norm and head" in "; ".join(made.notes)
    assert [number["lens_after"] for number in made.numbers if number.get("site")][:2] == [1, 0.875]
    (plain, *_) = measure_drift(sides[0], after)
    assert all(site.lens is None for site in plain.sites), "one side has none"
    assert "logit lens" not in [one.group for one in drift_table({("a", "b"): [plain]}, "t", "mean").headings]


def test_backbones_of_another_width_are_refused(pair: tuple[ArrayRun, ArrayRun], tmp_path: Path) -> None:
    run, _ = pair
    wide = {place: np.hstack([values, values]) for place, values in run.features.items()}
    other = ArrayRun(tmp_path, "wide", run.suite, run.episodes, wide)
    train_probes(other, permutations=0, jobs=1, controls=())
    with pytest.raises(UsageError, match="no site of the backbone with one name and width in common"):
        measure_drift(run, other)
