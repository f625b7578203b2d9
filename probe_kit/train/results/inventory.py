"""The content of a run: `probe-kit run show`."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from probe_kit.runs.environment_success import EnvironmentSuccess, bounds_of
from probe_kit.runs.layout import PROBES
from probe_kit.runs.reader import RunReader
from probe_kit.runs.results import Bundle, unfinished_bundles
from probe_kit.runs.run import Run
from probe_kit.train.choices import CORRECT
from probe_kit.train.results.control_scores import UNTRAINED
from probe_kit.train.results.store import (
    is_current,
    load_results,
    newest_bundle,
    read_controls,
    read_probes,
    settings_of,
)


@dataclass(frozen=True)
class StoredProbes:
    """A set of probe results.

    Attributes:
        key: Key of the results.
        state: `used` if `retention` reads them by default, `other` if it does so for their key, `label` if they
            are of a label of one's own, `other episodes` if the run has others by now.
        created: Time when they were fitted (UTC, ISO 8601).
        controls: Baselines and, last, `untrained: NAME`.
        wording: Wording of the run that they are of; empty where the run is in its items' own words.
    """

    key: str
    state: str
    created: str
    target: str = ""
    views: tuple[str, ...] = ()
    categories: tuple[str, ...] = ()
    permutations: int = 0
    token_permutations: int = 0
    seed: int = 0
    call: int = 0
    controls: tuple[str, ...] = ()
    wording: str = ""


@dataclass(frozen=True)
class Inventory:
    """A run and the results stored with it.

    Attributes:
        episodes: Number of episodes that the run has.
        planned: Number of episodes that it was planned to have.
        failed: Number of episodes that were given up.
        outcomes: Number of episodes by outcome.
        streams: Streams by name, in words.
        probes: Probe results, oldest first.
        unfinished: Finished sites of interrupted sweeps, by key.
        wordings: Episodes by the wording they were asked in, empty for the items' own words alone.
        success: Success rates of a run in an environment; None for others and where no fact `success` is stored.
        bounds: How the episodes of a policy server were bounded, in words; empty for other runs.
    """

    run: str
    model: str
    random_weights: bool
    weights_sha256: str | None
    suite: str
    settings_sha256: str
    categories: tuple[str, ...]
    episodes: int
    planned: int
    failed: int
    outcomes: Mapping[str, int]
    streams: Mapping[str, str]
    probes: tuple[StoredProbes, ...]
    unfinished: Mapping[str, int]
    wordings: Mapping[str, int] = field(default_factory=dict)
    success: EnvironmentSuccess | None = None
    bounds: str = ""


def inventory(run: Any) -> Inventory:
    """List the content of `run`, a RunReader; runs that were not made by probe_kit give less."""
    episodes = run.episodes
    return Inventory(
        run=str(run.location),
        model=run.model,
        random_weights=run.random_weights,
        weights_sha256=run.weights_sha256,
        suite=run.suite,
        settings_sha256=run.settings_sha256,
        categories=tuple(dict.fromkeys(episodes["category"].astype(str))),
        episodes=len(episodes),
        planned=run.planned,
        failed=len(run.failed),
        outcomes={str(name): int(count) for name, count in episodes["outcome"].value_counts().items()},
        streams={name: _words(run, name) for name in run.streams},
        probes=tuple(stored_probes(run)),
        unfinished=unfinished_bundles(run.location, PROBES),
        wordings={name: len(run.in_wording(name).episodes) for name in run.wordings},
        success=EnvironmentSuccess.of(episodes),
        bounds=bounds_of(episodes),
    )


def stored_probes(run: Any) -> list[StoredProbes]:
    """Return every set of probe results of a run, oldest first."""
    # Probes are fitted on the run in one of its wordings, or on itself if it has none.
    readers, bundles = [run.in_wording(name) for name in run.wordings] or [run], read_probes(run.location)
    newest = (newest_bundle(reader, bundles, CORRECT) for reader in readers)
    used = {bundle.key for bundle in newest if bundle is not None}
    probes = [_probes(readers, bundle, used) for bundle in bundles.values()]
    return sorted(probes, key=lambda stored: (stored.created, stored.key))


def _probes(readers: Sequence[RunReader], bundle: Bundle, used: Collection[str]) -> StoredProbes:
    settings = settings_of(bundle)
    current = [run for run in readers if is_current(settings, run)]
    state = "other episodes" if not current else "other" if settings.balanced else "label"
    return StoredProbes(
        key=bundle.key,
        state="used" if bundle.key in used else state,
        created=bundle.times.get("created", ""),
        target=settings.target if settings.balanced else f"{settings.target} ({settings.task})",
        views=settings.views,
        categories=settings.categories,
        permutations=settings.permutations,
        token_permutations=settings.token_permutations,
        seed=settings.seed,
        call=settings.call,
        controls=_controls(bundle),
        wording=(current[0].wording or "") if current else "",
    )


def _controls(bundle: Bundle) -> tuple[str, ...]:
    controls = read_controls(bundle)
    names = dict.fromkeys(name for name in controls.names if name != UNTRAINED)
    networks = dict.fromkeys(f"untrained: {score.untrained}" for score in controls.untrained)
    if UNTRAINED in controls.names and not networks:
        networks = {UNTRAINED: None}
    return (*names, *networks)


def _words(run: RunReader, name: str) -> str:
    stream = run.streams[name]
    steps = f" × {stream.iterations} iterations" if stream.iterations else ""
    return f"{stream.layers} layers{steps}, width {stream.width}; views {', '.join(run.views(name))}"


def readers_of_results(run: Run) -> Iterator[Callable[[], object]]:
    """Yield a function per stored result, which reads all of it.

    Raises:
        RunDamagedError: For damaged results.
    """
    for key in read_probes(run.location):
        yield partial(_read, run, key)
    yield partial(stored_probes, run)


def _read(run: Run, key: str) -> object:
    results = load_results(run, key)
    return results.scores, results.controls
