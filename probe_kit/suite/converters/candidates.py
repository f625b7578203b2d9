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
    """A picture of the source; two equal ids are one picture.

    Attributes:
        load: Function that returns the picture upright and in RGB.
        original: Path or key that the picture is read from.
        operation: Description of how `load` changes the picture.
        least_side: Least length of the shorter side in pixels; None for the limit of the options.
        real_face: Whether it shows a real person.
    """

    image_id: str
    load: Callable[[], Image.Image] = field(compare=False, repr=False)
    original: str
    operation: str = "none"
    least_side: int | None = None
    real_face: bool = False


@dataclass(frozen=True)
class Wording:
    """The wording of an item: its phrase, and the opposite phrase if the question has one.

    Attributes:
        rule_id: Name of the rewriting rule.
        proposed_by: Model, hash of the prompt and raw reply of a wording that a model proposed; None for a rule's.
    """

    phrase: str
    rule_id: str
    opposite: str | None = None
    article: str = "the"
    proposed_by: Mapping[str, str] | None = None  # model, prompt_sha256, raw reply


@dataclass(frozen=True)
class Candidate:
    """One question of the source with the picture that answers it, and with the wrong picture if it has one.

    Attributes:
        distractor: The picture that does not answer the question; None where pairing has to find one.
        answer: Short answer in words, where the pictures are the answer to a question in words.
        wording: Given where the source says what the picture shows; None where the rewriting rules have to find
            one.
        family: Name of a family; pictures are paired inside one family first.
        shows: Names of what the picture is known to show.
        forbids: Names of what must not be in the other picture.
        needs_person: Whether only a person can accept the candidate.
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
        """The hash of question and answer: it changes with the question, so that a stale review is noticed."""
        return sha256_text(f"{self.question}\n{self.answer}")


@dataclass
class SourceContent:
    """The content of a source: candidates, the number of records per category, and why others were left out.

    `license`, `attribution`, `url` and `revision` are those of the source.

    Attributes:
        pool: Number of records by category.
        reasons: Number of records that were left out, by reason.
        files: Annotation files that were read.
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
    """The settings that every source shares.

    Attributes:
        min_side: Least length of a picture's shorter side, in pixels.
        max_aspect: Largest ratio of the longer to the shorter side.
        min_spread: Least standard deviation of the grey levels.
        legible_at: Tile side in pixels at which edges must survive; None for no such check.
        paper_polarity: Whether to keep every comparison as the source asks it, so that pictures alone can give the
            answer.
        image_root: Folder of the pictures; None if they lie below the root.
        llm_base: Address of an OpenAI-compatible service that proposes wordings where no rule matches; None for no
            service. Its key is read from the environment variable PROBE_KIT_LLM_KEY.
        llm_model: Name of the model at this service; None without a service.
        llm_cache: Folder of the service's replies; None without a service.
        trust_llm: Whether wordings of the model are emitted without a person's review.
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
        """Return the folder that contains the pictures."""
        return Path(self.image_root) if self.image_root else root


@dataclass(frozen=True)
class CompBenchOptions(ConvertOptions):
    """The options of MLLM-CompBench.

    Attributes:
        fer: Whether to use FER-2013, whose faces are 48 px.
        fer_min_side: Least side of FER-2013's faces in pixels, in place of `min_side`.
    """

    fer: bool = True
    fer_min_side: int = 48


@dataclass(frozen=True)
class IconQaOptions(ConvertOptions):
    """The options of IconQA.

    Attributes:
        all_distractors: Whether to make an item per wrong choice, not one per problem.
        cross_items: Whether to pair the pictures of "how many" questions.
    """

    min_side: int = 48
    min_spread: float = 4.0
    all_distractors: bool = False
    cross_items: bool = True


@dataclass(frozen=True)
class MmbenchOptions(ConvertOptions):
    """The options of MMBench.

    Attributes:
        include_real_faces: Whether to make Celebrity, which shows real people.
    """

    include_real_faces: bool = False


@dataclass(frozen=True)
class OkVqaOptions(ConvertOptions):
    """The options of OK-VQA.

    Attributes:
        instances: Folder with COCO's `instances_<split>.json`, which can show that an animal is absent; None for
            none.
        min_agreement: Share of the ten answers that must agree.
        min_object_share: Least share of the picture's area that the object's box covers.
    """

    instances: str | None = None
    min_agreement: float = 0.6
    min_object_share: float = 0.08


@dataclass(frozen=True)
class VlThinkOptions(ConvertOptions):
    """The options of VL-Think.

    Attributes:
        recolor: Whether to add pink, white and grey by repainting.
        extra_boards: Further sets of boards to use, of `laundry`, `weather` and `arrows`.
    """

    recolor: bool = False
    extra_boards: tuple[str, ...] = ()


@dataclass(frozen=True)
class Act2AnswerOptions:
    """The options of a set in Act2Answer's own format, for what the format does not say.

    Attributes:
        tile_yaw: Degrees by which the set's scene turns the tiles; 90 as released, 0 as in VL-Think.
        contains_real_face: Whether the pictures show real people.
        license: SPDX name of the pictures' licence, if it is known.
    """

    tile_yaw: int = 90
    contains_real_face: bool = False
    license: str = "LicenseRef-Act2Answer-assets"


def options_from[Options: (ConvertOptions, Act2AnswerOptions)](
    kind: type[Options], values: dict[str, Any]
) -> Options:
    """Make the options of one source.

    Args:
        kind: Class of the source's options.
        values: Values of options by name.

    Raises:
        UsageError: For a name that the source does not have; the message has the nearest one.
    """
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
"""Largest size of an annotation file; the instances of COCO have 350 MB."""
_TRIM_STEP = 12  # levels that ink differs from white


def read_annotations(path: Path, source: str, remedy: str, kind: type = dict) -> Any:
    """Read the JSON value of `kind` in an annotation file.

    Raises:
        SuiteError: If the file cannot be read; the message names source, file and remedy.
    """
    return read_json(path, SuiteError, f"{remedy} It is needed to convert {source}.", MOST_BYTES, kind)


def first_existing(tried: Sequence[Path], source: str, record: str, remedy: str) -> Path:
    """Return the first path that is a file.

    Raises:
        SuiteError: If none is; the message names the record, all tried paths, and the remedy.
    """
    for path in tried:
        if path.is_file():
            return path
    listed = ", ".join(str(path) for path in dict.fromkeys(tried))
    raise SuiteError(f"{source}: image not found for {record}: tried {listed}; {remedy}")


def field_of(record: Any, name: str, kind: type, source: str, where: str) -> Any:
    """Return a field of a record.

    Raises:
        SuiteError: If the field is missing or of another type.
    """
    value = record.get(name) if isinstance(record, dict) else None
    if not isinstance(value, kind):
        raise SuiteError(
            f"{source}: {where}: field {name!r} is {value!r}; expected a {kind.__name__}. "
            "Check that this is the release the converter was made for (docs/suite.md)."
        )
    return value


def by_key[Key, Value](entries: Iterable[tuple[Key, Value, str]], source: str, key: str) -> dict[Key, Value]:
    """Return the values of (key, value, where) by their key.

    Args:
        entries: Key, value, and a description of the record for messages.
        source: Name of the source, for messages.
        key: Name of the key, for messages.

    Raises:
        SuiteError: For a key that occurs twice; the message names both records.
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
    """Return a function that loads a photograph as it is."""
    return partial(decode_picture, path)


def trimmed_art(path: Path) -> Image.Image:
    """Load line art on white without its own margins, as a square, with one margin for all pictures."""
    return trim(decode_picture(path))


def trim(image: Image.Image) -> Image.Image:
    """Return the picture cut to its ink and padded to a white square with a margin of 8 %."""
    ink = (255 - np.asarray(image.convert("RGB"), np.int64)).max(axis=2) > _TRIM_STEP
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    if not len(rows):
        return image
    cut = image.crop((int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1))
    side = round(max(cut.size) / (1 - 2 * MARGIN))
    square = Image.new("RGB", (side, side), WHITE)
    square.paste(cut, ((side - cut.width) // 2, (side - cut.height) // 2))
    return square
