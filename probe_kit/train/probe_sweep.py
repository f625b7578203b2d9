"""Probes of every site of a run: `train_probes`, in this process, in several, or on a Ray cluster."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from probe_kit._execution.executor import GivenUp, TaskQueue, work_off
from probe_kit._execution.process_pool import ProcessPool
from probe_kit._execution.ray_pool import RayPool
from probe_kit._system.types import Progress
from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import NoProbesError, RunIncompleteError, UnknownCategoryError, UsageError, WorkerDiedError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.environment_success import condition_counts
from probe_kit.runs.reader import RunReader, check_several_wordings
from probe_kit.statistics.folds import FoldUnit
from probe_kit.train.choices import CORRECT, EVERYWHERE, Incomplete
from probe_kit.train.controls import (
    add_controls,
    add_untrained,
    check_same_source,
    check_untrained,
    prepare_controls,
)
from probe_kit.train.crossval.site_probe import SiteProbe
from probe_kit.train.problem import Problem, make_problem
from probe_kit.train.results.control_scores import Controls
from probe_kit.train.results.probe_results import Direction, ProbeResults, ProbeSettings, episodes_sha256
from probe_kit.train.results.store import SweepCheckpoint, is_stored, load_results, save_results
from probe_kit.train.samples import Samples, is_token_view, read_samples, sites_of
from probe_kit.train.solver.arrays import check_device
from probe_kit.train.target import Target
from probe_kit.train.target_samples import TargetSamples, groups_of, target_samples

Key = tuple[str, Site]
"""A view and a site."""

Columns = Iterator[tuple[Key, Samples]]
Problems = Mapping[str, Problem]
Probed = dict[str, SiteProbe]


def probe_columns(
    columns: Columns,
    problems: Problems,
    jobs: int | None = None,
    device: str | None = None,
    ray: str | None = None,
) -> Iterator[tuple[Key, Probed]]:
    """Yield the probes of every column by category, as they are finished; the workers change no number.

    A worker's own error is raised here too.

    Args:
        columns: Samples of every view and site.
        problems: Probing problems, by category.
        jobs: Columns at once, 1 by default.
        device: Device on which torch solves them; numpy does without one.
        ray: Address of a cluster that solves them; `auto` for the one this process belongs to, or a new one on
            this machine. `jobs` is then by default as many as it has cores.

    Raises:
        MissingExtraError: If Ray is asked for and not installed.
        WorkerDiedError: If workers die with the same column or before they begin.
    """
    if ray is None and (jobs or 1) == 1:
        for key, samples in columns:
            yield key, _probe(samples, problems, device)
        return
    pool = ProcessPool(fit_columns, problems, jobs or 1) if ray is None else RayPool(
        fit_columns, problems, ray, lambda cluster: [0] * (jobs or max(1, int(cluster["CPU"])))
    )  # fmt: skip
    # One column is read ahead, so that memory holds no more than that and those in work.
    queue = TaskQueue(((f"{key[1]} {key[0]}", (key, samples)) for key, samples in columns), "column")
    for slot, event in work_off(pool, queue):
        if isinstance(event, GivenUp):
            raise WorkerDiedError(
                f"the column {event.task[0][1]} {event.task[0][0]} was lost with each worker that fitted it; the "
                f"last one: {event.reason}. Its last words are above. The same command continues after the last "
                "finished site; fewer --jobs take less memory"
            )
        key, probed = event
        queue.end(slot, f"{key[1]} {key[0]}")
        yield key, probed


def fit_columns(
    problems: Problems, take: Callable[[], tuple[Key, Samples]], report: Callable[[tuple[Key, Probed]], None]
) -> None:
    """Fit one column after the other in a worker elsewhere, with one BLAS thread.

    With more threads each, the workers would wait for the same cores.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    with threadpool_limits(1):
        while True:
            key, samples = take()
            report((key, _probe(samples, problems)))


def _probe(samples: Samples, problems: Problems, device: str | None = None) -> Probed:
    on_device = samples.to(device)
    return {category: problem.probe(on_device) for category, problem in problems.items()}


# -- the sweep -----------------------------------------------------------------------------------------------

TOKEN_PERMUTATIONS = 59
"""Label permutations of token views by default: every token is a sample, and each permutation costs a full fit.

The smallest p is then 1/60; a site with one permutation that does as well as the labels is still below 0.05.
"""


def train_probes(
    run: RunReader,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    target: Target | str = CORRECT,
    window: int | None = None,
    align_to: Target | None = None,
    call: int = 0,
    permutations: int = 200,
    token_permutations: int = TOKEN_PERMUTATIONS,
    folds: FoldUnit = "groups",
    incomplete: Incomplete = "keep",
    controls: Sequence[str] | None = None,
    suite: Path | None = None,
    untrained: RunReader | None = None,
    seed: int = 0,
    jobs: int | None = None,
    device: str | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> ProbeResults:
    """Probe every site of every stream for `target`, per category and view, and store the results in the run.

    With the same settings and episodes the stored results are returned, whatever jobs and device. An interrupted
    sweep continues after the last finished site. Controls are added to what is stored. No results are stored
    before all sites are fitted: where this raises, `load_results` still returns the earlier results.

    Args:
        run: Run whose activations are probed.
        categories: Categories, each one by itself; by default all of the run for a side. `all` pools every
            episode; it is the default of every other target.
        views: Pooled views, and `tokens` or `tokens:ROLE`. In these every token is a sample, and the decision
            about a sample is the mean of its tokens' decisions.
        target: A side, such as `side.correct`, a built-in column, such as `sim.tool_y`, or a `Target` of a table
            of one's own.
        window: With a label for every inference, how many of each episode take part; by default as many as 90 % of
            the episodes reach.
        align_to: Target that decides where windows begin: at the first inference at which it is true.
        call: Captured inference, counted from 0, that a label of whole episodes is decoded from; episodes that
            ended before it are left out.
        permutations: Number of label permutations behind the p-values.
        token_permutations: Number of these, the first ones, that token views take, which cost many times as much.
        folds: `groups` keeps items that share a picture together; `concepts` also items about the same two
            concepts.
        incomplete: `drop` leaves out items of which an episode is missing; `keep` uses their other episode.
        controls: Features that never see the model, see `CONTROLS`; () for none. By default of a side
            `random-features` and `pixels`, of other targets all that the run allows but `action` and `position`.
            Where pictures cannot be found, a warning says that they were left out.
        suite: Folder of the run's suite; the embedded one is found or drawn again without it.
        untrained: A run of the same episodes, usually by random weights, to compare with. A site that does not
            exceed `random-features` and the untrained network shows no signal, whatever its p-value.
        seed: Seed of folds, permutations and controls, and of the flips of the target `side.shuffled`.
        jobs: Processes that probe, this one alone by default; with more than one, a script needs `if __name__ ==
            "__main__":`.
        device: Device on which torch solves logistic probes, such as `cuda`; numpy without one.
        ray: Address of a Ray cluster that probes; `auto` for the one this process belongs to, or a new one on this
            machine. `jobs` is then how many sites at once, by default as many as it has cores.
        progress: Called after every site; by default a bar in a notebook, nothing elsewhere.

    Raises:
        RunIncompleteError: For a run without episodes.
        NoProbesError: For a run without activations.
        UnknownCategoryError: For a category that the run does not have.
        UnknownSiteError: For a view that no stream has.
        TooFewGroupsError: For fewer independent groups than folds, and for a class in too few of them.
        UnbalancedEpisodesError: If so many episodes of one side are missing that the other is right without
            knowledge.
        NonFiniteActivationError: For features that hold NaN or infinity.
        ProbeNotConvergedError: If a logistic probe stops before its optimum.
        UsageError: For options that are wrong or that the target or run does not allow, and for an `untrained` run
            of other episodes.
        SuiteError: For another suite in the folder `suite`, or a damaged one.
        SuiteNotFoundError: For a control in `controls` whose pictures cannot be found.
    """
    check_options(views, permutations, token_permutations, jobs, device, ray)
    options: dict[str, Any] = {
        "views": views, "permutations": permutations, "token_permutations": token_permutations, "folds": folds,
        "incomplete": incomplete, "seed": seed, "call": call, "window": window, "align_to": align_to,
    }  # fmt: skip
    workers: dict[str, Any] = {"jobs": jobs, "device": device, "ray": ray, "progress": progress}
    check_run(run, categories)
    if untrained is not None:
        check_run(untrained, categories)
    sweep = ProbeSweep.of(run, target, categories, **options)
    if device is not None and sweep.target.task != "binary":
        raise UsageError(
            f"device {device!r} with {sweep.target.described}; ridge is solved by numpy, a device solves logistic "
            "probes. Leave device out"
        )
    sweep.check()
    settings = sweep.settings
    stored = Controls() if sweep.stored is None else sweep.stored.controls
    prepared = prepare_controls(
        run, sweep.samples, settings.balanced, controls, suite, stored, settings.categories
    )  # fmt: skip
    untrained_sweep = None
    if untrained is not None:
        check_same_source(run, untrained, sweep.samples, settings.balanced)
        same: Target | str = settings.target if settings.balanced else sweep.target
        untrained_sweep = ProbeSweep.of(untrained, same, settings.categories, **options)
        check_untrained(run, untrained, sweep.samples, untrained_sweep.samples, settings.balanced, call)
        untrained_sweep.check()
    results = add_controls(sweep.results(**workers), sweep.problems, sweep.widths, prepared)
    if untrained_sweep is not None:
        untrained_results = untrained_sweep.results(**workers)
        results = add_untrained(results, untrained_results)
        untrained_sweep.keep(untrained_results, requested=False)
    return sweep.keep(results, requested=True)


def check_options(
    views: Sequence[str],
    permutations: int,
    token_permutations: int = 0,
    jobs: int | None = None,
    device: str | None = None,
    ray: str | None = None,
) -> None:
    """Raise UsageError for options that are wrong whatever the run."""
    check_device(device)
    if device is not None and ((jobs or 1) > 1 or ray is not None):
        raise UsageError(
            f"device {device!r} is used by one process, got jobs={jobs}, ray={ray!r}. Leave `jobs` and `ray` out."
        )
    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs={jobs}; expected at least 1 process, or None")
    if min(permutations, token_permutations) < 0:
        raise UsageError(
            f"permutations={permutations}, token_permutations={token_permutations}; expected 0 or more (0: no p)"
        )
    if not views or len(set(views)) < len(views):
        raise UsageError(f"views {', '.join(views) or 'none'}; expected one or more, each once, such as mean")


def check_run(run: RunReader, categories: Sequence[str] | None) -> None:
    """Raise an error for a run that cannot be probed with these categories.

    Raises:
        RunIncompleteError: For a run without episodes.
        UnknownCategoryError: For a category that the run does not have.
        UsageError: For episodes in several wordings.
    """
    if len(run.episodes) == 0:
        raise RunIncompleteError(f"{run.location} has no finished episode to probe. Finish it first")
    names = list(dict.fromkeys(run.episodes["category"]))
    for category in categories or ():
        if category not in (*names, EVERYWHERE):
            raise UnknownCategoryError(f"{run.location} has no category {category!r}; it has: {', '.join(names)}")
    check_several_wordings(run.episodes)


def probe_settings(
    run: RunReader, *, views: Sequence[str], permutations: int, target: str, seed: int
) -> ProbeSettings:
    """Return the settings of the probes that `train_probes` fits with these options, others at their default.

    Their key is that of the stored results. Nothing is fitted.

    Raises:
        NoProbesError: For a run without activations.
    """
    return ProbeSweep.of(run, target, None, views=views, permutations=permutations, seed=seed).settings


@dataclass(frozen=True)
class ProbeSweep:
    """The probes of a target in one run that are to be fitted, or are stored.

    Attributes:
        run: The run whose activations are probed.
        target: The target with its labels.
        samples: The labelled episodes or inferences of the run.
        settings: The settings that identify the results.
    """

    run: RunReader
    target: Target
    samples: TargetSamples
    settings: ProbeSettings

    @classmethod
    def of(
        cls,
        run: RunReader,
        target: Target | str,
        categories: Sequence[str] | None,
        *,
        views: Sequence[str],
        permutations: int,
        seed: int,
        token_permutations: int = TOKEN_PERMUTATIONS,
        folds: FoldUnit = "groups",
        incomplete: Incomplete = "keep",
        call: int = 0,
        window: int | None = None,
        align_to: Target | None = None,
    ) -> "ProbeSweep":
        """Read labels and samples; nothing is probed yet."""
        if not run.streams:
            raise NoProbesError(
                f"{run.location} has no activations to probe: of {run.model!r} no stream was stored."
            )
        target = Target.of_run(run, target, seed=seed) if isinstance(target, str) else target.on(run)
        event = None if align_to is None else align_to.on(run)
        if categories is None:
            categories = tuple(dict.fromkeys(run.episodes["category"])) if target.balanced else (EVERYWHERE,)
        if folds != "groups" and (target.group_by or target.exchange_within):
            raise UsageError(
                f"folds={folds!r} with columns of groups ({target.group_by or target.exchange_within}); expected "
                "one of both. Leave --folds, or --group-by and --exchange-within, out"
            )
        if target.balanced and (window is not None or event is not None):
            option = f"window={window}" if window is not None else "align_to"
            raise UsageError(f"{option} with the side {target.name!r}; it needs labels of single inferences")
        samples = target_samples(run, target, categories, call, window, event, incomplete)
        grouping = ""
        if not target.balanced:
            ids = run.episodes["episode_id"].astype(str).tolist()
            columns = (names.tolist() for names in groups_of(run, target))
            grouping = sha256_json(sorted(zip(ids, *columns, strict=True)))
        settings = ProbeSettings(
            model=run.model,
            random_weights=run.random_weights,
            weights=run.weights_sha256,
            suite=run.suite,
            seed_text=run.seed_text,
            run_settings=run.settings_sha256,
            episodes=episodes_sha256(run),
            categories=tuple(categories),
            views=tuple(views),
            target=target.name,
            permutations=permutations,
            seed=seed,
            # 0 where none is probed, so that the option does not change the key of results that it has no part in.
            token_permutations=min(token_permutations, permutations) if any(map(is_token_view, views)) else 0,
            folds=folds,
            incomplete=incomplete,
            call=call,
            task=target.task,
            label=target.sha256,
            group_by=target.group_by or "group_id",
            exchange_within=target.exchange_within or "",
            grouping=grouping,
            window=samples.window,
            align_to="" if event is None else f"{event.name}#{event.sha256[:12]}",
        )
        return cls(run, target, samples, settings)

    @cached_property
    def stored(self) -> ProbeResults | None:
        """The stored results of the same settings; None if nothing was probed with them."""
        key = self.settings.key
        return load_results(self.run, key) if is_stored(self.run.location, key) else None

    @cached_property
    def problems(self) -> dict[str, Problem]:
        """The probing problem of every category."""
        return {
            name: make_problem(self.run, self.target, self.samples, name, self.settings)
            for name in self.settings.categories
        }

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """The pairs of view and site, in order."""
        return tuple((view, site) for view in self.settings.views for site in sites_of(self.run, view))

    @property
    def widths(self) -> dict[str, int]:
        """The width of every stream; for a target other than a side, of the probed streams only."""
        streams = self.run.streams
        names = streams if self.target.balanced else dict.fromkeys(site.stream for _, site in self.keys)
        return {name: streams[name].width for name in names}

    def check(self) -> None:
        """Raise an error for everything that can be wrong before anything is probed."""
        if self.stored is None:
            _ = self.keys, self.problems

    def results(self, *, progress: Progress | None, **workers: Any) -> ProbeResults:
        """Return the stored results, or new ones that are not stored yet.

        Args:
            progress: Called after every site; None for a bar in a notebook and nothing elsewhere.
            **workers: The options `jobs`, `device` and `ray` of `probe_columns`.
        """
        if self.stored is not None:
            return self.stored
        probes = self._probe_all(progress or notebook_progress("sites probed"), workers)
        curves = {}
        for category, problem in self.problems.items():
            for view in self.settings.views:
                of_view = {site: probe[category] for (name, site), probe in probes.items() if name == view}
                parts = tuple(str(self.run.streams[site.stream].part) for site in of_view)
                curves[category, view] = problem.curve(of_view, parts)
        directions = {
            (category, view, site): Direction(probe.weights, probe.intercepts, probe.spreads)
            for (view, site), of_site in probes.items()
            for category, probe in of_site.items()
            if self.target.balanced
        }
        run, samples = self.run, self.samples
        return ProbeResults(
            self.settings,
            curves,
            directions,
            stamp=run.stamp,
            label=run.label,
            left_out=samples.left_out,
            conditions=condition_counts(run.episodes.iloc[sorted(set(samples.rows.tolist()))]),
        )

    def _probe_all(self, progress: Progress | None, workers: Mapping[str, Any]) -> dict[Key, Probed]:
        """Return every view and site, in order, for every category; columns of an interrupted sweep are loaded."""
        unfinished = SweepCheckpoint.of(self.run.location, self.settings.key, self.run.stamp)
        probes = {key: stored for key in self.keys if (stored := unfinished.read(*key)) is not None}
        rows, inferences = self.samples.rows, self.samples.inferences
        columns = ((key, read_samples(self.run, *key, rows, inferences)) for key in self.keys if key not in probes)
        for key, of_site in probe_columns(columns, self.problems, **workers):
            unfinished.keep(*key, of_site)
            probes[key] = of_site
            if progress is not None:
                progress(len(probes), len(self.keys), f"{key[1]} {key[0]}")
        return {key: probes[key] for key in self.keys}  # workers finish in any order

    def keep(self, results: ProbeResults, *, requested: bool) -> ProbeResults:
        """Store `results` and return them as loaded from the store; for `requested` see `save_results`."""
        save_results(results, self.run.location, requested=requested)
        SweepCheckpoint.of(self.run.location, self.settings.key).discard()
        return load_results(self.run, self.settings.key)
