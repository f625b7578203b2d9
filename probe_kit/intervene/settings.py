"""The settings of an intervention: the part of a run that it is made on, and all that decides its numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, get_args

from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.declared import Readout
from probe_kit.intervene.pairs import PairRow
from probe_kit.runs.run import Run

FORMAT = 2  # raise when stored numbers would be others; with the settings it is hashed into the key
DONORS = 3  # the rule of `draw_donors`; raise when it gives other donors
FIRST_CHUNK: Readout = "first-chunk"
PER_STEP: Readout = "per-step"


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The part of a run that an intervention is made on, as settings; see `kinds.base.Intervention`.

    The fields are those of every intervention. The class is separate from `Intervention`, because sessions read it
    and interventions are built on sessions.

    Attributes:
        kind: Name of the kind; an attribute of the class.
        usual_vary: Default of `vary`; an attribute of the class.
    """

    kind: ClassVar[str]
    usual_vary: ClassVar[str] = "picture"

    categories: tuple[str, ...] | None = None
    items: int | None = None
    readout: Readout = FIRST_CHUNK
    vary: str = ""
    frames: int | None = None
    pairs: tuple[PairRow, ...] = ()
    instructions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.items is not None and self.items < 1:
            raise UsageError(f"items is {self.items}; expected at least 1")
        if self.readout not in get_args(Readout):
            raise UsageError(f"readout is {self.readout!r}; expected one of {', '.join(get_args(Readout))}")

    @property
    def varied(self) -> str:
        """The input that the source has of its donor."""
        return self.vary or self.usual_vary

    def items_in(self, run: Run) -> list[str]:
        """Return the items of a run that are replayed."""
        return items_of(run, self.categories, self.items)

    def parameters(self) -> dict[str, Any]:
        """Return its own settings as plain JSON; with the run they decide its numbers."""
        common = {setting.name for setting in fields(Choice)}
        values = {
            setting.name: getattr(self, setting.name)
            for setting in fields(self)
            if setting.init and setting.name not in common
        }
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def categories_in(run: Run, categories: Sequence[str] | None) -> tuple[str, ...]:
    """Return some categories; None for all of a run.

    Raises:
        UnknownCategoryError: For a category that the run lacks.
    """
    available = list(dict.fromkeys(run.episodes["category"].astype(str)))
    for category in categories or ():
        if category not in available:
            raise UnknownCategoryError(
                f"{run.location} has no category {category!r}; it has: {', '.join(available)}"
            )
    return tuple(categories or available)


def items_of(run: Run, categories: Sequence[str] | None, items: int | None) -> list[str]:
    """Return the items that are replayed, category by category.

    Raises:
        UsageError: If there is none.
    """
    if items is not None and items < 1:
        raise UsageError(f"items is {items}; expected at least 1")
    episodes, selected = run.episodes, list[str]()
    for category in categories_in(run, categories):
        names = episodes.loc[episodes["category"] == category, "item_id"].astype(str)
        selected += list(dict.fromkeys(names))[:items]
    if not selected:
        raise UsageError(f"{run.location} has no episode yet; extract some first")
    return selected


def settings_of(intervention: Choice, run: Run) -> dict[str, Any]:
    """Return everything that decides the numbers, as plain JSON; its hash is the key."""
    pairs: dict[str, Any] = {}
    if not run.source.is_scene:
        pairs = {"vary": intervention.varied, "frames": intervention.frames}
        pairs["pairs"] = [list(row) for row in intervention.pairs]
        pairs |= {} if intervention.pairs else {"donors": DONORS}
        pairs |= {"instructions": list(intervention.instructions)} if intervention.instructions else {}
    return {
        "format": FORMAT,
        "kind": intervention.kind,
        "run_settings": run.settings_sha256,
        "stamp": run.stamp,
        "weights": run.weights_sha256,
        "wording": run.wording,
        "categories": list(categories_in(run, intervention.categories)),
        "items": intervention.items,
        "readout": intervention.readout,
        **pairs,
        **intervention.parameters(),
    }


def key_of(settings: Mapping[str, Any]) -> str:
    """Return the first 12 hex digits of the settings' sha256: the name of the results' folder."""
    return sha256_json(settings)[:12]


def check_run_fits(run: Run) -> None:
    """Refuse a run whose policy did not act, or acted in a way that cannot be repeated here.

    Raises:
        UsageError: If effects of an intervention cannot be measured on the run.
    """
    settings = run.settings
    why = None
    if run.ask is not None:
        why = f"{run.model} was asked and did not act; intervene on a run of `probe-kit extract`"
    elif run.weights_sha256 is None or not run.streams:
        why = f"{run.model} is scripted: it has no network in which anything could be changed"
    elif not run.source.is_scene and run.inputs is None:
        why = "it stores no inputs, with which a repeated observation could be compared"
    elif run.capture_only and not run.recorded:
        why = (
            f"{run.model} only captured activations (--no-act): no action was stored with which the effect of a "
            "change could be compared. Extract a run without --no-act, of a checkpoint whose actions move this arm"
        )
    elif settings.get("edits"):
        why = "its streams were edited already, and the stored run does not hold the vectors"
    if why is not None:
        raise UsageError(f"{run.location}: {why}")
