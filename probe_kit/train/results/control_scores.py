"""Scores of the controls that probes are compared with: features without a model, an untrained network."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from math import isnan
from typing import Any

from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.significance import SIGNIFICANCE

RANDOM_FEATURES, UNTRAINED = "random-features", "untrained"
"""The controls that a site must beat, where they were run, before its signal counts as knowledge."""


@dataclass(frozen=True)
class ControlScore:
    """The held-out score of the same probe on features that never saw the model, or of an untrained network.

    The probe is nested like that of the sites.

    Attributes:
        ci: 95 % interval over groups.
        p: p by the label permutations of the category's probes; None without any.
        chance: Mean score under these permutations, 1/2 for a side; None without any.
        n: Number of samples.
        stream: Stream whose width `random-features` have, or whose best site is that of `untrained`; empty for
            others.
        view: View of `untrained`; empty for others.
        by_step: Metric at each of `ProbeCurve.steps`, in order.
    """

    name: str
    category: str
    score: float
    ci: tuple[float, float]
    p: float | None
    chance: float | None
    n: int
    stream: str = ""
    view: str = ""
    by_step: tuple[float, ...] = ()

    @property
    def above_chance(self) -> bool:
        """Whether features without a model give the target away."""
        return self.p is not None and self.p < SIGNIFICANCE


@dataclass(frozen=True)
class UntrainedScore:
    """The gain of a probe of a side over the untrained network's, on the same episodes.

    Attributes:
        peak: Whether the best site of the stream is compared with the best site there; otherwise the same site in
            both.
        ci: 95 % interval over groups.
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
    """A test of a site's probe against a control: paired by group, family-wise over its stream.

    Attributes:
        control: For a side `random-features`, a control that `is_informative`, or `untrained` for the best site of
            that stream in the untrained network; for other targets every control that was run.
        reference: The control's score.
    """

    control: str
    category: str
    view: str
    site: str
    reference: float
    p: float


Exceeds = dict[str, bool | None]
"""Truth values by name: whether a site is better than `chance` and than each control; None for one not run."""


def has_signal(exceeds: Exceeds) -> bool:
    """Whether a site shows knowledge: better than chance, and than every control that was run."""
    return exceeds["chance"] is True and False not in exceeds.values()


def missed_controls(exceeds: Exceeds) -> tuple[str, ...]:
    """Return the names of chance and controls that a site is not shown to exceed."""
    return tuple(name for name, better in exceeds.items() if not better and (better is False or name == "chance"))


@dataclass(frozen=True)
class Controls:
    """The scores of the controls so far.

    Attributes:
        comparisons: Comparisons of every site with controls.
        left_out: Reasons why a default control was not run, by name.
        untrained_probes: Key of the untrained network's probes, which names its weights, settings and episodes;
            empty without one, and in older results, which do not name it.
    """

    scores: tuple[ControlScore, ...] = ()
    untrained: tuple[UntrainedScore, ...] = ()
    comparisons: tuple[ControlComparison, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    untrained_probes: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """The controls that have scores; the untrained network of a side is in `untrained` alone."""
        return tuple(dict.fromkeys(score.name for score in self.scores))

    def exceeds(self, category: str, view: str, site: Site | str, p_fwe: float) -> Exceeds:
        """Return whether a site with this family-wise p is better than chance and than each control, by name.

        `random-features` and `untrained` are always listed, other controls where sites were compared with them.
        """
        chance = None if isnan(p_fwe) else bool(p_fwe < SIGNIFICANCE)
        absent: Exceeds = {RANDOM_FEATURES: None, UNTRAINED: None}
        return {"chance": chance, **absent, **self.exceeded(category, view, site)}

    def exceeded(self, category: str, view: str, site: Site | str) -> dict[str, bool]:
        """Return whether a site exceeds each control that it was compared with, by name."""
        return {
            name: comparison.p < SIGNIFICANCE for name, comparison in self._of_site(category, view, site).items()
        }

    def reference(self, category: str, view: str, site: Site | str) -> float:
        """Return the score of the best control of a site; NaN without any."""
        return max(
            (comparison.reference for comparison in self._of_site(category, view, site).values()),
            default=float("nan"),
        )

    def _of_site(self, category: str, view: str, site: Site | str) -> dict[str, ControlComparison]:
        return self._compared.get((category, view, str(site)), {})

    @cached_property
    def _compared(self) -> dict[tuple[str, str, str], dict[str, ControlComparison]]:
        """The comparisons by category, view and site, then by control."""
        by_site: dict[tuple[str, str, str], dict[str, ControlComparison]] = {}
        for comparison in self.comparisons:
            by_site.setdefault((comparison.category, comparison.view, comparison.site), {})[comparison.control] = (
                comparison
            )
        return by_site

    def of_category(self, category: str) -> dict[str, ControlScore]:
        """Return the scores of a category by name, without those of an untrained network."""
        scores = (score for score in self.scores if score.category == category and score.name != UNTRAINED)
        return {score.name: score for score in scores}

    def of_stream(self, category: str, view: str, stream: str) -> tuple[ControlScore, ...]:
        """Return the scores that sites of a stream are compared with in a view, the best first."""
        scores = [score for score in self.scores if score.category == category]
        scores = [score for score in scores if score.stream in ("", stream) and score.view in ("", view)]
        return tuple(sorted(scores, key=lambda score: -score.score))

    def untrained_peak(self, category: str, view: str, stream: str) -> UntrainedScore | None:
        """Return the best site of a stream against the untrained network's best, None without one."""
        peaks = (s for s in self.untrained if s.peak and (s.category, s.view) == (category, view))
        return next((score for score in peaks if score.site.startswith(f"{stream}.")), None)

    def has(self, name: str, categories: Iterable[str]) -> bool:
        """Return whether a control was run for all of some categories."""
        return set(categories) <= {score.category for score in self.scores if score.name == name}

    def with_scores(
        self, scores: Iterable[ControlScore], comparisons: Iterable[ControlComparison] = ()
    ) -> "Controls":
        """Return these and more; a new score or comparison replaces that of the same control and place."""
        by_place = {
            (score.name, score.category, score.stream, score.view): score for score in (*self.scores, *scores)
        }
        by_site = {(o.control, o.category, o.view, o.site): o for o in (*self.comparisons, *comparisons)}
        names = {key[0] for key in by_place}
        missing = {name: why for name, why in self.left_out.items() if name not in names}
        return replace(
            self, scores=tuple(by_place.values()), comparisons=tuple(by_site.values()), left_out=missing
        )

    def with_untrained(self, scores: Sequence[UntrainedScore], probes: str) -> "Controls":
        """Return the same with another untrained network, with which nothing is compared yet.

        Args:
            scores: Gains over that network.
            probes: Key of its probes.
        """
        return replace(
            self,
            untrained=tuple(scores),
            untrained_probes=probes,
            scores=tuple(score for score in self.scores if score.name != UNTRAINED),
            comparisons=tuple(test for test in self.comparisons if test.control != UNTRAINED),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the content of `controls.json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> "Controls":
        """Return the controls that `to_json` returned."""
        lists = {"ci": tuple, "by_step": tuple}

        def read(members: dict[str, Any]) -> dict[str, Any]:
            return {name: lists[name](value) if name in lists else value for name, value in members.items()}

        return cls(
            tuple(ControlScore(**read(score)) for score in stored["scores"]),
            tuple(UntrainedScore(**read(score)) for score in stored["untrained"]),
            tuple(ControlComparison(**comparison) for comparison in stored["comparisons"]),
            dict(stored["left_out"]),
            str(stored.get("untrained_probes", "")),
        )
