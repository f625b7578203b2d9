"""A diagnosis of a run: every input's importance and passage, stored in the run and read from there."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.diagnose.choices import FRAMES
from probe_kit.diagnose.frames import frames_of
from probe_kit.diagnose.importance import Importance, exit_code
from probe_kit.diagnose.measure import Actions, InputExchange
from probe_kit.diagnose.passage import SitePassage, describe_passage, measure_passage
from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.extract.sources.donors import Frame
from probe_kit.extract.sources.inputs import with_input
from probe_kit.hashing import sha256_json
from probe_kit.intervene.pairs import Pair
from probe_kit.runs.layout import DIAGNOSES
from probe_kit.runs.records import as_json
from probe_kit.runs.results import HEAD, read_bundle, write_bundle

if TYPE_CHECKING:
    from probe_kit.hooks.contract.observation import Observation
    from probe_kit.intervene.sessions.session import LoadPolicy, ReplaySession, ReplaySource
    from probe_kit.runs.run import Run

FORMAT, FILE = "probe_kit diagnosis 1", "diagnosis.json"
Progress = Callable[[str], None]


@dataclass(frozen=True)
class InputDiagnosis:
    """One input: how much of the action it decides, and the sites on its way.

    note: why there are no sites, where there are none.
    """

    importance: Importance
    passage: tuple[SitePassage, ...] = ()
    note: str = ""

    @property
    def name(self) -> str:
        """The name of the input."""
        return self.importance.name

    @property
    def where(self) -> str:
        """The place of the loss, or the sites that carry it; the note where nothing was measured inside."""
        return describe_passage(self.passage, self.importance.matters) or self.note


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of every input of a run's model.

    key: of the stored diagnosis. label: of the run. n_frames, n_groups: that were used.
    """

    key: str
    label: str
    n_frames: int
    n_groups: int
    inputs: tuple[InputDiagnosis, ...]

    def exit_code(self, required: Sequence[str] = ()) -> int:
        """0 if every required input arrives and matters, else 1; see `importance.exit_code`."""
        names = [diagnosed.name for diagnosed in self.inputs]
        if unknown := [name for name in required if name not in names]:
            raise UsageError(f"no input is called {unknown[0]!r}; this source has {', '.join(names)}")
        return exit_code([diagnosed.importance for diagnosed in self.inputs], required)

    def to_json(self) -> dict[str, Any]:
        """Plain values; numbers that are not known are None."""
        return {
            "key": self.key,
            "label": self.label,
            "n_frames": self.n_frames,
            "n_groups": self.n_groups,
            "inputs": [
                {
                    **_plain(asdict(diagnosed.importance)),
                    "where": diagnosed.where,
                    "note": diagnosed.note,
                    "passage": [_plain(asdict(site)) for site in diagnosed.passage],
                }
                for diagnosed in self.inputs
            ],
        }

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> "Diagnosis":
        """The diagnosis that `to_json` gave."""
        inputs = []
        for record in stored["inputs"]:
            numbers = {name: record[name] for name in Importance.__dataclass_fields__}
            numbers["share_ci"] = tuple(_number(end) for end in numbers["share_ci"])
            numbers |= {name: _number(numbers[name]) for name in ("share", "control", "every", "p")}
            sites = tuple(
                SitePassage(site["name"], site["difference"], _number(site["carried"]))
                for site in record["passage"]
            )
            inputs.append(InputDiagnosis(Importance(**numbers), sites, record["note"]))
        return cls(stored["key"], stored["label"], stored["n_frames"], stored["n_groups"], tuple(inputs))


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _finite(value) for name, value in values.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_finite(end) for end in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def diagnose_run(
    run: "Run",
    *,
    frames: int = FRAMES,
    inputs: Sequence[str] = (),
    inside: bool = True,
    paraphrases: Mapping[str, str] | None = None,
    seed: int = 0,
    source: "ReplaySource | None" = None,
    load: "LoadPolicy | None" = None,
    progress: Progress = lambda _: None,
) -> Diagnosis:
    """Diagnose the inputs of a run's model on first frames of the run; a stored diagnosis is loaded.

    frames: how many. inputs: their names, such as `instruction`; empty for all. inside: whether sites are patched.
    paraphrases: by instruction, other words of the same meaning; they are the control of the instruction. seed: of
    the draw of donors. source, load: as for `run_intervention`. progress: called with the name of every step.
    Raises UsageError for a model that does not act, a run with too few groups, or an unknown input.
    """
    from probe_kit.intervene.sessions.opening import open_session
    from probe_kit.intervene.sessions.session import ReplaySource

    if run.weights_sha256 is None or not run.streams:
        raise UsageError(f"{run.location}: {run.model} is scripted and has no network; diagnose a policy")
    settings = {
        "format": FORMAT,
        "stamp": run.stamp,
        "frames": frames,
        "inputs": list(inputs),
        "inside": inside,
        "paraphrases": dict(paraphrases or {}),
        "seed": seed,
    }
    key = sha256_json(settings)[:12]
    if run.location.exists(f"{DIAGNOSES}/{key}/{HEAD}"):
        return load_diagnosis(run, key)
    with open_session(run, source or ReplaySource(), load) as session, session.ready():
        progress("frames")
        drawn = frames_of(session, frames, dict(paraphrases or {}))
        diagnosis = replace(_diagnose(session, drawn, inputs, inside, seed, progress), key=key, label=run.label)
        certificate = {"policy": session.policy.card.to_json()}
    files = {FILE: as_json(diagnosis.to_json()), "certificate.json": as_json(certificate)}
    now = datetime.now(UTC).isoformat(timespec="microseconds")
    write_bundle(run.location, DIAGNOSES, key, {"settings": settings}, files, {"created": now})
    return diagnosis


def load_diagnosis(run: "Run", key: str) -> Diagnosis:
    """A stored diagnosis. Raises RunDamagedError if it was changed."""
    bundle = read_bundle(run.location, DIAGNOSES, key)
    bundle.check_format(FORMAT)
    return Diagnosis.from_json(json.loads(bundle.read(FILE)))


def _diagnose(
    session: "ReplaySession",
    frames: Sequence[Frame],
    names: Sequence[str],
    inside: bool,
    seed: int,
    progress: Progress,
) -> Diagnosis:
    def infer(observations: Sequence["Observation"], seeds: Sequence[int]) -> Actions:
        return np.stack([session.act(*inference) for inference in zip(observations, seeds, strict=True)])

    progress("inputs")
    policy = session.policy
    reads_state, camera = policy.state_numbers is not None, policy.card.cameras[0] if policy.card.cameras else ""
    exchange = InputExchange(infer, frames, seed)
    inputs = []
    for importance in exchange.measure(names, reads_state=reads_state, camera=camera):
        progress(f"sites of {importance.name}")
        inputs.append(_look_inside(session, exchange, importance) if inside else InputDiagnosis(importance))
    groups = len({frame.group for frame in frames})
    return Diagnosis("", "", len(frames), groups, tuple(inputs))


def _look_inside(session: "ReplaySession", exchange: InputExchange, importance: Importance) -> InputDiagnosis:
    """The sites of an input that could be exchanged, with one donor per frame of equally many tokens."""
    if importance.matters is None:
        return InputDiagnosis(importance)
    frames = exchange.frames
    pairs = [
        Pair(
            frames[index].observation,
            with_input(frames[index].observation, importance.name, frames[donor].observation),
            frames[index].seed,
            group=frames[index].group,
        )
        for index, donor in dict(reversed(exchange.donors(importance.name))).items()
    ]
    fitting = [pair for pair in pairs if _as_many_tokens(session, pair)]
    if not fitting:
        return InputDiagnosis(importance, note="sites were not patched: no two inputs have equally many tokens")
    try:
        return InputDiagnosis(importance, measure_passage(session, fitting, exchange.scale))
    except UnsupportedInterventionError as error:
        return InputDiagnosis(importance, note=f"sites were not patched: {error}")


def _as_many_tokens(session: "ReplaySession", pair: Pair) -> bool:
    rows = [session.policy.token_roles([observation]) for observation in (pair.clean, pair.source)]  # type: ignore[list-item]
    counts = [{stream: len(roles[0]) for stream, roles in row.items()} for row in rows]
    return counts[0] == counts[1]
