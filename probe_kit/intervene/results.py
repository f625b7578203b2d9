"""The result of an intervention: a table, the verdicts, the ways to write them, and what a run stores."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit._system.counting import plural
from probe_kit._system.escaping import csv_of_frame
from probe_kit._system.json_text import json_text
from probe_kit.errors import NoProbesError
from probe_kit.intervene.evidence import StoredEvidence, which_layer
from probe_kit.intervene.exchange import TRACE, describe_trace, share_of_variance
from probe_kit.intervene.kinds import kind_of
from probe_kit.intervene.kinds.base import Intervention, frame_of
from probe_kit.intervene.kinds.image_swap import ImageSwapEffect
from probe_kit.intervene.outcomes import DONOR, IMAGE_SWAP, ConditionOutcomes, Effect
from probe_kit.intervene.places import unread_note
from probe_kit.intervene.settings import PER_STEP, key_of
from probe_kit.intervene.stored import (
    CERTIFICATE,
    EFFECTS,
    EPISODES,
    Measurement,
    find_measurement,
    find_stored,
)
from probe_kit.intervene.verdict import UseVerdict, describe_readouts, size_of_groups
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.reader import RunReader
from probe_kit.runs.records import as_json
from probe_kit.runs.results import find_bundle, tidy_bundle, write_bundle
from probe_kit.statistics.paired_tests import smallest_flip_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.suite.categories import category_of
from probe_kit.train.results.store import load_results

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit._tables.table import Table
    from probe_kit.train.results.probe_results import ProbeResults


_VERDICT_COLUMNS = ("verdict", "behaviour", "reversed", "reason", "where", "tie")


@dataclass(frozen=True)
class InterventionResult(Measurement):
    """One intervention: its settings, its effects, and their meaning together with all else its run stores."""

    @classmethod
    def of_stored(cls, stored: Measurement) -> "InterventionResult":
        """Return the result of a stored intervention."""
        return cls(stored.run, stored.settings, stored.read, stored.files, stored.key, stored.created)

    @property
    def _kind(self) -> type[Intervention]:
        return kind_of(self.kind)

    @cached_property
    def effects(self) -> list[Any]:
        """The rows of its kind, such as one `PatchEffect` per category and edit."""
        return list(self._kind.effects(self))

    @property
    def table(self) -> "pd.DataFrame":
        """The effects as one line per row, with their columns; for a kind with verdicts also its `UseVerdict`."""
        frame = frame_of(self.effects)
        if self._kind.has_verdict and self.outcomes.is_scene:
            verdicts = [self.verdicts.get(str(category), None) for category in frame["category"]]
            for name in _VERDICT_COLUMNS:
                frame[name] = [None if verdict is None else getattr(verdict, name) for verdict in verdicts]
        return frame

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes that a reader must know, a sentence each."""
        certificate, notes = self.certificate, list[str]()
        check = certificate["replay"]
        what = "clean inferences" if self.outcomes.episode_outcomes is None else "unedited trajectories"
        if check["compared"] == 0:
            notes.append(f"The run does not store what was executed, so that {what} were not compared with it.")
        elif check["equal"] != check["compared"]:
            notes.append(
                f"{check['equal']} of {check['compared']} {what} are the run's bit for bit; the others differ by "
                f"at most {check['largest_difference']:.2g}: a larger batch, or another device."
            )
        counts = certificate.get("items", {"asked": 0, "played": 0})
        if left_out := counts["asked"] - counts["played"]:
            notes.append(f"{left_out} of {counts['asked']} items have no counterpart and were skipped.")
        if unread := certificate.get("unread", ()):
            notes.append(f"{unread_note(unread)}.")
        if passed := certificate.get("passed_over", {}):
            reason = next(iter(passed.values()))
            notes.append(f"passed over, because an answer has no direction there: {', '.join(passed)} ({reason}).")
        tests = () if self._kind.is_descriptive else (*self._few_groups(), *self._trace(), *self._one_step())
        return *notes, *tests, *self._kind.notes(self.effects)

    def _few_groups(self) -> list[str]:
        counts = {category: np.unique(part.groups).size for category, part in self.outcomes.by_category()}
        return [
            f"{category}: with {plural(count, 'group')} of items no p can be below "
            f"{smallest_flip_p(count):.2g}, so that nothing is beyond chance. Play more (--items)."
            for category, count in counts.items()
            if smallest_flip_p(count) >= SIGNIFICANCE
        ]

    def _trace(self) -> list[str]:
        """Return a note where the exchange, of which effects are shares, changes next to nothing."""
        outcomes = self.outcomes
        # Swaps of an input play all of the donor's inputs as well, and have their own floor.
        is_part = IMAGE_SWAP in outcomes.conditions and DONOR not in outcomes.conditions
        if outcomes.is_scene or outcomes.size is None or not is_part:
            return []
        share = float(share_of_variance(outcomes.size[outcomes.conditions.index(IMAGE_SWAP)]).mean())
        return [f"{describe_trace(self.exchange, share)}."] if share < TRACE else []

    def _one_step(self) -> list[str]:
        if not self.outcomes.is_scene:
            return []
        if self.readout == PER_STEP:
            return [
                "Per step: every condition was evaluated at every inference of the unedited episode "
                "(teacher-forced), and the lateral displacements of its actions are summed; none was executed."
            ]
        is_per_step = self.certificate.get("supported", {}).get("readout") == PER_STEP
        if not is_per_step or self.outcomes.episode_outcomes is not None:
            return []
        return [
            "This family's inference is one action in greedy bins: the first one says little of where the hand "
            "will go, and small effects stay within a bin. Use --readout per-step."
        ]

    def to_json(self) -> str:
        """Return key, settings, certificate and the table as JSON."""
        content = {
            "key": self.key,
            "label": self.run.label,
            "settings": self.settings,
            "certificate": self.certificate,
            "effects": json.loads(self.table.to_json(orient="records", double_precision=15)),
        }
        return json_text(content)

    def to_csv(self) -> str:
        """Return the table as comma-separated values with a header.

        A text that a spreadsheet would compute has a `'` in front.
        """
        return csv_of_frame(self.table)

    @property
    def findings(self) -> tuple[str, ...]:
        """The last lines of the command: a short sentence per category, and one that says which layer matters."""
        return *self._kind.findings(self.effects, self), *self._which_layer(1)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings with numbers, reasons, and all that is known of the layer."""
        return *self._kind.sentences(self.effects, self), *self._which_layer(None)

    def to_rich(self, details: bool = True) -> "Table":
        """Return the table for a terminal.

        Args:
            details: Whether to split the table where it is wide, and to state below it the reasons of each
                verdict. Else columns are left out by name.
        """
        table = self._kind.table(self.effects, self)
        if not details:
            return replace(table, overflow="leave out")
        reasons = [
            f"{category_of(name).title}: {verdict.explanation}"
            for name, verdict in (self.verdicts if self._kind.has_verdict else {}).items()
            if verdict.explanation
        ]
        return replace(table, overflow="split").with_remarks(reasons)

    @property
    def legend(self) -> str:
        """The explanation of its verdicts that a reader must know."""
        uses = (self.verdicts.get(row.category) for row in self.effects)
        swaps = [row for row in self.effects if isinstance(row, ImageSwapEffect)]
        reasons = (verdict.explanation for verdict in self.verdicts.values())
        size = size_of_groups(reasons, [(row.n_items, row.n_groups) for row in swaps])
        return "; ".join(filter(None, (describe_readouts(uses), size)))

    # -- with what else is stored --------------------------------------------------------------------------------

    @cached_property
    def verdicts(self) -> dict[str, UseVerdict]:
        """The verdicts by category, from this result and what else is stored at the first access.

        Empty without sides.

        Raises:
            RunDamagedError: If a stored intervention was changed.
        """
        if not self.is_scene:
            return {}
        evidence = StoredEvidence(self.run, self.effects if self._kind.has_verdict else ())
        return evidence.verdicts(_newest_probes(self.run))

    @cached_property
    def layers(self) -> dict[str, list[str]]:
        """The knowledge of the layer by category, of a kind that edits places; see `which_layer`."""
        if not self.is_scene or not self._kind.asks_where:
            return {}
        return which_layer(StoredEvidence(self.run), _newest_probes(self.run), self.settings["categories"])

    def _which_layer(self, most: int | None) -> list[str]:
        return [
            f"Which layer, {category_of(name).title}: {'; '.join(parts[:most])}."
            for name, parts in self.layers.items()
        ]


def load_effects(run: RunReader, key: str | None = None, kind: str | None = None) -> InterventionResult:
    """Load the stored intervention whose key begins with `key`, or the newest (of `kind`).

    Raises:
        RunDamagedError: If it was changed.
        NoInterventionsError: If there is none.
        UsageError: For a key that does not exist or is not the only one.
    """
    return _read_in_full(find_stored(run, key, kind))


def find_effects(run: RunReader, key: str) -> InterventionResult | None:
    """Return the stored intervention with exactly this key; None if there is none. Raises as `load_effects`."""
    stored = find_measurement(run, key)
    return None if stored is None else _read_in_full(stored)


def _read_in_full(stored: Measurement) -> InterventionResult:
    """Return the result, whose files are read now: a changed one is refused here and not in a table."""
    result = InterventionResult.of_stored(stored)
    _ = result.outcomes, result.certificate
    return result


def verdicts_of(run: RunReader) -> dict[str, UseVerdict]:
    """Return verdicts by category, from all interventions and the newest probes that are stored with a run."""
    return StoredEvidence(run).verdicts(_newest_probes(run))


def _newest_probes(run: RunReader) -> "ProbeResults | None":
    try:
        return load_results(run)
    except NoProbesError:
        return None


# -- the store -----------------------------------------------------------------------------------------------


def save(
    run: RunReader,
    settings: Mapping[str, Any],
    outcomes: ConditionOutcomes,
    certificate: Mapping[str, Any],
    extra_files: Mapping[str, bytes] = MappingProxyType({}),
) -> str:
    """Write `interventions/<key>/`, all or nothing, and return the key; results that exist already are kept.

    The effects are stored without verdicts, which later probes may change.

    Args:
        run: Run to store them in.
        settings: Settings that decide the numbers, see `settings_of`.
        outcomes: Numbers of the conditions.
        certificate: Record of what was loaded and checked.
        extra_files: Further files by name.
    """
    key = key_of(settings)
    if find_bundle(run.location, INTERVENTIONS, key) is not None:
        tidy_bundle(run.location, INTERVENTIONS, key)
        return key
    files = {EPISODES: outcomes.to_bytes(), CERTIFICATE: as_json(certificate), **extra_files}
    measurement = Measurement(run, settings, files.__getitem__, files)
    rows: Sequence[Effect] = kind_of(measurement.kind).effects(measurement)
    files[EFFECTS] = csv_of_frame(frame_of(rows).drop(columns="key", errors="ignore")).encode()
    now = datetime.now(UTC).isoformat(timespec="microseconds")
    write_bundle(run.location, INTERVENTIONS, key, {"settings": dict(settings)}, files, {"created": now})
    return key
