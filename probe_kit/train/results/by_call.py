"""Probe results of one run at several captured inferences."""

from dataclasses import replace

from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import is_current, is_ours, load_results, read_probes, settings_of


def load_results_by_call(run: RunReader, like: ProbeResults) -> dict[int, ProbeResults]:
    """By captured inference, in order: the stored probes of `run` that differ from `like` in nothing else.

    Episodes that ended before an inference have no part in its probes. `like` itself is among them.
    """
    found = {like.settings.call: like}
    for key, bundle in read_probes(run.location).items():
        if not is_ours(bundle):
            continue
        settings = settings_of(bundle)
        alike = replace(settings, call=like.settings.call, episodes=like.settings.episodes)
        if alike == like.settings and settings.call != like.settings.call and is_current(settings, run):
            found[settings.call] = load_results(run, key)
    return dict(sorted(found.items()))
