"""Cells of a label column that people write: numbers, percentages, units, yes and no, and spellings of a class."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from probe_kit.errors import UsageError
from probe_kit.train import Target
from probe_kit.train.choices import Task

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
    file.write_text("episode_id,y,scene\na,yes,7\nb,no,8\na,Yes,7.0\nb,no,8\n", encoding="utf-8")
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
