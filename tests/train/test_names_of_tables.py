"""Names in tables are texts as they are written, in every format: no reader takes them for numbers."""

from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

import probe_kit as pk
from probe_kit._system.escaping import csv_of_frame
from probe_kit._system.table_cells import MISSING, alike, problem_of, similar_name
from probe_kit.errors import UsageError
from probe_kit.runs import Run
from probe_kit.train import Target
from probe_kit.train.builtin_columns import label_frame
from probe_kit.train.target_samples import target_samples

LIKE_NUMBERS = [
    "000", "0700", "1e5", "5e882100", "7e123400", "05e88210", "0x10", "1_0", "inf", "Infinity", "nan1", "\u0663",
    "+1", "1.0", "1.1", "1.10", "-0", ".5", "true", "no", "1,5", "10 %", "2026-01-05", "1/2", "9007199254740993",
]  # fmt: skip
"""Names that some reader takes for a number, a truth value, a date or nothing."""


def as_csv(table: pd.DataFrame, folder: Path) -> Any:
    (folder / "names.csv").write_text(csv_of_frame(table), encoding="utf-8", newline="")
    return folder / "names.csv"


def as_tsv(table: pd.DataFrame, folder: Path) -> Any:
    table.to_csv(folder / "names.tsv", sep="\t", index=False)
    return folder / "names.tsv"


def as_parquet(kind: pa.DataType) -> Callable[[pd.DataFrame, Path], Any]:
    def write(table: pd.DataFrame, folder: Path) -> Any:
        columns = {
            name: pa.array(table[name].tolist(), pa.string()).cast(kind) for name in ("episode_id", "group")
        }
        parquet.write_table(pa.table({**columns, "y": table["y"].tolist()}), folder / "names.parquet")
        return folder / "names.parquet"

    return write


def as_frame(kind: str) -> Callable[[pd.DataFrame, Path], Any]:
    def write(table: pd.DataFrame, folder: Path) -> Any:
        del folder
        return table.astype({"episode_id": kind, "group": kind})

    return write


def as_index(table: pd.DataFrame, folder: Path) -> Any:
    del folder
    return table.set_index(["episode_id", "group"])


FORMATS = {
    "CSV": as_csv,
    "TSV": as_tsv,
    "Parquet": as_parquet(pa.string()),
    "Parquet, large": as_parquet(pa.large_string()),
    "Parquet, dictionary": as_parquet(pa.dictionary(pa.int32(), pa.string())),
    "objects": as_frame("object"),
    "strings": as_frame("string"),
    "categories": as_frame("category"),
    "index": as_index,
}
every_format = pytest.mark.parametrize("written", FORMATS.values(), ids=FORMATS)


def table_of(names: list[str]) -> pd.DataFrame:
    return pd.DataFrame({"episode_id": names, "group": names, "y": [number % 2 for number in range(len(names))]})


def read(written: Callable[[pd.DataFrame, Path], Any], names: list[str], folder: Path) -> Target:
    return Target.read(written(table_of(names), folder), "y", group_by="group")


@every_format
def test_names_that_look_like_something_else_stay_as_they_are(
    written: Callable[[pd.DataFrame, Path], Any], tmp_path: Path
) -> None:
    labels = read(written, LIKE_NUMBERS, tmp_path)
    assert labels.episodes == labels.groups == tuple(LIKE_NUMBERS)


TEXTS = st.text(
    st.characters(exclude_categories=("Cc", "Cf", "Cs", "Zl", "Zp", "Co", "Cn")), min_size=1, max_size=8
).map(lambda text: normalize("NFC", " ".join(text.split())))
HASHES = st.text("0123456789abcdef", min_size=8, max_size=8)
DIGITS = st.text("0123456789.eE+-", min_size=1, max_size=6)
NAMES = (HASHES | DIGITS | TEXTS).filter(
    lambda name: bool(name) and name not in MISSING and not problem_of(name) and name == normalize("NFC", name)
)


@pytest.mark.slow
@every_format
@settings(max_examples=60, deadline=None)
@given(names=st.lists(NAMES, min_size=3, max_size=12, unique_by=alike))
def test_a_table_keeps_any_names(
    written: Callable[[pd.DataFrame, Path], Any], names: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    labels = read(written, names, tmp_path_factory.mktemp("names"))
    assert labels.episodes == labels.groups == tuple(names)


@pytest.mark.parametrize("pair", [("7", "007"), ("7", "7.0"), ("Red", "red"), ("'7", "7")])
@pytest.mark.parametrize("written", [as_csv, as_frame("object")], ids=["CSV", "objects"])
def test_groups_that_differ_by_what_programs_change_are_refused(
    written: Callable[[pd.DataFrame, Path], Any], pair: tuple[str, str], tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="expected one spelling of one name"):
        Target.read(written(table_of(["a", "b", "c"]).assign(group=[*pair, "8"]), tmp_path), "y", group_by="group")


@pytest.mark.parametrize(
    ("cells", "names"),
    [
        ([7, 8, 2**60], ("7", "8", str(2**60))),
        ([7.0, 8.0, 9.0], ("7", "8", "9")),  # an integer column beside an empty cell
        ([0.1, 0.25, 3.0], ("0.1", "0.25", "3")),
        ([True, False, True], ("True", "False", "True")),
        ([Decimal("1.10"), Decimal("1.1"), Decimal("7.00")], ("1.10", "1.1", "7.00")),
        ([np.datetime64("2026-01-05")] * 3, ("2026-01-05 00:00:00",) * 3),
    ],
)
def test_typed_names_are_spelled_by_their_digits(cells: list[Any], names: tuple[str, ...]) -> None:
    table = pd.DataFrame({"episode_id": list("abc"), "group": cells, "y": [0, 1, 0]})
    assert Target.read(table, "y", group_by="group").groups == names


@pytest.mark.parametrize("cell", [float("inf"), 2.0**60])
def test_a_number_that_has_lost_its_name_is_refused_with_how_to_read_it(cell: float) -> None:
    """`pandas.read_csv` makes inf of the hash 5e882100."""
    table = pd.DataFrame({"episode_id": list("abc"), "group": [cell, 1.0, 2.0], "y": [0, 1, 0]})
    with pytest.raises(UsageError, match=r"row 1, column 'group' is .*dtype=\{'group': str\}"):
        Target.read(table, "y", group_by="group")


def test_a_series_with_its_keys_in_the_index_is_a_table(shown_run: Run) -> None:
    index = pd.MultiIndex.from_tuples([(0, 0), (1, 5), (2, 10)], names=["episode_index", "frame_index"])
    labels = Target.read(pd.Series([0.5, 1.5, 2.5], index, name="y"), "y").on(shown_run)
    assert labels.episodes == ("episode-000000", "episode-000001", "episode-000002")
    assert labels.inferences == (0, 1, 2)


# -- classes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("written", [as_csv, as_frame("object")], ids=["CSV", "objects"])
@pytest.mark.parametrize(
    ("cells", "classes"),
    [
        (["01", "02", "10"], ("01", "02", "10")),
        (["5e882100", "7e123400", "ab12cd34"], ("5e882100", "7e123400", "ab12cd34")),
        (["1e5", "100000", "2"], ("100000", "1e5", "2")),
        (["10", "9", "8"], ("8", "9", "10")),
    ],
)
def test_classes_that_are_declared_are_names(
    written: Callable[[pd.DataFrame, Path], Any], cells: list[str], classes: tuple[str, ...], tmp_path: Path
) -> None:
    table = written(table_of(["a", "b", "c"]).assign(y=cells), tmp_path)
    assert Target.read(table, "y", "classes").coded.classes == classes


@pytest.mark.parametrize(("cell", "message"), [("5e2100", "is infinite"), ("5e10", "expected one type")])
def test_a_hash_among_undeclared_labels_is_refused_with_the_task(cell: str, message: str) -> None:
    table = table_of(["a", "b", "c"]).assign(y=[cell, "ab12cd34", "cd34ab12"])
    with pytest.raises(UsageError, match=rf"{message}.*--task classes"):
        Target.read(table, "y")


def test_predictions_of_texts_of_digits_are_the_texts_of_their_rows() -> None:
    """Sorted as numbers, 9 comes before 10; as texts, behind it."""
    y = np.tile(["9", "10"], 20)
    X = np.stack([(y == "10").astype(float), np.arange(40) % 3], axis=1)
    probes = pk.probe(X, y, permutations=0)
    assert (probes.predictions[0] == y).all()


# -- keys -----------------------------------------------------------------------------------------------------


def test_an_id_that_lost_its_zeros_is_refused_with_the_one_that_the_run_has(shown_run: Run) -> None:
    table = label_frame(shown_run).assign(mine=lambda table: np.arange(len(table), dtype=float))
    shouted = table.assign(episode_id=table["episode_id"].str.upper())
    with pytest.raises(UsageError, match=r"It has 'episode-000000', .* dtype=\{'episode_id': str\}"):
        target_samples(shown_run, Target.read(shouted, "mine"), None, 0, None)
    assert similar_name("7", ["8", "007"]) == similar_name("7.0", ["007"]) == "007"
    assert similar_name("1e5", ["100000"]) is None


def frames() -> pd.DataFrame:
    keys = [(episode, frame) for episode in range(14) for frame in range(20)]
    table = pd.DataFrame(keys, columns=["episode_index", "frame_index"])
    return table.assign(index=table.index, y=np.random.default_rng(0).normal(size=len(table)))


@pytest.mark.parametrize("form", ["csv", "parquet", "frame"])
def test_labels_have_the_keys_of_lerobot(shown_run: Run, tmp_path: Path, form: str) -> None:
    """The run shows every fifth frame of twelve of the fourteen episodes."""
    table, path = frames(), tmp_path / f"labels.{form}"
    ours = table.rename(columns={"episode_index": "source_episode", "frame_index": "frame"})
    if form != "frame":
        (table.to_csv if form == "csv" else table.to_parquet)(path, index=False)
    theirs = Target.read(table if form == "frame" else path, "y").on(shown_run)
    expected = Target.read(ours, "y").on(shown_run)
    assert (theirs.episodes, theirs.inferences) == (expected.episodes, expected.inferences)
    np.testing.assert_array_equal(theirs.coded.values, expected.coded.values)
    assert len(theirs.episodes) == 47


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t.assign(source_episode=t["episode_index"] + 1),
            "'source_episode' is 1 and 'episode_index' is 0",
        ),
        (lambda t: t.assign(frame=t["frame_index"] + 1), "'frame' is 1 and 'frame_index' is 0"),
        (lambda t: t.assign(frame_index=t["frame_index"] + 1), "column 'frame_index' is 20; episode 0 of"),
        (lambda t: t.assign(episode_index=t["episode_index"] + 1), "column 'episode_index' is 14; the data set"),
        (lambda t: t.drop(columns="episode_index"), "has the keys 'episode_index' and 'frame_index'"),
        (lambda t: t.assign(frame_index=0), "episode '0', frame_index 0 has a label"),
        (lambda t: t.drop(columns="frame_index"), "or add a column 'frame'"),
    ],
)
def test_keys_of_lerobot_that_contradict_each_other_or_the_data_set_are_refused(
    shown_run: Run, change: Callable[[pd.DataFrame], pd.DataFrame], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        Target.read(change(frames()), "y").on(shown_run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"source_episode": 1},
            "column 'source_episode' is 1, and episode_id 'episode-000000' is episode 0 of the",
        ),
        ({"frame": 1}, "column 'frame' is 1, and episode_id 'episode-000000', inference 0, is frame 0 of the"),
    ],
)
def test_ids_and_numbers_of_other_episodes_are_refused(
    shown_run: Run, change: dict[str, int], message: str
) -> None:
    table = label_frame(shown_run).assign(mine=lambda table: np.arange(len(table), dtype=float))
    assert Target.read(table, "mine").on(shown_run).episodes
    for column, by in change.items():
        table[column] += by
    with pytest.raises(UsageError, match=message):
        Target.read(table, "mine").on(shown_run)
