"""Columns of labels: built in, or of a table, with their cells and tasks."""

import shutil
from collections.abc import Callable
from datetime import timedelta
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from probe_kit._system.escaping import csv_of_frame
from probe_kit.cli import app
from probe_kit.env.scoring import CHANNELS
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.runs import open_run
from probe_kit.train import Target, train_probes
from probe_kit.train.builtin_columns import SIM_COLUMNS, builtin_names, label_frame
from probe_kit.train.choices import SIDES, Task
from probe_kit.train.target_commands import CONSTANT, listed_targets
from tests.support.labelled_run import CALLS, EVERY, GRASP, RELEASE

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
    ("cells", "declared_task", "task", "classes"),
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
    tmp_path: Path, cells: list[str], declared_task: str | None, task: str, classes: tuple[str, ...]
) -> None:
    rows = "".join(f"e{number},{cell}\n" for number, cell in enumerate(cells))
    labels = Target.read(written(tmp_path, "episode_id,y\n" + rows), "y", task=declared_task)  # type: ignore[arg-type]
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
    with pytest.raises(UsageError, match=r"there is no file .*absent\.csv; expected a table"):
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


@pytest.mark.slow
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
    table = pd.DataFrame({"source_episode": [0, 1], "frame": [3, 4], "y": [1.5, 2.5]})
    decimal = table.astype({"source_episode": float, "frame": float})
    assert Target.read(decimal, "y").episodes == Target.read(table, "y").episodes == ("0", "1")


Reader = Callable[..., Target]


def of_csv(cells: list[str], folder: Path, task: Task | None = None) -> Target:
    frame = pd.DataFrame({"episode_id": [f"e{number}" for number in range(len(cells))], "y": cells})
    frame.to_csv(folder / "labels.csv", index=False)
    return Target.read(folder / "labels.csv", "y", task)


def of_frame(cells: list[str], folder: Path, task: Task | None = None) -> Target:
    del folder
    frame = pd.DataFrame({"episode_id": [f"e{number}" for number in range(len(cells))], "y": cells})
    return Target.read(frame, "y", task)


def of_parquet(cells: list[str], folder: Path, task: Task | None = None) -> Target:
    ids = [f"e{number}" for number in range(len(cells))]
    parquet.write_table(
        pa.table({"episode_id": ids, "y": pa.array(cells, pa.string())}), folder / "labels.parquet"
    )
    return Target.read(folder / "labels.parquet", "y", task)


every_format = pytest.mark.parametrize("read", [of_csv, of_frame, of_parquet])


@every_format
@pytest.mark.parametrize(
    ("cells", "values"),
    [
        (["0,1", "0,25", "1"], [0.1, 0.25, 1]),
        (["0,5", "1,234", "-2,5"], [0.5, 1.234, -2.5]),
        ([",5", "1,5e-3", "+2,5"], [0.5, 0.0015, 2.5]),
        (["0.1", "1.234", "5."], [0.1, 1.234, 5]),
        (["10%", "20 %", "12.5%"], [0.1, 0.2, 0.125]),
        (["1,5%", "2,25 %", "3%", "NA"], [0.015, 0.0225, 0.03, np.nan]),
        (["\u22120.5", "\u20130.25", "\uff0d1.5"], [-0.5, -0.25, -1.5]),
        (["'0.5", "'-1.5", "2.25"], [0.5, -1.5, 2.25]),
        ([" 0.5 ", "\u00a01.5", "2.25\n"], [0.5, 1.5, 2.25]),
        (["0.5", "1e3", "2E-1"], [0.5, 1000, 0.2]),
    ],
)
def test_a_quantity_that_is_spelled_without_doubt_is_a_number(
    read: Reader, cells: list[str], values: list[float], tmp_path: Path
) -> None:
    labels = read(cells, tmp_path)
    assert (labels.task, labels.coded.classes) == ("continuous", ())
    np.testing.assert_allclose(labels.coded.values, values, rtol=1e-15)


@every_format
@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["0,5", "0.7", "0.9"], "row 1.*'0,5' and .*'0.7'; expected one decimal sign"),
        (["1,234", "2,345", "3,456"], "'1,234' may be 1.234 or 1234"),
        (["10%", "0.2", "0.3"], "'0.2' and .*'10%'; expected a percent sign in every cell or in none"),
        (["10%", "red", "20%"], "expected a percent sign in every cell or in none"),
    ],
)
def test_a_number_with_two_readings_is_refused_with_what_to_write(
    read: Reader, cells: list[str], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=expected.replace("row 1", "(row 1|line 2)")):
        read(cells, tmp_path)


@pytest.mark.parametrize(("cells", "is_read"), [("1.000;1.250;999", False), ("1.000;1.250;0.999", True)])
def test_a_point_may_separate_thousands_in_a_table_with_semicolons(
    cells: str, is_read: bool, tmp_path: Path
) -> None:
    file = tmp_path / "labels.csv"
    rows = "".join(f"e{number};{cell}\n" for number, cell in enumerate(cells.split(";")))
    file.write_text("episode_id;y\n" + rows, encoding="utf-8")
    if is_read:
        assert Target.read(file, "y").coded.values.tolist() == [1, 1.25, 0.999]
    else:
        with pytest.raises(UsageError, match=r"line 2.*'1.000' may be 1.000 or 1000"):
            Target.read(file, "y")
    file.write_text(file.read_text(encoding="utf-8").replace(";", ","), encoding="utf-8")
    assert Target.read(file, "y").coded.values[0] == 1


QUANTITIES = [
    "{}.5 m", "0.{}m", "{} cm", "{}mm", "{} °", "{}°C", "0,{} m", "$ {}", "{} €", "~{}", "≈ 0.{}", "<{}", "±0.{}",
    "({}.5)",
    "1 00{}", "1'00{}", "1_00{}", "1,00{}.5", "1.000,{}", "1,000,00{}", "1.000.00{}", "0.{} furlongs",
    "{} cups", "{}/7",
    "0:0{}", "12:3{}", "1:02:3{}.5", "{} N", "{}.5 rad/s", "0.{} ‰", "\uff11\uff0e{}", "\u0661\u066b{}", "- 0.{}",
]  # fmt: skip


@every_format
@pytest.mark.parametrize("form", QUANTITIES)
def test_a_quantity_in_another_spelling_is_never_decoded_as_classes(
    read: Reader, form: str, tmp_path: Path
) -> None:
    cells = [form.format(number) for number in (1, 2, 3, 1)]
    with pytest.raises(UsageError, match=r"(line 2|row 1), column 'y': .* looks like a quantity.*--task"):
        read(cells, tmp_path)
    with pytest.raises(UsageError, match=r"looks like a quantity|continuous label needs numbers"):
        read(cells, tmp_path, "continuous")
    labels = read(cells, tmp_path, "classes")
    assert (labels.task, len(labels.coded.classes)) == ("classes", 3)


@every_format
@pytest.mark.parametrize(
    "cells",
    [
        ["red", "blue", "green"],
        ["1st", "2nd", "3rd"],
        ["level 1", "level 2", "level 3"],
        ["2026-01-05", "2026-01-06", "2026-01-07"],
        ["05.01.2026", "06.01.2026", "07.01.2026"],
        ["0-10", "10-20", "20-30"],
        ["3D", "4x", "5a"],
        ["a1", "b2", "v1.2.3"],
        ["yes", "no", "maybe"],
    ],
)
def test_names_of_classes_may_have_digits(read: Reader, cells: list[str], tmp_path: Path) -> None:
    labels = read(cells, tmp_path)
    assert labels.coded.classes == tuple(sorted(cells))


@every_format
@pytest.mark.parametrize(
    ("cells", "classes", "values"),
    [
        (["Yes", "yes", "NO", "no"], ("no", "yes"), [1, 1, 0, 0]),
        (["y", "yes", "N", "no"], ("no", "yes"), [1, 1, 0, 0]),
        (["yes", "TRUE", "false", "no"], ("no", "yes"), [1, 1, 0, 0]),
        (["TRUE", "True", "false", "F"], ("False", "True"), [1, 1, 0, 0]),
        (["1", "1.0", "0", "0.0"], ("0", "1"), [1, 1, 0, 0]),
        (["cafe\u0301", "café", "a  b", "a\u00a0b"], ("a b", "café"), [1, 1, 0, 0]),
    ],
)
def test_spellings_of_one_class_are_one_class(
    read: Reader, cells: list[str], classes: tuple[str, ...], values: list[int], tmp_path: Path
) -> None:
    labels = read(cells, tmp_path)
    assert (labels.task, labels.coded.classes) == ("binary", classes)
    assert labels.coded.values.tolist() == values


@every_format
@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["Red", "red", "blue"], "'red', and .*'Red'; expected one spelling"),
        (["red", "re\u00add", "blue"], "'re.*d', and .*'red'; expected one spelling"),
        (["7", "007", "8"], "'007', and .*'7'; expected one spelling"),
        (["yes", "ja", "no"], "'ja' in a column of yes and no"),
        (["yes", "no", "1"], "'1' in a column of yes and no"),
        (["yes", "y", "no", "maybe"], "'y' in a column of yes and no"),
        (["true", "false", "1"], "is a number|has a number"),
    ],
)
def test_spellings_that_may_be_one_class_are_refused(
    read: Reader, cells: list[str], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=expected):
        read(cells, tmp_path)


def test_equal_rows_count_once_and_contradicting_ones_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "labels.csv"
    file.write_text("episode_id,y,scene\na,yes,7\nb,no,8\na,Yes,7\nb,no,8\n", encoding="utf-8")
    labels = Target.read(file, "y", group_by="scene")
    assert (labels.episodes, labels.groups, labels.table.lines) == (("a", "b"), ("7", "8"), [2, 3])
    assert labels.coded.values.tolist() == [1, 0]
    for row in ("a,no,7", "a,yes,9", "a,,7"):
        file.write_text(f"episode_id,y,scene\na,yes,7\nb,no,8\n{row}\n", encoding="utf-8")
        with pytest.raises(UsageError, match="line 4: episode 'a' has a label in line 2 already"):
            Target.read(file, "y", group_by="scene")


def test_what_a_column_holds_is_one_line(tmp_path: Path) -> None:
    assert of_csv(["0,5", "1,5", ""], tmp_path).contents == "y (binary), 2 classes: 0.5 1, 1.5 1; 1 missing"
    assert of_csv(["0,5", "1,5", "2,5", "NA"], tmp_path).contents == (
        "y (continuous), 3 numbers from 0.5 to 2.5; 1 missing"
    )
    many = [f"kind{number:02}" for number in range(25)]
    assert of_csv(many, tmp_path).contents.endswith("kind18 1, kind19 1, and 5 more")


def test_columns_of_the_simulation_are_the_stored_state_at_the_step_of_each_inference(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    frame = label_frame(run)
    assert len(frame) == CALLS * len(run.episodes) - 2, "the last episode ended after two inferences"
    assert frame["control_step"].tolist()[:CALLS] == [0, EVERY, 2 * EVERY, 3 * EVERY]
    row, simulated_state = frame.iloc[CALLS + 2], run.trajectory(1).frames[2 * EVERY]
    state = dict(zip(CHANNELS, simulated_state.tolist(), strict=True))
    for name in ("tool", "cube"):
        assert [row[f"sim.{name}_{axis}"] for axis in "xyz"] == [state[f"{name}.{axis}"] for axis in "xyz"]
    tile = f"tile_{run.episodes['side_correct'].iloc[1]}"
    away = [state[f"cube.{axis}"] - state[f"{tile}.{axis}"] for axis in "xy"]
    assert row["sim.distance_correct"] == pytest.approx(np.hypot(*away), rel=1e-6)
    steps = frame["control_step"]
    complete_rows = frame["episode_id"] != run.episodes["episode_id"].iloc[-1]
    assert (frame["sim.steps_to_grasp"] == GRASP - steps).all()
    assert (frame["sim.held"] == ((steps >= GRASP) & (steps < RELEASE))).all()
    phases = np.select([steps < GRASP, steps < RELEASE], ["before grasp", "holding"], "after release")
    assert (frame["sim.phase"] == phases)[complete_rows].all()


def test_columns_of_the_item_name_its_pictures(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    first = label_frame(run).groupby("episode_id", sort=False).first()
    for episode, row in run.episodes.set_index("episode_id").iterrows():
        item_row = first.loc[episode]
        assert (item_row["item.named"], item_row["item.other"]) == (
            row["target_concept"],
            row["distractor_concept"],
        )
        left_concept = row["target_concept"] if row["side_correct"] == "left" else row["distractor_concept"]
        assert item_row["item.left"] == left_concept
        assert item_row["item.pair"].split(" / ") == sorted([row["target_concept"], row["distractor_concept"]])
        assert item_row["item.category"] == row["category"]


def test_every_built_in_column_is_the_same_from_the_run_and_from_its_table(
    labelled_run: Path, tmp_path: Path
) -> None:
    file = tmp_path / "labels.csv"
    written = CliRunner().invoke(app, ["labels", str(labelled_run), "--out", str(file)])
    assert written.exit_code == 0, written.stderr
    for name in set(builtin_names()) - {"item.category"}:
        assert name in written.stdout
        built_in = Target.of_run(open_run(labelled_run), name)
        read = Target.read(file, name, task=built_in.task)
        assert read.coded.classes == built_in.coded.classes, name
        assert (read.sha256 == built_in.sha256) == name.startswith("sim."), "items have no inference"
    assert CliRunner().invoke(app, ["labels", str(labelled_run), "--out", str(file)]).exit_code == 2, "it exists"


def test_a_constant_or_unknown_column_is_refused_by_name(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    assert ("item.category", CONSTANT) in [row[:2] for row in listed_targets(run.only(["color"]))]
    constant = {name for name, task, *_ in listed_targets(run) if task == CONSTANT}
    assert not {"item.category", *SIDES} & constant
    with pytest.raises(UsageError, match=r"'item.category' has one value"):
        Target.of_run(run.only(["color"]), "item.category")
    with pytest.raises(UsageError, match=r"no built-in column 'sim.tool_w'; there are: sim.tool_x"):
        Target.of_run(run, "sim.tool_w")


@pytest.mark.slow
def test_a_target_has_options_exactly_where_train_accepts_it(labelled_run: Path, tmp_path: Path) -> None:
    shutil.copytree(labelled_run, tmp_path / "run")
    run = open_run(tmp_path / "run")
    rows = {row.target: row for row in listed_targets(run) if row.options is not None or row.refused}
    assert rows["side.correct"].options == ()
    assert rows["sim.held"].options == ("--target", "sim.held")
    assert rows["side.chosen"].options is None
    assert "0 independent groups" in rows["side.chosen"].refused
    for name, row in rows.items():
        target = Target.of_run(run, name, task="classes" if "classes" in (row.options or ()) else None)
        if row.options is None:
            with pytest.raises(ProbeKitError) as refusal:
                train_probes(run, target=target, permutations=0, controls=())
            assert row.refused in str(refusal.value)
        else:
            train_probes(run, target=target, permutations=0, controls=())


def test_a_category_with_too_few_groups_is_left_out_of_the_command(labelled_run: Path, tmp_path: Path) -> None:
    shutil.copytree(labelled_run, tmp_path / "run")
    for commit in sorted((tmp_path / "run" / "commits").iterdir())[-12:]:
        commit.unlink()
    for sealed in ("sealed", "columns.zarr"):
        shutil.rmtree(tmp_path / "run" / sealed)
    run = open_run(tmp_path / "run", allow_partial=True)
    assert run.episodes.groupby("category")["group_id"].nunique().to_dict() == {"color": 6, "shape": 3}
    assert next(iter(listed_targets(run))).options == ("--categories", "color")


def test_a_run_that_did_not_act_has_no_chosen_side(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    run.episodes.drop(columns=["side_placed"], inplace=True)
    with pytest.raises(UsageError, match=r"captured without acting"):
        Target.of_run(run, "side.chosen")


@pytest.mark.slow
def test_a_target_is_added_by_the_entry_that_contributing_shows(
    labelled_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The diff of CONTRIBUTING is applied; list, table and probes then have the target."""
    page = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    diff = page.partition("## To add a target")[2].partition("```diff")[2].partition("```")[0]
    added = "\n".join(line[1:] for line in diff.splitlines() if line.startswith("+ "))
    (entry,) = eval(f"{{{added}}}", {"np": np}).items()
    monkeypatch.setitem(SIM_COLUMNS, *entry)
    shutil.copytree(labelled_run, tmp_path / "run")
    run = open_run(tmp_path / "run")
    assert "sim.speed" in [name for name, *_ in listed_targets(run)]
    assert label_frame(run)["sim.speed"].min() >= 0
    results = train_probes(run, target="sim.speed", permutations=0, controls=("step",))
    assert results.settings.task == "continuous"
