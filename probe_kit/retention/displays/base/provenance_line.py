"""The line under a figure: model, weights, suite, sizes, settings."""

from dataclasses import dataclass
from typing import Self

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import span
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.reader import RunReader
from probe_kit.train.choices import CORRECT, EVERYWHERE
from probe_kit.train.results.probe_results import ProbeResults

RANDOM = "RANDOM WEIGHTS"
SHOWN = 12
"""Hex digits of a hash that a caption shows."""


@dataclass(frozen=True)
class ProvenanceLine:
    """The origin of the numbers of a figure.

    weights: sha256 of the weights that acted, None for a scripted policy. suite: `name@version#hash`.
    n: number of episodes, in words. settings: sha256 of the run's settings. probes: key of the probe results.
    call: captured inference that was probed, None without probes.
    """

    model: str
    random_weights: bool
    weights: str | None
    suite: str
    n: str
    settings: str
    probes: str | None = None
    target: str = CORRECT
    call: int | None = None

    @classmethod
    def of_run(cls, run: RunReader) -> Self:
        """Return the line of a run's behaviour."""
        rule = run.rule
        n = f"n = {counted(len(run.episodes), 'episode')}" + ("" if rule == "disc" else f" by the rule {rule}")
        return cls(run.label, run.random_weights, run.weights_sha256, run.suite, n, run.settings_sha256)

    @classmethod
    def of_results(cls, results: ProbeResults, view: str) -> Self:
        """Return the line of probes in one view."""
        settings = results.settings
        sizes = [curve.labels.size for (_, name), curve in results.curves.items() if name == view]
        n = f"n = {span(sizes)} episodes per category, view {view}"
        return cls(
            results.label, settings.random_weights, settings.weights, settings.suite, n, settings.run_settings,
            results.key, settings.target, settings.call,
        )  # fmt: skip

    @classmethod
    def of_label(cls, results: ProbeResults, category: str, view: str) -> Self:
        """Return the line of probes of a label in one category and view."""
        settings, curve = results.settings, results.curves[category, view]
        of = "" if category == EVERYWHERE else f", category {category}"
        sizes = f"{counted(curve.labels.size, 'sample')} in {counted(curve.n_groups, 'group')}"
        n = f"n = {sizes}, view {view}{of}"
        return cls(
            settings.model, settings.random_weights, settings.weights, settings.suite, n, settings.run_settings,
            results.key, settings.target, settings.call if settings.window == 1 else None,
        )  # fmt: skip

    @classmethod
    def of_row(cls, row: RetentionRow) -> Self:
        """Return the line of a row of the retention table, usually a mean."""
        n = f"n = {counted(row.success.n_episodes, 'episode')}"
        return cls(
            row.run.label or row.run.model,
            row.run.random_weights,
            row.run.weights_sha256,
            row.run.suite,
            n,
            row.run.settings,
            row.run.probes,
            call=row.run.call,
        )

    @property
    def parts(self) -> tuple[str, str, str, str, str, str, str]:
        """Return the parts of the line, most important first; random weights are named in capitals.

        Model, suite, n, call, target, probes, weights; empty where there is nothing to say.
        """
        return (
            f"{self.model} {RANDOM}" if self.random_weights else self.model,
            self.suite,
            self.n,
            "" if self.call is None else f"call {self.call}",
            f"target {self.target}" if self.target != CORRECT else "",
            f"probes {self.probes}" if self.probes else "",
            f"weights {self.weights[:SHOWN]}" if self.weights else "",
        )

    @property
    def line(self) -> str:
        """Everything in one line, for a caption."""
        return " · ".join(filter(None, [*self.parts, f"settings {self.settings[:SHOWN]}"]))
