"""The model that the command checks, and what its checks ask for."""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from probe_kit.check_adapter.outcome import folder_size
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.conformance.check import SkipTest
from probe_kit.hooks.conformance.examples import examples_for
from probe_kit.hooks.conformance.subject import ContractSettings
from probe_kit.hooks.contract.model import Model
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.options import Option
from probe_kit.hooks.family import SIZE, Family

LARGEST_COPY = 1_000_000_000
"""Bytes of a checkpoint that is copied and loaded several times; a larger one costs minutes and disk."""
INSTRUCTIONS = tuple(
    f"Put the cube on the {name}" for name in ("star", "red shape", "cube", "blue shape", "green shape", "arrow")
)
"""Of different lengths; several have equally many letters, words or tokens."""


class Trial:
    """What checks ask for, as `conformance.subject.Given`.

    given: options by name. instructions: at least two; the first two are those of the observations.
    """

    def __init__(
        self, family: Family, checkpoint: str | None, given: Mapping[str, Any], instructions: Sequence[str]
    ) -> None:
        self._family, self._checkpoint, self._given, self.instructions = family, checkpoint, given, instructions
        self._scratch: Path | None = None
        self.loaded: Model | None = None

    def close(self) -> None:
        """Remove what was written, and let the model go."""
        self.loaded = None
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    @property
    def settings(self) -> ContractSettings:
        """The family with its options; a size stands for a checkpoint, which is named instead."""
        settings = ContractSettings()
        settings.family = self._family.name
        settings.other_words = f" {self.instructions[0].split()[-1]}"  # a word that the tokenizer knows
        settings.options = {name: value for name, value in self._given.items() if name != SIZE}
        settings.unloadable_options = (
            frozenset(own.name for own in self._family.options) - self.other_options.keys()
        )
        return settings

    @property
    def model(self) -> Model:
        """The loaded model."""
        if self.loaded is None:
            raise SkipTest("the model is not loaded")
        return self.loaded

    @property
    def observations(self) -> list[Observation]:
        """Two whose instructions differ in length."""
        return examples_for(self.model, *self.instructions[:2])

    @property
    def alike(self) -> list[Observation]:
        """All instructions; among the default ones some have equally many tokens."""
        return examples_for(self.model, *self.instructions)

    @cached_property
    def checkpoint(self) -> Path:
        """The folder of the checkpoint. Raises SkipTest where there is none, or where it is too large to copy."""
        place = self._family.place(self._checkpoint, self._given.get(SIZE))
        if place is None:
            raise SkipTest("the family brings its own weights; give --checkpoint to check how it loads")
        folder = checkpoint_folder(place)
        if (size := folder_size(folder)) > LARGEST_COPY:
            raise SkipTest(
                f"the checkpoint has {size / 1e9:.1f} GB and would be copied; check a tiny one of the same layout"
            )
        return folder

    @property
    def other_options(self) -> Mapping[str, Any]:
        """Of options with a closed list of values, and of switches, one that is not in use."""
        others = {own.name: _other(own, self._given.get(own.name, own.default)) for own in self._family.options}
        return {name: value for name, value in others.items() if value is not None and name != SIZE}

    @property
    def folder(self) -> Path:
        """A new empty folder."""
        if self._scratch is None:
            self._scratch = Path(tempfile.mkdtemp(prefix="probe-kit-check-"))
        return Path(tempfile.mkdtemp(dir=self._scratch))


def _other(option: Option, used: Any) -> Any:
    """Another value than `used`; None where the declaration names none."""
    if option.kind is bool:
        return not (used in (True, "True") or str(used).lower() in ("true", "yes", "on", "1"))
    return next((value for value in option.choices if str(value) != str(used)), None)
