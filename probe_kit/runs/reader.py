"""The protocol of a run: what probes, tables and interventions read of it, in memory or stored; and its checks."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import counted
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.runs.layout import DATASET, ENVIRONMENT
from probe_kit.runs.origin import Origin

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs.inputs import StoredInputs
    from probe_kit.runs.store import Location

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
