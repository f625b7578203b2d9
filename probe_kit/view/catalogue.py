"""The payloads of a page by name, for `--export` and the server, and the following of runs that grow."""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

from probe_kit._system.table_cells import is_count
from probe_kit.hashing import sha256_json
from probe_kit.retention.columns.text import VIEWER_WORDS
from probe_kit.runs import Run
from probe_kit.runs.layout import COMMITS, FAILED
from probe_kit.runs.thumbnails import episode_frames
from probe_kit.view.episode_payloads import episode_payload, episodes_payload
from probe_kit.view.run_payloads import (
    failure_script,
    payload_script,
    results_payload,
    run_payload,
    site_map_payload,
    stored_keys,
    target_map_payload,
)
from probe_kit.view.viewed_run import view_runs

SCHEMA = 2
"""Version of the payloads; the page refuses another one."""
INDEX_PAYLOAD = "index"
"""The payload that a page reads first."""
_NUMBER = re.compile(r"[0-9]{5,8}")


class Catalogue:
    """The payloads of some runs. Names are looked up and never joined to a path.

    index                   the runs of the page
    RUN/run                 settings, streams, sites, certificate, rows of the table
    RUN/episodes            one column per property of the episodes
    RUN/map/CATEGORY        scores by site, and held-out log-odds of the category's episodes
    RUN/target/N            scores by site of the N-th target that was probed
    RUN/results             tables of stored probes, interventions and diagnoses
    RUN/e/NNNNN             one episode
    """

    def __init__(self, runs: Sequence[Run], probes_of: Run | None = None) -> None:
        self.runs = {viewed.key: viewed for viewed in view_runs(runs, probes_of)}
        self.growing = [key for key in self.runs if not self._is_finished(key)]
        """The keys of the runs that were unfinished."""

    def poll(self) -> list[dict[str, Any]]:
        """Return the progress of every run of `growing`; of commits and failures, only new ones are read."""
        return [self._poll(key) for key in self.growing]

    def _poll(self, key: str) -> dict[str, Any]:
        run = self.runs[key].run
        counts = {COMMITS: len(run.commits()), FAILED: len(run.failed)}
        if not self._is_finished(key) and any(len(run.location.keys(where)) != n for where, n in counts.items()):
            run = run.grown()
            self.runs[key] = replace(self.runs[key], run=run)
        return {"run": key, "committed": len(run.commits()), "planned": run.planned, "failed": len(run.failed)}

    def _is_finished(self, key: str) -> bool:
        run = self.runs[key].run
        return len(run.commits()) >= run.planned

    def names(self, categories: Collection[str] | None = None) -> Iterator[str]:
        """Yield all names in the order of export.

        Args:
            categories: Categories whose episodes and maps are named, all by default.
        """
        yield INDEX_PAYLOAD
        for key, viewed in self.runs.items():
            yield from (f"{key}/run", f"{key}/episodes", f"{key}/results")
            if len(viewed.run.episodes):
                yield from (f"{key}/target/{number}" for number in range(len(viewed.target_curves)))
            probed = [name for name in viewed.probed_categories if categories is None or name in categories]
            yield from (f"{key}/map/{category}" for category in probed)
            yield from (f"{key}/e/{number:05d}" for number in self.numbers(key, categories))

    def numbers(self, key: str, categories: Collection[str] | None = None) -> list[int]:
        """Return the numbers of the episodes of a run, of some categories or all."""
        viewed = self.runs[key]
        episodes = zip(viewed.position_of, viewed.run.episodes["category"], strict=True)
        return [number for number, category in episodes if categories is None or category in categories]

    def script(self, name: str) -> bytes:
        """Return the payload of this name as a script.

        Raises:
            KeyError: For any other name.
        """
        return payload_script(name, self._payload(name), self._places)

    def failure(self, name: str, error: Exception) -> bytes:
        """Return the script with the reason why a payload cannot be made, without paths of this machine."""
        return failure_script(name, str(error), self._places)

    @property
    def _places(self) -> tuple[str, ...]:
        return tuple(location for viewed in self.runs.values() for location in viewed.paths)

    def stamp(self, name: str) -> str:
        """Return a hash that changes with the commits and probes that a payload is made of.

        That of the index needs no table, so that a page begins at once.

        Args:
            name: Name of a payload.

        Raises:
            KeyError: For an unknown payload.
        """
        parts = name.split("/")
        if parts[0] not in self.runs:
            return sha256_json([SCHEMA, name, [[key, run.run.stamp] for key, run in self.runs.items()]])
        viewed = self.runs[parts[0]]
        refitted = sorted(other.key for other in viewed.refitted.values())
        probes = None if viewed.results is None else viewed.results.key
        stored = stored_keys(viewed) if parts[-1] in ("results", "run") or "target" in parts else []
        return sha256_json([SCHEMA, name, viewed.run.stamp, probes, refitted, stored])

    def picture(self, key: str, number: int) -> bytes | None:
        """Return the committed frames of an episode; None without any.

        Args:
            key: Key of the run.
            number: Number of the episode.

        Raises:
            KeyError: For an unknown run or episode.
            RunDamagedError: If the frames were changed.
        """
        viewed = self.runs[key]
        frames = episode_frames(viewed.run, viewed.position_of[number])
        return None if frames is None else frames.content

    def _payload(self, name: str) -> Any:
        if name == INDEX_PAYLOAD:
            return self._index()
        match name.split("/"):
            case [key, "run"]:
                return run_payload(self.runs[key], list(self.runs.values()))
            case [key, "episodes"]:
                return episodes_payload(self.runs[key])
            case [key, "results"]:
                return results_payload(self.runs[key])
            case [key, "target", number] if is_count(number):
                return target_map_payload(self.runs[key], int(number))
            case [key, "map", category]:
                return site_map_payload(self.runs[key], category)
            case [key, "e", number] if _NUMBER.fullmatch(number):
                return episode_payload(self.runs[key], int(number))
        raise KeyError(name)

    def _index(self) -> dict[str, Any]:
        runs = [
            {"key": key, "label": viewed.run.label, "episodes": len(viewed.run.episodes)}
            for key, viewed in self.runs.items()
        ]
        return {"schema": SCHEMA, "runs": runs, "words": list(VIEWER_WORDS.items())}
