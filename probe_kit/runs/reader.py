"""The protocol of a run, in memory or stored: what probes, tables and interventions read of it; and its checks."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import counted
from probe_kit._terminal.notebook import facts_html
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.card import EMBEDDED, streams_text
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.runs.layout import CAPTURE_ONLY, DATASET, ENVIRONMENT
from probe_kit.suite.categories import check_categories

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs.arrays import StoredInputs
    from probe_kit.runs.store import Location


ORIGIN = "origin"
"""Entry of a certificate."""
SUITE = "suite"
OF_SCENE = "scene."
"""Beginning of the name of a file that a field of the scene gives."""


class LoadedModel(Protocol):
    """The model of a run's settings; see `ModelSettings`."""

    @property
    def family(self) -> str:
        """Its name."""

    @property
    def options(self) -> Mapping[str, Any]:
        """Options of the family."""

    @property
    def random_weights(self) -> bool:
        """Whether random weights were requested."""

    @property
    def weights_seed(self) -> int:
        """Seed of requested random weights."""


@dataclass(frozen=True)
class Origin:
    """Files and choices of one process that played episodes of a run; none is part of the run's identity.

    files: absolute, by field of the source's settings, such as `suite`, `folder` or `scene.background`.
    checkpoint: absolute folder, hub id, or a word of the family; empty if unknown. options: of the family, as they
    were passed, files and folders absolute. random_weights: whether random weights were requested, which a file
    that calls its weights random is not. weights_seed: of requested random weights. repositories: commits of
    further repositories of the hub, by name, which a repetition reads again.
    """

    files: Mapping[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    random_weights: bool = False
    weights_seed: int = 0
    repositories: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        model: LoadedModel,
        files: Mapping[str, Path],
        checkpoint: str,
        repositories: Mapping[str, str] = MappingProxyType({}),
    ) -> Self:
        """Return the origin of a process. files: of its source. checkpoint, repositories: of the model's card."""
        return cls(
            files={name: _absolute(path) for name, path in files.items()},
            checkpoint=_absolute(checkpoint) if is_here(checkpoint) else checkpoint,
            options={**model.options, **{name: _absolute(path) for name, path in option_files(model).items()}},
            random_weights=model.random_weights,
            weights_seed=model.weights_seed,
            repositories=dict(repositories),
        )

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Self:
        """Return the origin in the record of a process; an empty one where it has none."""
        return cls(**record.get(ORIGIN, {}))

    @property
    def suite(self) -> str | None:
        """The suite's folder; None for the embedded suite and for runs without one."""
        return self.files.get(SUITE)

    @property
    def scene_files(self) -> dict[str, Path]:
        """The files of the scene by its fields."""
        return {
            name.removeprefix(OF_SCENE): Path(path)
            for name, path in self.files.items()
            if name.startswith(OF_SCENE)
        }

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def option_files(model: LoadedModel) -> dict[str, Path]:
    """Files and folders of this machine that options of a model name."""
    from probe_kit.hooks.registry import get_family

    family = get_family(model.family)
    names = [option.name for option in (() if family is None else family.options) if option.is_path]
    # The same text may be a word of the family, such as a data set's name.
    return {name: Path(str(model.options[name])) for name in names if is_here(model.options.get(name))}


def is_here(text: str | None) -> bool:
    """Whether a setting, such as a checkpoint, is a folder or file of this machine."""
    if text in (None, "", EMBEDDED):
        return False
    try:
        return Path(str(text)).expanduser().exists()
    except (OSError, RuntimeError):  # no path at all, or ~name of an unknown user
        return False


def _absolute(path: Path | str) -> str:
    return str(Path(path).expanduser().absolute())


SIDE = "side_correct"
"""The column of episodes whose question has a correct picture on one side."""


@dataclass(frozen=True)
class RunSource:
    """The observations that a run is made of.

    kind: of the source's settings, such as `scene` or `lerobot`; `arrays` for a run that probe_kit did not play.
    name: with what identifies it, such as `NAME@VERSION#HASH` of a suite. words: what the run did with it.
    """

    kind: str
    name: str
    words: str

    @property
    def subject(self) -> str:
        """The things that its model was shown, in a word; of a source of your own its kind."""
        return {"scene": "scenes", "lerobot": "recordings", "env": "environments"}.get(self.kind, self.kind)

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> "RunSource":
        """Return the source that the settings of a stored run name."""
        if DATASET in settings:
            name = f"{settings['recording']['name']}#{settings[DATASET]['meta_blake2b'][:12]}"
            kind = str(settings[DATASET].get("kind", "lerobot"))
            subject = "recordings" if kind == "lerobot" else kind
            return cls(kind, name, f"it shows {subject} ({name}), and its model did not act")
        if ENVIRONMENT in settings:
            name = f"{settings['played']['name']}@{settings[ENVIRONMENT]['revision']}"
            return cls("env", name, f"it plays an environment of your own ({name})")
        name = str(settings["suite"]["identity"])
        return cls("scene", name, f"it plays {name}")


class Tokens(Protocol):
    """Tokens `start` up to `start + T` of all episodes."""

    @property
    def start(self) -> int:
        """First position."""

    @property
    def values(self) -> NDArray[np.float32]:
        """(E, T, D)."""

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(E, T)."""


class RunReader(Protocol):
    """A finished or growing run, as `open_run` gives it. `ArrayRun` has these members over arrays in memory."""

    @property
    def location(self) -> "Location":
        """The place of the run; probe results go to `probes` there. For a folder: `locate(folder)`."""

    @property
    def model(self) -> str:
        """Name of the model."""

    @property
    def label(self) -> str:
        """Name of the run in tables and legends; two runs of one model differ in it."""

    @property
    def weights_sha256(self) -> str | None:
        """Hash of the weights that ran; None for a policy without weights."""

    @property
    def random_weights(self) -> bool:
        """Whether the weights are random; marked in every table and figure."""

    @property
    def suite(self) -> str:
        """Identity of the suite, `name@version#hash`, or of another source."""

    @property
    def episodes(self) -> "pd.DataFrame":
        """One row per finished episode, with at least `episode_id`, `item_id`, `category`, `group_id`,
        `layout`, `side_correct`, `outcome` and `side_placed`.
        """

    @property
    def streams(self) -> Mapping[str, Stream]:
        """Captured streams by name; empty for a policy without activations."""

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings the run was extracted with."""

    def views(self, stream: str) -> Sequence[str]:
        """Pooled views stored for `stream`."""

    def sites(self, stream: str) -> Sequence[Site]:
        """Sites stored for `stream`, in order."""

    def column(self, site: Site, view: str) -> NDArray[np.float32]:
        """(E, D) features of one site, rows in the order of `episodes`."""

    def token_mask(self, site: Site, role: str | None = None) -> NDArray[np.bool_]:
        """(E, T): the tokens of `role` at one site, or all but padding. Every episode has at least one.

        Raises UnknownSiteError if no tokens were stored.
        """

    def iter_token_blocks(self, site: Site, role: str | None = None) -> Iterable[Tokens]:
        """Yield those tokens, some positions of all episodes at a time. Raises as `token_mask`."""

    # -- parts that arrays in memory do not have -------------------------------------------------------

    @property
    def source(self) -> RunSource:
        """The observations that it is made of."""

    @property
    def recorded(self) -> bool:
        """Whether its source shows recordings: a frame per inference, and no outcomes."""

    @property
    def in_own_environment(self) -> bool:
        """Whether its episodes were played in an environment of the user's own."""

    @property
    def inputs(self) -> "StoredInputs | None":
        """State, actions and small pictures of every inference; None for a run of scenes."""

    @property
    def control_steps(self) -> NDArray[np.int64]:
        """(E, N) control step or frame of each inference."""

    @property
    def captured_calls(self) -> int:
        """Inferences captured per episode, at most."""

    @property
    def has_trajectories(self) -> bool:
        """Whether episodes keep what happened in them step by step."""

    @property
    def lens_margins(self) -> NDArray[np.float64] | None:
        """(E, L) of the logit lens of answers by letter."""

    @property
    def control_features(self) -> Mapping[str, NDArray[np.floating]]:
        """(E, D) features of controls by name, in place of built-in ones."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """Settings that it was made with."""

    @property
    def certificate(self) -> Mapping[str, Any]:
        """The record of what was loaded and checked."""

    @property
    def mixed(self) -> Sequence[str]:
        """The parts that change numbers and differ between episodes."""

    @property
    def origins(self) -> Sequence[Origin]:
        """Files and choices of the processes that played it."""

    @property
    def stamp(self) -> str:
        """Hash of all commits; empty where the settings are the hash of all numbers."""

    @property
    def seed_text(self) -> str:
        """The text that random draws over its items are seeded with."""

    @property
    def suite_parent(self) -> str | None:
        """Content hash of the suite that `suite` was selected from."""

    @property
    def items(self) -> "pd.DataFrame | None":
        """One row per planned item with the hash of its content."""

    @property
    def planned(self) -> int:
        """Episodes of the plan, finished or not."""

    @property
    def planned_ids(self) -> Collection[str]:
        """Ids of all planned episodes, shown or not."""

    @property
    def planned_items(self) -> Mapping[str, str]:
        """Category of every planned item by its id."""

    @property
    def failed(self) -> Mapping[str, str]:
        """Episodes that were given up, with the reason."""

    @property
    def wording(self) -> str | None:
        """The only wording whose episodes are shown, None for all."""

    @property
    def wordings(self) -> Sequence[str]:
        """The wordings that items were asked in; empty for their own words alone."""

    @property
    def all_wordings(self) -> Self:
        """The same run with the episodes of all wordings."""

    @property
    def rule(self) -> str:
        """The rule by which outcomes are given."""

    @property
    def score(self) -> str:
        """The reading of answers by which outcomes are given, see `scored`."""


# -- checks ------------------------------------------------------------------------------------------------------


def full_name(label: str, random_weights: bool, captured_only: bool = False) -> str:
    """Return the label of a run, marked if the weights are random or the model only captured."""
    return label + (" (random weights)" if random_weights else "") + (" (capture only)" if captured_only else "")


def origin_of(run: RunReader) -> Origin:
    """Return files and choices that the run was made of; none where it does not say."""
    return run.origins[0] if run.origins else Origin()


def check_sides(run: RunReader, purpose: str) -> None:
    """Raise UsageError for a run without sides. purpose: what is not possible without them, in a word."""
    if SIDE not in run.episodes:
        raise UsageError(
            f"{run.location} has no column {SIDE}: {run.source.words}. There are no sides, so {purpose} is not "
            f"possible. `probe-kit targets {run.location}` lists what can be decoded, `probe-kit labels "
            f"{run.location}` writes a table for labels of your own"
        )


def check_several_wordings(episodes: "pd.DataFrame") -> None:
    """Raise UsageError for episodes of several wordings: probes and success rates are of one."""
    if "wording" in episodes and episodes["wording"].nunique() > 1:
        wordings = ", ".join(dict.fromkeys(episodes["wording"].astype(str)))
        raise UsageError(
            f"the episodes were asked in several wordings ({wordings}); probes and success rates take one. Choose "
            "it with --wording NAME, or `run.in_wording(NAME)` in Python"
        )


def check_call(run: RunReader, call: int) -> None:
    """Raise UsageError if no such inference was captured, and for a run that does not keep them apart."""
    captured = run.captured_calls
    if call and not 0 < call < captured:
        raise UsageError(
            f"{run.location} has {counted(captured, 'captured inference')} per episode, counted from 0; "
            f"there is no {call}. Extract with --captured-calls {call + 1} or more"
        )


def reached_calls(run: RunReader) -> NDArray[np.bool_]:
    """(E, C) whether an episode has a captured inference; all have the only one of a run not made by probe_kit."""
    if not hasattr(run, "reached"):  # `ArrayRun` has one inference per row and no such method
        return np.ones((len(run.episodes), 1), bool)
    return np.stack([run.reached(call) for call in range(run.captured_calls)], axis=1)


def select_items(
    items: "pd.DataFrame", categories: Sequence[str] | None, per_category: int | None, where: str
) -> list[str]:
    """Ids of the first items of some categories, in the order of the plan.

    items: as `Run.items`. categories: slugs, all by default. where: the run, for messages.
    Raises UnknownCategoryError and UsageError, see `Run.only`.
    """
    categories_of_run = list(dict.fromkeys(items["category"].astype(str)))
    selected = categories_of_run if categories is None else check_categories(categories, categories_of_run)
    if not selected:
        raise UsageError("no category selected. Name at least one, or leave `categories` out for all.")
    item_ids: list[str] = []
    for category in selected:
        planned = items[items["category"] == category]
        count = len(planned) if per_category is None else per_category
        if not 0 < count <= len(planned):
            raise UsageError(
                f"items is {count}, but {where} plans {len(planned)} items of {category!r}; give a number from 1 "
                f"to {len(planned)}, or play more with `probe-kit extract`"
            )
        _check_twins(planned, count, category)
        item_ids += planned["item_id"].iloc[:count].tolist()
    return item_ids


def _check_twins(items: "pd.DataFrame", count: int, category: str) -> None:
    """Raise UsageError if the first items hold one of two role-exchanged twins, and the others the other one."""
    pairs = items["pair_id"]
    separated = set(pairs.iloc[:count].dropna()) & set(pairs.iloc[count:].dropna())
    if separated:
        raise UsageError(
            f"items is {count}, which would keep one of the role-exchanged twins {min(separated)!r} of "
            f"{category!r} and drop the other. Give an even number."
        )


# -- a run in words ----------------------------------------------------------------------------------------------


def run_text(run: RunReader) -> str:
    """One line: model, suite, how much is there, where."""
    random = ", RANDOM WEIGHTS" if run.random_weights else ""
    random += ", CAPTURE ONLY (it did not act)" if CAPTURE_ONLY in _outcomes(run) else ""
    return f"<Run {run.label}{random} on {run.suite}: {_episodes(run)}, at {run.location}>"


def run_html(run: RunReader) -> str:
    """Describe the run, how it went, and its folder."""
    weights = "scripted, no weights" if run.weights_sha256 is None else f"sha256 {run.weights_sha256[:12]}"
    facts = {
        "suite": run.suite,
        "weights": f"RANDOM ({weights})" if run.random_weights else weights,
        "episodes": _episodes(run),
        "outcomes": ", ".join(f"{name} {count}" for name, count in _outcomes(run).items()),
        "streams": streams_text(run.streams.values()),
        "at": run.location.name if Path(str(run.location)).is_absolute() else str(run.location),
    }
    return facts_html(f"Run of {run.label}", facts, "run.episodes is the table, run.column(site) one site of it")


def _episodes(run: RunReader) -> str:
    committed = len(run.episodes)
    return f"{committed} episodes" if committed == run.planned else f"{committed} of {run.planned} episodes"


def _outcomes(run: RunReader) -> dict[str, int]:
    if run.episodes.empty:
        return {}
    return {str(name): int(count) for name, count in run.episodes["outcome"].value_counts().items()}
