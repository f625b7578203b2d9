"""Whatever stands in one table is one family of tests: its p-values are corrected over the lot."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe_kit.retention import retention_table
from probe_kit.retention.compare.known_used import OVERALL
from probe_kit.retention.joins import joins_of
from probe_kit.retention.rows.row import MEAN
from tests.retention.asked_runs import SaidRun, acted, asked

SHARES = {"color": (20, 0.9), "shape": (16, 0.7)}


def by_chance(seed: int, less: float = 0.0) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {category: draw.random((count, 2)) < share - less for category, (count, share) in SHARES.items()}


def stepped(values: Sequence[float]) -> list[float]:
    """Holm's steps, one by one."""
    found = [0.0] * len(values)
    highest = 0.0
    for rank, place in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        highest = max(highest, min(1.0, (len(values) - rank) * values[place]))
        found[place] = highest
    return found


def check(rows: Sequence[tuple[float | None, float | None]], number: int) -> None:
    """rows: p and corrected p of a family."""
    assert len(rows) == number
    values = [p for p, _ in rows if p is not None]
    assert len(values) == number
    assert [p_holm for _, p_holm in rows] == [pytest.approx(p) for p in stepped(values)]
    assert len({round(p, 9) for p in values}) > 2, "the family must hold p-values that differ"


@pytest.fixture
def runs(tmp_path: Path) -> list[SaidRun]:
    vlms = [asked(tmp_path / f"r{n}", by_chance(n), called=f"vlm {n}") for n in range(2)]
    policies = [acted(tmp_path / f"p{n}", by_chance(9 + n, 0.15 * n), f"policy {n}") for n in range(3)]
    return [*vlms, *policies]


def test_gaps_are_one_family_over_categories_and_pairs_and_means_another(runs: list[SaidRun]) -> None:
    found = retention_table(runs, vlm_vla=True).vlm_vla
    assert len({(gap.group, gap.minus) for gap in found}) == 6
    check([(gap.p, gap.p_holm) for gap in found if gap.category != "mean"], 12)
    check([(gap.p, gap.p_holm) for gap in found if gap.category == "mean"], 6)


def test_differences_are_one_family_and_means_another(runs: list[SaidRun]) -> None:
    found = retention_table(runs[2:]).differences
    check([(row.p, row.p_holm) for row in found if row.category != "mean"], 4)


def test_joins_that_a_report_shows_together_are_one_family(runs: list[SaidRun]) -> None:
    table = retention_table(runs)
    joins = joins_of(runs, table).tables
    tests = [one for join in joins for row in join.rows if row.category != OVERALL for one in row.comparisons]
    check([(one.p, one.p_holm) for one in tests], len(list(product(range(2), range(3), SHARES))))
    summaries = [one for join in joins for row in join.rows if row.category == OVERALL for one in row.comparisons]
    assert len(summaries) == 6
    assert all(one.p_holm is None for one in summaries)


def test_wordings_of_all_runs_are_one_family_over_categories_and_pairs(tmp_path: Path) -> None:
    found = retention_table([worded(tmp_path / f"run {seed}", seed) for seed in range(2)]).wordings
    check([(pair.p, pair.p_holm) for pair in found if pair.category != MEAN], 2 * 3 * 2)
    check([(pair.p, pair.p_holm) for pair in found if pair.category == MEAN], 2 * 3)


class Worded(SaidRun):
    """A run whose episodes were played in three wordings; tables show the first."""

    wordings = ("knowledge", "named", "side")

    @property
    def all_wordings(self) -> SaidRun:
        plain = [acted(Path(str(self.path)), by_chance(self.seed + n, -0.2 * n)).episodes for n in range(3)]
        tables = [
            table.assign(wording=name, episode_id=table["episode_id"] + f":{name}")
            for name, table in zip(self.wordings, plain, strict=True)
        ]
        return SaidRun(self.path, "policy", self.suite, pd.concat(tables, ignore_index=True), {})

    @property
    def seed(self) -> int:
        return int(self.settings["seed"])


def worded(path: Path, seed: int) -> SaidRun:
    plain = acted(path, by_chance(seed))
    episodes = plain.episodes.assign(wording="knowledge")
    return Worded(plain.path, "policy", plain.suite, episodes, {}, settings={"seed": 10 * seed})
