"""Plain text: nothing that a terminal obeys, and no local folders in shared pages."""

import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probe_kit._system.escaping import terminal_safe, without_places
from probe_kit._terminal.notebook import facts_html, rows_html
from probe_kit.hooks import load_model
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.retention import retention_table
from probe_kit.retention.report import report_html
from tests.retention.asked_runs import SaidRun, acted, asked


@pytest.mark.parametrize(
    ("hostile", "harmless"),
    [
        ("\x1b[31mred\x1b[0m", "␛[31mred␛[0m"),
        ("\x1b]0;title\x07", "␛]0;title␇"),
        ("\x9b31m", "\ufffd31m"),
        ("over\rwritten", "over␍written"),
        ("gone\x08\x7f", "gone␈␡"),
        ("user\u202egnp.exe", "user\ufffdgnp.exe"),
        ("\u2066isolate\u2069", "\ufffdisolate\ufffd"),
        ("half \ud800", "half \ufffd"),
        ("line\u2028line", "line\ufffdline"),
    ],
)
def test_nothing_is_left_that_a_terminal_obeys(hostile: str, harmless: str) -> None:
    assert terminal_safe(hostile) == harmless


@pytest.mark.parametrize("text", ["plain", "Δ, π and ×", "two\nlines\tand a tab", "日本語", "[bold]brackets[/]"])
def test_ordinary_text_stays_as_it_is(text: str) -> None:
    assert terminal_safe(text) == text


RIGHT = {"color": np.random.default_rng(0).random((12, 2)) < 0.7}
MACHINE = {
    "checkpoint": "/home/jane doe/models/my fine-tune",
    "audit": {"file": "/home/jane/models/model.safetensors", "cache": "~/.cache/huggingface/hub"},
    "note": "read from /opt/data/weights.bin, see C:\\Users\\jane\\notes.txt",
}


def runs(folder: Path) -> list[SaidRun]:
    """Without probes, with items left out, with other first frames: each makes a note that names a run."""
    policy = acted(folder / "a policy", RIGHT, "pi0 · tokenizer=/home/jane/tokenizers/mine")
    policy = replace(
        policy, certificate={"policy": MACHINE}, settings={"suite": {"folder": str(folder / "suite")}}
    )
    policy.episodes["first_frame_sha256"] = "other"
    return [policy, asked(folder / "a VLM", RIGHT, worded=True)]


def leaks(page: str, folder: Path) -> list[str]:
    """Places of this machine in a page; figures are bytes in which any letters may stand together."""
    text = re.sub(r"data:[\w/+-]+;base64,[\w+/=]+", "", page)
    return [
        place
        for place in (str(folder), str(Path.home()) + "/", tempfile.gettempdir() + "/", "/home/", "Users", "/opt/")
        if place in text
    ]


def test_no_path_of_this_machine_stands_in_the_report(tmp_path: Path) -> None:
    own = runs(tmp_path)
    table = retention_table(own, vlm_vla=True)
    assert leaks("\n".join(table.notes), tmp_path), "the notes of this table must name runs by their places"
    page = report_html(own, table)
    assert leaks(page, tmp_path) == []
    assert "Success rates only: acted has no activations to probe" in page
    assert "Answers only" not in page, "a model that was only asked lacks nothing"
    assert "my fine-tune" in page  # of a path its last part is kept
    assert "model.safetensors" in page


def test_no_path_of_this_machine_stands_in_a_notebook(tmp_path: Path) -> None:
    assert leaks(retention_table(runs(tmp_path))._repr_html_(), tmp_path) == []


def test_no_path_of_this_machine_stands_in_what_notebooks_show_of_runs_and_models(tmp_path: Path) -> None:
    facts = facts_html("Run of /opt/models/a", {"weights": MACHINE["note"], "at": str(tmp_path)}, "see ~/runs/a")
    rows = rows_html("Probes", ("/opt/data/x",), [(str(tmp_path / "a"),)], str(tmp_path))
    copied = tmp_path / "my models" / "copy"
    shutil.copytree(embedded_checkpoint("pi0-tiny"), copied)
    model = load_model("pi0-tiny", str(copied))._repr_html_()
    assert "copy" in model
    assert leaks(facts + rows + model, tmp_path) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("in /home/jane/runs/a: 3 episodes", "in a: 3 episodes"),
        ('{"folder": "/data/my runs/b"}', '{"folder": "b"}'),
        ("see ~/runs/a, then", "see a, then"),
        ("from file:///home/jane/x.bin", "from x.bin"),
        (r"on C:\Users\jane\a.bin now", "on a.bin now"),
        ("`probe-kit train /data/runs/a` fits", "`probe-kit train a` fits"),
    ],
)
def test_of_a_path_the_last_part_is_kept(text: str, expected: str) -> None:
    assert without_places(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "n/a",
        "left / right",
        "s3://bucket/runs/a",
        "https://example.org/a/b",
        "Qwen/Qwen3-VL-4B",
        "</s>",
        "a/b/c",
        "/",
    ],
)
def test_what_is_no_path_of_a_machine_stays(text: str) -> None:
    assert without_places(text) == text
