"""Scores of the controls that probes are compared with: baselines, and an untrained network."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import isnan
from typing import Any

from probe_kit.statistics.significance import SIGNIFICANCE

RANDOM_FEATURES, UNTRAINED = "random-features", "untrained"
"""The controls that a site must beat, where they were run, before its signal counts as knowledge."""


@dataclass(frozen=True)
class BaselineScore:
    """Held-out accuracy of the same nested probe on features that never saw the model.

    95 % interval over groups; p by the label permutations of the category's probes (None without any).
    """

    name: str
    category: str
    accuracy: float
    ci: tuple[float, float]
    p: float | None
    chance: float
    n: int

    @property
    def above_chance(self) -> bool:
        """Whether the suite gives the answer away without a model."""
        return self.p is not None and self.p < SIGNIFICANCE


@dataclass(frozen=True)
class UntrainedScore:
    """How much more accurate a probe is than the untrained network's, on the same episodes.

    ci: 95 % interval over groups.

    peak: the best site of the stream here against the best site there; otherwise the same site in both.
    """

    category: str
    view: str
    site: str
    untrained_site: str
    peak: bool
    accuracy: float
    untrained_accuracy: float
    difference: float
    ci: tuple[float, float]
    untrained: str


@dataclass(frozen=True)
class ControlComparison:
    """Whether a site's probe is more accurate than a control: paired by group, family-wise over its stream.

    control: `random-features`, or `untrained` for the best site of that stream in the untrained network.
    reference: the control's accuracy.
    """

    control: str
    category: str
    view: str
    site: str
    reference: float
    p: float


Exceeds = dict[str, bool | None]
"""Whether a site is better than `chance`, `random-features` and `untrained`; None for what was not run."""


def has_signal(exceeds: Exceeds) -> bool:
    """Whether that is knowledge: better than chance, and than every control that was run."""
    return exceeds["chance"] is True and False not in exceeds.values()


@dataclass(frozen=True)
class Controls:
    """Scores of the controls so far. excess: every site compared with random-features and untrained."""

    baselines: tuple[BaselineScore, ...] = ()
    untrained: tuple[UntrainedScore, ...] = ()
    excess: tuple[ControlComparison, ...] = ()

    def exceeds(self, category: str, view: str, site: str, p_fwe: float) -> Exceeds:
        """What a site with this family-wise p is better than."""
        found = self._beaten.get((category, view, site), {})
        chance = None if isnan(p_fwe) else bool(p_fwe < SIGNIFICANCE)
        return {"chance": chance, RANDOM_FEATURES: found.get(RANDOM_FEATURES), UNTRAINED: found.get(UNTRAINED)}

    @cached_property
    def _beaten(self) -> dict[tuple[str, str, str], dict[str, bool]]:
        """By category, view and site: the controls it was compared with, and whether it is better."""
        beaten: dict[tuple[str, str, str], dict[str, bool]] = {}
        for one in self.excess:
            beaten.setdefault((one.category, one.view, one.site), {})[one.control] = one.p < SIGNIFICANCE
        return beaten

    def of_category(self, category: str) -> dict[str, BaselineScore]:
        """Baselines of a category by name."""
        return {score.name: score for score in self.baselines if score.category == category}

    def untrained_peak(self, category: str, view: str, stream: str) -> UntrainedScore | None:
        """The best site of a stream against the untrained network's best, None without one."""
        found = (s for s in self.untrained if s.peak and (s.category, s.view) == (category, view))
        return next((score for score in found if score.site.startswith(f"{stream}.")), None)

    def with_baselines(self, scores: Iterable[BaselineScore]) -> "Controls":
        """These and more; a newer score replaces one of the same name and category."""
        merged = {(score.name, score.category): score for score in (*self.baselines, *scores)}
        return replace(self, baselines=tuple(merged.values()))

    def with_untrained(self, scores: Sequence[UntrainedScore]) -> "Controls":
        """The same baselines with another untrained network."""
        return replace(self, untrained=tuple(scores))

    def with_excess(self, found: Sequence[ControlComparison]) -> "Controls":
        """These, with all sites held anew against the controls that are in `found`."""
        renewed = {one.control for one in found}
        return replace(self, excess=(*(one for one in self.excess if one.control not in renewed), *found))

    def to_json(self) -> dict[str, Any]:
        """As stored in `controls.json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> "Controls":
        """The controls that `to_json` gave."""
        return cls(
            tuple(BaselineScore(**{**score, "ci": tuple(score["ci"])}) for score in stored["baselines"]),
            tuple(UntrainedScore(**{**score, "ci": tuple(score["ci"])}) for score in stored["untrained"]),
            tuple(ControlComparison(**one) for one in stored["excess"]),
        )
