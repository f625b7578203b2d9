"""Probes of every site of a run for one label: `train_label_probes`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import NoProbesError, RunIncompleteError, UnknownCategoryError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.folds import sums_by_group
from probe_kit.train.data.run_reader import RunReader, check_several_wordings, seed_text_of
from probe_kit.train.data.samples import Samples, is_token_view, sites_of
from probe_kit.train.execution import Columns, ExecutionSettings, Problems, probe_columns
from probe_kit.train.labels.controls.label_controls import add_label_controls, prepare_controls
from probe_kit.train.labels.controls.untrained import add_untrained_control, same_frames
from probe_kit.train.labels.label_probe import LabelProbe
from probe_kit.train.labels.label_problem import LabelProblem, label_problem
from probe_kit.train.labels.label_results import LabelCurve, LabelResults
from probe_kit.train.labels.label_settings import LabelSettings
from probe_kit.train.labels.label_store import load_label_results, save_label_results
from probe_kit.train.labels.labelled_samples import EVERYWHERE, LabelledSamples, labelled_samples
from probe_kit.train.labels.labels import Labels
from probe_kit.train.results.probe_results import episodes_sha256
from probe_kit.train.results.store import is_stored, stamp_of_run

Progress = Callable[[int, int, str], None]
_LABEL = "label"


def train_label_probes(
    run: RunReader,
    labels: Labels,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    window: int | None = None,
    permutations: int = 200,
    call: int = 0,
    controls: Sequence[str] | None = None,
    suite: Path | None = None,
    untrained: RunReader | None = None,
    align_to: Labels | None = None,
    seed: int = 0,
    jobs: int | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> LabelResults:
    """Probe every site for `labels`, and store the results in the run; see `train_probes`.

    categories: the episodes that are probed together, all by default. window: with labels of single inferences,
    how many of each episode take part; by default as many as 90 % of the episodes reach. controls: of `step`,
    `state`, `action`, `instruction`, `pixels` and `random-features`; by default all that the run allows but
    `action`. untrained: a run that showed the same frames to a network of random weights; every site is compared
    with the best of its stream there. align_to: with labels of single inferences, where windows begin: at the
    first inference at which this column is true.
    """
    check_label_run(run, categories, views, permutations)
    samples = labelled_samples(run, labels, categories, call, window, align_to)
    beside = None if untrained is None else same_frames(run, untrained, samples)
    labels, _ = labels.on(run)  # how many it does not show is counted among the samples
    settings = _settings(run, labels, samples, categories, views, permutations, call, seed, align_to)
    names, inputs, left_out = prepare_controls(run, samples, controls, suite)
    stored = load_label_results(run, settings.key) if is_stored(run.location, settings.key) else None
    keys = [(view, site) for view in views for site in sites_of(run, view)]
    compared = untrained is None or (stored is not None and stored.controls.untrained == untrained.settings_sha256)
    if stored is not None and compared and all(name in stored.controls.names for name in names):
        save_label_results(stored, run)  # they were asked for last
        return stored
    problem = label_problem(run, labels, samples, permutations, seed)
    results = stored or _fit(run, problem, settings, keys, ExecutionSettings(jobs, None, ray), progress)
    widths = {site.stream: run.streams[site.stream].width for _, site in keys}
    results = add_label_controls(results, problem, widths, names, inputs, left_out)
    if untrained is not None and beside is not None and not compared:
        results = add_untrained_control(results, problem, untrained, beside)
    save_label_results(results, run)
    return load_label_results(run, settings.key)


def check_label_run(
    run: RunReader, categories: Sequence[str] | None, views: Sequence[str], permutations: int
) -> None:
    """Raise for a run without episodes, activations or the categories, and for views that no label has."""
    if len(run.episodes) == 0:
        raise RunIncompleteError(f"{run.location} has no finished episode to probe. Finish it first")
    if not run.streams:
        raise NoProbesError(f"{run.location} has no activations to probe: of {run.model!r} no stream was stored.")
    known = [EVERYWHERE, *dict.fromkeys(run.episodes["category"])]
    if unknown := [name for name in categories or () if name not in known]:
        raise UnknownCategoryError(
            f"{run.location} has no category {unknown[0]!r}; it has: {', '.join(known[1:])}"
        )
    if tokens := [view for view in views if is_token_view(view)]:
        raise UsageError(f"view {tokens[0]!r} with labels; expected pooled views, such as mean or mean:ROLE")
    if not views or len(set(views)) < len(views):
        raise UsageError(f"views {', '.join(views) or 'none'}; expected one or more, each once, such as mean")
    if permutations < 0:
        raise UsageError(f"permutations={permutations}; expected 0 or more (0: no p)")
    check_several_wordings(run.episodes)


def _settings(
    run: RunReader, labels: Labels, samples: LabelledSamples, categories: Sequence[str] | None,
    views: Sequence[str], permutations: int, call: int, seed: int, align_to: Labels | None,
) -> LabelSettings:  # fmt: skip
    settings: dict[str, Any] = getattr(run, "settings", {})
    names = run.episodes["episode_id"].astype(str).to_numpy()[samples.rows].tolist()
    grouping = zip(names, samples.groups.tolist(), samples.strata.tolist(), strict=True)
    return LabelSettings(
        model=str(settings.get("label", run.model)),
        random_weights=run.random_weights,
        weights=run.weights_sha256,
        suite=run.suite,
        seed_text=seed_text_of(run),
        run_settings=run.settings_sha256,
        episodes=episodes_sha256(run),
        categories=() if categories is None or EVERYWHERE in categories else tuple(sorted(categories)),
        views=tuple(views),
        target=labels.target,
        task=labels.task,
        label=labels.sha256,
        group_by=labels.group_by or "group_id",
        exchange_within=labels.exchange_within or EVERYWHERE,
        grouping=sha256_json(sorted(set(grouping))),
        window=samples.window,
        call=call,
        permutations=permutations,
        seed=seed,
        align_to="" if align_to is None else f"{align_to.target}#{align_to.on(run)[0].sha256[:12]}",
    )


def _fit(
    run: RunReader, problem: LabelProblem, settings: LabelSettings, keys: Sequence[tuple[str, Site]],
    crew: ExecutionSettings, progress: Progress | None,
) -> LabelResults:  # fmt: skip
    samples = problem.samples
    columns = ((key, Samples.pooled(samples.features(run, *key))) for key in keys)
    # Executors need of a problem that it can be sent to a process, and probes samples.
    fitted = probe_columns(cast(Columns, columns), cast(Problems, {_LABEL: problem}), crew)
    progress = progress or notebook_progress("sites probed")
    probes: dict[tuple[str, Site], LabelProbe] = {}
    for key, found in fitted:
        probes[key] = cast(LabelProbe, found[_LABEL])
        if progress is not None:
            progress(len(probes), len(keys), f"{key[1]} {key[0]}")
    return LabelResults(
        settings=settings,
        classes=problem.classes,
        labels=samples.values,
        episodes=run.episodes["episode_id"].to_numpy(dtype=str)[samples.rows],
        inferences=samples.inferences.astype(np.int64),
        groups=samples.groups,
        fold_of=problem.fold_of,
        curves={
            view: _curve(run, [key for key in keys if key[0] == view], probes, samples.groups)
            for view in settings.views
        },
        smallest_p=problem.smallest_p,
        left_out=samples.left_out,
        stamp=stamp_of_run(run),
        aligned=None if samples.aligned is None else samples.aligned.astype(np.int64),
    )


def _curve(
    run: RunReader,
    keys: Sequence[tuple[str, Site]],
    probes: dict[tuple[str, Site], LabelProbe],
    groups: NDArray[np.str_],
) -> LabelCurve:
    own = [probes[key] for key in keys]
    return LabelCurve(
        sites=tuple(site for _, site in keys),
        parts=tuple(str(run.streams[site.stream].part) for _, site in keys),
        predictions=np.stack([probe.predictions for probe in own]),
        scores=np.stack([probe.scores for probe in own]),
        null=np.stack([probe.null for probe in own]),
        penalties=np.stack([probe.penalties for probe in own]),
        inner=np.stack([sums_by_group(probe.inner, groups) for probe in own]).astype(np.float32),
    )
