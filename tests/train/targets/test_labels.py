"""Labels of one's own: what is read, and what is refused with its file and line."""

from datetime import timedelta
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from probe_kit._system.escaping import csv_of_frame
from probe_kit.errors import UsageError
from probe_kit.train import Target

HEADING = "episode_id,inference,y,scene\n"


def written(folder: Path, text: str) -> Path:
    file = folder / "labels.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_csv_a_parquet_file_and_a_frame_of_the_same_column_have_one_hash(tmp_path: Path) -> None:
    frame = pd.DataFrame({"episode_id": list("bacd"), "inference": [0, 1, 0, 0], "y": [0.1, 1 / 3, np.nan, 2]})
    frame.to_csv(tmp_path / "labels.csv", index=False)
    frame.to_parquet(tmp_path / "labels.parquet")
    read = [Target.read(source, "y") for source in (frame, tmp_path / "labels.csv", tmp_path / "labels.parquet")]
    assert len({labels.sha256 for labels in read}) == 1
    assert {labels.task for labels in read} == {"continuous"}
    shuffled = Target.read(frame.iloc[::-1], "y")
    assert shuffled.sha256 == read[0].sha256, "the order of the rows is no part of a column"
    other = Target.read(frame.assign(y=[0.1, 1 / 3, 2.0, 2]), "y")
    assert other.sha256 != read[0].sha256


@pytest.mark.parametrize(
    ("cells", "asked", "task", "classes"),
    [
        (["red", "blue", ""], None, "binary", ("blue", "red")),
        (["red", "blue", "green"], None, "classes", ("blue", "green", "red")),
        (["true", "false", "TRUE"], None, "binary", ("False", "True")),
        (["0", "1", "1.0"], None, "binary", ("0", "1")),
        (["0.5", "1", "nan"], None, "binary", ("0.5", "1")),
        (["0.5", "1", "2e-3"], None, "continuous", ()),
        (["10", "9", "8"], "classes", "classes", ("8", "9", "10")),
        (["10", "9", "8"], "continuous", "continuous", ()),
        ([str(number) for number in range(21)], None, "continuous", ()),
        (["'=SUM(A1)", "x", "'=SUM(A1)"], None, "binary", ("=SUM(A1)", "x")),
    ],
)
def test_the_task_follows_from_the_values_where_they_leave_no_doubt(
    tmp_path: Path, cells: list[str], asked: str | None, task: str, classes: tuple[str, ...]
) -> None:
    rows = "".join(f"e{number},{cell}\n" for number, cell in enumerate(cells))
    labels = Target.read(written(tmp_path, "episode_id,y\n" + rows), "y", task=asked)  # type: ignore[arg-type]
    assert (labels.task, labels.coded.classes, labels.per_step) == (task, classes, False)
    empty = [cell in ("", "nan") for cell in cells]
    assert np.isnan(labels.coded.values).tolist() == empty


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("episode,y\na,1\n", "line 1 lacks the key column 'episode_id'; it has episode, y"),
        ("episode_id,x\na,1\n", "has no column 'y' to decode; it has: x"),
        ("episode_id,y,y\na,1,2\n", "line 1 has the column 'y' twice"),
        ("episode_id,y\n", "has no line below its heading"),
        ("", "lacks the key column"),
        ("episode_id|y\na|1\n", "Its fields are separated by bars; save it with commas, semicolons or tabs."),
        ("episode_id,y\na,1\nb,red\n", "line 3, column 'y': 'red' is text, and line 2 has a number"),
        ("episode_id,y\na,1\n\nb,true\n", "line 4, column 'y': 'true' is text, and line 2 has a number"),
        ("episode_id,y\na,1\nb\n", "line 3 has 1 fields, the heading has 2"),
        ('episode_id,y\na,"1\n', "is no CSV"),
        ("episode_id,y\na,1\n,2\n", "line 3, column 'episode_id' is empty"),
        ("episode_id,y\na,9007199254740993\nb,1\n", "line 2, column 'y': the integer 9007199254740993 is beyond"),
        ("episode_id,y\na,1.5\nb,-inf\n", "line 3, column 'y' is infinite"),
        (
            "episode_id,y\na,red\nb,r\u202eed\n",
            "line 3, column 'y' holds the control or direction character U+202E",
        ),
        ("episode_id,y\na,1\nb,2\na,3\n", "line 4: episode 'a' has a label in line 2 already"),
        (HEADING + "a,0,1,s\na,0,2,s\n", "line 3: episode 'a', inference 0 has a label in line 2 already"),
        (HEADING + "a,-1,1,s\n", "line 2, column 'inference' is -1; expected the number of a captured"),
        (HEADING + "a,0.5,1,s\n", "line 2, column 'inference' is 0.5"),
        (HEADING + "a,inf,1,s\n", "line 2, column 'inference' is inf"),
        (HEADING + "a,,1,s\n", "line 2, column 'inference' is empty"),
        (HEADING + "a,0,1,s\nb,0,2,\n", "line 3, column 'scene' is empty; expected a name in every line"),
        ("episode_id,y\na,1\nb,1\n", "has one value, 1; expected two or more"),
        ("episode_id,y\na,\nb,\n", "has no value; expected two or more"),
        ("episode_id,y\na,1\nb,2\nc,3\n", "3 integers, from 1 to 3, which can be classes or quantities"),
    ],
)
def test_a_table_that_is_wrong_is_refused_with_its_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(UsageError) as refused:
        Target.read(written(tmp_path, text), "y", group_by="scene")
    assert expected in str(refused.value)


@pytest.mark.parametrize(
    ("cells", "task", "expected"),
    [
        (["red", "blue"], "continuous", "texts such as 'blue'; a continuous label needs numbers"),
        (["1", "2", "3"], "binary", "has 3 values (1, 2, 3, …); a binary label needs two"),
        (["1.5", "2", "3"], "classes", "decimals such as 1.5; classes need texts or integers"),
        (
            ["true", "false"],
            "continuous",
            "has true and false; a continuous label needs numbers. Use --task binary",
        ),
        (
            ["0.5", "1.5", "1e300"],
            None,
            "has values up to 1e+300, and they differ by 1e+300; expected at most 1e+100",
        ),
        (["1e-200", "2e-200", "3e-200"], None, "differences of at least 1e-100. Correct the cell"),
        (["1", "2"], "ordinal", "task 'ordinal'; expected one of binary, classes, continuous"),
    ],
)
def test_a_task_that_the_values_cannot_have_is_refused(
    tmp_path: Path, cells: list[str], task: str | None, expected: str
) -> None:
    rows = "".join(f"e{number},{cell}\n" for number, cell in enumerate(cells))
    with pytest.raises(UsageError) as refused:
        Target.read(written(tmp_path, "episode_id,y\n" + rows), "y", task=task)  # type: ignore[arg-type]
    assert expected in str(refused.value)


def test_files_that_are_no_tables_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        Target.read(tmp_path / "absent.csv", "y")
    (tmp_path / "bytes.csv").write_bytes(b"episode_id,y\n\xff\xfe,1\n")
    with pytest.raises(UsageError, match="Give a CSV file in UTF-8"):
        Target.read(tmp_path / "bytes.csv", "y")
    (tmp_path / "no.parquet").write_bytes(b"PAR1")
    with pytest.raises(UsageError, match="is no Parquet file"):
        Target.read(tmp_path / "no.parquet", "y")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([[1, 2], [3, 4]], "row 1, column 'y' is of type list; expected text, a number, or true or false"),
        ([{"a": 1}, {"a": 2}], "is of type dict"),
        ([b"x", b"y"], "is of type bytes"),
        ([timedelta(seconds=1), timedelta(seconds=2)], "a duration as a number of seconds"),
        ([2**60, None], "row 1, column 'y': the integer 1152921504606846976 is beyond 2^53"),
        ([2**64 - 1, 1], "row 1, column 'y': the integer 18446744073709551615 is beyond 2^53"),
        ([1.0, 2.0**60], "row 2, column 'y': the whole number 1.15292e+18 is beyond 2^53"),
    ],
)
def test_cells_of_parquet_that_are_no_labels_are_refused_with_their_row(
    tmp_path: Path, values: list[object], expected: str
) -> None:
    column = pa.array(values, pa.uint64() if 2**64 - 1 in values else None)
    parquet.write_table(pa.table({"episode_id": ["a", "b"], "y": column}), tmp_path / "labels.parquet")
    with pytest.raises(UsageError) as refused:
        Target.read(tmp_path / "labels.parquet", "y")
    assert expected in str(refused.value)


def test_a_column_that_a_parquet_file_has_twice_is_refused_and_others_keep_their_dots(tmp_path: Path) -> None:
    names = ["episode_id", "arm.y", "z", "z"]
    columns = [pa.array(["a", "b"]), pa.array([Decimal("0.25"), Decimal("1.50")]), *[pa.array([1, 2])] * 2]
    parquet.write_table(pa.Table.from_arrays(columns, names), tmp_path / "labels.parquet")
    assert Target.read(tmp_path / "labels.parquet", "arm.y", "continuous").coded.values.tolist() == [0.25, 1.5]
    with pytest.raises(UsageError, match="has the column 'z' twice"):
        Target.read(tmp_path / "labels.parquet", "z")


@pytest.mark.slow
def test_a_heading_of_a_million_columns_is_read_for_the_few_that_are_asked_for(tmp_path: Path) -> None:
    heading = "episode_id,y," + ",".join(f"x{number}" for number in range(10**6))
    rows = "".join(f"\ne{number},{number / 3}" + "," * 10**6 for number in range(3))
    labels = Target.read(written(tmp_path, heading + rows), "y")
    assert labels.coded.values.tolist() == [0, 1 / 3, 2 / 3]


def test_a_heading_of_a_million_columns_without_a_key_is_refused_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="line 1 lacks the key column") as refused:
        Target.read(written(tmp_path, ",".join(f"x{number}" for number in range(10**6))), "x1")
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize("formula", ["=1+1", "=cmd|' /C calc'!A0", "+1+1", "@SUM(A1)", "-2+3"])
def test_a_formula_is_a_text_and_leaves_as_one(tmp_path: Path, formula: str) -> None:
    """It names a class; what is written for a spreadsheet has a quotation mark in front."""
    labels = Target.read(written(tmp_path, f"episode_id,y\na,{formula}\nb,x\nc,x\n"), "y")
    assert formula in labels.coded.classes
    assert f"'{formula}" in csv_of_frame(pd.DataFrame({"class": labels.coded.classes}))


@pytest.mark.parametrize(
    ("text", "target", "expected"),
    [
        ("episode_id,y\u202e\na,1.5\nb,2.5\n", "y\u202e", "name of a column holds the control or direction"),
        ("episode_id,y\na\u202e,1.5\nb,2.5\n", "y", "line 2, column 'episode_id' holds the control or direction"),
        ("episode_id,y\na,r\x1b[31med\nb,blue\n", "y", "character U+001B"),
        ("episode_id,y\na,r\x00ed\nb,blue\n", "y", "character U+0000"),
        (
            "episode_id,y\na," + "9" * 5000 + "\nb,2.5\n",
            "y",
            "line 2, column 'y': the integer 999999999999… of 400 digits or more",
        ),
        ("episode_id,y\na,1e999\nb,2.5\n", "y", "line 2, column 'y' is infinite"),
        ("episode_id,y\na," + "x" * 200_000 + "\nb,y\n", "y", "line 2 is no CSV: field larger than field limit"),
        ("episode_id,y\na,1.5\nb,n.a.\n", "y", "line 3, column 'y': 'n.a.' may mean a missing value or a class"),
        ("source_episode,frame,y\n0,nan,1.5\n1,0,2.5\n", "y", "column 'frame' is empty; expected the number of a"),
        (
            "source_episode,frame,y\n0.5,0,1.5\n1,0,2.5\n",
            "y",
            "'source_episode' is 0.5; expected the number of an",
        ),
        ("source_episode,y\n-1,1.5\n1,2.5\n", "y", "column 'source_episode' is -1; expected the number of an"),
        ("source_episode,y\nx,1.5\n1,2.5\n", "y", "column 'source_episode' is 'x'; expected the number of an"),
    ],
)
def test_hostile_tables_are_refused_with_their_place(
    tmp_path: Path, text: str, target: str, expected: str
) -> None:
    with pytest.raises(UsageError) as refused:
        Target.read(written(tmp_path, text), target)
    assert expected in str(refused.value)


def test_numbers_of_episodes_as_a_merge_leaves_them_are_the_same_keys() -> None:
    """A column of integers with an empty cell somewhere becomes one of decimals."""
    whole = pd.DataFrame({"source_episode": [0, 1], "frame": [3, 4], "y": [1.5, 2.5]})
    decimal = whole.astype({"source_episode": float, "frame": float})
    assert Target.read(decimal, "y").episodes == Target.read(whole, "y").episodes == ("0", "1")
