"""Options of a conversion: shared settings, and some per source."""

from dataclasses import dataclass, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from probe_kit.errors import UsageError


@dataclass(frozen=True)
class ConvertOptions:
    """Settings every source shares.

    min_side: pixels of the shorter side. max_aspect: longer over shorter side. min_spread: standard deviation of
    the grey levels. legible_at: tile side in pixels at which edges must survive, None for no such check.
    paper_polarity: keep every comparison as the source asks it, which lets pictures alone give the answer.
    image_root: where pictures lie if not below the root.
    llm_base, llm_model, llm_cache: an OpenAI-compatible service that proposes wordings no rule finds; its key is
    read from the environment variable PROBE_KIT_LLM_KEY. trust_llm: emit them without a person.
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

    min_agreement: share of the ten answers that must agree. min_object_share: of the picture's area.
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

    tile_yaw: degrees by which its scene turns the tiles; 90 as released, 0 as VL-Think does.
    contains_real_face: whether its pictures show real people. license: an SPDX name, if you know it.
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
