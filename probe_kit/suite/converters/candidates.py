"""Candidates: questions with their pictures from any source, before pairing; sources, options and files."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probe_kit._system.bounded_files import read_json
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import sha256_text
from probe_kit.suite.pictures import WHITE, decode_picture


@dataclass(frozen=True)
class SourcePicture:
    """A picture of the source. `load` gives it upright and RGB; two equal ids are one picture.

    Attributes:
        original: Path or key it is read from.
        operation: What `load` did to it.
        least_side: What the shorter side must have in pixels, None for the usual limit.
    """

    image_id: str
    load: Callable[[], Image.Image] = field(compare=False, repr=False)
    original: str
    operation: str = "none"
    least_side: int | None = None
    real_face: bool = False


@dataclass(frozen=True)
class Wording:
    """The wording of an item: its phrase, and the opposite phrase if the question has one."""

    phrase: str
    rule_id: str
    opposite: str | None = None
    article: str = "the"
    proposed_by: Mapping[str, str] | None = None  # model, prompt_sha256, raw reply


@dataclass(frozen=True)
class Candidate:
    """One question of the source with the picture that answers it, and with the one that does not if it has one.

    Attributes:
        answer: Short answer in words, where the pictures are the answer to a question in words.
        wording: Given where the source says what the picture shows; else the rewriting rules have to find one.
        family: Pictures are paired inside one family first.
        shows: Names it is known to show.
        forbids: Names that must not be in the other picture.
        needs_person: Only a person can accept it.
    """

    source_id: str
    category: str
    question: str
    target: SourcePicture
    distractor: SourcePicture | None = None
    answer: str = ""
    wording: Wording | None = None
    concept: str = ""
    construction: str = "native_pair"
    family: str = ""
    shows: frozenset[str] = frozenset()
    forbids: frozenset[str] = frozenset()
    needs_person: bool = False
    side_word: bool = False

    @property
    def question_sha256(self) -> str:
        """Changes with the question, so that a stale review is noticed."""
        return sha256_text(f"{self.question}\n{self.answer}")


@dataclass
class Reading:
    """The content of a source: candidates, the number of records per category, and why others were left out.

    Attributes:
        files: Annotation files read. license, attribution, url and revision are those of the source.
    """

    license: str
    attribution: str
    url: str
    redistributable: bool = False
    revision: str = "unknown"
    split: str = "unknown"
    pool: Counter[str] = field(default_factory=Counter)
    candidates: list[Candidate] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)
    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


# -- options -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConvertOptions:
    """Settings every source shares.

    Attributes:
        min_side: Pixels of the shorter side.
        max_aspect: Longer over shorter side.
        min_spread: Standard deviation of the grey levels.
        legible_at: Tile side in pixels at which edges must survive, None for no such check.
        paper_polarity: Keep every comparison as the source asks it, which lets pictures alone give the answer.
        image_root: Where pictures lie if not below the root.
        llm_base: An OpenAI-compatible service that proposes wordings no rule finds; its key is read from the
            environment variable PROBE_KIT_LLM_KEY.
        llm_model: As `llm_base`.
        llm_cache: As `llm_base`.
        trust_llm: Emit them without a person.
    """

    min_side: int = 100
    max_aspect: float = 2.5
    min_spread: float = 8.0
    legible_at: int | None = None
    max_words: int = 12
    max_characters: int = 80
    allow_unicode: bool = False
    paper_polarity: bool = False
    side_words: bool = True
    image_root: str | None = None
    llm_base: str | None = None
    llm_model: str | None = None
    llm_cache: str | None = None
    trust_llm: bool = False

    def pictures_below(self, root: Path) -> Path:
        """Return the folder below which pictures are looked for."""
        return Path(self.image_root) if self.image_root else root


@dataclass(frozen=True)
class CompBenchOptions(ConvertOptions):
    """fer: whether to use FER-2013, whose faces are 48 px; fer_min_side is their own limit."""

    fer: bool = True
    fer_min_side: int = 48


@dataclass(frozen=True)
class IconQaOptions(ConvertOptions):
    """all_distractors: an item per wrong choice, not one per problem. cross_items: pair "how many" stems."""

    min_side: int = 48
    min_spread: float = 4.0
    all_distractors: bool = False
    cross_items: bool = True


@dataclass(frozen=True)
class MmbenchOptions(ConvertOptions):
    """include_real_faces: Celebrity shows real people, and is made only on request."""

    include_real_faces: bool = False


@dataclass(frozen=True)
class OkVqaOptions(ConvertOptions):
    """instances: folder with COCO's `instances_<split>.json`, which can show that an animal is absent.

    Attributes:
        min_agreement: Share of the ten answers that must agree.
        min_object_share: Of the picture's area.
    """

    instances: str | None = None
    min_agreement: float = 0.6
    min_object_share: float = 0.08


@dataclass(frozen=True)
class VlThinkOptions(ConvertOptions):
    """recolor: add pink, white and gray by repainting. extra_boards: of laundry, weather and arrows."""

    recolor: bool = False
    extra_boards: tuple[str, ...] = ()


@dataclass(frozen=True)
class Act2AnswerOptions:
    """The options of a set in Act2Answer's own format, for what the format does not say.

    Attributes:
        tile_yaw: Degrees by which its scene turns the tiles; 90 as released, 0 as VL-Think does.
        contains_real_face: Whether its pictures show real people.
        license: An SPDX name, if you know it.
    """

    tile_yaw: int = 90
    contains_real_face: bool = False
    license: str = "LicenseRef-Act2Answer-assets"


def options_from[Options: (ConvertOptions, Act2AnswerOptions)](
    kind: type[Options], values: dict[str, Any]
) -> Options:
    """The options of one source. Raises UsageError for a name it does not have, with the nearest one."""
    names = [field.name for field in fields(kind)]
    for name in values:
        if name not in names:
            near = get_close_matches(name, names, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise UsageError(f"unknown option {name!r}; this source has: {', '.join(names)}.{hint}")
    if isinstance(values.get("extra_boards"), list):
        values = values | {"extra_boards": tuple(values["extra_boards"])}
    return kind(**values)


# -- files and pictures ------------------------------------------------------------------------------------------


MARGIN = 0.08  # of the longer side, around trimmed art
MOST_BYTES = 1 << 30
"""Of annotations; the instances of COCO have 350 MB."""
_TRIM_STEP = 12  # levels that ink differs from white


def read_annotations(path: Path, source: str, remedy: str, kind: type = dict) -> Any:
    """The JSON value of `kind` in a file. Raises SuiteError naming source, file and remedy."""
    return read_json(path, SuiteError, f"{remedy} It is needed to convert {source}.", MOST_BYTES, kind)


def first_existing(tried: Sequence[Path], source: str, record: str, remedy: str) -> Path:
    """The first path that is a file. Raises SuiteError naming the record, what was tried, and the remedy."""
    for path in tried:
        if path.is_file():
            return path
    listed = ", ".join(str(path) for path in dict.fromkeys(tried))
    raise SuiteError(f"{source}: image not found for {record}: tried {listed}; {remedy}")


def field_of(record: Any, name: str, kind: type, source: str, where: str) -> Any:
    """A field of a record. Raises SuiteError if it is missing or of another type."""
    value = record.get(name) if isinstance(record, dict) else None
    if not isinstance(value, kind):
        raise SuiteError(
            f"{source}: {where}: field {name!r} is {value!r}; expected a {kind.__name__}. "
            "Check that this is the release the converter was made for (docs/suite.md)."
        )
    return value


def by_key[Key, Value](entries: Iterable[tuple[Key, Value, str]], source: str, key: str) -> dict[Key, Value]:
    """The values of (key, value, where) by their key. key: its name, for messages.

    Raises:
        SuiteError: Naming both records of a key that occurs twice.
    """
    values: dict[Key, Value] = {}
    places: dict[Key, str] = {}
    for name, value, where in entries:
        if name in values:
            raise SuiteError(
                f"{source}: {where}: {key} {name!r} is that of {places[name]} too; expected one record per {key}. "
                "Unpack the release again."
            )
        values[name], places[name] = value, where
    return values


def photo(path: Path) -> partial[Image.Image]:
    """Loads a photograph as it is."""
    return partial(decode_picture, path)


def trimmed_art(path: Path) -> Image.Image:
    """Line art on white without its own margins, square, with one margin for all."""
    return trimmed(decode_picture(path))


def trimmed(image: Image.Image) -> Image.Image:
    """The picture cut to its ink and padded to a white square with a margin of 8 %."""
    ink = (255 - np.asarray(image.convert("RGB"), np.int64)).max(axis=2) > _TRIM_STEP
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    if not len(rows):
        return image
    cut = image.crop((int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1))
    side = round(max(cut.size) / (1 - 2 * MARGIN))
    square = Image.new("RGB", (side, side), WHITE)
    square.paste(cut, ((side - cut.width) // 2, (side - cut.height) // 2))
    return square
