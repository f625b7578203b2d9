"""Probe results of one run at several captured inferences."""

from dataclasses import replace

from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results, read_probes, settings_of


def load_results_by_call(run: RunReader, like: ProbeResults) -> dict[int, ProbeResults]:
    """Return the stored probes of `run` that differ from `like` in their captured inference alone, by inference.

    Episodes that ended before an inference have no part in its probes. `like` itself is among them.
    """
    by_call = {like.settings.call: like}
    for key, bundle in read_probes(run.location).items():
        settings = settings_of(bundle)
        if settings.call not in by_call and replace(settings, call=like.settings.call) == like.settings:
            by_call[settings.call] = load_results(run, key)
    return dict(sorted(by_call.items()))
