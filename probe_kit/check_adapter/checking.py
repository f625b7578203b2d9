"""All checks of one family, one after the other."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Self

from probe_kit.check_adapter.outcome import Outcome, package_of, tried
from probe_kit.check_adapter.trial import INSTRUCTIONS, Trial
from probe_kit.errors import UsageError
from probe_kit.hooks.conformance.check import require
from probe_kit.hooks.contract.options import read_pairs
from probe_kit.hooks.registry import entry_module, find_family

_HEAVY = 3
_LISTED = f"import sys, {{module}}; sys.exit({_HEAVY} if 'torch' in sys.modules else 0)"
_PATIENCE = 120
"""Seconds in which a module can be imported."""


class Checking:
    """The checks of a family with a checkpoint and options; a context that removes what they wrote.

    options: as KEY=VALUE. instructions: at least two, None for those of the embedded suite.
    Raises UnknownModelError, UsageError, MissingExtraError and CheckpointError as `Family.check` does.
    """

    def __init__(
        self, model: str, checkpoint: str | None, options: Sequence[str], instructions: Sequence[str] | None,
        device: str, dtype: str | None,
    ) -> None:  # fmt: skip
        self._family, self._checkpoint = find_family(model), checkpoint
        self._device, self._dtype = device, dtype
        self._options = self._family.check(checkpoint, device, dtype, False, read_pairs(options), 0)
        self._package = package_of(self._family.loader)
        self._trial = Trial(self._family, checkpoint, self._options, instructions or INSTRUCTIONS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._trial.close()

    def outcomes(self) -> Iterator[Outcome]:
        """Naming, loading, the contract, and the run; without a loaded model the rest is left out."""
        if (module := entry_module(self._family.name)) is not None:
            yield self._tried(
                "naming_the_family_imports_no_torch",
                "Naming the family imports no torch, so that commands without a model stay fast.",
                "Keep `FAMILY` in a module that does not import the network; `loader` names the one that does.",
                partial(_require_light, module),
            )
        loaded = self._tried(
            "the_model_loads",
            "The model loads, every tensor from the file.",
            "Correct the loader at the place that is named.",
            self._load,
        )
        yield loaded
        if loaded.state == "passed":
            yield from self._contract()
            yield from self._smoke_runs()

    def _tried(self, name: str, sentence: str, change: str, body: Callable[[], None]) -> Outcome:
        return tried(name, sentence, change, body, self._package)

    def _load(self) -> None:
        self._trial.loaded = self._family.load(self._checkpoint, self._device, self._dtype, options=self._options)

    def _contract(self) -> Iterator[Outcome]:
        from probe_kit.hooks.conformance.contract import ANSWER_CHECKS, POLICY_CHECKS
        from probe_kit.hooks.conformance.subject import AnswerSubject, PolicySubject

        kinds = [
            *([(PolicySubject, POLICY_CHECKS)] if self._family.acts else []),
            *([(AnswerSubject, ANSWER_CHECKS)] if self._family.reads else []),
        ]
        for kind, checks in kinds:
            subject = kind(self._trial.settings, self._trial)
            for own in checks:
                yield self._tried(own.name, own.sentence, own.change, partial(own, subject))

    def _smoke_runs(self) -> Iterator[Outcome]:
        """The model is let go first: a run loads its own."""
        from probe_kit.check_adapter.smoke_run import act_twice, answer_twice
        from probe_kit.hooks.contract.model import Policy

        model = self._trial.model
        mismatch = isinstance(model, Policy) and model.embodiment_mismatch() is not None
        del model
        self._trial.loaded = None
        name, words = self._family.name, self._trial.instructions[0]
        chosen: dict[str, Any] = {
            "checkpoint": self._checkpoint, "options": self._options, "device": self._device, "dtype": self._dtype,
        }  # fmt: skip
        if self._family.acts:
            yield self._tried(
                "two_episodes_are_extracted",
                "Two episodes are extracted, and every stored site is loaded again.",
                "Correct what the error names; the contract checks above do not see a scene.",
                lambda: act_twice(name, chosen, words, mismatch, self._trial.folder),
            )
        if self._family.reads:
            yield self._tried(
                "two_questions_are_asked",
                "Questions about two episodes are asked, and every stored site is loaded again.",
                "Correct what the error names; the contract checks above do not see a scene.",
                lambda: answer_twice(name, chosen, words, self._trial.folder),
            )


def _require_light(module: str) -> None:
    """In a process of its own: this one may have imported torch. Raises UsageError if it cannot be imported."""
    done = subprocess.run(
        [sys.executable, "-c", _LISTED.format(module=module)],
        capture_output=True, encoding="utf-8", errors="replace", check=False, timeout=_PATIENCE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    if done.returncode not in (0, _HEAVY):
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise UsageError(f"`import {module}` fails in a new process: {last}")
    require(done.returncode == 0, f"`import {module}` imports torch", "a module that imports none")
