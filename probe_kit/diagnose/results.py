"""The results of a diagnosis, input by input: stored form, table and sentences. Loads no model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from math import isfinite, nan
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, PlainSerializer

from probe_kit._system.counting import plural
from probe_kit._tables.numbers import p_text, whole_percent
from probe_kit._tables.table import Cell, Heading, Table
from probe_kit.errors import UsageError
from probe_kit.intervene.exchange import describe_seed, does_seed_decide
from probe_kit.intervene.further_instructions import hash_of_instructions

if TYPE_CHECKING:
    from pydantic import TypeAdapter


FRAMES = 24
"""With so many frames, words that decide were detected in nine of ten draws or more (`docs/notes/causal.md`)."""
LEAST_GROUPS = 6
"""Fewer groups cannot show at p < 0.05 that anything matters, by sign flips of whole groups: 2⁻⁵ is 0.03."""


def count_groups(frames: int) -> int:
    """Return the number of groups of the scene from which so many frames are drawn, two of each.

    The two items of a group ask for one side each, before the same pictures. A policy that goes to one side where
    it does not understand is moved by other words in one of both, whichever side that is. The mean of both varies
    half as much between groups as one frame does.
    """
    return max(LEAST_GROUPS, -(-frames // 2))


Verdict = Literal["decides", "moves", "no effect", "open", "does not arrive", "not varied", "not an input"]
MATTERS: tuple[Verdict, ...] = ("decides", "moves")
IDLE: tuple[Verdict, ...] = ("no effect", "does not arrive")
"""Verdicts that an input does not matter; `open` is none of them."""
CARRIES = 0.5
"""Share of the change of the action from which a site counts as carrying an input."""
LIKE_NONE = 1e-6
"""Relative difference of activations that rounding can cause: some units of the last place of float32."""
Number = Annotated[
    float,
    BeforeValidator(lambda stored: nan if stored is None else stored),
    PlainSerializer(lambda number: number if isfinite(number) else None),
]
"""A number that may be unknown: NaN here, null in JSON."""
Limits = tuple[Number, Number]
NO_LIMITS = (nan, nan)


@dataclass(frozen=True)
class SitePassage:
    """One site of the network; its numbers are means over pairs.

    Attributes:
        name: Name of the site in the form of `--sites`.
        difference: Norm of the difference of the activations, relative to the clean ones.
        carried: The change of the action under the patch of this site, projected on the change under the donor's
            input. It is 1 for all of the change, and NaN where the donor changes no action.
    """

    name: str
    difference: float
    carried: Number

    @property
    def stream(self) -> str:
        """The stream of the site."""
        return self.name.partition(".")[0]

    @property
    def differs(self) -> bool:
        """Whether the input reaches the site at all."""
        return self.difference > LIKE_NONE


Change = Literal["lost in fine-tuning", "weaker", "never there", "in both", "stronger", "gained", "open"]


@dataclass(frozen=True)
class BaseComparison:
    """One input in the base checkpoint, and the difference to it.

    Attributes:
        verdict: The verdict on the base, on the same pairs.
        share: The total-effect index in the base, on the same pairs.
        difference: Difference of the shares, tuned minus base.
        ci: The 95 % interval of the difference by groups.
        p: The two-sided p-value of the difference, by sign flips of whole groups.
    """

    change: Change
    verdict: Verdict
    share: Number
    difference: Number
    ci: Limits
    p: Number


@dataclass(frozen=True)
class InputDiagnosis:
    """One input: does it arrive, how much of the action does it decide, and which sites lie on its way?

    Attributes:
        reason: Reason of the verdict.
        share: The total-effect index, 1 where nothing else matters.
        share_ci: The 95 % interval of the index by groups (Student).
        control: The index of a change that should not matter.
        every: The index of all inputs together.
        p: Exact, one-sided, by permutation in whole groups: the input changes more than its control.
        unchanged: Inferences, of `n_inferences` with another value or a blank, in which no number of the action
            changed.
        passage: The sites in the order of the network.
        note: Reason why there are no sites.
        units: The numbers of a state that do not fit the statistics of the checkpoint, in words; empty for none.
        units_are_other: Whether other units or another robot are certain.
        base: The same input in the base checkpoint; None without one.
        seed: The index of another seed; NaN where it was not measured.
    """

    name: str
    verdict: Verdict
    reason: str
    share: Number = nan
    share_ci: Limits = NO_LIMITS
    control: Number = nan
    every: Number = nan
    p: Number = nan
    n_pairs: int = 0
    n_groups: int = 0
    n_inferences: int = 0
    unchanged: int = 0
    passage: tuple[SitePassage, ...] = ()
    note: str = ""
    units: str = ""
    units_are_other: bool = False
    base: BaseComparison | None = None
    seed: Number = nan

    @property
    def arrives(self) -> bool:
        """Whether any other value of the input changed any action."""
        return self.verdict != "does not arrive"

    @property
    def matters(self) -> bool | None:
        """True if the input decides or moves the action, False if not; None where that was not tested."""
        return None if self.verdict in ("not varied", "not an input") else self.verdict in MATTERS

    @property
    def where(self) -> str:
        """The place of the loss, or the sites that carry it; the note where nothing was measured inside.

        Numbers in other units are lost in front of the network, wherever inside the difference ends.
        """
        inside = describe_passage(self.passage, self.verdict) or self.note
        if not self.units:
            return inside
        lost = "the loss is" if self.units_are_other and self.verdict in IDLE else "a loss may be"
        before = f"{lost} in front of the network: {self.units}"
        return before if self.verdict in IDLE or not inside else f"{inside}; {before}"


def describe_passage(passage: Sequence[SitePassage], verdict: Verdict) -> str:
    """Return where the input is lost, or which sites carry it, as a sentence without its stop; else empty."""
    if not passage:
        return ""
    reached = [site for site in passage if site.differs]
    if not reached:
        return "no site inside the network differs: it ends before the first layer"
    if passage[-1] is not reached[-1]:
        following = passage[passage.index(reached[-1]) + 1]
        return f"the difference ends behind {reached[-1].name}; {following.name} is bit-equal"
    if verdict in MATTERS:
        carriers = [site for site in passage if site.carried >= CARRIES]
        spans = []  # the first and the last of every stream, such as `backbone.00–02`
        for stream in dict.fromkeys(site.stream for site in carriers):
            names = [site.name for site in carriers if site.stream == stream]
            until = f"–{names[-1].partition('.')[2]}" if len(names) > 1 else ""
            spans.append(f"{names[0]}{until}")
        return f"carried by {', '.join(spans)}" if spans else "no site alone carries half of it"
    strongest = max(passage, key=lambda site: site.difference)
    last = passage[-1]
    largest = f"it is strongest at {strongest.name} (relative difference {strongest.difference:.2g})"
    if strongest is last:
        reach, loss = ", the last site", "behind it"
    else:
        reach, loss = f" and reaches {last.name} ({last.difference:.2g})", "in the action part itself"
    return f"{largest}{reach}: the loss is {loss}" if verdict == "no effect" else f"{largest}{reach}"


@dataclass(frozen=True)
class SiteKnowledge:
    """One layer of a stream, at its best iteration.

    Attributes:
        name: Name of the site in the form of `--sites`.
        part: Part of the model, such as `backbone`.
        score: Held-out score.
        chance: Chance level of this site.
        signal: Whether it exceeds chance, family-wise, and every control.
    """

    name: str
    part: str
    score: Number
    chance: Number
    signal: bool


@dataclass(frozen=True)
class Knowledge:
    """The knowledge of one target.

    Attributes:
        key: Key of the probes, which the run stores.
        metric: Name of the metric of the scores.
        retention: Share of the backbone's score above chance that the action part has, NaN where it is undefined.
        note: Reason why it is undefined.
    """

    target: str
    key: str
    metric: str
    sites: tuple[SiteKnowledge, ...]
    retention: Number
    retention_ci: Limits
    note: str

    def best(self, backbone: bool) -> SiteKnowledge | None:
        """Return the site farthest above its chance, of the backbone or after it; one with signal if there is."""
        sites = [site for site in self.sites if (site.part == "backbone") == backbone]
        return max(sites, key=lambda site: (site.signal, site.score - site.chance), default=None)

    def describe(self, decided: bool) -> str:
        """Return a sentence about the sites that know the target.

        Args:
            decided: Whether any input decides the action.
        """
        best = [site for site in (self.best(True), self.best(False)) if site is not None]
        carriers = [site for site in best if site.signal]
        if not carriers:
            return f"{self.target} cannot be read anywhere: {self._words(best[0])} is no signal."
        where = " and ".join(self._words(site) for site in carriers)
        if best[-1].part == "backbone":
            return f"{self.target} can be read at {where}."
        if not best[-1].signal:
            return (
                f"{self.target} can be read at {where}; {self._words(best[-1])} is no signal: not shown in the "
                "action part."
            )
        used = "" if decided else ", and not shown to be used: no input decides the action"
        return f"{self.target} can be read up to the action, at {where}{self._describe_retention()}{used}."

    def _words(self, site: SiteKnowledge) -> str:
        return f"{site.name} ({self.metric} {site.score:z.2f}, chance {site.chance:z.2f})"

    def _describe_retention(self) -> str:
        low, high = self.retention_ci
        limits = f" [{low:z.2f}, {high:z.2f}]" if isfinite(low) and isfinite(high) else ""
        return f"; retention {self.retention:z.2f}{limits}" if isfinite(self.retention) and not self.note else ""


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of every input of a run's model.

    Attributes:
        key: Key of the stored diagnosis.
        label: Label of the run.
        n_frames: Number of frames that were used.
        n_groups: Number of groups of those frames.
        base: The checkpoint that it is compared with; empty for none.
        knowledge: The knowledge of a target; None for none.
        weights_sha256: Hash of the weights that were diagnosed.
        checkpoint: The checkpoint of these weights, as its card names it.
        random_weights: Whether they are of an untrained network.
        source: The suite, data set or environment of the frames.
        settings: Everything that decides the numbers, of which the key is the hash.
    """

    key: str
    label: str
    n_frames: int
    n_groups: int
    inputs: tuple[InputDiagnosis, ...]
    base: str = ""
    knowledge: Knowledge | None = None
    weights_sha256: str = ""
    checkpoint: str = ""
    random_weights: bool = False
    source: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)

    def exit_code(self, required: Sequence[str] = ()) -> int:
        """Return 0 if every required input arrives and matters, else 1; see `exit_code`."""
        names = [diagnosed.name for diagnosed in self.inputs]
        check_names(required, names)
        return exit_code(self.inputs, required)

    def to_json(self) -> dict[str, Any]:
        """Return the diagnosis as plain values; numbers that are not known are None."""
        plain: dict[str, Any] = _adapter().dump_python(self, mode="json")
        for values, diagnosed in zip(plain["inputs"], self.inputs, strict=True):
            values["where"] = diagnosed.where
        return plain

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> "Diagnosis":
        """Return the diagnosis from the values that `to_json` returned."""
        return _adapter().validate_python(stored)


@cache
def _adapter() -> "TypeAdapter[Diagnosis]":
    from pydantic import TypeAdapter

    return TypeAdapter(Diagnosis)


def check_names(names: Sequence[str], available: Sequence[str]) -> None:
    """Raise UsageError for a name that no input has."""
    if unknown := [name for name in names if name not in available]:
        raise UsageError(f"no input is called {unknown[0]!r}; there are {', '.join(available)}")


def exit_code(inputs: Sequence[InputDiagnosis], required: Sequence[str] = ()) -> int:
    """Return 0 if every required input arrives and matters, else 1.

    Args:
        inputs: Diagnosed inputs of one run.
        required: Names of inputs; empty for all that were tested.
    """
    tested = [diagnosed for diagnosed in inputs if diagnosed.matters is not None]
    judged = [diagnosed for diagnosed in inputs if diagnosed.name in required] if required else tested
    return 0 if judged and all(diagnosed.matters for diagnosed in judged) else 1


# -- table and sentences -------------------------------------------------------------------------------------

_HEADINGS = (
    Heading("input"),
    Heading("arrives", "whether any number of any action changed under another value"),
    Heading("effect", "decides, moves, no effect, open, does not arrive, not varied, not an input"),
    Heading("decides %", "share of the action's variance that is due to it: total-effect index, 95 % by groups"),
    Heading("control %", "the same of a change that should not matter, such as a full stop more or less"),
    Heading("all inputs %", "the same of all inputs together; the seed decides the rest"),
    Heading("p", "one-sided, of a larger change than by its control; labels of whole groups are permuted"),
)
_FINDINGS = {
    "decides": "decides the action",
    "moves": "moves the action, is not shown to decide it",
    "no effect": "arrives and changes the action by less than 1 % more than a change without meaning",
    "open": "arrives; whether it matters is open",
    "does not arrive": "does not arrive",
    "not varied": "was not tested",
    "not an input": "is no input of this model",
}
_CHANGES = {
    "lost in fine-tuning": "it was lost in fine-tuning",
    "weaker": "it is weaker than in the base",
    "never there": "the base does not use it either",
    "in both": "the base uses it too",
    "stronger": "it is stronger than in the base",
    "gained": "it was gained in fine-tuning",
    "open": "the difference to the base is open",
}
_OF_BASE = (
    Heading("base %", "the share of the base checkpoint, on the same pairs"),
    Heading("difference %", "of both shares, tuned minus base, 95 % by groups"),
    Heading("p of the difference", "two-sided, by sign flips of whole groups"),
    Heading("change"),
)


def diagnosis_table(diagnosis: "Diagnosis") -> Table:
    """Return a table with one line per input, one sentence per input below it, and one of the target."""
    headings = (*_HEADINGS, *_OF_BASE) if diagnosis.base else _HEADINGS
    rows = [_row(diagnosed, headings) for diagnosed in diagnosis.inputs]
    title = f"Inputs of {diagnosis.label}: {diagnosis.n_frames} frames of {diagnosis.n_groups} groups"
    if diagnosis.base:
        title += f"; base {diagnosis.base}"
    numbers = tuple(diagnosis.to_json()["inputs"])
    notes = [*sentences(diagnosis), *describe_origin(diagnosis)]
    return Table.of(title, headings, rows, notes=notes, numbers=numbers)


def describe_origin(diagnosis: "Diagnosis") -> list[str]:
    """Return sentences on the weights, the checkpoint, the source and the settings of a diagnosis."""
    if not diagnosis.weights_sha256:
        return []
    settings = diagnosis.settings
    random = " (random weights)" if diagnosis.random_weights else ""
    base = settings.get("base")
    parts = [
        f"inputs {', '.join(settings['inputs'])}" if settings.get("inputs") else "all inputs",
        "sites patched" if settings.get("inside") else "no site patched",
        *([f"{len(settings['pairs'])} pairs of a table"] if settings.get("pairs") else []),
        *([f"paraphrases of {len(settings['paraphrases'])} texts"] if settings.get("paraphrases") else []),
        *(_words_of(settings["instructions"]) if settings.get("instructions") else []),
        f"seed {settings.get('seed', 0)}",
    ]
    return [
        f"weights {diagnosis.weights_sha256[:12]} of checkpoint {diagnosis.checkpoint}{random}"
        + (f"; base {diagnosis.base} with weights {base[:12]}." if base else "."),
        f"source {diagnosis.source}; settings: {', '.join(parts)}; key {diagnosis.key}.",
    ]


def _words_of(instructions: Sequence[str]) -> list[str]:
    return [f"{plural(len(instructions), 'further instruction')} (sha256 {hash_of_instructions(instructions)})"]


def _row(diagnosed: "InputDiagnosis", headings: Sequence[Heading]) -> Sequence[Cell]:
    tested = diagnosed.matters is not None
    arrives = "yes" if diagnosed.arrives else "no"
    cells = [
        Cell(diagnosed.name),
        Cell(arrives if tested else None),
        Cell(diagnosed.verdict),
        Cell(diagnosed.share, whole_percent, diagnosed.share_ci),
        Cell(diagnosed.control, whole_percent),
        Cell(diagnosed.every, whole_percent),
        Cell(diagnosed.p, p_text),
    ]
    if (base := diagnosed.base) is not None:
        cells += [
            Cell(base.share, whole_percent),
            Cell(base.difference, whole_percent, base.ci),
            Cell(base.p, p_text),
            Cell(base.change),
        ]
    cells += [Cell(None)] * (len(headings) - len(cells))
    alarms = {"arrives", "effect"} if diagnosed.matters is False else set()
    if base is not None and base.change == "lost in fine-tuning":
        alarms.add("change")
    return [replace(cell, alarm=heading.text in alarms) for heading, cell in zip(headings, cells, strict=True)]


def sentences(diagnosis: "Diagnosis") -> list[str]:
    """Return a sentence per input, one if the seed decides more than the inputs, and one about the target."""
    lines = [sentence(diagnosed) for diagnosed in diagnosis.inputs]
    tested = [diagnosed for diagnosed in diagnosis.inputs if diagnosed.matters is not None]
    most = max(tested, key=lambda diagnosed: diagnosed.every, default=None)
    if most is not None and does_seed_decide(most.every, most.seed):
        lines.append(f"{describe_seed(most.every)}.")
    if not tested:
        lines.append("no input varies between these frames, so that nothing was tested.")
    if diagnosis.knowledge is not None:
        decided = any(diagnosed.verdict == "decides" for diagnosed in diagnosis.inputs)
        lines.append(diagnosis.knowledge.describe(decided))
    return lines


def sentence(diagnosed: "InputDiagnosis") -> str:
    """Return one sentence on the outcome of an input, and on where it is lost or carried."""
    reason = "" if diagnosed.verdict in MATTERS else f" ({diagnosed.reason})"
    where = f"; {diagnosed.where}" if diagnosed.where else ""
    base = f"; {_CHANGES[diagnosed.base.change]}" if diagnosed.base is not None else ""
    return f"{diagnosed.name} {_FINDINGS[diagnosed.verdict]}{reason}{where}{base}."
