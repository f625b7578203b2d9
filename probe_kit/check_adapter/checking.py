"""All checks of one family, one after the other: naming, loading, the contract, and a run of two episodes."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw

from probe_kit._system.escaping import csv_of_rows
from probe_kit.errors import UsageError
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.hooks.conformance.check import CheckOutcome, package_of, require, try_check
from probe_kit.hooks.conformance.subject import INSTRUCTIONS, Subject
from probe_kit.hooks.contract.declared import read_pairs
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.registry import entry_module, find_family
from probe_kit.hooks.testing import CONTRACTS
from probe_kit.suite import Terms, suite_from_csv

_HEAVY = 3
_LISTED = f"import sys, {{module}}; sys.exit({_HEAVY} if 'torch' in sys.modules else 0)"
_PATIENCE = 120
"""Seconds in which a module can be imported."""
_RUNS = {
    True: (
        "two_episodes_are_extracted",
        "Two episodes are extracted, and every stored site is loaded again.",
    ),
    False: (
        "two_questions_are_asked",
        "Questions about two episodes are asked, and every stored site is loaded again.",
    ),
}
"""The name and the sentence of the run, by whether the model acts."""
STEPS = 8
"""The largest number of control steps of an episode."""
_SIDE = 224
_COLOURS = ("red", "blue")
_RUN_ADVICE = "Correct what the error names; the contract checks above do not see a scene."


def subjects_of(
    model: str, checkpoint: str | None, options: Sequence[str], instructions: Sequence[str] | None, device: str,
    dtype: str | None,
) -> list[Subject]:  # fmt: skip
    """Return the family under check: as a policy, as a model that answers, or both.

    Args:
        model: Name of the family.
        checkpoint: Folder or name of the weights; None for those of the family.
        options: Options of the family, each as KEY=VALUE.
        instructions: At least two; None for those of the embedded suite.
        device: The device on which the model runs, such as `cpu`.
        dtype: Data type of the weights; None for that of the family.

    Raises:
        UnknownModelError: As `Family.check` does.
        UsageError: As `Family.check` does.
        MissingExtraError: As `Family.check` does.
        CheckpointError: As `Family.check` does.
    """
    family = find_family(model)
    load_options = family.check(checkpoint, device, dtype, False, read_pairs(options), 0)
    common: dict[str, Any] = {"options": load_options, "instructions": instructions or INSTRUCTIONS}
    common |= {"device": device, "dtype": dtype}
    kinds = [kind for kind in CONTRACTS if (family.abilities.acts if kind.acting else family.abilities.reads)]
    return [kind(model, checkpoint, **common) for kind in kinds]


def outcomes(subjects: Sequence[Subject]) -> Iterator[CheckOutcome]:
    """Check every subject and yield the outcome of each check; without a loaded model the rest is left out."""
    first, package = subjects[0], package_of(subjects[0].family.loader)

    def check_one(name: str, sentence: str, change: str, body: Callable[[], object]) -> CheckOutcome:
        return try_check(name, sentence, change, body, package)

    if (module := entry_module(first.name)) is not None:
        yield check_one(
            "naming_the_family_imports_no_torch",
            "Naming the family imports no torch, so that commands without a model stay fast.",
            "Keep `FAMILY` in a module that does not import the network; `loader` names the one that does.",
            partial(_require_light, module),
        )
    loaded = check_one(
        "the_model_loads",
        "The model loads, every tensor from the file.",
        "Correct the loader at the place that is named.",
        lambda: first.model,
    )
    yield loaded
    if loaded.state != "passed":
        return
    for subject in subjects:
        subject.share_model(first)
        for contract in CONTRACTS[type(subject)]:
            yield check_one(contract.name, contract.sentence, contract.change, partial(contract, subject))
    model = first.model
    mismatch = isinstance(model, Policy) and model.embodiment_mismatch() is not None
    del model
    for subject in subjects:
        subject.close()  # a run loads its own
    for subject in subjects:
        with subject:
            yield check_one(*_RUNS[subject.acting], _RUN_ADVICE, partial(_run, subject, mismatch))


def _run(subject: Subject, mismatch: bool) -> None:
    """Extract or ask about two episodes, in the folder of the subject, and load every site again.

    Raises as `extract_run` and `ask_run` too.

    Args:
        subject: The family under check; whether it acts decides between the two runs.
        mismatch: Whether the actions do not fit the arm, so that the run captures and does not act.

    Raises:
        CheckFailedError: For a run that is not whole.
    """
    common: dict[str, Any] = {
        "checkpoint": subject.given_checkpoint, "options": subject.options, "device": subject.device,
        "dtype": subject.dtype, "suite": _one_item(subject.instructions[0], subject.folder), "frames": "none",
        "env_workers": 0,
    }  # fmt: skip
    if subject.acting:
        settings = ExtractSettings(
            subject.name,
            capture_only=mismatch,
            accept_units=True,  # a tiny checkpoint may have any statistics
            accept_ignored_inputs=True,  # and untrained bins that no input moves
            max_steps=STEPS,
            **common,
        )
        run = extract_run(settings, subject.folder / "run")
    else:
        run = ask_run(AskSettings(subject.name, tokens="pooled", **common), subject.folder / "run")
    require(len(run.episodes) == 2, f"{len(run.episodes)} episodes", "2, the item in both layouts")
    for stream in run.streams:
        for site, view in product(run.sites(stream), run.views(stream)):
            rows = len(run.column(site, view))
            require(rows == 2, f"{site} has {rows} rows of {view}", "2, one per episode")


def _require_light(module: str) -> None:
    """Import the module in a process of its own, as this one may have imported torch.

    Raises:
        UsageError: If the import fails.
    """
    process = subprocess.run(
        [sys.executable, "-c", _LISTED.format(module=module)],
        capture_output=True, encoding="utf-8", errors="replace", check=False, timeout=_PATIENCE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    if process.returncode not in (0, _HEAVY):
        last = (process.stderr.strip().splitlines() or [f"exit code {process.returncode}"])[-1]
        raise UsageError(f"`import {module}` fails in a new process: {last}")
    require(process.returncode == 0, f"`import {module}` imports torch", "a module that imports none")


def _one_item(instruction: str, folder: Path) -> Path:
    """Return a suite of one item over two discs; played in both layouts it is two episodes."""
    for colour in _COLOURS:
        picture = Image.new("RGB", (_SIDE, _SIDE), "white")
        ImageDraw.Draw(picture).ellipse((32, 32, 192, 192), fill=colour)
        picture.save(folder / f"{colour}.png")
    correct, wrong = (f"{colour}.png" for colour in _COLOURS)
    row = {"instruction": instruction, "correct": correct, "wrong": wrong, "object": instruction.split()[-1]}
    (folder / "discs.csv").write_text(csv_of_rows(list(row), [row]), encoding="utf-8")
    terms = Terms("CC0-1.0", "drawn by probe-kit check-adapter")
    return suite_from_csv(folder / "discs.csv", folder / "suite", terms=terms).folder
