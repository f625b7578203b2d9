"""What every intervention is asked, and the key under which its results are stored. Needs no model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.interventions import Readout
from probe_kit.runs.run import Run
from probe_kit.runs.scene_only import check_scene_run

FORMAT = 2  # raise when stored numbers would be others
FIRST_CHUNK: Readout = "first-chunk"
PER_STEP: Readout = "per-step"


@dataclass(frozen=True, kw_only=True)
class InterventionSettings:
    """What is asked of every kind of intervention.

    categories: of the run; None for all. items: so many of each category, the first ones; None for all.
    readout: what of the policy's answer is read, see `Readout`.
    """

    categories: tuple[str, ...] | None = None
    items: int | None = None
    readout: Readout = FIRST_CHUNK

    def __post_init__(self) -> None:
        if self.items is not None and self.items < 1:
            raise UsageError(f"items is {self.items}; expected at least 1")
        if self.readout not in get_args(Readout):
            raise UsageError(f"readout is {self.readout!r}; expected one of {', '.join(get_args(Readout))}")

    @property
    def kind(self) -> str:
        """Its name on the command line."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Any]:
        """What else decides its numbers, as plain JSON."""
        return {}

    def categories_in(self, run: Run) -> tuple[str, ...]:
        """Its categories. Raises UnknownCategoryError for one that the run lacks."""
        known = list(dict.fromkeys(run.episodes["category"].astype(str)))
        for category in self.categories or ():
            if category not in known:
                raise UnknownCategoryError(
                    f"{run.location} has no category {category!r}; it has: {', '.join(known)}"
                )
        return self.categories or tuple(known)


def items_of(run: Run, intervention: InterventionSettings) -> list[str]:
    """The items that are replayed, category by category. Raises UsageError if there is none."""
    episodes, chosen = run.episodes, []
    for category in intervention.categories_in(run):
        names = episodes.loc[episodes["category"] == category, "item_id"].astype(str)
        chosen += list(dict.fromkeys(names))[: intervention.items]
    if not chosen:
        raise UsageError(f"{run.location} has no episode yet; extract some first")
    return chosen


def settings_of(intervention: InterventionSettings, run: Run) -> dict[str, Any]:
    """Everything that decides the numbers, as plain JSON; its hash is the key."""
    return {
        "format": FORMAT,
        "kind": intervention.kind,
        "run_settings": run.settings_sha256,
        "stamp": run.stamp,
        "weights": run.weights_sha256,
        "wording": run.wording,
        "categories": list(intervention.categories_in(run)),
        "items": intervention.items,
        "readout": intervention.readout,
        **intervention.parameters(),
    }


def key_of(settings: Mapping[str, Any]) -> str:
    """First 12 hex digits of the settings' sha256: the name of the results' folder."""
    return sha256_json(settings)[:12]


def check_run_fits(run: Run) -> None:
    """Raise UsageError for a run whose policy did not act, or acted in a way that is not done again here."""
    check_scene_run(run, "an intervention")
    settings = run.settings
    why = None
    if "ask" in settings:
        why = f"{run.model} was asked and did not act; intervene on a run of `probe-kit extract`"
    elif run.weights_sha256 is None or not run.streams:
        why = f"{run.model} is scripted: it has no network in which anything could be changed"
    elif run.capture_only:
        why = (
            f"{run.model} only captured activations (--no-act): no action was stored with which the effect of a "
            "change could be compared. Extract a run without --no-act, of a checkpoint whose actions move this arm"
        )
    elif settings.get("edits"):
        why = "its streams were edited already, and the stored run does not hold the vectors"
    if why is not None:
        raise UsageError(f"{run.location}: {why}")
