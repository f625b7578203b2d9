"""The tables of a study file and their fields, and the mistakes in a file, each with the path of its value.

Values are checked here, references to names in `checks`.
"""

import json
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from unicodedata import category

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from probe_kit._system.complaints import shorten_text
from probe_kit.errors import UsageError
from probe_kit.extract.parts import ModelSettings
from probe_kit.extract.prompts import PictureShown, Query
from probe_kit.extract.sources.scene import SceneOptions
from probe_kit.hooks.contract.declared import ProtocolName
from probe_kit.runs.layout import AskTokens, LaterViews
from probe_kit.scene_names import SceneName
from probe_kit.train.choices import CORRECT, Side
from probe_kit.train.choices import Control as FeatureControl

Place = tuple[str | int, ...]
_BARE = re.compile(r"[\w.-]+")


@dataclass(frozen=True)
class Mistake:
    """A mistake in a file.

    Attributes:
        path: Path of the value, such as `("runs", 0, "models")`.
        text: The fault and the remedy.
    """

    path: Place
    text: str

    @property
    def field(self) -> str:
        """The path in the form of the file, such as `runs[0].models`."""
        parts = [f"[{part}]" if isinstance(part, int) else f".{_key(part)}" for part in self.path]
        return "".join(parts).removeprefix(".") or "the file"


def _key(name: str) -> str:
    """Return a name on one line, in quotes where it needs them."""
    return shorten_text(name if _BARE.fullmatch(name) else json.dumps(name))


class StudyFileError(UsageError):
    """A study file has mistakes; the message lists all of them in the order of the file, each with its path."""

    def __init__(self, file: str, content: dict[str, Any], mistakes: Sequence[Mistake]) -> None:
        self.mistakes = tuple(sorted(mistakes, key=lambda mistake: _order(content, mistake.path)))
        super().__init__("\n".join(f"{file}: {mistake.field}: {mistake.text}" for mistake in self.mistakes))


def part_in_file(path: Place, content: Any) -> Place:
    """Return the part of a path that leads to a value of the content of a file."""
    for at, part in enumerate(path):
        try:
            content = content[part]
        except (KeyError, IndexError, TypeError):
            return path[:at]
    return path


def _order(content: Any, path: Place) -> list[int]:
    """Return the position of a value among its neighbours, in every table and list around it."""
    positions = []
    for part in part_in_file(path, content):
        positions.append(part if isinstance(part, int) else list(content).index(part))
        content = content[part]
    return positions


def complaint_of_unknown(what: str, name: str, names: Collection[str]) -> str:
    """Return a sentence on a name that is unknown, with the nearest match."""
    near = get_close_matches(name, names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"unknown {what} {shorten_text(name)!r}; known: {', '.join(names) or 'there are none'}.{hint}"


# -- the tables of a file ----------------------------------------------------------------------------------------


SCHEMA_VERSION = 1
"""Version of study files, their key `schema`; raise it when the meaning of earlier files changes."""


def _each_once[Value](values: list[Value]) -> list[Value]:
    """Return the values.

    Raises:
        ValueError: Where one comes twice.
    """
    for twice in (value for at, value in enumerate(values) if value in values[:at]):
        raise ValueError(f"{twice!r} comes twice; name each once")
    return values


def _printable(text: str) -> str:
    """Return the text.

    Raises:
        ValueError: Where a terminal or file name could not show it.
    """
    if any(category(character) in ("Zl", "Zp") or category(character).startswith("C") for character in text):
        raise ValueError("a line break or control character is not allowed")
    return text


def _whole_number(value: Any) -> Any:
    """Return the value.

    Raises:
        ValueError: For `true` and `1.0`, which Python finds equal to 1.
    """
    if type(value) is not int:
        raise ValueError("should be 1")
    return value


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]{0,59}$")]
"""A name of a model, condition, ask, block or table: small letters, digits, dots, hyphens and underscores."""
Text = Annotated[str, Field(min_length=1, max_length=500), AfterValidator(_printable)]
"""A text that is printed as it is, or names a place: one line."""
Names = Annotated[list[str], Field(min_length=1), AfterValidator(_each_once)]
SeveralNames = Annotated[list[str], Field(min_length=2), AfterValidator(_each_once)]
TwoNames = Annotated[list[str], Field(min_length=2, max_length=2), AfterValidator(_each_once)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Even = Annotated[int, Field(ge=2, le=1_000_000, multiple_of=2)]
"""Number of items of a category: an odd number would keep one of two role-exchanged twins and drop the other."""
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
Size = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,3}x[1-9][0-9]{0,3}$")]
TableKind = Literal[
    "success",
    "sides",
    "ablation",
    "vlms",
    "vlm-vla",
    "probing",
    "as-paper",
    "groups",
    "chain",
    "score",
    "stages",
    "drift",
]
Control = Literal["untrained"] | FeatureControl
FigureKind = Literal["curves", "dose", "overview"]


class _Table(BaseModel):
    """A table of the file: unknown keys are mistakes, and nothing is converted silently."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        # Settings of a run raise UsageError for the first wrong value; a file's mistakes are all collected.
        BaseModel.__init__(self, **values)


class SuiteTable(_Table):
    """The suite of all runs.

    Attributes:
        path: Folder of the suite; the embedded suite by default.
        categories: Categories of all blocks that name none.
        items: Items per category of all blocks that name none.
        counts: Items per category of a suite that is not here yet, for the plan; later it must hold so many.
    """

    path: Text | None = None
    categories: Names | None = None
    items: Even | None = None
    counts: dict[str, Even] = {}


class ModelTable(_Table, ModelSettings):
    """One model: the part `model` of the settings of a run, and its place in the study.

    Attributes:
        label: Name of the model in tables.
        groups: Groups that it belongs to.
        vlm: The VLM of its backbone.
        finetuned_from: The model that it was trained from.
        untrained: Its network with random weights.
        protocol: The protocol, as in `probe-kit extract`.
        scene: The scene, as in `probe-kit extract`.
        execute: Actions executed per inference, as in `probe-kit extract`.
        batch: Batch size, as in `probe-kit extract`.
        unavailable: Reason why it is not played; it is named in plans and tables.
    """

    label: Text | None = None
    groups: Annotated[list[Name], AfterValidator(_each_once)] = []
    vlm: str | None = None
    finetuned_from: str | None = None
    untrained: str | None = None
    protocol: ProtocolName | None = None
    scene: SceneName | None = None
    execute: Count | None = None
    batch: Count = 1
    gpus: Annotated[int, Field(ge=0, le=1)] = 0
    unavailable: Text | None = None


class ConditionTable(_Table, SceneOptions):
    """The playing of a policy: the options of a scene, and further options of `probe-kit extract`.

    The scene of a condition takes the place of the model's.
    """

    background: Annotated[Path | None, Field(strict=False)] = None
    arm_urdf: Annotated[Path | None, Field(strict=False)] = None
    wordings: Names | None = None
    no_act: bool = False
    accept_units: bool = False
    accept_ignored_inputs: bool = False
    captured_calls: Count | Literal["all"] = 1
    later_views: LaterViews = "all"


class AskTable(_Table):
    """The asking of a VLM, as in `probe-kit ask`."""

    prompt: Text
    picture_size: Size = "224x224"
    picture: PictureShown = "frame"
    query: Query = "target"


class ExcludeTable(_Table):
    """Runs of a block that are not made: those that equal every name given."""

    model: str | None = None
    condition: str | None = None
    ask: str | None = None


class BlockTable(_Table):
    """A block of runs: models × conditions, or models × asks, × seeds.

    Attributes:
        categories: Categories of the runs; default the suite's.
        items: Items per category; default the suite's.
    """

    name: Name
    models: Names
    conditions: Names | None = None
    asks: Names | None = None
    categories: Names | None = None
    items: Even | None = None
    seeds: Annotated[list[Seed], Field(min_length=1), AfterValidator(_each_once)] = [0]
    tokens: AskTokens | None = None
    exclude: list[ExcludeTable] = []

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.conditions is None) == (self.asks is None):
            raise ValueError("give either conditions, for policies, or asks, for VLMs")
        return self


class ProbesTable(_Table):
    """Probes of the runs of some blocks, as in `probe-kit train`."""

    runs: Names
    views: Names = ["mean"]
    permutations: Annotated[int, Field(ge=0, le=100_000)] = 200
    controls: Annotated[list[Control], AfterValidator(_each_once)] = []
    target: Side = CORRECT
    seed: Seed = 0


class PairsTable(_Table):
    """Two conditions of the same models."""

    conditions: TwoNames
    models: Names


class ComparisonTable(_Table):
    """A named comparison, one family of tests: pairs of conditions, a chain of models, or groups of models."""

    pairs: PairsTable | None = None
    chain: SeveralNames | None = None
    groups: SeveralNames | None = None


class DriftTable(_Table):
    """Pairs of models, each `model` or `model/ask`, and the view of the tokens."""

    pairs: Annotated[
        list[Annotated[list[str], Field(min_length=2, max_length=2)]],
        Field(min_length=1),
        AfterValidator(_each_once),
    ]
    view: str = "mean"


class ElsewhereTable(_Table):
    """Numbers that were not measured here, in a column next to the score.

    Attributes:
        source: Source of the numbers.
        values: The numbers by model.
    """

    title: Text
    source: Text
    values: Annotated[dict[str, float], Field(min_length=1)]


class TableTable(_Table):
    """A table to print.

    Attributes:
        runs: Blocks that it is made of.
        comparison: Name of the comparison, where its kind shows one.
        drift: Name of the drift, where its kind shows one.
        elsewhere: Of a table of kind `score`, a column of numbers from elsewhere.
    """

    kind: TableKind
    runs: Names | None = None
    comparison: str | None = None
    drift: str | None = None
    categories: Names | None = None
    elsewhere: ElsewhereTable | None = None


class FigureTable(_Table):
    """A figure to draw.

    Attributes:
        runs: Blocks that it is made of.
        view: View of the tokens in curves, the first probed by default.
    """

    kind: FigureKind
    runs: Names
    categories: Names | None = None
    view: str | None = None


class Study(_Table):
    """A whole study file.

    Attributes:
        out: Folder or URL of runs; default `runs/NAME`.
        scene: Scene of every model that names none, and of VLMs too.
    """

    version: Annotated[Literal[1], BeforeValidator(_whole_number)] = Field(alias="schema")
    name: Name
    out: Text | None = None
    scene: SceneName | None = None
    suite: SuiteTable = SuiteTable()
    models: Annotated[dict[Name, ModelTable], Field(min_length=1)]
    conditions: dict[Name, ConditionTable] = {}
    asks: dict[Name, AskTable] = {}
    runs: Annotated[list[BlockTable], Field(min_length=1)]
    probes: dict[Name, ProbesTable] = {}
    comparisons: dict[Name, ComparisonTable] = {}
    drift: dict[Name, DriftTable] = {}
    tables: dict[Name, TableTable] = {}
    figures: dict[Name, FigureTable] = {}

    @property
    def folder(self) -> str:
        """The folder or URL of the runs."""
        return self.out or f"runs/{self.name}"

    @property
    def shown_probes(self) -> dict[str, ProbesTable]:
        """The probes that tables and figures show, by name: those of the side of the correct picture."""
        return {name: table for name, table in self.probes.items() if table.target == CORRECT}

    def block(self, name: str) -> BlockTable:
        """Return the block of this name."""
        return next(block for block in self.runs if block.name == name)
