"""Storage of probe results: `RUN/probes/<key>/`, either complete or absent.

Results exist when their settings do, which are written last, with the hashes of all else; see `runs.results`.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.bounded_files import UNREADABLE, open_arrays
from probe_kit._system.escaping import as_argument, csv_of_frame
from probe_kit.errors import NoProbesError, RunDamagedError, UnknownSiteError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.layout import PROBE_DIRECTIONS, PROBES
from probe_kit.runs.reader import RunReader
from probe_kit.runs.results import (
    Bundle,
    Pieces,
    axes_problem,
    bundle_keys,
    complete_key,
    is_complete,
    read_bundle,
    read_bundles,
    tidy_bundle,
    write_bundle,
)
from probe_kit.runs.store import Location, locate
from probe_kit.statistics.sufficiency import GROUPS_FOR_PROBES, probe_command
from probe_kit.train.choices import CORRECT, EVERYWHERE, SIDES
from probe_kit.train.crossval.site_probe import SiteProbe
from probe_kit.train.results.control_scores import Controls
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import (
    FORMAT,
    ProbeResults,
    ProbeSettings,
    StoredDirections,
    episodes_sha256,
    save_directions,
)


@dataclass(frozen=True)
class SweepCheckpoint:
    """The probes of single sites, kept until the sweep they belong to is complete."""

    pieces: Pieces

    @classmethod
    def of(cls, run: Location, key: str, stamp: str = "") -> "SweepCheckpoint":
        """Return the checkpoints of a sweep.

        Args:
            run: Location of the run.
            key: Key of the sweep's results.
            stamp: Hash of the commits that the sweep reads.
        """
        return cls(Pieces.of(run, PROBES, key, stamp, "the same `probe-kit train` then probes the site again"))

    @property
    def folder(self) -> str:
        """The folder of the checkpoints in the run."""
        return self.pieces.folder

    def read(self, view: str, site: Site) -> dict[str, SiteProbe] | None:
        """Return the probes of a site by category, or None if the sweep did not get that far.

        Raises:
            RunDamagedError: If they were changed, or are of another site or of other commits.
        """
        arrays = self.pieces.read(f"{view}+{site}", SiteProbe)
        if arrays is None:
            return None
        return {
            category: SiteProbe(**{part: arrays[f"{category}/{part}"] for part in SiteProbe.__annotations__})
            for category in dict.fromkeys(name.rsplit("/", 1)[0] for name in arrays)
        }

    def keep(self, view: str, site: Site, probes: Mapping[str, SiteProbe]) -> None:
        """Store the probes of a site by category."""
        arrays = {
            f"{category}/{part}": array
            for category, probe in probes.items()
            for part, array in vars(probe).items()
        }
        self.pieces.keep(f"{view}+{site}", arrays)

    def discard(self) -> None:
        """Remove all checkpoints, because the sweep is complete."""
        self.pieces.discard()


# -- complete results ----------------------------------------------------------------------------------------

SCORES, DECISIONS = "scores.csv", "decisions.npz"
DIRECTIONS, CONTROLS = PROBE_DIRECTIONS, "controls.json"
_TEXTS, _FACTS = ("parts", "classes"), ("task", "balanced", "smallest_p")
"""Members of a curve that are tuples of texts, and those that are single values."""
_STORED_AS = {"balanced": "is_side"}
"""The names of members in files, where they differ: another name would not be read in results that are there."""


def save_results(results: ProbeResults, run: Path | Location, *, requested: bool = True) -> None:
    """Write results to `probes/<key>/` of a run, all or nothing; probes that are there are kept.

    Args:
        results: Probes with their controls.
        run: Location of the run.
        requested: Whether a user wants these probes, which `load_results` then prefers to all older ones. False
            for those that are only needed for others, as the untrained control of another run.
    """
    location, scores = locate(run), {SCORES: csv_of_frame(results.scores).encode()}
    controls: dict[str, bytes] = {}
    if results.controls != Controls():
        controls = {CONTROLS: json.dumps(results.controls.to_json(), indent=2).encode()}
    if not is_stored(location, results.key):
        curves = _pack(results.curves)
        files = scores | {
            DECISIONS: _npz(lambda file: np.savez_compressed(file, allow_pickle=False, **curves)),
            DIRECTIONS: _npz(lambda file: save_directions(results.directions, file)),
        }
        head = {"settings": asdict(results.settings), "stamp": results.stamp, "left_out": dict(results.left_out)}
        head |= {"conditions": dict(results.conditions)} if results.conditions else {}
        times = {"created": results.created, "requested": _now() if requested else ""}
        write_bundle(location, PROBES, results.key, head, files | controls, times)
        return
    stored = read_probes(location)
    bundle = stored[results.key]
    times = dict(bundle.times)
    if requested and bundle.key != max(stored.values(), key=_rank).key:
        times["requested"] = _now()
    if controls or times != bundle.times:
        files = controls | scores if controls else {}
        write_bundle(location, PROBES, results.key, bundle.head, files, times)
    else:
        tidy_bundle(location, PROBES, results.key)


def _npz(write: Callable[[BytesIO], None]) -> bytes:
    file = BytesIO()
    write(file)
    return file.getvalue()


def is_stored(run: Location, key: str) -> bool:
    """Whether complete results called `key` exist. Raises RunDamagedError if their head was changed."""
    return is_complete(run, PROBES, key)


def load_results(run: RunReader, key: str | None = None, target: str | None = None) -> ProbeResults:
    """Return the stored results called `key`, or else the newest for `target` on the episodes the run has now.

    The newest are those that were asked for last, whether they were fitted then or loaded.

    Args:
        run: Run with the results.
        key: Key, as `probe-kit run show` lists it, or its beginning; no other results are read.
        target: A side, a built-in column, or one of a table; by default the correct side. The newest of a side are
            of the first captured inference; those of later ones are read by their key.

    Raises:
        NoProbesError: If there are none.
        UsageError: For a key that is not there or of another target.
        RunDamagedError: If results that are read were changed, lost their settings, have another format, or are of
            other activations.
    """
    location = run.location
    if key is not None:
        complete = complete_key(key, bundle_keys(location, PROBES), location, "probe results")
        bundle = _check_bundle(read_bundle(location, PROBES, complete))
        if target not in (None, probed := settings_of(bundle).target):
            raise UsageError(
                f"{location}: the probes {bundle.key} are of {probed!r}, not of {target!r}. Give their key with "
                f"--target {probed}, or leave it out"
            )
        return _read(run, bundle)
    target, stored = target or CORRECT, read_probes(location)
    newest = newest_bundle(run, stored, target)
    if newest is None:
        if not run.streams:
            raise NoProbesError(f"{location} has no activations to probe: of {run.model!r} no stream was stored.")
        hint = f" (of {len(stored)} stored, none: other episodes or another target)" if stored else ""
        raise NoProbesError(
            f"{location} has no probes for target {target!r} on its episodes{hint}. {how_to_probe(run, target)}"
        )
    return _read(run, newest)


def newest_bundle(run: RunReader, stored: Mapping[str, Bundle], target: str) -> Bundle | None:
    """Return the results of a target that `load_results` reads without a key; None without any."""
    of_target = [
        bundle
        for bundle, settings in _current(run, stored)
        if settings.target == target and not (settings.balanced and settings.call)
    ]
    return max(of_target, key=_rank, default=None)


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


def load_side_results(run: RunReader, key: str | None = None) -> ProbeResults:
    """Return stored results of a side, as `load_results` does.

    Raises:
        UsageError: For a key of another target.
    """
    results = load_results(run, key)
    if not results.settings.balanced:
        raise UsageError(
            f"{run.location}: the probes {results.key} are of {results.settings.target!r}, not of a side. Add "
            f"--target {results.settings.target}, or give the key of other probes"
        )
    return results


def stored_targets(run: RunReader) -> dict[str, int]:
    """Return the targets, without sides, that the run has probes of on its present episodes.

    They are in alphabetical order. The value of each is the number of different labels that it had: every one of
    them was a test.
    """
    current = _current(run, read_probes(run.location))
    versions = {(settings.target, settings.label) for _, settings in current if not settings.balanced}
    return dict(sorted(Counter(target for target, _ in versions).items()))


def _current(run: RunReader, stored: Mapping[str, Bundle]) -> list[tuple[Bundle, ProbeSettings]]:
    current = run.settings_sha256, episodes_sha256(run)
    pairs = [(bundle, settings_of(bundle)) for bundle in stored.values()]
    return [pair for pair in pairs if (pair[1].run_settings, pair[1].episodes) == current]


def is_current(settings: ProbeSettings, run: RunReader) -> bool:
    """Whether probes of these settings are of the episodes that the run has now."""
    return (settings.run_settings, settings.episodes) == (run.settings_sha256, episodes_sha256(run))


def how_to_probe(run: RunReader, target: str = CORRECT) -> str:
    """Return a sentence that says how a run gets probes of a target: the command, or what it has too few of."""
    from probe_kit.train.builtin_columns import BuiltinColumns

    location = as_argument(run.location)
    if target not in SIDES and target in BuiltinColumns(run).names:
        return f"Run `probe-kit train {location} --target {as_argument(target)}`."
    if target not in SIDES:
        return (
            f"It is no built-in column of this run: `probe-kit targets {location}` lists these. If it is a column "
            f"of your table, run `probe-kit train {location} --labels FILE --target {as_argument(target)}`."
        )
    if run.recorded or run.in_own_environment:
        return f"`probe-kit targets {location}` lists what can be probed."
    of_target = "" if target == CORRECT else f" --target {target}"
    if not {"category", "group_id"} <= set(run.episodes):
        return f"Run `probe-kit train {location}{of_target}`."
    counts = run.episodes.groupby("category", sort=False)["group_id"].nunique().to_dict()
    command = probe_command(run.location, counts)
    command += of_target if command else ""
    few = [f"{name} has {count}" for name, count in counts.items() if count < GROUPS_FOR_PROBES]
    if not few:
        return f"Run `{command}`."
    hint = f" `{command}` probes the others." if command else ""
    return (
        f"Probes need {GROUPS_FOR_PROBES} independent groups of items: {', '.join(few)}. Extract more items.{hint}"
    )


def _rank(bundle: Bundle) -> tuple[bool, str, str, str]:
    """Return a key to sort by: the newest results have the highest.

    Probes of a side on all categories together rank below others: statements by category have no number from them.
    """
    settings = settings_of(bundle)
    by_category = not settings.balanced or settings.categories != (EVERYWHERE,)
    return by_category, bundle.times.get("requested", ""), bundle.times.get("created", ""), bundle.key


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _pack(curves: Mapping[tuple[str, str], ProbeCurve]) -> dict[str, Any]:
    """Return arrays by `category/view/member`; views hold no slash."""
    return {
        f"{category}/{view}/{_STORED_AS.get(member.name, member.name)}": _as_array(value)
        for (category, view), curve in curves.items()
        for member in fields(curve)
        if (value := getattr(curve, member.name)) is not None
    }


def _as_array(value: Any) -> Any:
    return np.array([str(member) for member in value], str) if isinstance(value, tuple) else value


def _unpack(arrays: Mapping[str, Any]) -> dict[tuple[str, str], ProbeCurve]:
    curves: dict[tuple[str, str], dict[str, Any]] = {}
    members_of = {stored: member for member, stored in _STORED_AS.items()}
    for name, value in arrays.items():
        category, view, member = name.rsplit("/", 2)  # from the right: a category of one's own may hold a slash
        curves.setdefault((category, view), {})[members_of.get(member, member)] = value
    for (category, view), members in curves.items():
        if problem := axes_problem(ProbeCurve.AXES, members):
            raise ValueError(f"{category}/{view} {problem}")
        members["sites"] = tuple(Site.parse(str(name)) for name in members["sites"])
        members |= {name: tuple(map(str, members[name])) for name in _TEXTS}
        members |= {name: members[name].item() for name in _FACTS if name in members}
    return {key: ProbeCurve(**members) for key, members in curves.items()}


def read_probes(run: Location) -> dict[str, Bundle]:
    """Return every complete result by key.

    Raises:
        RunDamagedError: For a changed result or another format.
    """
    return {key: _check_bundle(bundle) for key, bundle in read_bundles(run, PROBES).items()}


def _check_bundle(bundle: Bundle) -> Bundle:
    if (settings_key := sha256_json(bundle.head["settings"])[:12]) != bundle.key:
        raise bundle.head_damaged(f"has the settings of {settings_key}")
    bundle.check_format(FORMAT)
    return bundle


def settings_of(bundle: Bundle) -> ProbeSettings:
    """Return the settings of stored results.

    Raises:
        RunDamagedError: If they cannot be those of this format.
    """
    stored = bundle.head["settings"]
    try:
        lists = {name: tuple(stored[name]) for name in ("categories", "views")}
        return ProbeSettings(**{**stored, **lists})
    except (KeyError, TypeError, ValueError) as error:
        raise bundle.head_damaged(f"has settings that cannot be those of format {FORMAT}: {error!r}") from error


def read_controls(bundle: Bundle) -> Controls:
    """Return the controls that results were compared with so far.

    Raises:
        RunDamagedError: If the file holds no controls.
    """
    if not bundle.has(CONTROLS):
        return Controls()
    try:
        return Controls.from_json(bundle.read_json(CONTROLS))
    except (KeyError, TypeError, ValueError) as error:
        raise bundle.damaged(CONTROLS, f"holds no controls ({error!r})") from error


def _read(run: RunReader, bundle: Bundle) -> ProbeResults:
    settings = settings_of(bundle)
    stamp, now = str(bundle.head.get("stamp", "")), run.stamp
    # Arrays in memory have no commits, and are compared by their settings.
    is_foreign = stamp != now and bool(stamp and now)
    if is_foreign and (settings.run_settings != run.settings_sha256 or is_current(settings, run)):
        raise RunDamagedError(
            f"{run.location}/{bundle.folder} holds probes of other activations than the run has: they were fitted "
            f"to commits {stamp[:12]}, here are {now[:12]}. Remove it and run the same `probe-kit train` again"
        )
    try:
        with open_arrays(bundle.read(DECISIONS)) as arrays:
            curves = _unpack(arrays)
    except (*UNREADABLE, TypeError, UnknownSiteError) as error:
        raise RunDamagedError(
            f"{run.location}/{bundle.folder}/{DECISIONS} cannot be read: {error}. Remove {bundle.folder} and run "
            "the same `probe-kit train` again"
        ) from error
    return ProbeResults(
        settings,
        curves,
        StoredDirections(bundle, DIRECTIONS),
        read_controls(bundle),
        bundle.times.get("created", ""),
        stamp,
        run.label,
        dict(bundle.head.get("left_out", {})),
        dict(bundle.head.get("conditions", {})),
    )
