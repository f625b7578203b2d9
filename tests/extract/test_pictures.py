"""A folder of pictures with a table: one inference about each line, its other columns as labels."""

import csv
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import probe_kit as pk
from probe_kit.cli import app
from probe_kit.diagnose.diagnosis import diagnose_run
from probe_kit.errors import ProbeKitError, RecordingError, TooFewGroupsError, UsageError
from probe_kit.extract import ExtractSettings, PictureFolder, extract_run, prepare
from probe_kit.extract.config_files import moved_of
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.extract.sources import kinds
from probe_kit.extract.sources.pictures import PictureSource
from probe_kit.hashing import derive_seed
from probe_kit.hooks import Observation, Policy
from probe_kit.intervene import AttentionReadout, InstructionSwap, ReplayFiles, run_intervention
from probe_kit.intervene.frame_session import Frames, FrameSession
from probe_kit.intervene.open_session import open_session
from probe_kit.retention.displays import attention_on_picture
from probe_kit.runs import open_run, verify_run
from probe_kit.train.builtin_columns import label_frame
from probe_kit.view.catalogue import Catalogue
from tests.view.payload_reader import floats, read_payload

COUNT = 12
TEXTS = ("Put the cube on the red shape", "Put the cube on the gray shape")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve pictures; `red` and `side` say on which side the red square is, of all but the last one."""
    home = tmp_path_factory.mktemp("pictures")
    lines: list[dict[str, Any]] = []
    for number in range(COUNT):
        picture = np.random.default_rng(number).integers(150, 256, (48, 64, 3), dtype=np.uint8)
        picture[10:30, slice(4, 24) if number % 2 else slice(40, 60)] = (200, 20, 20)
        Image.fromarray(picture).save(home / f"{number}.png")
        text = TEXTS[number // 2 % 2]
        labels = {"red": number % 2, "side": ["", "right", "left"][(number < COUNT - 1) * (1 + number % 2)]}
        lines.append({"picture": f"{number}.png", "instruction": text, "group": f"g{number}", **labels})
    with (home / "table.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)
    return home


def source(folder: Path) -> PictureFolder:
    return PictureFolder(folder, folder / "table.csv")


@pytest.fixture(scope="module")
def run(folder: Path, pi0_tiny: Policy, tmp_path_factory: pytest.TempPathFactory) -> pk.Run:
    settings = ExtractSettings("pi0-tiny", source=source(folder), env_workers=0)
    return prepare(settings, model=pi0_tiny).run(tmp_path_factory.mktemp("shown") / "run")


def test_every_line_is_a_row_with_the_models_own_prediction_bit_for_bit(
    run: pk.Run, folder: Path, pi0_tiny: Policy
) -> None:
    assert verify_run(run.path, deep=True).ok
    assert str(folder) not in json.dumps(run.settings), "where the pictures and their table lie is of this machine"
    assert run.episodes["instruction"].tolist() == [TEXTS[number // 2 % 2] for number in range(COUNT)]
    assert run.episodes["group_id"].tolist() == [f"g{number}" for number in range(COUNT)]
    assert run.inputs is not None
    assert run.inputs.read("columns")[:, 0, 0].tolist() == [number % 2 for number in range(COUNT)]
    policy = pi0_tiny.with_cameras(pi0_tiny.card.cameras[:1])
    picture = np.asarray(Image.open(folder / "3.png"))
    seed = derive_seed(int(run.episodes["policy_seed"][3]), "inference", 0)
    with torch_threads(1):  # as a small network has in a run
        expected = policy.predict([Observation(picture, np.zeros(8, np.float32), TEXTS[1])], [seed])[0]
    np.testing.assert_array_equal(run.inputs.read("prediction")[3, 0], expected)
    assert np.isfinite(run.column(pk.Site("backbone", 3), "mean")).all()


def test_columns_of_texts_and_of_true_and_false_are_labels_as_they_were_written(
    run: pk.Run, tmp_path: Path
) -> None:
    table = label_frame(run)
    sides = ["left" if number % 2 else "right" for number in range(COUNT - 1)]
    assert table["picture"].tolist() == [f"{number}.png" for number in range(COUNT)]
    assert table["dataset.side"].tolist() == [*sides, None], "an empty cell is no class"
    target = pk.Target.of_run(run, "dataset.side")
    assert (target.coded.task, target.coded.classes) == ("binary", ("left", "right"))
    Image.new("RGB", (64, 48)).save(tmp_path / "0.png")
    lines = "".join(f"0.png,{TEXTS[0]},{word}\n" for word in ("true", "false", "true"))
    (tmp_path / "table.csv").write_text(f"picture,instruction,open\n{lines}", encoding="utf-8")
    opened = source(tmp_path).open()
    assert opened.identity(0)["dataset"]["names"] == {"truth": ["open"]}
    assert [row.content.numbers for row in opened.rows(0)] == [(1.0,), (0.0,), (1.0,)]


def test_another_picture_is_another_row(folder: Path, tmp_path: Path) -> None:
    Image.new("RGB", (64, 48)).save(tmp_path / "0.png")
    (tmp_path / "table.csv").write_text(f"picture,instruction\n0.png,{TEXTS[0]}\n", encoding="utf-8")
    rows = [source(home).open().rows(0)[0].columns["content_blake2b"] for home in (folder, tmp_path)]
    assert rows[0] != rows[1]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("picture\n0.png\n", "expected the columns picture and instruction"),
        ("", "no line"),
        ("picture,instruction\nnone.png,go\n", "none.png cannot be read"),
        ("picture,instruction\n../0.png,go\n", "expected a file in the folder"),
        ("picture,instruction\n0.png,\n", "line 2 has the instruction ''"),
        ("picture,instruction,red\n0.png,go,5 cm\n", "line 2, column 'red': '5 cm' looks like a quantity"),
        (
            "picture,instruction,red\n0.png,go,left\n0.png,go,2\n",
            "line 3, column 'red': 2 is a number, and line 2",
        ),
        ("picture,instruction,id\n0.png,go,a\n0.png,go,a\n", "the id 'a' twice"),
        ("picture,instruction\ntable.csv,go\n", "table.csv"),
        ("picture,instruction,id\n0.png,go,\x1b[31mred\n", "the id .*expected plain text"),
        ("picture,instruction,group\n0.png,go,\u202ered\n", "the group .*expected plain text"),
        ("picture,instruction,side\n0.png,go,\x9b2J\n", "column 'side' holds the control .*expected plain text"),
        ("picture,instruction,\x1b[2J\n0.png,go,left\n", "the heading .*expected plain text"),
    ],
)
def test_a_line_that_cannot_be_shown_is_named(folder: Path, tmp_path: Path, table: str, message: str) -> None:
    (tmp_path / "0.png").write_bytes((folder / "0.png").read_bytes())
    (tmp_path / "table.csv").write_text(table, encoding="utf-8")
    with pytest.raises(ProbeKitError, match=message) as refused:
        source(tmp_path).open()
    assert isinstance(refused.value, RecordingError | UsageError)


def test_a_link_in_the_folder_is_followed_within_it_alone(folder: Path, tmp_path: Path) -> None:
    home, sibling = tmp_path / "home", tmp_path / "home-beside"
    shutil.copytree(folder, home)
    shutil.copytree(folder, sibling)
    (home / "inside.png").symlink_to("0.png")
    (home / "outside.png").symlink_to(sibling / "0.png")
    (home / "elsewhere").symlink_to(sibling)
    (tmp_path / "another").symlink_to(home)
    for name in ("inside.png", "outside.png", "elsewhere/0.png"):
        (home / "table.csv").write_text(f"picture,instruction\n{name},go\n", encoding="utf-8")
        if name == "inside.png":
            assert len(source(tmp_path / "another").open().rows(0)) == 1
            continue
        with pytest.raises(RecordingError, match=f"line 2 names {name}, a link to a file outside"):
            source(home).open()


def test_a_table_of_a_spreadsheet_is_read_by_the_rules_of_all_tables(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "0.png").write_bytes((folder / "0.png").read_bytes())
    table = tmp_path / "table.csv"
    table.write_bytes("sep=;\r\npicture;instruction;group;red\r\n0.png;gehe;7.0;−2\r\n".encode("utf-16"))
    (row,) = source(tmp_path).open().rows(0)
    assert (row.columns["group_id"], row.content.numbers) == ("7.0", (-2.0,)), "a name is no number"
    table.write_text("picture,instruction,group\n0.png,go,Red\n0.png,go,red\n", encoding="utf-8")
    with pytest.raises(UsageError, match="expected one spelling"):
        source(tmp_path).open()
    table.write_text("picture,instruction,red\n0.png,go,1e999\n", encoding="utf-8")
    with pytest.raises(UsageError, match="expected a finite number"):
        source(tmp_path).open()


@pytest.mark.slow
def test_pictures_are_shown_again_for_interventions_and_diagnoses(
    run: pk.Run, folder: Path, pi0_tiny: Policy
) -> None:
    with open_session(run, ReplayFiles(), lambda *_: pi0_tiny) as session:
        assert isinstance(session, FrameSession)
        frames = session.frames.index
        assert [frame.group for frame in frames] == [f"g{number}" for number in range(COUNT)]
        for number in (0, COUNT - 1):
            picture = np.asarray(Image.open(folder / f"{number}.png"))
            np.testing.assert_array_equal(frames[number].observation.image, picture)
    swapped = run_intervention(run, InstructionSwap(), load=lambda *_: pi0_tiny)
    assert np.isfinite(swapped.outcomes.displacement).any()
    assert diagnose_run(run, load=lambda *_: pi0_tiny).inputs


def test_pictures_that_were_moved_are_given_by_the_options_of_extract(
    run: pk.Run, folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path / "photos")
    moved = pk.open_run(run.path)
    gone = {"folder": "/nowhere/photos", "table": "/nowhere/table.csv"}
    moved.__dict__["origins"] = tuple(replace(origin, files=gone) for origin in run.origins)
    with pytest.raises(UsageError, match="Give it with --pictures"):
        Frames(moved, ReplayFiles())
    places = moved_of(moved, {"pictures": tmp_path / "photos", "table": tmp_path / "photos" / "table.csv"})
    frames = Frames(moved, ReplayFiles(moved=places))
    assert len(frames.index) == COUNT


@pytest.mark.slow
def test_the_viewer_shows_a_pictures_run_with_its_attention_over_each_picture(
    run: pk.Run, pi0_tiny: Policy, tmp_path: Path
) -> None:
    copy = open_run(shutil.copytree(run.path, tmp_path / "run"))
    run_intervention(copy, AttentionReadout(items=2), load=lambda *_: pi0_tiny)
    catalogue = Catalogue([copy])
    _, viewed = read_payload(catalogue.script("run/run"))
    assert (viewed["sides"], viewed["committed"]) == (False, COUNT)
    _, episode = read_payload(catalogue.script("run/e/00001"))
    assert (episode["frames"]["count"], episode["frames"]["steps"], episode["attention"]["steps"]) == (1, [0], [0])
    boxes = floats(episode["attention"]["boxes"]).reshape(-1, 4)
    (weights,) = (floats(packed) for packed in episode["attention"]["weights"])
    assert weights.size == episode["attention"]["blocks"] * len(boxes)
    assert catalogue.picture("run", 1) is not None
    assert attention_on_picture(copy).axes


def test_the_viewer_names_a_picture_and_says_its_labels_in_words(run: pk.Run) -> None:
    catalogue = Catalogue([run])
    _, episodes = read_payload(catalogue.script("run/episodes"))
    assert [episodes["item"]["words"][code] for code in episodes["item"]["codes"]][3] == "3.png"
    _, episode = read_payload(catalogue.script("run/e/00003"))
    assert episode["words"] == {"picture": "3.png", "side": "left"}
    (columns,) = (group for group in episode["inputs"] if group["title"] == "columns")
    assert [series["name"] for series in columns["series"]] == ["red"], "a text is no chart"
    _, last = read_payload(catalogue.script(f"run/e/{COUNT - 1:05d}"))
    assert last["words"] == {"picture": f"{COUNT - 1}.png"}, "an empty cell is no label"


def test_a_picture_that_changes_after_the_plan_is_not_shown(
    folder: Path, pi0_tiny: Policy, tmp_path: Path
) -> None:
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    planned = prepare(ExtractSettings("pi0-tiny", source=source(tmp_path), env_workers=0), model=pi0_tiny)
    for number in range(COUNT):
        Image.new("RGB", (64, 48)).save(tmp_path / f"{number}.png")
    with pytest.raises(ProbeKitError) as failed:
        planned.run(tmp_path / "run")
    assert "was changed after the run was planned" in failed.value.__notes__[0]


def test_pictures_refuse_by_name_the_options_that_they_cannot_use(folder: Path) -> None:
    refused: list[dict[str, Any]] = [{"execute": 2}, {"video": "all"}, {"batch": "auto"}]
    for values in refused:
        with pytest.raises(UsageError, match="does not apply with --pictures"):
            prepare(ExtractSettings("pi0-tiny", source=source(folder), **values))
    with pytest.raises(UsageError, match="--items does not apply with --pictures"):
        ExtractSettings.of_command({"model": "x", "pictures": "a", "table": "b", "items": 2})
    with pytest.raises(UsageError, match="--table"):
        ExtractSettings.of_command({"model": "x", "pictures": "a"})


@pytest.mark.slow
def test_workers_show_the_same_pictures(run: pk.Run, folder: Path, tmp_path: Path) -> None:
    again = extract_run(ExtractSettings("pi0-tiny", source=source(folder), workers=2), tmp_path / "run")
    site = pk.Site("expert", 3, iteration=9)
    np.testing.assert_array_equal(again.column(site, "mean"), run.column(site, "mean"))


def test_a_run_names_the_table_that_was_read_even_if_it_is_changed_later(folder: Path, tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_bytes((folder / "table.csv").read_bytes())
    opened = PictureSource.open(PictureFolder(folder, table), selects_only=False)
    before = opened.identity(1)
    table.write_text("picture,instruction\n0.png,another\n", encoding="utf-8")
    assert opened.identity(1) == before
    changed = PictureSource.open(PictureFolder(folder, table), selects_only=False)
    assert changed.identity(1) != before


@pytest.mark.slow
def test_the_next_step_is_a_target_that_can_be_probed_and_one_of_few_integers_has_its_task(
    run: pk.Run, folder: Path, tmp_path: Path
) -> None:
    lines = (folder / "table.csv").read_text(encoding="utf-8").splitlines()
    counts = [line.rsplit(",", 3)[0] + f",{number % 3}" for number, line in enumerate(lines[1:])]
    (tmp_path / "counts.csv").write_text("\n".join(["picture,instruction,objects", *counts]), encoding="utf-8")
    settings = ExtractSettings("pi0-tiny", source=PictureFolder(folder, tmp_path / "counts.csv"), env_workers=0)
    counted = extract_run(settings, tmp_path / "run")
    for where, options in (
        (run.location, "--target dataset.red"),
        (counted.location, "--target dataset.objects --task continuous"),
    ):
        listed = CliRunner().invoke(app, ["targets", str(where)])
        assert f"next: probe-kit train {where} {options}\n" in listed.stderr.replace("\n ", " "), listed.stderr
    with pytest.raises(UsageError, match=r"shows pictures .* `probe-kit targets "):
        pk.train_probes(counted)


@pytest.mark.slow
def test_a_target_that_train_would_refuse_is_no_next_step(folder: Path, tmp_path: Path) -> None:
    lines = (folder / "table.csv").read_text(encoding="utf-8").splitlines()
    rare = [
        f"{line.rsplit(',', 3)[0]},{'rare' if number < 3 else 'often'}" for number, line in enumerate(lines[1:])
    ]
    (tmp_path / "rare.csv").write_text("\n".join(["picture,instruction,kind", *rare]), encoding="utf-8")
    settings = ExtractSettings("pi0-tiny", source=PictureFolder(folder, tmp_path / "rare.csv"), env_workers=0)
    few = extract_run(settings, tmp_path / "run")
    listed = CliRunner().invoke(app, ["targets", str(few.location)])
    assert "train refuses dataset.kind: the class 'rare' is in 3 of 12 groups" in listed.stderr
    assert "next: probe-kit labels" in listed.stderr.replace("\n", " ")
    with pytest.raises(TooFewGroupsError, match="is in 3 of 12 groups"):
        pk.train_probes(few, target=pk.Target.of_run(few, "dataset.kind"))


PAGE = Path(__file__).parents[2] / "CONTRIBUTING.md"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder of the import path with the new file and what an installer makes of the entry point."""
    page = PAGE.read_text(encoding="utf-8")
    file = page.partition("## To add a source\n")[2].partition("```python\n")[2].partition("```")[0]
    (tmp_path / "noise_source.py").write_text(file, encoding="utf-8")
    (entry,) = [line for line in page.splitlines() if line.startswith("noise = ")]
    about = tmp_path / "noise_source-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: noise-source\nVersion: 1\n", encoding="utf-8")
    points = f"[{kinds.ENTRY_POINTS}]\n{entry.replace(chr(34), '')}\n"
    (about / "entry_points.txt").write_text(points, encoding="utf-8")
    return tmp_path


def typed(package: Path, *line: str) -> None:
    """Type a line of probe-kit where the package is installed."""
    path = os.pathsep.join([str(package), *sys.path])
    ended = subprocess.run(
        [sys.executable, "-m", "probe_kit", *line],
        capture_output=True, encoding="utf-8", check=False, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr


@pytest.mark.slow
def test_a_source_is_one_file_from_its_option_to_its_run(package: Path, tmp_path: Path) -> None:
    line = ("extract", "--model", "pi0-tiny", "--noise", "3", "--env-workers", "0")
    typed(package, *line, "--out", str(tmp_path / "run"))
    run = pk.open_run(tmp_path / "run")
    assert len(run.episodes) == 3
    column = run.column(pk.Site("backbone", 3), "mean")
    assert np.isfinite(column).all()
    assert len(np.unique(column, axis=0)) == 3


@pytest.mark.slow
def test_a_model_that_answers_is_asked_about_the_same_source(package: Path, tmp_path: Path) -> None:
    """It predicts no actions, so that the run declares none."""
    typed(
        package, "ask", "--model", "vlm-tiny", "--noise", "3", "--tokens", "pooled", "--out", str(tmp_path / "run")
    )
    assert len(pk.open_run(tmp_path / "run" / "instruction").episodes) == 3


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("json:loads", "no class derived from SourceSettings"),
        ("no_such_module_here:Noise", "ModuleNotFoundError"),
        ("probe_kit.extract.sources.pictures:PictureFolder", "its kind is 'pictures'"),
        ("probe_kit.extract.sources.source:SourceSettings", "its kind is"),
    ],
)
def test_a_source_that_cannot_be_used_is_left_out_by_name(
    value: str, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = EntryPoint("noise", value, kinds.ENTRY_POINTS)
    monkeypatch.setattr(kinds, "entry_points", lambda **_: [entry])
    with pytest.warns(kinds.BrokenSourceWarning, match="noise") as warned:
        assert list(kinds._third_party()) == []
    assert problem in str(warned[0].message)
