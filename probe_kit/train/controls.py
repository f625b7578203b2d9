"""What probes are held against: baselines that never see the model, and a twin that was never trained."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

SIGNIFICANCE = 0.05


@dataclass(frozen=True)
class BaselineScore:
    """Held-out accuracy of the same nested probe on features that never saw the model.

    95 % interval over groups; p by the relabellings of the category's probes (None without any).
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
class TwinScore:
    """How much more accurate than its twin's a probe is, on the same episodes; 95 % interval over groups.

    peak: the best site of the stream here against the best site there; otherwise the same site in both.
    """

    category: str
    view: str
    site: str
    twin_site: str
    peak: bool
    accuracy: float
    twin_accuracy: float
    difference: float
    ci: tuple[float, float]
    twin: str


@dataclass(frozen=True)
class Controls:
    """What was controlled so far."""

    baselines: tuple[BaselineScore, ...] = ()
    twin: tuple[TwinScore, ...] = ()

    def of_category(self, category: str) -> dict[str, BaselineScore]:
        """Baselines of a category by name."""
        return {score.name: score for score in self.baselines if score.category == category}

    def twin_peak(self, category: str, view: str, stream: str) -> TwinScore | None:
        """The best site of a stream against the twin's best, None without a twin."""
        found = (s for s in self.twin if s.peak and (s.category, s.view) == (category, view))
        return next((score for score in found if score.site.startswith(f"{stream}.")), None)

    def with_baselines(self, scores: Iterable[BaselineScore]) -> "Controls":
        """These and more; a newer score replaces one of the same name and category."""
        merged = {(score.name, score.category): score for score in (*self.baselines, *scores)}
        return Controls(tuple(merged.values()), self.twin)

    def with_twin(self, scores: Sequence[TwinScore]) -> "Controls":
        """The same baselines with another twin."""
        return Controls(self.baselines, tuple(scores))

    def to_json(self) -> dict[str, Any]:
        """As stored in `controls.json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> "Controls":
        """What `to_json` gave."""
        return cls(
            tuple(BaselineScore(**{**score, "ci": tuple(score["ci"])}) for score in stored["baselines"]),
            tuple(TwinScore(**{**score, "ci": tuple(score["ci"])}) for score in stored["twin"]),
        )
