"""The settings of an intervention, its store `RUN/interventions/<key>/`, and the choice among stored ones.

settings.json      the head: what was asked, of which commits, and the hashes of the rest; written last
episodes.npz       per condition and episode where the action would go, and how far it changed
effects.csv        the same in numbers per category, for people and other programs
attention.npz      of the kind `attention`: shares per inference, block, iteration, head and role
attention_patches.npz  of it, where the family says which token sees what: shares per inference, block and patch
certificate.json   what was loaded, and what was checked

A stored intervention is chosen by what it is about, never by when it was made: another map, role, direction,
coefficient, or a try on fewer episodes replaces nothing. Conditions that were played on the same episodes are
pooled, whichever intervention they came with. Needs no model.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from io import BytesIO
from math import hypot
from typing import Any, ClassVar, Self, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import open_arrays, parse_json
from probe_kit.errors import NoInterventionsError, UnknownCategoryError, UsageError
from probe_kit.hashing import derive_seed, sha256_json
from probe_kit.hooks.contract.declared import Readout
from probe_kit.intervene.exchange import Exchange
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.reader import SIDE, RunReader, full_name
from probe_kit.runs.results import HEAD, Bundle, complete_key, read_bundles
from probe_kit.runs.run import Run
from probe_kit.runs.store import Location

FORMAT = 2  # raise when stored numbers would be others
DONORS = 2  # the rule of `draw_donors`; raise when it gives other donors
FIRST_CHUNK: Readout = "first-chunk"
PER_STEP: Readout = "per-step"
CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE = "clean", "image_swap", "instruction_swap", "noise"
"""Conditions: as in the run, the two pictures swapped, the counterpart's instruction, the noise drawn anew."""
ERASE, PROBE_ACCURACY = "erase", "probe_accuracy"
"""A kind, and what its certificate calls what probes read behind its conditions."""
ATTENTION, RECORDED, ATTENTION_FILE = "attention", "recorded", "attention.npz"
"""A kind, its condition with recorded weights, and the file in which they are."""
PATCHES_FILE = "attention_patches.npz"
"""The attention on single patches of the first camera's picture, and where they lie in it."""
DONOR, CONTROL_INPUT = "frame_swap", "control_input"
"""Conditions without sides: all inputs of the donor, and a change of the input that means nothing."""
UNCHANGED = frozenset({CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE, RECORDED, DONOR, CONTROL_INPUT})
"""Conditions in which nothing inside the network is changed."""
EPISODES, EFFECTS, CERTIFICATE = "episodes.npz", "effects.csv", "certificate.json"
PairRow = tuple[str, int, str, int]
"""Episode and frame of the clean inference, and of its donor."""


# -- settings ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The part of a run that an intervention is made on, as settings; see `kinds.base.Intervention`.

    Fields are those of every intervention. kind, usual_vary: of the class.
    """

    kind: ClassVar[str]
    usual_vary: ClassVar[str] = "picture"

    categories: tuple[str, ...] | None = None
    items: int | None = None
    readout: Readout = FIRST_CHUNK
    vary: str = ""
    frames: int | None = None
    pairs: tuple[PairRow, ...] = ()

    def __post_init__(self) -> None:
        if self.items is not None and self.items < 1:
            raise UsageError(f"items is {self.items}; expected at least 1")
        if self.readout not in get_args(Readout):
            raise UsageError(f"readout is {self.readout!r}; expected one of {', '.join(get_args(Readout))}")

    @property
    def varied(self) -> str:
        """Return the input that the source has of its donor."""
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
    """Return some categories, by default all of a run. Raises UnknownCategoryError for one that it lacks."""
    available = list(dict.fromkeys(run.episodes["category"].astype(str)))
    for category in categories or ():
        if category not in available:
            raise UnknownCategoryError(
                f"{run.location} has no category {category!r}; it has: {', '.join(available)}"
            )
    return tuple(categories or available)


def items_of(run: Run, categories: Sequence[str] | None, items: int | None) -> list[str]:
    """Return the items that are replayed, category by category. Raises UsageError if there is none."""
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
    if not has_sides(run):
        pairs = {"vary": intervention.varied, "frames": intervention.frames}
        pairs["pairs"] = [list(row) for row in intervention.pairs]
        pairs |= {} if intervention.pairs else {"donors": DONORS}
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


def has_sides(run: Run) -> bool:
    """Whether a run's questions have a correct picture on a side."""
    return SIDE in run.episodes


def key_of(settings: Mapping[str, Any]) -> str:
    """First 12 hex digits of the settings' sha256: the name of the results' folder."""
    return sha256_json(settings)[:12]


def check_run_fits(run: Run) -> None:
    """Raise UsageError for a run whose policy did not act, or acted in a way that is not done again here."""
    settings = run.settings
    why = None
    if "ask" in settings:
        why = f"{run.model} was asked and did not act; intervene on a run of `probe-kit extract`"
    elif run.weights_sha256 is None or not run.streams:
        why = f"{run.model} is scripted: it has no network in which anything could be changed"
    elif not has_sides(run) and run.inputs is None:
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


# -- outcomes ------------------------------------------------------------------------------------------------


def arrays_of(record: object, without: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Return the attributes of an object that are there, as arrays by name."""
    return {
        name: np.asarray(value)
        for name, value in vars(record).items()
        if value is not None and name not in without
    }


def arrays_to_bytes(record: object, without: Sequence[str] = ()) -> bytes:
    """Return the same as a `.npz`; the same numbers give the same bytes."""
    file = BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays_of(record, without))
    return file.getvalue()


def arrays_from_bytes(content: bytes, texts: str = "") -> dict[str, Any]:
    """Return the arrays of a `.npz` by name. texts: the one that becomes a tuple of strings."""
    with open_arrays(content) as arrays:
        return with_texts(arrays, texts)


def with_texts(arrays: Mapping[str, NDArray[Any]], texts: str) -> dict[str, Any]:
    """Return arrays by name, one of them as a tuple of strings."""
    return {name: tuple(map(str, value)) if name == texts else value for name, value in arrays.items()}


Array = NDArray[np.float64]
_FLAT = 1e-6
"""Share of a number's size below which its spread is rounding."""


def spread_of(clean: NDArray[np.float32]) -> Array:
    """Return (N,) 1 / variance of every number of the clean actions (E, N); 0 for numbers without spread."""
    values = np.ascontiguousarray(clean, np.float64)
    variance = values.var(axis=0)
    varies = np.sqrt(variance) > _FLAT * np.maximum(np.abs(values).max(axis=0, initial=0.0), _FLAT)
    return np.where(varies, 1 / np.where(varies, variance, 1.0), 0.0)


def directions_of(clean: Array, source: Array, weights: Array) -> tuple[Array, Array]:
    """Return (E, N) the directions that displacements are read along, and (E,) the sources' own displacements.

    clean, source: (E, N). A displacement of x is (x − clean) · direction: its component toward the source, in root
    mean squares of spreads. Zero where the source changes nothing.
    """
    apart = source - clean
    count = max(int((weights > 0).sum()), 1)
    squares = (apart**2 * weights).sum(axis=1) / count
    lengths = np.sqrt(squares)
    scale = np.where(lengths > 0, 1 / np.where(lengths > 0, lengths, 1.0), 0.0)
    return apart * weights / count * scale[:, None], lengths


def displacements_toward(chunks: NDArray[np.float32], source: int) -> Array:
    """Return (K, E) displacements toward the source's action of K conditions. chunks: (K, E, N), clean first."""
    values = np.ascontiguousarray(chunks, np.float64)  # sums are rounded by how an array lies
    directions, _ = directions_of(values[0], values[source], spread_of(chunks[0]))
    return np.asarray(((values - values[0]) * directions).sum(axis=2))


def sizes(chunks: NDArray[np.float32]) -> Array:
    """Return (K, E) the distance of K conditions' actions from clean ones, in root mean squares of spreads."""
    values = np.ascontiguousarray(chunks, np.float64)  # sums are rounded by how an array lies
    weights = spread_of(chunks[0])
    count = max(int((weights > 0).sum()), 1)
    return np.asarray(np.sqrt(((values - values[0]) ** 2 * weights).sum(axis=2) / count))


BY_CONDITION = ("displacement", "max_action_change", "edit_log", "episode_outcomes", "toward", "size", "chunks")
"""Arrays with conditions along their first axis."""
UNSTORED = ("seed_text", "chunks", "mass", "inferences", "patches")
"""Fields that a stored intervention does not have, or has in a file of its kind's own."""


@dataclass(frozen=True)
class ConditionOutcomes:
    """The numbers of K conditions in E episodes of a run.

    conditions: names of the K, the clean one first. episodes, items, groups, categories, sides: (E,), `sides`
    those of the correct picture. displacement: (K, E) metres from the middle, left positive; without sides toward
    the source's action. max_action_change: (K, E) largest difference of any action from the clean one's. edit_log:
    (K, E, 5), see `LOG_FIELDS`. replay_error: (E,) of the clean inference from the stored one; NaN where the run
    does not say. episode_outcomes: (K, E) where the cube ended, correct, wrong or oob, for episodes that were
    played to their end; then `displacement` is the cube's, and `max_action_change` and `replay_error` are of the
    trajectory; None where nothing was executed. toward, size: (K, E) displacement toward the source's action and
    size of the change, in spreads of clean actions; None where whole episodes were played. seed_text: of the run,
    by which random draws are made.

    While an intervention is made: chunks: (K, E, N) all numbers of the actions of first inferences. mass: (N, B,
    I, H, R) the attention of N inferences, inferences: (N, 2) their rows in the run's episodes and their calls;
    None where attention was not recorded. patches: (N, B, P) of single patches; None where they are not known.
    """

    conditions: tuple[str, ...]
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    categories: NDArray[np.str_]
    sides: NDArray[np.str_]
    displacement: NDArray[np.float64]
    max_action_change: NDArray[np.float64]
    edit_log: NDArray[np.float64]
    replay_error: NDArray[np.float64]
    episode_outcomes: NDArray[np.str_] | None = None
    toward: NDArray[np.float64] | None = None
    size: NDArray[np.float64] | None = None
    seed_text: str = ""
    chunks: NDArray[np.float32] | None = None
    mass: NDArray[np.float32] | None = None
    inferences: NDArray[np.int64] | None = None
    patches: NDArray[np.float32] | None = None

    @property
    def has_sides(self) -> bool:
        """Whether the correct picture lies on a side; else displacements are toward the source's action."""
        return bool(self.sides.size) and bool(self.sides[0])

    def of(self, condition: str) -> NDArray[np.float64]:
        """(E,) lateral of one condition."""
        return np.asarray(self.displacement[self.conditions.index(condition)])

    @property
    def correct_sign(self) -> NDArray[np.float64]:
        """(E,) +1 where the correct picture lies left, −1 where it lies right, or where nothing has a side."""
        return np.where(self.sides == "left", 1.0, -1.0)

    def exchange(self, source: str = IMAGE_SWAP) -> Exchange | None:
        """Return the effect of a condition with other inputs, in one category; None if it was not played."""
        if source not in self.conditions:
            return None
        flips = derive_seed("sign flips", self.seed_text, str(self.categories[0]))
        pair = self.of(CLEAN), self.of(source)
        return Exchange(*pair, -self.correct_sign, self.groups, self.items, self.seed_text, flips)

    @property
    def counts(self) -> dict[str, Any]:
        """Return category, and numbers of episodes, items and groups, as columns of a row; of one category."""
        sizes = {"n_items": np.unique(self.items).size, "n_groups": np.unique(self.groups).size}
        return {"category": str(self.categories[0]), "n_episodes": self.episodes.size, **sizes}

    def of_episodes(self, selected: NDArray[np.bool_]) -> "ConditionOutcomes":
        """Some of the episodes. selected: (E,)."""
        cut: dict[str, Any] = {
            name: np.compress(selected, value, int(name in BY_CONDITION))
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        return replace(self, **cut)

    def by_category(self) -> "list[tuple[str, ConditionOutcomes]]":
        """Every category with its episodes, in the order of the episodes."""
        names = dict.fromkeys(map(str, self.categories))
        return [(name, self.of_episodes(self.categories == name)) for name in names]

    def in_spreads(self) -> "ConditionOutcomes":
        """Return the same with displacements toward the source's action, and sizes; of first inferences."""
        if self.chunks is None:
            return self
        # Toward the source's action, of all its inputs if they were played.
        references = [name for name in (DONOR, IMAGE_SWAP) if name in self.conditions]
        toward = displacements_toward(self.chunks, self.conditions.index(references[0])) if references else None
        displacement = self.displacement
        if toward is not None and not self.has_sides:
            # Where no inference gave another action, a displacement is none, or was estimated.
            displacement = np.where(self.max_action_change > 0, toward, displacement)
        return replace(self, displacement=displacement, toward=toward, size=sizes(self.chunks))

    @classmethod
    def joined(cls, parts: "Sequence[ConditionOutcomes]") -> "ConditionOutcomes":
        """Return the episodes of all parts, one after the other."""
        parts = [part for part in parts if part.episodes.size] or parts[:1]
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts], axis=int(name in BY_CONDITION))
            for name, value in vars(parts[0]).items()
            if isinstance(value, np.ndarray)
        }
        return replace(parts[0], **arrays)

    def to_bytes(self) -> bytes:
        """Return a `.npz`; the same numbers give the same bytes."""
        return arrays_to_bytes(self, UNSTORED)

    @classmethod
    def from_bytes(cls, content: bytes, seed_text: str = "") -> "ConditionOutcomes":
        """Load what `to_bytes` gave."""
        return cls(**arrays_from_bytes(content, "conditions"), seed_text=seed_text)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One row of effects, read from outcomes; every kind adds columns."""

    category: str

    def to_json(self) -> dict[str, Any]:
        """Return plain values by column."""
        return asdict(self)


# -- the store -----------------------------------------------------------------------------------------------

TILES_APART = 0.31
"""Metres between the tiles of the default scene; taken for a run that stores no scene."""


@dataclass(frozen=True)
class Measurement:
    """One intervention of a run, stored or about to be: what effects, their table and their sentences are made of.

    settings: what decided its numbers, see `settings_of`. read: a stored file by its name; raises RunDamagedError
    if it was changed. files: their names. key: of its folder. created: ISO time (UTC), empty before it is stored.
    explains: whether the caption of its table says what each verdict rests on, as sentences do.
    """

    run: RunReader = field(repr=False)
    settings: Mapping[str, Any]
    read: Callable[[str], bytes] = field(repr=False)
    files: Collection[str] = ()
    key: str = ""
    created: str = ""
    explains: bool = True

    @classmethod
    def of(cls, run: RunReader, bundle: Bundle) -> Self:
        """Return one that a run stores."""
        settings, created = bundle.head["settings"], bundle.times.get("created", "")
        return cls(run, settings, bundle.read, bundle.files, bundle.key, created)

    @property
    def kind(self) -> str:
        """Return the kind of the intervention."""
        return str(self.settings["kind"])

    @property
    def readout(self) -> str:
        """Return `first-chunk` or `per-step`."""
        return str(self.settings.get("readout", FIRST_CHUNK))

    @property
    def newest(self) -> tuple[str, str]:
        """Return the time at which it was made, and the key, which decide between equals."""
        return self.created, self.key

    @cached_property
    def outcomes(self) -> ConditionOutcomes:
        """The numbers of its conditions. Raises RunDamagedError if they were changed."""
        return ConditionOutcomes.from_bytes(self.read(EPISODES), self.run.seed_text)

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """The record of what was loaded and checked. Raises RunDamagedError if it was changed."""
        certificate: dict[str, Any] = parse_json(self.read(CERTIFICATE))
        return certificate

    def rows[Row: Effect](self, of_category: Callable[[ConditionOutcomes], Iterable[Row]]) -> list[Row]:
        """Return the rows of all categories, in the order of the episodes, each with the key."""
        parts = (of_category(part) for _, part in self.outcomes.by_category())
        key: dict[str, Any] = {"key": self.key}  # every kind's rows have it, as their last column
        return [replace(row, **key) for rows in parts for row in rows]

    # -- words of tables -----------------------------------------------------------------------------------------

    @property
    def subject(self) -> str:
        """Return model and suite, as titles have them."""
        label = full_name(self.run.label, self.run.random_weights)
        # The label of a run of recordings says on what already.
        name = self.run.suite.partition("#")[0]
        return label if self.run.label.endswith(f" on {name}") else f"{label} on {self.run.suite}"

    @property
    def lacks_sides(self) -> bool:
        """Whether the run has no correct picture on a side."""
        return not self.outcomes.has_sides

    @property
    def exchange(self) -> str:
        """Return the change of inputs that effects are shares of."""
        return f"exchange of the {self.settings.get('vary') or ''}" if self.lacks_sides else "image swap"

    def in_words(self, text: str) -> str:
        """Return a text about the image swap, about what was exchanged in this run."""
        return text.replace("image swap", self.exchange)

    @property
    def verdicts(self) -> Mapping[str, Any]:
        """Return by category the `UseVerdict`; those of an `InterventionResult`, here none."""
        return {}

    @property
    def legend(self) -> str:
        """Return what a reader of the verdicts must know."""
        return ""

    @property
    def tiles_apart(self) -> float:
        """Return metres between the middles of the tiles of the run's scene, or of the default one."""
        scene: Any = self.run.settings.get("scene", {})
        if "tile_left" not in scene or "tile_right" not in scene:
            return TILES_APART
        (left_x, left_y), (right_x, right_y) = scene["tile_left"], scene["tile_right"]
        return hypot(left_x - right_x, left_y - right_y)


def is_stored(run: Location, key: str) -> bool:
    """Whether complete results called `key` are there."""
    return run.exists(f"{INTERVENTIONS}/{key}/{HEAD}")


def read_interventions(run: Location) -> dict[str, Bundle]:
    """Every complete intervention by key. Raises RunDamagedError if one was changed or has another format."""
    bundles = read_bundles(run, INTERVENTIONS)
    for key, bundle in bundles.items():
        bundle.check_format(FORMAT)
        if (key_of_settings := key_of(bundle.head["settings"])) != key:
            raise bundle.head_damaged(f"has the settings of {key_of_settings}")
    return bundles


def stored_interventions(run: RunReader, kind: str | None = None) -> list[Measurement]:
    """Return those of the episodes that the run has now, in the wording it is in, oldest first.

    kind: only these. Raises RunDamagedError if any of the run was changed, lost its settings or has another
    format.
    """
    required = {
        "stamp": run.stamp, "run_settings": run.settings_sha256,
        "wording": run.wording, **({} if kind is None else {"kind": kind}),
    }  # fmt: skip
    fitting = [
        Measurement.of(run, bundle)
        for bundle in read_interventions(run.location).values()
        if all(bundle.head["settings"].get(name) == value for name, value in required.items())
    ]
    return sorted(fitting, key=lambda intervention: intervention.newest)


def find_stored(run: RunReader, key: str | None = None, kind: str | None = None) -> Measurement:
    """The one whose key begins with `key`, or the newest of `kind`.

    Raises NoInterventionsError if there is none, UsageError for a key that is not there or not the only one.
    """
    candidates = stored_interventions(run, kind)
    if key is None:
        if not candidates:
            raise NoInterventionsError(
                f"{run.location} has no stored intervention{'' if kind is None else f' of kind {kind}'} on its "
                f"episodes. Run `probe-kit intervene {run.location}`"
            )
        return candidates[-1]
    by_key = {intervention.key: intervention for intervention in candidates}
    return by_key[complete_key(key, by_key, run.location, "interventions")]


# -- the choice among stored ones ----------------------------------------------------------------------------


Rank = tuple[bool, int, bool]
"""The larger, the more a result says: rightly read, of more episodes, as its family says it should be read.

Wrongly read is the first inference of a family in which that says little (`per-step`).
"""


@dataclass(frozen=True)
class StoredResult:
    """The part of one stored intervention that is of one category. outcomes: of its episodes alone."""

    stored: Measurement
    category: str
    outcomes: ConditionOutcomes
    rank: Rank


def stored_results(run: RunReader, kind: str) -> list[StoredResult]:
    """Return results by category as the run has them; of each what says most comes last.

    Of what says as much the newest. Raises RunDamagedError.
    """
    order = {name: at for at, name in enumerate(dict.fromkeys(run.episodes["category"].astype(str)))}
    results = []
    for stored in stored_interventions(run, kind):
        family = stored.certificate.get("supported", {}).get("readout", FIRST_CHUNK)
        is_wrong = family == PER_STEP != stored.readout
        for category, outcomes in stored.outcomes.by_category():
            rank = not is_wrong, outcomes.episodes.size, stored.readout == family
            results.append(StoredResult(stored, category, outcomes, rank))
    return sorted(
        results,
        key=lambda result: (
            order.get(result.category, len(order)), result.category, result.rank, result.stored.newest,
        ),
    )  # fmt: skip


def preferred_by_category(run: RunReader, kind: str, readout: str | None = None) -> dict[str, StoredResult]:
    """Return by category, of all that is stored of a kind, the result that says most. Raises RunDamagedError.

    readout: of those alone; None for any.
    """
    results = stored_results(run, kind)
    return {result.category: result for result in results if readout in (None, result.stored.readout)}


@dataclass(frozen=True)
class PooledConditions:
    """Conditions that several interventions played on the same episodes of one category.

    like: one of them. sources: by condition, of whom it is; without those in which nothing was changed.
    """

    like: StoredResult
    sources: dict[str, StoredResult]

    def outcomes(self, conditions: Sequence[str]) -> ConditionOutcomes:
        """Some of the conditions, in the order that is asked for, behind what was unchanged."""
        base = self.like.outcomes
        unchanged = [name for name in (CLEAN, IMAGE_SWAP) if name in base.conditions]
        every = [(base, name) for name in unchanged] + [(self.sources[name].outcomes, name) for name in conditions]
        stacked: dict[str, Any] = {}
        for array in BY_CONDITION:
            values = [getattr(outcomes, array) for outcomes, _ in every]
            rows = (outcomes.conditions.index(name) for outcomes, name in every)
            has_all = all(value is not None for value in values)  # an older one may be stored without it
            stacked[array] = (
                np.stack([value[row] for value, row in zip(values, rows, strict=True)]) if has_all else None
            )
        return replace(base, conditions=tuple(name for _, name in every), **stacked)


def pool_conditions(results: Iterable[StoredResult], setting: Sequence[str] = ()) -> list[PooledConditions]:
    """Pool what was played on the same episodes, with the same actions where nothing was changed.

    results: as `stored_results` orders them. setting: names of settings in which they must agree as well.
    """
    pooled: dict[tuple[object, ...], PooledConditions] = {}
    for result in results:
        outcomes = result.outcomes
        agreed = tuple(str(result.stored.settings.get(name)) for name in ("readout", *setting))
        unchanged = [outcomes.of(name).tobytes() for name in (CLEAN, IMAGE_SWAP) if name in outcomes.conditions]
        same = (result.category, *agreed, tuple(outcomes.episodes.tolist()), *unchanged)
        sources = pooled.setdefault(same, PooledConditions(result, {})).sources
        sources.update({name: result for name in outcomes.conditions if name not in UNCHANGED})
    return list(pooled.values())
