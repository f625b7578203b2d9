"""Reading of a run: episodes, pooled columns, tokens. Needs neither a simulator nor a model."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe_kit._system.escaping import as_argument
from probe_kit._terminal.notebook import facts_html
from probe_kit.env.scoring import DEFAULT_RULE, check_rule
from probe_kit.errors import (
    NoTrajectoryError,
    RunDamagedError,
    RunIncompleteError,
    UnknownSiteError,
    UsageError,
)
from probe_kit.hooks.contract.card import streams_text
from probe_kit.hooks.contract.sites import Site, Stream, resolve_view
from probe_kit.runs.array_store import ArrayStore
from probe_kit.runs.arrays import (
    EpisodeRows,
    StoredInputs,
    TokenBlock,
    decode_bfloat16,
    open_array,
    role_mask,
    token_blocks,
)
from probe_kit.runs.columns import Columns, find_columns
from probe_kit.runs.commits import (
    Commit,
    Seconds,
    read_commits,
    read_failures,
    read_seconds,
    redo,
    stamp_of,
)
from probe_kit.runs.layout import (
    CAPTURE_ONLY,
    CONDITIONS,
    DATA,
    DATASET,
    ENVIRONMENT,
    INPUTS,
    MEAN_VIEW,
    TRAJECTORY,
    ArrayKind,
    StoredStream,
    VectorKind,
    source_settings_of,
)
from probe_kit.runs.plan import RowColumns, while_growing
from probe_kit.runs.provenance import (
    Processes,
    Provenance,
    differences,
    read_processes,
)
from probe_kit.runs.records import RESTORE, Checksum
from probe_kit.runs.root import read_label, read_root
from probe_kit.runs.run_source import SERVED, Origin, RunSource, select_items
from probe_kit.runs.run_view import view_run
from probe_kit.runs.store import Location, locate
from probe_kit.runs.trajectories import Trajectories, judge_again, watch, with_outcomes

if TYPE_CHECKING:
    import xarray as xr

    from probe_kit.env.scoring import Trajectory


_OUTCOME = ("outcome", "side_placed", "seconds_inference", "seconds_simulation")
"""The columns of every episode behind those of its plan, and so of a table of no episodes too."""


class NotSealedWarning(UserWarning):
    """A warning that a column was read from rows, which gives the same numbers slowly."""


def open_run(path: Path | str | Location, allow_partial: bool = False) -> "Run":
    """Open the run in folder `path`, or at a URL such as `s3://bucket/prefix/run` (extra `remote`).

    Args:
        path: The folder or the URL.
        allow_partial: Open the run even if episodes of the plan are missing or failed; `episodes` then lists
            fewer.

    Raises:
        RunNotFoundError: If there is no run.
        RunIncompleteError: If the run is unfinished.
        RunDamagedError: If its schema is another one, a committed object is missing, or plan, metadata or any
            record is not what was written.
    """
    run = read_run(locate(path))
    # At the opening, so that damage is met before hours of work, and not in the middle of a table.
    run.check_records()
    committed = len(run.episodes)
    if committed < run.planned and not allow_partial:
        failed = f" ({len(run.failed)} failed: {', '.join(run.failed)})" if run.failed else ""
        remedy = "Finish it with the same `probe-kit extract`, or accept what is there"
        if run.source.kind == SERVED:
            remedy = "Clients played them and cannot repeat them: accept what is there"
        raise RunIncompleteError(
            f"{path} has {committed} of {run.planned} episodes{failed}. {remedy} (--partial, allow_partial=True)"
        )
    return run


def read_run(location: Location) -> "Run":
    """Return the run at `location`, finished or not; plan and commits are read together. Raises as `open_run`."""

    def read() -> Run:
        run = Run(location)
        _ = run.stamp  # reads the commits now, beside the plan they belong to
        return run

    return while_growing(location, read)


class Run:
    """A stored run. Rows of every array follow `episodes`, which lists the committed ones in plan order.

    Attributes:
        rule: The rule that gives outcomes, see `under`; `disc` at the last step is what was stored.
        last_steps: The number of control steps at the end that the rule judges.
        wording: The only wording whose episodes are shown, None for all; see `in_wording`.
        item_ids: The only items whose episodes are shown, None for all; see `only`.
        score: The score by which a run of questions is read: `text`, as stored.
        control_features: Features of a control by its name that the run brings along; none for a stored run, see
            `ArrayRun`.
        viewed: The run that this is a view of, see `view_run`; None for a run as it is stored.
    """

    rule: str = DEFAULT_RULE
    last_steps: int = 1
    score: str = "text"  # of a run of questions; see `retention/behaviour.py` for others
    control_features: Mapping[str, NDArray[np.floating]] = MappingProxyType({})
    viewed: "Run | None" = None

    def __init__(
        self, path: Path | str | Location, wording: str | None = None, item_ids: frozenset[str] | None = None
    ) -> None:
        """Read the records of the run at `path`; `open_run` also refuses an unfinished one."""
        location = locate(path)
        self.location, self.wording, self.item_ids = location, wording, item_ids
        self.root = read_root(location)
        self.root.check()
        if not self.root.plan:
            raise RunIncompleteError(
                f"{location} was begun and has no plan yet. Run the same `probe-kit extract` again"
            )
        self.settings: dict[str, Any] = self.root.settings
        self.settings_sha256: str = self.root.card.settings_sha256
        self._streams = self.root.streams

    def check_records(self) -> None:
        """Raise RunDamagedError if a record of the run is not what was written, or names a commit that is gone.

        Checks label, commits, seconds, provenance, certificates, seal and failures; results stored with the run
        are checked when read.
        """
        _ = self.label, self._seconds, self.failed, self._processes, self.columns

    def __repr__(self) -> str:
        random = ", RANDOM WEIGHTS" if self.random_weights else ""
        random += ", CAPTURE ONLY (it did not act)" if CAPTURE_ONLY in self._outcomes else ""
        return f"<Run {self.label}{random} on {self.suite}: {self._progress}, at {self.location}>"

    def _repr_html_(self) -> str:
        weights = "scripted, no weights" if self.weights_sha256 is None else f"sha256 {self.weights_sha256[:12]}"
        facts = {
            "suite": self.suite,
            "weights": f"RANDOM ({weights})" if self.random_weights else weights,
            "episodes": self._progress,
            "outcomes": ", ".join(f"{name} {count}" for name, count in self._outcomes.items()),
            "streams": streams_text(self.streams.values()),
            "at": self.location.name if Path(str(self.location)).is_absolute() else str(self.location),
        }
        advice = "run.episodes is the table, run.column(site) one site of it"
        return facts_html(f"Run of {self.label}", facts, advice)

    @property
    def _progress(self) -> str:
        committed = len(self.episodes)
        return f"{committed} episodes" if committed == self.planned else f"{committed} of {self.planned} episodes"

    @property
    def _outcomes(self) -> dict[str, int]:
        """Count the episodes by outcome."""
        if self.episodes.empty:
            return {}
        return {str(name): int(count) for name, count in self.episodes["outcome"].value_counts().items()}

    @property
    def path(self) -> Path:
        """The run's folder. Raises UsageError if it lies in an object store."""
        return self.location.path

    @property
    def model(self) -> str:
        """The model's name, as given to `probe-kit extract`."""
        return str(self._setting("model"))

    @cached_property
    def label(self) -> str:
        """The name of the run in tables and legends: a label that was given, or the model and what sets it apart.

        It may be changed, see `label_run`.

        Raises:
            RunDamagedError: If its record is missing or was changed.
        """
        return read_label(self.root)

    @property
    def weights_sha256(self) -> str | None:
        """The hash of the weights that acted; None for a scripted run."""
        return cast("str | None", self._setting("weights_sha256"))

    @property
    def random_weights(self) -> bool:
        """Whether this run was made with random weights."""
        return bool(self._setting("random_weights"))

    def _setting(self, name: str) -> Any:
        """Return a setting that every run stores. Raises RunDamagedError for a run without it."""
        if name not in self.settings:
            raise RunDamagedError(
                f"{self.location} does not store the setting {name!r}, which every run of probe_kit has. "
                "Extract it again, or take the run from where it was copied"
            )
        return self.settings[name]

    @property
    def capture_only(self) -> bool:
        """Whether the model was captured and did not act: the run has activations and no success rate."""
        return bool(self.settings.get("capture_only"))

    @property
    def ask(self) -> Mapping[str, Any] | None:
        """The settings with which its model was asked; None for one that acts."""
        return self.settings.get("ask")

    @cached_property
    def source(self) -> RunSource:
        """The observations that the run is made of: their kind, and the name that identifies them."""
        return RunSource.of(self.settings)

    @property
    def recorded(self) -> bool:
        """Whether the run shows stored pictures, as recordings do: no sides, no outcomes and no scene."""
        return DATASET in self.settings

    @property
    def in_own_environment(self) -> bool:
        """Whether the episodes were played in an environment of the user's own: there are no sides."""
        return ENVIRONMENT in self.settings

    @property
    def suite(self) -> str:
        """The identity of the suite that was run, `name@version#hash`.

        For recordings it is the data set's `name#hash`, for an environment of the user's own its `name@revision`.
        """
        return self.source.name

    @property
    def seed_text(self) -> str:
        """The text that random draws over the run's items are seeded with; see `suite.Suite.seed_text`.

        Runs that show no suite have `suite` here.
        """
        return str(self.settings["suite"]["seed_text"]) if "suite" in self.settings else self.suite

    @cached_property
    def inputs(self) -> StoredInputs | None:
        """State, actions and small pictures of every shown frame; None for a run of scenes.

        Raises:
            ActivationsLeftOutError: In a copy without activations.
        """
        source = source_settings_of(self.settings)
        if not source:
            return None
        if any(name.startswith(f"{INPUTS}/") for name in self.root.left_out):
            self.root.refuse_left_out("there are no inputs")
        return StoredInputs(self.data, self._numbers, source)

    @property
    def suite_parent(self) -> str | None:
        """The content hash of the suite that `suite` was selected from; None for a whole suite."""
        return self.root.stored_plan.suite_parent

    @cached_property
    def items(self) -> pd.DataFrame:
        """A row per planned item, played or not: `item_id`, `category`, `group_id`, `pair_id`, `content_sha256`.

        Items of two runs are the same where `item_id` and `content_sha256` are equal. The hash is that of
        `suite.Item.content_sha256`, None in runs that show no suite. Two wordings of an item are one row.
        """
        names = {name: name for name in ("item_id", "category", "group_id", "pair_id")}
        names["item_content_sha256"] = "content_sha256"
        rows = {row["item_id"]: [row.get(name) for name in names] for row in self._plan_of_items}
        return pd.DataFrame(list(rows.values()), columns=list(names.values()))

    @cached_property
    def _processes(self) -> Processes:
        return read_processes(self.root, {commit.provenance for commit in self._commits.values()})

    def restore_records(self) -> None:
        """Write the records of processes that are missing and follow from the others."""
        for key, content in self._processes.remade.items():
            self.location.create(key, content)

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """The record of what was loaded and checked: the first process's, then what every process measured.

        The entry `processes` has the records of all processes. The entry `hooks_on_equals_hooks_off` says whether
        in each process the actions or answers with and without capture have one hash. The entry `mixed` has what
        changes numbers and was not the same for all episodes.
        """
        processes = list(self._processes.records)
        certificate = dict(self._processes.first)
        checks = [process["capture_check"] for process in processes if process.get("capture_check")]
        if checks:
            certificate["hooks_on_equals_hooks_off"] = all(
                value == check.get(name.replace("_with_", "_without_"))
                for check in checks
                for name, value in check.items()
                if name.endswith("_with_hooks_sha256")
            )
        # A server writes a record at its end too, and one when a condition comes for the first time.
        edits: dict[str, Any] = {}
        for process in sorted(processes, key=lambda record: record.get("served", {}).get("committed", 0)):
            edits |= process.get(CONDITIONS, {})
        conditions = {CONDITIONS: edits} if edits else {}
        return {**certificate, **conditions, "processes": processes, "mixed": list(self.mixed)}

    @cached_property
    def origins(self) -> tuple[Origin, ...]:
        """The origins of the processes that played it, the first process first; empty before the first episode."""
        if not self._commits:
            return ()
        origins: list[Origin] = []
        for record in (self._processes.first, *self._processes.records):
            if (origin := Origin.of_record(record)) not in origins:
                origins.append(origin)
        return tuple(origins)

    @cached_property
    def provenances(self) -> dict[str, Provenance]:
        """The device and versions that made committed episodes, by the name in commits.

        Raises:
            RunDamagedError: If a commit names a provenance that is not stored.
        """
        names = sorted({commit.provenance for commit in self.commits()})
        return {name: self._processes.provenances[name] for name in names}

    @property
    def mixed(self) -> tuple[str, ...]:
        """The parts that change numbers and differ between episodes, such as `versions.torch`; mostly none."""
        return differences(self.provenances.values())

    # -- wordings --------------------------------------------------------------------------------------

    @property
    def wordings(self) -> tuple[str, ...]:
        """The wordings that items were asked in, as `--wordings` named them; empty for their own words alone."""
        return tuple(self.settings.get("wordings", {}).get("names", ()))

    def in_wording(self, wording: str | None = None) -> "Run":
        """Return the same run with the episodes of one wording only, as probes and success rates need it.

        Without a name this is the first wording; a run in the items' own words is then returned as it is.

        Raises:
            UsageError: For a wording that was not asked.
        """
        if wording is None and not self.wordings:
            return self
        name = self.wordings[0] if wording is None else wording
        if name not in self.wordings:
            available = (
                ", ".join(self.wordings) or "the items' own words only (it was extracted without --wordings)"
            )
            raise UsageError(f"{self.location} has no wording {name!r}; it has {available}")
        return self._showing(name, self.item_ids)

    @property
    def all_wordings(self) -> "Run":
        """The same run with the episodes of all wordings."""
        return self if self.wording is None else self._showing(None, self.item_ids)

    def only(self, categories: Sequence[str] | None = None, items: int | None = None) -> "Run":
        """Return the same run with the first items of some categories only, in the order of the plan.

        A run of more items thereby serves where fewer are wanted: seeds depend on the run's seed and the item
        alone. Probes are fitted to the episodes that are shown, and stored with the run under a key of their own.

        Args:
            categories: Slugs of categories; None for all.
            items: The number of items per category; None for all.

        Raises:
            UnknownCategoryError: For a category the run lacks.
            UsageError: For a number that is not positive, exceeds what a category has, or would separate
                role-exchanged twins.
        """
        if categories is None and items is None:
            return self
        item_ids = select_items(self.items, categories, items, str(self.location))
        return self._showing(self.wording, frozenset(item_ids))

    def _showing(self, wording: str | None, item_ids: frozenset[str] | None) -> "Run":
        return Run(self.location, wording, item_ids).under(self.rule, self.last_steps)

    def grown(self) -> "Run":
        """Return the same run with the episodes that were committed since; only their commits are read."""

        def read() -> Run:
            run = self._showing(self.wording, self.item_ids)
            # Fills the cache of `cached_property`: a commit never changes, so only new ones are read.
            run.__dict__["_commits"] = read_commits(run.root, self._commits)
            return run

        return while_growing(self.location, read)

    @cached_property
    def _commits(self) -> dict[int, Commit]:
        return read_commits(self.root)

    def commits(self) -> list[Commit]:
        """Return the commit of every episode, in the order of `episodes`."""
        return [self._commits[number] for number in self._numbers]

    @cached_property
    def _numbers(self) -> list[int]:
        return [planned["episode"] for planned in self._plan if planned["episode"] in self._commits]

    @cached_property
    def stamp(self) -> str:
        """The hash of all commits, by which derived files name their source."""
        return stamp_of(self._commits)

    @cached_property
    def failed(self) -> dict[str, str]:
        """The reason of every episode that was given up, by its id."""
        return read_failures(self.root)

    @cached_property
    def planned(self) -> int:
        """The number of episodes in the plan, committed or not."""
        return len(self._plan)

    @cached_property
    def planned_ids(self) -> frozenset[str]:
        """The ids of all planned episodes, shown or not."""
        return frozenset(str(row["episode_id"]) for row in self.root.plan)

    @cached_property
    def planned_items(self) -> Mapping[str, str]:
        """The category of every item of the plan by its id, whatever is shown of the run: its suite has all."""
        return {str(row["item_id"]): str(row["category"]) for row in self.root.plan}

    @cached_property
    def _plan_of_items(self) -> list[RowColumns]:
        """The plan of the items that are shown, in all wordings."""
        return [e for e in self.root.plan if self.item_ids is None or e["item_id"] in self.item_ids]

    @cached_property
    def _plan(self) -> list[RowColumns]:
        return [e for e in self._plan_of_items if self.wording is None or e["wording"] == self.wording]

    @cached_property
    def _columns_rows(self) -> NDArray[np.intp] | slice:
        """The rows of `episodes` among those of the columns, which hold every committed episode."""
        if self.wording is None and self.item_ids is None:
            return slice(None)
        # In the order in which `seal` wrote them, which is that of the whole plan.
        sealed = [planned["episode"] for planned in self.root.plan if planned["episode"] in self._commits]
        return np.flatnonzero(np.isin(sealed, self._numbers))

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """The committed episodes, one per row: the plan's columns, then the outcome's, then how long it took.

        `seconds_inference` and `seconds_simulation` are wall-clock seconds. The first are those of the model's
        calls; a call for several observations counts with its share. The second are those of setting up,
        simulating and drawing. Both are NaN where the folder `times` was deleted. They differ between runs of one
        identity.
        """
        plan = self.root.planned
        rows = [
            {
                **plan[number],
                **self._commits[number].outcome,
                "seconds_inference": self._seconds[number].inference,
                "seconds_simulation": self._seconds[number].simulation,
            }
            for number in self._numbers
        ]
        return pd.DataFrame(rows or None, columns=None if rows else [*self.root.plan[0], *_OUTCOME])

    @cached_property
    def _seconds(self) -> dict[int, Seconds]:
        return read_seconds(self.root, self._commits)

    @cached_property
    def control_steps(self) -> NDArray[np.int64]:
        """The control step (E, N) int64 at which each inference of an episode was made, -1 behind its last one.

        N is the largest number of inferences of an episode; 0 for scripts. Captured inference `call` is column
        `call`. A control step is one executed action; an inference at step 4 saw the state after four actions. For
        recordings it is the number of the frame in its episode. An episode in which nothing moves (`ask`, or
        without acting) has one inference, at step 0.
        """
        stored = [commit.control_steps for commit in self.commits()]
        steps = np.full(
            (len(stored), max((len(episode_steps) for episode_steps in stored), default=0)), -1, np.int64
        )
        for row, episode_steps in enumerate(stored):
            steps[row, : len(episode_steps)] = episode_steps
        return steps

    @cached_property
    def lens_margins(self) -> NDArray[np.float64] | None:
        """The logit lens (E, L): the logit of the letter for left minus that for right, at every layer.

        It exists for questions that are answered by letter, with left named first. The last layer gives the
        model's answer. None for every other run; NaN for episodes without one.
        """
        stored = [commit.lens_margins or [] for commit in self.commits()]
        layers = max(map(len, stored), default=0)
        if not layers:
            return None
        return np.array([margins or [np.nan] * layers for margins in stored], np.float64)

    # -- trajectories ----------------------------------------------------------------------------------

    @cached_property
    def has_trajectories(self) -> bool:
        """Whether episodes keep what happened in them step by step.

        Runs made before it was stored do not, nor runs whose model did not act, nor copies without it.
        """
        if TRAJECTORY in self.root.left_out or not self.root.has_trajectories:
            return False
        keeps = (
            any(key.startswith(f"{TRAJECTORY}/") for key in commit.objects) for commit in self._commits.values()
        )
        return all(keeps)  # the commit of an episode that did not act names none

    @cached_property
    def trajectories(self) -> Trajectories:
        """The trajectories of all episodes, in the order of `episodes`. Raises NoTrajectoryError without any."""
        if not self.has_trajectories:
            raise NoTrajectoryError(
                f"{self.location} keeps no trajectories; it was made before they were stored, or is a copy "
                "without them. Extract it again to have them"
            )
        rows = EpisodeRows(open_array(self.data, TRAJECTORY), self._numbers)
        return Trajectories(rows, self._every_episode["steps"].astype(int).tolist(), str(self.location))

    def trajectory(self, episode: str | int) -> "Trajectory":
        """Return the trajectory of one episode, frame by frame; `.to_xarray()` labels it.

        Args:
            episode: Its id, such as `color-0001:o`, or its row in `episodes`.

        Raises:
            NoTrajectoryError: If the run keeps none.
            UsageError: For an unknown episode.
            RunDamagedError: If stored bytes are missing or changed.
        """
        return self.trajectories[self._position(episode)]

    def judged(self, rule: str, last_steps: int = 1) -> pd.DataFrame:
        """Return a row per episode with the fields of `Judgement`: what an outcome rule says of it.

        Args:
            rule: A name of `probe_kit.env.scoring.RULES`.
            last_steps: The number of control steps at the end that count; the released evaluation averages over
                11.

        Raises:
            UsageError: For an unknown rule.
            NoTrajectoryError: If the run keeps no trajectories.
        """
        if last_steps == 1:
            return self._watched[0][check_rule(rule)].copy()
        sides = self._every_episode["side_correct"]
        return judge_again(self.trajectories, sides, self.settings["scene"], rule, last_steps)

    def under(self, rule: str, last_steps: int = 1) -> "Run":
        """Return the same run with its outcomes by another rule, for tables and figures; see `judge_again`."""
        if (check_rule(rule), last_steps) == (self.rule, self.last_steps):
            return self
        episodes = with_outcomes(self.episodes, self.judged(rule, last_steps).loc[self.episodes.index])
        return view_run(self, episodes, rule=rule, last_steps=last_steps)

    @cached_property
    def behaviour(self) -> pd.DataFrame:
        """A row per episode: its id, then what hand and cube did, see `probe_kit.env.scoring.Behaviour`.

        Raises:
            NoTrajectoryError: If the run keeps no trajectories.
        """
        return (
            self._watched[1]
            .assign(episode_id=self._every_episode["episode_id"])
            .set_index("episode_id")
            .reset_index()
        )

    @cached_property
    def _watched(self) -> tuple[dict[str, pd.DataFrame], pd.DataFrame]:
        return watch(self.trajectories, self._every_episode["side_correct"], self.settings["scene"])

    @property
    def _every_episode(self) -> pd.DataFrame:
        """The episodes that rows of arrays are of; a view may show some of them only."""
        return self.episodes if self.viewed is None else self.viewed.episodes

    def instruction_ids(self, episode: str | int) -> tuple[int, ...] | None:
        """Return the token ids of one episode's instruction as the policy received it; None if none are stored."""
        ids = self.commits()[self._position(episode)].instruction_ids
        return None if ids is None else tuple(ids)

    def _position(self, episode: str | int) -> int:
        """Return the row in `episodes`. Raises UsageError for an unknown episode."""
        names = self._every_episode["episode_id"].tolist()
        if isinstance(episode, str) and episode in names:
            return names.index(episode)
        if isinstance(episode, int) and 0 <= episode < len(names):
            return episode
        raise UsageError(
            f"{self.location} has no episode {episode!r}; it has {len(names)}, from {names[0]!r} on"
            if names
            else f"{self.location} has no episode yet"
        )

    # -- streams ---------------------------------------------------------------------------------------

    @property
    def streams(self) -> dict[str, Stream]:
        """The captured streams; empty for a scripted run."""
        return {name: stored.stream for name, stored in self._streams.items()}

    def stored(self, stream: str) -> StoredStream:
        """Return the storage of one stream. Raises UnknownSiteError for a stream that is not stored."""
        if stream not in self._streams:
            streams = ", ".join(self._streams) or "none (a scripted run has no activations)"
            raise UnknownSiteError(f"{self.location} has no stream {stream!r}; stored: {streams}")
        return self._streams[stream]

    def views(self, stream: str, call: int = 0) -> tuple[str, ...]:
        """Return the pooled views of one stream that are stored of captured inference `call`."""
        return (MEAN_VIEW,) if self._keeps_mean_of(call) else self.stored(stream).views

    def _keeps_mean_of(self, call: int) -> bool:
        """Whether captured inference `call` is one of which the mean alone is stored, in bfloat16."""
        return call > 0 and self.root.later_views == MEAN_VIEW

    def sites(self, stream: str) -> list[Site]:
        """Return all sites of one stream."""
        return self.stored(stream).stream.sites()

    @property
    def captured_calls(self) -> int:
        """The number of captured inferences per episode, from the first on; episodes that end early have fewer."""
        return int(self.settings["captured_calls"])

    def reached(self, call: int) -> NDArray[np.bool_]:
        """Return for every episode (E,) whether it got as far as captured inference `call`."""
        return np.array([len(commit.roles) > call for commit in self.commits()], bool)

    def _check(self, site: Site, call: int) -> StoredStream:
        stored = self.stored(site.stream)
        if not 0 <= call < self.captured_calls:
            raise UnknownSiteError(
                f"{self.location} has {self.captured_calls} captured inferences per episode, counted from 0; "
                f"asked for {call}. Extract with --captured-calls {call + 1}"
            )
        if site not in stored.stream.sites():
            raise UnknownSiteError(
                f"{self.location} has no site {site}; {site.stream} has {stored.layers} layers"
                + (f" and {stored.iterations} iterations" if stored.iterations else "")
            )
        return stored

    # -- pooled ----------------------------------------------------------------------------------------

    def column(self, site: Site, view: str = "mean", call: int = 0) -> NDArray[np.float32]:
        """Return one pooled view of one site at one captured inference, (E, D) float32, a row per episode.

        The rows of episodes that ended before inference `call` are NaN; see `reached`. With `--later-views mean`,
        inferences after the first have the view `mean` alone, rounded to bfloat16.

        Raises:
            UnknownSiteError: For a site, view or inference that is not stored.
            RunDamagedError: If stored bytes are missing or fail their checksum.
            ActivationsLeftOutError: In a copy without activations.
        """
        stored = self._check(site, call)
        if self.columns is None and f"{site.stream}/pooled" in self.root.left_out:
            self.root.refuse_left_out(f"there is no column of {site}")
        view = resolve_view(view, stored.views)
        if view not in (views := self.views(site.stream, call)):
            at = f" at inference {call}, with --later-views mean" if self._keeps_mean_of(call) else ""
            raise UnknownSiteError(f"no view {view!r} of {site.stream}{at}; stored: {', '.join(views)}")
        in_mean, lead = self._keeps_mean_of(call), stored.at(site)
        kind: VectorKind = "later" if in_mean else "pooled"
        index: tuple[Any, ...] = (call - 1, *lead)
        if self.columns is None:
            warnings.warn(
                f"{self.location} is not sealed; columns are put together from rows, which is slow but gives the "
                f"same numbers. `probe-kit run verify {as_argument(self.location)} --seal` makes it fast",
                NotSealedWarning,
                stacklevel=2,
            )
            index = index if in_mean else (call, *lead, stored.views.index(view))
            values = np.asarray(self._committed_rows(site.stream, kind)[(slice(None), *index)])
        else:
            index = index if in_mean else (call, stored.views.index(view), *lead)
            values = self.columns.read(f"{stored.name}/{kind}", index, site)[self._columns_rows]
        return decode_bfloat16(values) if in_mean else values

    @property
    def sealed(self) -> bool:
        """Whether columns were built from exactly the episodes that are committed."""
        return self.columns is not None

    @cached_property
    def columns(self) -> Columns | None:
        """The sealed columns, None if there are none of exactly these episodes. Raises RunDamagedError."""
        return find_columns(self.root, self._commits)

    def rows(self, stream: str, kind: ArrayKind = "pooled") -> EpisodeRows:
        """Return the stored rows of the committed episodes: all that was captured in one episode at a time.

        Raises:
            ActivationsLeftOutError: In a copy without activations.
        """
        if f"{stream}/{kind}" in self.root.left_out:
            self.root.refuse_left_out(f"there are no {kind} of {stream}")
        return EpisodeRows(open_array(self.data, f"{stream}/{kind}"), self._numbers)

    @property
    def data(self) -> ArrayStore:
        """The arrays of the committed episodes as a store of Zarr; every object is checked as it is read."""
        return ArrayStore(self.location, DATA, self._sums, self._advice, read_only=True)

    @cached_property
    def _sums(self) -> dict[str, Checksum]:
        """The sums of all objects of `data.zarr`, by key: metadata, and those that commits name."""
        sums = dict(self.root.metadata)
        for commit in self._commits.values():
            sums |= commit.objects
        return sums

    def _advice(self, key: str) -> str:
        """Return the remedy for a damaged object of `data.zarr`."""
        of = next((number for number, commit in self._commits.items() if key in commit.objects), None)
        return RESTORE if of is None else redo(of)

    def _committed_rows(self, stream: str, kind: VectorKind) -> NDArray[Any]:
        """Return the rows (E, S, [I,] L, [V,] D) of the committed episodes, read once per array."""
        if (stream, kind) not in self._kept_rows:
            rows = self.rows(stream, kind)
            self._kept_rows[stream, kind] = np.stack([rows[position] for position in range(len(rows))])
        return self._kept_rows[stream, kind]

    @cached_property
    def _kept_rows(self) -> dict[tuple[str, VectorKind], NDArray[Any]]:
        return {}

    def xarray(self) -> "xr.Dataset":
        """Return the pooled arrays with labelled views and episodes; dimensions of a stream carry its name.

        With `--later-views mean` they hold the first inference alone; `column` reads the others. Values of a
        sealed run are read when they are used, not before.
        """
        import xarray as xr

        arrays = {}
        for name, stored in self._streams.items():
            if self.columns is None:
                dimensions = ["episode", "call", *stored.dimensions, "view", "feature"]
                array = xr.DataArray(self._committed_rows(name, "pooled"), dims=dimensions)
            else:
                array = self.columns.xarray(name).isel(episode=self._columns_rows)
            renamed = {dimension: f"{name}_{dimension}" for dimension in (*stored.dimensions, "view", "feature")}
            array = array.rename(renamed).transpose("episode", "call", *renamed.values())
            arrays[f"{name}_pooled"] = array.assign_coords({f"{name}_view": list(stored.views)})
        labels = ("episode_id", "category", "layout", "side_correct", "outcome")
        episodes = self._every_episode
        available = [label for label in labels if label in episodes]
        return xr.Dataset(arrays, coords={label: ("episode", episodes[label]) for label in available})

    # -- tokens ----------------------------------------------------------------------------------------

    def tokens(
        self, site: Site, role: str | None = None, call: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return values (E, T, D) float32 and mask (E, T) bool of one site, of `role` or of all but padding.

        Values outside the mask are zero. For large runs use `iter_token_blocks`, which holds one block.

        Raises:
            UnknownSiteError: If the run was extracted without `--tokens all`, or never had that role.
        """
        mask = self.token_mask(site, role, call)
        values = np.zeros((*mask.shape, self.stored(site.stream).width), np.float32)
        for block in self.iter_token_blocks(site, role, call):
            values[:, block.start : block.start + block.mask.shape[1]] = block.values
        return values, mask

    def token_mask(self, site: Site, role: str | None = None, call: int = 0) -> NDArray[np.bool_]:
        """Return the mask (E, T) of the positions of `role`, or of all tokens but padding; see `tokens`."""
        stored = self._check(site, call)
        if self.settings["tokens"] != "all":
            raise UnknownSiteError(f"{self.location} stores pooled views only; extract with --tokens all")
        calls = [commit.roles for commit in self.commits()]
        spans = [episode_roles[call][site.stream] if call < len(episode_roles) else [] for episode_roles in calls]
        mask = role_mask(spans, stored.stored_tokens, role)
        if not mask[self.reached(call)].any(axis=1).all():
            roles = sorted({name for episode in spans for name, _, _ in episode})
            raise UnknownSiteError(f"not every episode has a token of role {role!r} at {site}; roles: {roles}")
        return mask

    def iter_token_blocks(self, site: Site, role: str | None = None, call: int = 0) -> Iterator[TokenBlock]:
        """Yield the tokens of one site, at most 128 positions of all episodes at a time; see `tokens`.

        Only blocks that hold a token of `role` are read.
        """
        mask = self.token_mask(site, role, call)
        stored = self.stored(site.stream)
        rows = self.rows(site.stream, "tokens")
        return token_blocks(rows, (call, *stored.at(site)), mask, stored.token_block)

    def gram(self, site: Site, role: str | None = None, call: int = 0) -> NDArray[np.float64]:
        """Return a linear kernel (E, E) float64 over the tokens of one site.

        An entry is the sum of the products of tokens at equal positions, divided by sqrt(n_i n_j). There n_i is an
        episode's number of chosen tokens, so that longer instructions have no larger weight.
        """
        kernel = np.zeros((len(self._numbers), len(self._numbers)))
        counts = np.zeros(len(self._numbers))
        for block in self.iter_token_blocks(site, role, call):
            flat = block.values.reshape(len(kernel), -1)
            kernel += flat @ flat.T
            counts += block.mask.sum(axis=1)
        return np.asarray(kernel / np.sqrt(np.outer(counts, counts)))
