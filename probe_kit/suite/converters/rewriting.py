"""Words of converted questions: an ordered table of rules that name the correct picture, and filters.

Optionally, a language model proposes a wording where no rule matches. A person must accept it.
"""

import json
import os
import re
import unicodedata
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probe_kit._system.bounded_files import MOST_BYTES, parse_json, read_regular_text
from probe_kit._system.drafts import write_whole
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.suite.converters.candidates import Candidate, ConvertOptions, Wording
from probe_kit.suite.items import instruction_for, side_words

# Opposites that were looked at one by one. Any other comparative is negated as "less" and its base.
_PAIRS = (
    "longer/shorter taller/shorter higher/lower bigger/smaller larger/smaller wider/narrower "
    "thicker/thinner darker/lighter brighter/darker older/younger heavier/lighter newer/older "
    "fuller/emptier deeper/shallower wetter/drier cleaner/dirtier smoother/rougher harder/softer "
    "hotter/colder fewer/more straighter/curvier sharper/blunter denser/sparser rounder/flatter "
    "more/less dryer/wetter warmer/cooler stronger/weaker faster/slower closer/farther"
)
ANTONYMS = dict(pair.split("/") for pair in _PAIRS.split())
ANTONYMS |= {value: key for key, value in ANTONYMS.items() if value not in ANTONYMS}
# Stems that lost an e: one vowel and one consonant, which else would be doubled, or a cluster that needs it.
_LOST_E = re.compile(r"((?<![aeiou])[aeiou][bcdfgklmnprstvz]|rg|rs|ns|rc|nc|[bpdtg]l|oos|v)$")
_BASES = {"better": "good", "worse": "bad", "farther": "far", "further": "far", "freer": "free"}
_ENDING_IN_ER = (
    "other water paper flower tiger river number corner finger letter together computer summer winter "
    "weather center feather leather power tower shower over under after ever never her silver copper "
    "butter runner player"
)
_NOT_COMPARATIVE = frozenset(_ENDING_IN_ER.split())
_PREFIX = re.compile(
    r"^(based on (these|the|the two|both) (images|pictures|photos)|looking at the (images|pictures)|"
    r"(in|from) (these|the|the two) (images|pictures)|(of|between) the two (images|pictures)),?\s+",
    re.IGNORECASE,
)
_TAIL = re.compile(r"\s+in (the|this|these|which|both) (image|picture|photo)s?$", re.IGNORECASE)
_IDENTITY = re.compile(
    r"who\b|what('s| is) the name|(what|which) (actor|actress|singer|player|person|celebrity)", re.IGNORECASE
)
_KIND = re.compile(
    r"(what|which) (kind|type|species|breed|sort|variety) of|(what|which) (animal|bird|dog|cat|tree|flower|plant)",
    re.IGNORECASE,
)
_ARTICLE = re.compile(r"^(the|a|an|one|some)\s+", re.IGNORECASE)
_GENERIC = ("image", "picture", "photo", "one", "option")
_ER = r"(?:[a-z]+er|worse|more|less|fewer)"


@dataclass(frozen=True)
class _Rule:
    """A rule that rewrites a question.

    Attributes:
        build: Function that makes the phrase and its opposite from the match. It returns None if the match means
            something else.
    """

    rule_id: str
    pattern: re.Pattern[str]
    build: Callable[[re.Match[str]], tuple[str, str | None] | None]


def rewrite(question: str, answer: str = "", options_are_names: bool = False) -> Wording | None:
    """Return the wording of the first rule that matches; None (rule R0) if a person has to write it.

    Args:
        question: Text of the source's question.
        answer: The right option's text, for questions whose options are words; empty for others.
        options_are_names: Whether the options are names of people.
    """
    text = clean(question)
    if options_are_names and _IDENTITY.match(text):
        return Wording(answer.strip(), "R10", article="none")
    if answer and _KIND.match(text) and len(answer.split()) <= 2:
        return Wording(f"picture of {_bare(answer)}", "R11")
    for rule in _TABLE:
        match = rule.pattern.match(text)
        built = rule.build(match) if match else None
        if built:
            phrase, opposite = built
            return Wording(phrase, rule.rule_id, opposite)
    return None


def clean(question: str) -> str:
    """Return the question without prefixes, question mark and double spaces."""
    text = re.sub(r"\s+", " ", question).strip().rstrip("?.! ").strip()
    text = _TAIL.sub("", _PREFIX.sub("", text))
    return text[:1].lower() + text[1:]


def opposite_of(comparative: str, noun_follows: str = "") -> str:
    """Return the opposite: "shorter" for "longer", "less dry" for "drier", "fewer" or "less" for "more"."""
    word = comparative.lower()
    if word == "more" and noun_follows:
        return "fewer" if noun_follows.endswith("s") and not noun_follows.endswith("ss") else "less"
    if word == "less":
        return "more"
    return ANTONYMS.get(word) or f"less {base_of(word)}"


def base_of(comparative: str) -> str:
    """Return the base form: "happy" for "happier", "big" for "bigger", "large" for "larger"."""
    if comparative in _BASES:
        return _BASES[comparative]
    stem = comparative.removesuffix("er")
    if stem.endswith("i"):
        return f"{stem[:-1]}y"
    if len(stem) > 3 and stem[-1] == stem[-2] and stem[-1] not in "lsz":
        return stem[:-1]
    return f"{stem}e" if _LOST_E.search(stem) else stem


def _bare(text: str) -> str:
    return _ARTICLE.sub("", _TAIL.sub("", text.strip()))


def _noun_of(text: str) -> str:
    """Return the noun of a question; "picture" for a mere "image"."""
    noun = _bare(text)
    return "picture" if noun.lower() in _GENERIC or noun.startswith("of ") else noun


def _is_comparative(word: str) -> bool:
    return word in ("worse", "more", "less", "fewer") or (word.endswith("er") and word not in _NOT_COMPARATIVE)


def _grade(match: re.Match[str]) -> tuple[str, str] | None:
    """Build "more ADJ X" and "less ADJ X" (R1, R3, R6)."""
    noun, degree, adjective = _noun_of(match["x"]), match["degree"], _bare(match["adj"])
    return f"{degree} {adjective} {noun}", f"{opposite_of(degree)} {adjective} {noun}"


def _comparative(match: re.Match[str]) -> tuple[str, str] | None:
    """Build "ADJ-er X" and its opposite (R2, R3, R6)."""
    word = match["er"].lower()
    if not _is_comparative(word) or word in ("more", "less", "fewer"):
        return None
    noun = _noun_of(match["x"])
    return f"{word} {noun}", f"{opposite_of(word)} {noun}"


def _doing(match: re.Match[str]) -> tuple[str, str]:
    verb = match["verb"].removesuffix("s")
    doing = f"{verb[:-1] if verb.endswith('e') else verb}ing"
    noun = _noun_of(match["x"])
    return f"more {doing} {noun}", f"less {doing} {noun}"


def _having(match: re.Match[str]) -> tuple[str, str] | None:
    """Build "X with more Y" and its opposite (R5, R7)."""
    word = match["er"].lower()
    if not _is_comparative(word):
        return None
    noun, owned = _noun_of(match["x"]), _bare(match["y"])
    follows = owned if word == "more" and " " not in owned else owned.split()[-1] if word == "more" else ""
    return f"{noun} with {word} {owned}", f"{noun} with {opposite_of(word, follows)} {owned}"


def _with(match: re.Match[str]) -> tuple[str, str]:
    owned = _TAIL.sub("", match["y"].strip())
    return f"picture with {owned}", f"picture without {owned}"


def _noun(match: re.Match[str]) -> tuple[str, None]:
    return _TAIL.sub("", match["noun"].strip()), None


def _clock(match: re.Match[str]) -> tuple[str, None]:
    return f"clock showing {match['time'].strip()}", None


def _rule(rule_id: str, pattern: str, build: Callable[[re.Match[str]], tuple[str, str | None] | None]) -> _Rule:
    return _Rule(rule_id, re.compile(f"{pattern}$", re.IGNORECASE), build)


_LOOKS = r"(?:looks|appears|seems|look|appear|seem)"
_PICTURE = r"(?:image|picture|photo)"
_IN_WHICH = rf"in which {_PICTURE} (?:is|are|does|do) the (?P<x>.+?) (?:{_LOOKS} )?"
_GRADE = r"(?P<degree>more|less) (?P<adj>[\w -]+)"
_OWNS_MORE = rf"(?:a |an |the )?(?P<er>{_ER}) (?P<y>.+)"
_TABLE: tuple[_Rule, ...] = (
    _rule("R9", r"(?:which|what) clock (?:shows|says|reads) (?:the time )?(?P<time>.+)", _clock),
    _rule("R6", rf"{_IN_WHICH}{_GRADE}", _grade),
    _rule("R6", rf"{_IN_WHICH}(?P<er>{_ER})", _comparative),
    _rule("R4", r"which (?P<x>.+?) (?P<verb>smiles|laughs|frowns|shines|glows) more", _doing),
    _rule("R1", rf"which (?P<x>.+?) (?:is|are) {_GRADE}", _grade),
    _rule("R3", rf"which (?P<x>.+?) {_LOOKS} {_GRADE}", _grade),
    _rule("R3", rf"which (?P<x>.+?) {_LOOKS} (?P<er>{_ER})", _comparative),
    _rule("R2", rf"which (?P<x>.+?) (?:is|are) (?P<er>{_ER})", _comparative),
    _rule("R7", rf"which (?P<x>{_PICTURE}) (?:has|have|contains|shows) {_OWNS_MORE}", _having),
    _rule("R5", rf"which (?P<x>.+?) (?:has|have) {_OWNS_MORE}", _having),
    _rule("R7", rf"which {_PICTURE} (?:has|have|contains) (?P<y>.+)", _with),
    _rule("R7", r"which (?:shape|figure|letter|object|one) has (?P<y>(?:a |no )?lines? of symmetry)", _with),
    _rule("R8", r"which (?:.+?) (?:shows|is) an? (?P<noun>.+)", _noun),
)


# -- filters -----------------------------------------------------------------------------------------------------


_LEAST_EDGE_ENERGY = 0.25  # of the original, after a picture was as small as on the screen


def picture_problem(image: Image.Image, options: ConvertOptions, least_side: int | None = None) -> str | None:
    """Return why the picture cannot be used; None if it can."""
    if min(image.size) < (options.min_side if least_side is None else least_side):
        return "picture too small"
    if max(image.size) > options.max_aspect * min(image.size):
        return "picture too long"
    grey = np.asarray(image.convert("L"), np.float64)
    if max(grey.std(), np.asarray(image, np.float64).std(axis=(0, 1)).max()) < options.min_spread:
        return "picture nearly blank"
    if options.legible_at is not None and _edges_lost(image, options.legible_at):
        return "picture not legible on a tile"
    return None


def _edges_lost(image: Image.Image, tile: int) -> bool:
    small = image.resize((tile, tile), Image.Resampling.LANCZOS).resize(image.size, Image.Resampling.BICUBIC)
    return _edge_energy(small) < _LEAST_EDGE_ENERGY * _edge_energy(image)


def _edge_energy(image: Image.Image) -> float:
    grey = np.asarray(image.convert("L"), np.float64)
    return float(sum((np.diff(grey, axis=axis) ** 2).sum() for axis in (0, 1)))


def text_problem(instruction: str, phrase: str, options: ConvertOptions) -> str | None:
    """Return why the instruction cannot be used; None if it can."""
    text = unicodedata.normalize("NFKC", instruction)
    checks: dict[str, Callable[[], bool]] = {
        "instruction has too many words": lambda: len(text.split()) > options.max_words,
        "instruction too long": lambda: len(text) > options.max_characters,
        "instruction is more than one sentence": lambda: any(
            mark in text.rstrip(".") for mark in (". ", "? ", "! ", "\n")
        ),
        "instruction ends with a period": lambda: text.endswith("."),
        "instruction is not plain ASCII": lambda: (
            not options.allow_unicode and not (text.isascii() and text.isprintable())
        ),
        "instruction names no object": lambda: not phrase.strip(),
        "instruction names a side": lambda: bool(side_words(text)),
    }
    return next((reason for reason, failed in checks.items() if failed()), None)


# -- a language model --------------------------------------------------------------------------------------------


_TIMEOUT_SECONDS = 60
_PROMPT = """Rewrite a question about two pictures as a command that names the picture that answers it.
Answer with one JSON object: instruction (starts with "Put the cube on"), object (the words after that, without
a leading article), polarity (pos, neg or none), keep (false if choosing one of two pictures is no answer)."""


def propose_wording(candidate: Candidate, options: ConvertOptions) -> Wording | None:
    """Return the wording that the service proposes; None if it proposes nothing usable.

    Replies are kept in `llm_cache`, so that the same conversion needs no network again.

    Raises:
        SuiteError: If the service does not answer.
        UsageError: For a service without a model or a folder for replies.
    """
    if options.llm_base is None:
        return None
    if not options.llm_model or not options.llm_cache:
        raise UsageError(
            "llm_base needs llm_model and llm_cache as well. Name the model and a folder for replies."
        )
    question = {"question": candidate.question, "answer": candidate.answer}
    key = sha256_json([options.llm_model, _PROMPT, question])
    cached = Path(options.llm_cache) / f"{key}.json"
    if not cached.is_file():
        reply = _ask(options.llm_base, options.llm_model, json.dumps(question, ensure_ascii=False))
        write_whole(cached, reply)
    return _usable(read_regular_text(cached), options.llm_model)


def _ask(base: str, model: str, question: str) -> str:
    body = {
        "model": model,
        "temperature": 0,
        "response_format": {"type": "json_object"},
        "messages": [{"role": "system", "content": _PROMPT}, {"role": "user", "content": question}],
    }
    request = urllib.request.Request(
        f"{base.rstrip('/')}/chat/completions",
        data=json.dumps(body).encode(),
        headers={
            "Content-Type": "application/json",
            "Authorization": f"Bearer {os.environ.get('PROBE_KIT_LLM_KEY', '')}",
        },
    )
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_SECONDS) as response:
            content = parse_json(response.read(MOST_BYTES))["choices"][0]["message"]["content"]
    except (urllib.error.URLError, TimeoutError, ValueError, KeyError, IndexError, TypeError) as problem:
        raise SuiteError(
            f"{base} gave no usable reply ({problem!r}). Check llm_base, or leave it out."
        ) from problem
    return str(content)


def _usable(reply: str, model: str) -> Wording | None:
    try:
        proposal: Any = parse_json(reply)
    except ValueError:
        return None
    if not isinstance(proposal, dict) or proposal.get("keep") is not True:
        return None
    phrase, instruction = str(proposal.get("object", "")).strip(), str(proposal.get("instruction", "")).strip()
    for article in ("the", "none"):
        if phrase and instruction == instruction_for(phrase, article):
            origin = {"model": model, "prompt_sha256": sha256_text(_PROMPT), "raw": reply}
            return Wording(phrase, "llm", article=article, proposed_by=origin)
    return None
