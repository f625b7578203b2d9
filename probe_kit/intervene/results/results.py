"""What an intervention did: a table, the verdicts, and the ways to write them down."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.errors import NoProbesError
from probe_kit.intervene.kinds.attention.attention_mass import AttentionShares
from probe_kit.intervene.kinds.closed_loop.effects import ClosedLoopEffect, closed_loop_effects
from probe_kit.intervene.kinds.erase.effects import ErasureEffect, erasure_effects
from probe_kit.intervene.kinds.frames import frame_of
from probe_kit.intervene.kinds.image_swap.effects import ImageSwapEffect, image_swap_effects, stored_image_swaps
from probe_kit.intervene.kinds.image_swap.verdict import UseVerdict, classify_all, encoded_in
from probe_kit.intervene.kinds.instruction_swap.effects import input_sensitivity
from probe_kit.intervene.kinds.site_effects import PatchEffect, patch_effects
from probe_kit.intervene.results.site_maps import stored_carrying_directions, stored_localised_sites
from probe_kit.intervene.store.answers import (
    ATTENTION_FILE,
    ERASE,
    IMAGE_SWAP,
    NOISE,
    PICTURES,
    PROBE_ACCURACY,
    ConditionOutcomes,
    StoredIntervention,
    find_stored,
)
from probe_kit.intervene.store.settings import PER_STEP
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.store import load_results

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit._terminal.responsive_table import ResponsiveTable


FOLLOW, WORDS = "follow", "words"
BLIND = 0.6
"""Accuracy below which a probe is said to be blind to one of two sides."""
LARGE = 2.0
"""Token norms beyond which a dose is said to be large."""


@dataclass(frozen=True)
class InterventionResult:
    """One intervention: what was asked, what it gave, and what that means.

    key: name of its folder. label: of the run. settings, certificate: as stored. verdicts: by category, from this
    and what else is stored with the run. attention: what was weighed, of the kind `attention` only.
    """

    key: str
    label: str
    suite: str
    random_weights: bool
    settings: dict[str, Any]
    certificate: dict[str, Any]
    outcomes: ConditionOutcomes = field(repr=False)
    attention: AttentionShares | None = field(default=None, repr=False)
    verdicts: dict[str, UseVerdict] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """Of the intervention."""
        return str(self.settings["kind"])

    @cached_property
    def rows(self) -> list[ImageSwapEffect]:
        """What the exchange of the pictures did, one per category; empty if no first action was asked for it."""
        if self.outcomes.episode_outcomes is not None or IMAGE_SWAP not in self.outcomes.conditions:
            return []
        return image_swap_effects(self.outcomes, self.suite, self.key)

    @cached_property
    def changes(self) -> list[PatchEffect]:
        """What changes inside the network did to first actions, one per category and change; else empty."""
        if self.outcomes.episode_outcomes is not None or self.kind == ERASE:
            return []
        return patch_effects(self.outcomes, self.suite, str(self.settings.get("toward", IMAGE_SWAP)), self.key)

    @cached_property
    def closed_loop_effects(self) -> list[ClosedLoopEffect]:
        """What changes did to whole episodes, one per category and condition; empty but for a closed loop."""
        return (
            []
            if self.outcomes.episode_outcomes is None
            else closed_loop_effects(self.outcomes, self.suite, self.key)
        )

    @cached_property
    def erasure_effects(self) -> list[ErasureEffect]:
        """What is left of an answer in first actions, one per category and condition; empty but for `erase`."""
        if self.kind != ERASE:
            return []
        return erasure_effects(self.outcomes, self.suite, self.key, self.certificate.get(PROBE_ACCURACY, {}))

    @property
    def table(self) -> "pd.DataFrame":
        """One line per category, with the fields of `ImageSwapEffect` and the verdict; or per change, of `PatchEffect`, of
        `ErasureEffect` or, in a closed loop, of `ClosedLoopEffect`; or per block, iteration, head and role, of `Attending`.
        """
        if self.outcomes.episode_outcomes is not None:
            return frame_of(self.carried_out)
        if self.kind == ERASE:
            return frame_of(self.erased)
        if self.attention is not None:
            return self.attention.frame()
        if self.kind == WORDS:
            return words_frame(self.outcomes, self.suite, self.key)
        if self.kind != FOLLOW:
            return frame_of(self.changes)
        frame = frame_of(self.rows)
        found = [self.verdicts.get(str(category), None) for category in frame["category"]]
        frame["verdict"] = [None if one is None else one.verdict for one in found]
        frame["reason"] = ["" if one is None else one.reason for one in found]
        return frame

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader must know, a sentence each."""
        return (
            *self._replay_items(),
            *self._passed_over(),
            *self._few_groups(),
            *self._one_step(),
            *self._large_doses(),
            *self._broken_hands(),
            *self._less_than_exchanging(),
            *self._no_cause(),
        )

    def _passed_over(self) -> list[str]:
        counts = self.certificate.get("items", {"asked": 0, "played": 0})
        left_out = counts["asked"] - counts["played"]
        return [f"{left_out} of {counts['asked']} items have no twin and were passed over."] if left_out else []

    def _few_groups(self) -> list[str]:
        if self.attention is not None:
            return []
        counts = {category: np.unique(own.groups).size for category, own in self.outcomes.by_category()}
        return [
            f"{category}: with {count} group{'s' * (count != 1)} of items no p can be below {0.5**count:.2g}, so "
            "that nothing is beyond chance. Play more (--items)."
            for category, count in counts.items()
            if 0.5**count >= SIGNIFICANCE
        ]

    def _no_cause(self) -> list[str]:
        if self.attention is None:
            return []
        return [
            "Attention weighs, and is no cause: what is weighed need not be used. It enters no verdict; what is "
            "read says an exchange (--kind interchange --sites memory.*)."
        ]

    def _one_step(self) -> list[str]:
        if self.attention is not None:
            return []
        is_shadow = self.certificate.get("supported", {}).get("readout") == "per-step"
        if self.settings.get("readout") == PER_STEP:
            return [
                "Shadow: every condition was evaluated at every inference of the unedited episode, and what its "
                "actions would add across is summed up; nothing of it was carried out."
            ]
        if not is_shadow or self.outcomes.episode_outcomes is not None:
            return []
        return [
            "This family's inference is one action in greedy bins: what the first one does says little of where "
            "the hand will go, and small effects stay within a bin. Ask with --readout per-step."
        ]

    def _large_doses(self) -> list[str]:
        large = {
            row.name: row.relative_change
            for row in self.changes
            if row.coefficient and row.relative_change > LARGE
        }
        return [
            f"{name} moves tokens by {ratio:.1f} times their own norm; what that does is little evidence."
            for name, ratio in large.items()
        ]

    def _broken_hands(self) -> list[str]:
        return [
            f"{row.category}, {row.name}: the cube is in a zone in {100 * row.in_zone:.0f} % of episodes; the "
            "hand is broken, and this enters no verdict."
            for row in self.carried_out
            if row.disrupted
        ]

    def _less_than_exchanging(self) -> list[str]:
        if not self.erased:
            return []
        blind = [row for row in self.erased if row.finding == "kept" and (row.readable or 1.0) < BLIND]
        broken = [row for row in self.erased if row.finding == "controls break too"]
        return [
            "Erasing says less than exchanging: what is read need not be linear, and may pass elsewhere. A loss "
            "beyond the controls is evidence of use; none is no evidence of the contrary.",
            *(f"{row.category}, {row.name}: a probe is blind, and the action goes on as before." for row in blind),
            *(
                f"{row.category}, {row.name}: random subspaces of the same rank break the action as well."
                for row in broken
            ),
        ]

    def _replay_items(self) -> tuple[str, ...]:
        check = self.certificate["replay"]
        if check["compared"] == 0:
            return (
                f"The run does not say what was carried out, so that {self._plain} were not compared with it.",
            )
        if check["equal"] < check["compared"]:
            return (
                f"{check['equal']} of {check['compared']} {self._plain} are the run's bit for bit; the others "
                f"differ by at most {check['largest_difference']:.2g}: a larger batch, or another device.",
            )
        return ()

    @property
    def _plain(self) -> str:
        return "plain inferences" if self.outcomes.episode_outcomes is None else "trajectories at dose 0"

    def to_json(self) -> str:
        """Key, settings, certificate and the table as JSON."""
        content = {
            "key": self.key,
            "label": self.label,
            "settings": self.settings,
            "certificate": self.certificate,
            "effects": json.loads(self.table.to_json(orient="records", double_precision=15)),
        }
        return json.dumps(content, indent=2, ensure_ascii=False)

    def to_csv(self) -> str:
        """The table as comma-separated values with a header."""
        return self.table.to_csv(index=False)

    def to_rich(self) -> "ResponsiveTable":
        """The table for a console."""
        of = f"{self.label}{' (random weights)' if self.random_weights else ''} on {self.suite}"
        from probe_kit.intervene.kinds.site_table import following_table, passing_table, words_table

        if self.outcomes.episode_outcomes is not None:
            from probe_kit.intervene.kinds.closed_loop.table import carried_out_table

            return carried_out_table(self.carried_out, of)
        if self.kind == ERASE:
            from probe_kit.intervene.kinds.erase.table import erased_table

            return erased_table(self.erased, of)
        if self.attention is not None:
            from probe_kit.intervene.kinds.attention.table import weighed_table

            return weighed_table(self.attention, self.suite, of)
        if self.kind == WORDS:
            return words_table(self.rows, input_sensitivity(self.outcomes), of)
        if self.kind != FOLLOW:
            return passing_table(self.changes, self.kind, of)
        return following_table(self.rows, self.verdicts, of)


def load_effects(run: RunReader, key: str | None = None, kind: str | None = None) -> InterventionResult:
    """The stored intervention whose key begins with `key`, or the newest (of `kind`), with verdicts as of now.

    Raises NoInterventionsError, UsageError for a key that is not there, RunDamagedError if it was changed.
    """
    return effects_of(run, find_stored(run, key, kind))


def effects_of(run: RunReader, stored: StoredIntervention) -> InterventionResult:
    """Read one stored intervention."""
    outcomes = stored.outcomes()
    own = image_swap_effects(outcomes, run.suite, stored.key) if stored.settings["kind"] == FOLLOW else []
    return InterventionResult(
        key=stored.key,
        label=run.label,
        suite=run.suite,
        random_weights=run.random_weights,
        settings=dict(stored.settings),
        certificate=stored.certificate(),
        outcomes=outcomes,
        attention=AttentionShares.of(stored),
        verdicts=verdicts_of(run, own),
    )


def verdicts_of(run: RunReader, shown: Sequence[ImageSwapEffect] = ()) -> dict[str, UseVerdict]:
    """By category, from all interventions and the newest probes that are stored with a run.

    shown: what an exchange of pictures did that is to be judged, whatever else is stored of these categories.
    """
    try:
        results = load_results(run)
    except NoProbesError:
        results = None
    found = {**stored_image_swaps(run), **{row.category: row for row in shown}}
    return classify_all(found, encoded_in(results), stored_localised_sites(run), stored_carrying_directions(run))


def effects_csv(
    outcomes: ConditionOutcomes,
    suite: str,
    target_side: str = IMAGE_SWAP,
    kind: str = "",
    further: Mapping[str, bytes] = MappingProxyType({}),
) -> str:
    """As stored beside the answers, without verdicts, which later probes may change.

    further: what else is stored, by the file's name.
    """
    if ATTENTION_FILE in further:
        return AttentionShares.from_bytes(further[ATTENTION_FILE]).frame().to_csv(index=False)
    if kind == ERASE:
        # What probes read stands in the certificate.
        frame = frame_of(erasure_effects(outcomes, suite))
        return frame.drop(columns=["key", "readable_before", "readable"]).to_csv(index=False)
    if outcomes.episode_outcomes is not None:
        return frame_of(closed_loop_effects(outcomes, suite)).drop(columns="key").to_csv(index=False)
    if {PICTURES, NOISE} <= set(outcomes.conditions):
        return words_frame(outcomes, suite).drop(columns="key").to_csv(index=False)
    changes = patch_effects(outcomes, suite, target_side)
    frame = frame_of(changes) if changes else frame_of(image_swap_effects(outcomes, suite))
    return frame.drop(columns="key").to_csv(index=False)


def words_frame(outcomes: ConditionOutcomes, suite: str, key: str = "") -> "pd.DataFrame":
    """One line per category: the fields of `ImageSwapEffect`, of exchanged words, and of `Sensitivity`."""
    frame = frame_of(image_swap_effects(outcomes, suite, key))
    steps = input_sensitivity(outcomes)
    for name in ("words", "pictures", "noise", "words_changed", "pictures_changed"):
        frame[name] = [getattr(row, name) for row in steps]
    return frame
