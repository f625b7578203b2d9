"""Probe results: a table of scores, and the held-out decisions behind it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING

from probe_kit.errors import UnknownSiteError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.label_permutations import permutations_for, shortage
from probe_kit.train.data.samples import is_token_view
from probe_kit.train.results.best_sites import results_html
from probe_kit.train.results.control_scores import Controls
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_directions import Direction, Place
from probe_kit.train.results.score_rows import score_rows
from probe_kit.train.settings import ProbeSettings

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, repr=False)
class ProbeResults:
    """Probes of one target in one run under one set of settings.

    curves: one per (category, view). directions: the probes' weights per (category, view, site), of a side.
    controls: what the probes are compared with, as far as requested.
    created: when they were fitted (UTC, ISO 8601); not part of the key. stamp: hash of the commits they were
    fitted to, empty for arrays in memory. label: what tables call the run, by default its model; not part of the
    key either. left_out: how many episodes and inferences have no part in any category, by reason.
    """

    settings: ProbeSettings
    curves: Mapping[tuple[str, str], ProbeCurve]
    directions: Mapping[Place, Direction] = field(default_factory=dict)
    controls: Controls = field(default_factory=Controls)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="microseconds"))
    stamp: str = ""
    label: str = ""
    left_out: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.settings.model)

    def remedy(self, category: str, view: str, tests: int = 1) -> str:
        """Return what to do where no p of a view can be below the level; empty where one can.

        tests: the number that p is corrected for.
        """
        settings, is_token = self.settings, is_token_view(view)
        permutations = settings.token_permutations if is_token else settings.permutations
        match shortage(self.curves[category, view].least_p, permutations, tests):
            case "permutations":
                return f"train with --{'token-' * is_token}permutations {permutations_for(tests)} or more"
            case "groups":
                if self.curves[category, view].least_p >= 1:
                    return "take groups in which the label differs"
                return "extract more items" if settings.is_side else "label more groups"
        return ""

    def __repr__(self) -> str:
        settings = self.settings
        random = ", RANDOM WEIGHTS" if settings.random_weights else ""
        task = "" if settings.is_side else f" ({settings.task})"
        return (
            f"<ProbeResults {settings.key} of {self.label}{random}: {', '.join(settings.categories)}; "
            f"views {', '.join(settings.views)}; target {settings.target}{task}; call {settings.call}; "
            f"{settings.permutations} label permutations>"
        )

    def _repr_html_(self) -> str:
        return results_html(self.settings, self.label, self.scores)

    @property
    def key(self) -> str:
        """Hash of the settings."""
        return self.settings.key

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """One row per category, view and site.

        `score` is what the column `metric` names, with its 95 % interval over groups (`ci_low`, `ci_high`); that
        of a side is called `accuracy` too. `chance`: one half for a side, else the mean score of the label
        permutations at this site. `p` of the site alone, `p_fwe` against the best of the stream: the most accurate
        site of a side, else the largest excess over chance. `smallest_p`: no p-value can be lower with so many
        label permutations. `depth`: the layer as a fraction. `exceeds_NAME`: whether the site exceeds that
        control; of a side `exceeds_random_features` and `exceeds_untrained`, missing where they were not run.
        `signal`: better than chance, family-wise, and than every control that sites were compared with. `n`:
        samples.

        Of a side also `C` and `fold_accuracy` per outer fold, `auc`, `log_loss`, and `control_accuracy`: the mean
        accuracy of the same probe on random labels that are consistent within a group, `selectivity` the accuracy
        above it; NaN without label permutations. Of other targets `penalties` per outer fold (λ, or 1 / C),
        `best_control`, the score of the best control, and of a quantity `spearman`, Spearman's ρ within folds.
        """
        import pandas as pd

        of = self.settings, self.controls
        frame = pd.DataFrame([row for key, curve in self.curves.items() for row in score_rows(*of, key, curve)])
        exceeds = [name for name in map(str, frame) if name.startswith("exceeds_")]
        return frame.astype({"iteration": "Int64", **dict.fromkeys(exceeds, "boolean")})

    def direction(self, category: str, view: str, site: Site) -> Direction:
        """Return the probes' weights at a site, in raw features. Raises UnknownSiteError if there are none."""
        try:
            return self.directions[category, view, site]
        except KeyError:
            settings = self.settings
            hint = (
                ""
                if settings.is_side
                else f"; probes of {settings.target!r} store no directions, those of a side do"
            )
            raise UnknownSiteError(
                f"there is no direction of {site}, category {category!r}, view {view!r}; probed were the sites of "
                f"categories {', '.join(settings.categories)} in views {', '.join(settings.views)}{hint}"
            ) from None


def episodes_sha256(run: RunReader) -> str:
    """Return the identity of the episodes a run holds now."""
    return sha256_json(sorted(run.episodes["episode_id"].astype(str)))
