"""A run of two episodes, as `probe-kit extract` or `probe-kit ask` makes it, in a folder that is removed."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw

from probe_kit._system.escaping import csv_of_rows
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.hooks.conformance.check import require
from probe_kit.runs import Run
from probe_kit.suite import Terms, suite_from_csv

STEPS = 8
"""Control steps of an episode at most."""
_SIDE = 224
_COLOURS = ("red", "blue")


def act_twice(
    model: str, load_options: Mapping[str, Any], instruction: str, capture_only: bool, folder: Path
) -> None:
    """Extract two episodes, and load every site again.

    load_options: checkpoint, options, device and dtype. capture_only: do not act, for actions that do not fit
    the arm. Raises what `extract_run` raises, and CheckFailedError for a run that is not whole.
    """
    settings = ExtractSettings(
        model,
        suite=_one_item(instruction, folder),
        frames="none",
        env_workers=0,
        capture_only=capture_only,
        accept_units=True,  # a tiny checkpoint may have any statistics
        accept_ignored_inputs=True,  # and untrained bins that no input moves
        max_steps=STEPS,
        **load_options,
    )
    _read_back(extract_run(settings, folder / "run"))


def answer_twice(model: str, load_options: Mapping[str, Any], instruction: str, folder: Path) -> None:
    """Ask about two episodes, activations included, and load every site again. Raises as `act_twice` does."""
    settings = AskSettings(
        model, suite=_one_item(instruction, folder), frames="none", env_workers=0, tokens="pooled", **load_options
    )
    _read_back(ask_run(settings, folder / "run"))


def _one_item(instruction: str, folder: Path) -> Path:
    """A suite of one item over two discs; played in both layouts it is two episodes."""
    for colour in _COLOURS:
        picture = Image.new("RGB", (_SIDE, _SIDE), "white")
        ImageDraw.Draw(picture).ellipse((32, 32, 192, 192), fill=colour)
        picture.save(folder / f"{colour}.png")
    correct, wrong = (f"{colour}.png" for colour in _COLOURS)
    row = {"instruction": instruction, "correct": correct, "wrong": wrong, "object": instruction.split()[-1]}
    (folder / "discs.csv").write_text(csv_of_rows(list(row), [row]), encoding="utf-8")
    terms = Terms("CC0-1.0", "drawn by probe-kit check-adapter")
    return suite_from_csv(folder / "discs.csv", folder / "suite", terms=terms).folder


def _read_back(run: Run) -> None:
    require(len(run.episodes) == 2, f"{len(run.episodes)} episodes", "2, the item in both layouts")
    for stream in run.streams:
        for site, view in product(run.sites(stream), run.views(stream)):
            rows = len(run.column(site, view))
            require(rows == 2, f"{site} has {rows} rows of {view}", "2, one per episode")
