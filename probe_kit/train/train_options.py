"""Options of `train` that belong together: those of a column of labels, and those of a transfer."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.train.choices import SIDES, Task

if TYPE_CHECKING:
    from probe_kit.train import RunReader, Target


@dataclass(frozen=True)
class TargetOptions:
    """Options that name a target: a side, a built-in column, or a column of a table."""

    name: str
    file: Path | None
    task: Task | None
    group_by: str | None
    exchange_within: str | None
    align_to: str | None = None

    def check(self, window: int | None) -> None:
        """Raise UsageError for a target that nothing names, and for a side with options that no side has."""
        from probe_kit.train.columns.builtin import builtin_names, is_builtin

        is_side, sides = self.name in SIDES, ", ".join(map(repr, SIDES))
        if self.file is not None and is_side:
            raise UsageError(
                f"--target {self.name} is a side, and --labels {self.file} is given. Name a column of the table "
                "with --target; rename the column if it is called so"
            )
        if self.file is None and not is_side and not is_builtin(self.name):
            raise UsageError(
                f"--target {self.name!r} is not one of {sides}, nor a built-in column "
                f"({', '.join(builtin_names())}). `probe-kit targets RUN` lists those of a run, such as "
                "dataset.NAME; give the table of another column with --labels FILE"
            )
        options = {
            "--task": self.task, "--group-by": self.group_by, "--exchange-within": self.exchange_within,
            "--window": window, "--align-to": self.align_to,
        }  # fmt: skip
        present = [option for option, value in options.items() if value is not None]
        if is_side and present:
            raise UsageError(
                f"{present[0]} is for labels of your own and built-in columns; give --target COLUMN too, and "
                "--labels FILE for one of a table"
            )

    @property
    def is_side(self) -> bool:
        """Whether the target is a side of a picture."""
        return self.name in SIDES

    def read(self, run: "RunReader", file: Path | None = None, seed: int = 0) -> "Target":
        """Return the target for a run: of the table, of another `file`, or built in."""
        from probe_kit.train import Target

        options = self.task, self.group_by, self.exchange_within
        if (table := file or self.file) is None:
            return Target.of_run(run, self.name, *options, seed=seed)
        return Target.read(table, self.name, *options)

    def event(self, run: "RunReader") -> "Target | None":
        """Return the column where windows begin; of `COLUMN=VALUE` whether it has the value."""
        from probe_kit.train import Target
        from probe_kit.train.columns.builtin import is_builtin

        if self.align_to is None:
            return None
        name, equals, value = self.align_to.partition("=")
        event = Target.of_run(run, name) if self.file is None or is_builtin(name) else Target.read(self.file, name)
        return event.equal_to(value) if equals else event


@dataclass(frozen=True)
class TransferOptions:
    """Options that name a run to score probes on."""

    run: str
    labels: Path | None
    across_weights: bool

    @classmethod
    def of(
        cls, run: str | None, labels: Path | None, across_weights: bool, target: TargetOptions
    ) -> "TransferOptions | None":
        """Return the options; None without `--test-on`. Raises UsageError where one needs another."""
        if run is None:
            if labels is not None or across_weights:
                option = "--test-labels" if labels is not None else "--across-weights"
                raise UsageError(f"{option} is for a transfer; give --test-on RUN too, or leave it out")
            return None
        if labels is not None and target.file is None:
            raise UsageError("--test-labels with a built-in target; give --labels FILE too, or leave it out")
        return cls(run, labels, across_weights)
