"""Conversion (`convert`) from a benchmark's folder to a suite, in five counted stages."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from hashlib import file_digest
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.bounded_files import open_regular
from probe_kit.errors import SuiteError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.suite.categories import check_categories
from probe_kit.suite.converters import act2answer, compbench, iconqa, mmbench, okvqa, vlthink
from probe_kit.suite.converters.act2answer import SOURCE as ACT2ANSWER
from probe_kit.suite.converters.candidates import (
    Candidate,
    CompBenchOptions,
    ConvertOptions,
    IconQaOptions,
    MmbenchOptions,
    OkVqaOptions,
    SourceContent,
    SourcePicture,
    VlThinkOptions,
    options_from,
)
from probe_kit.suite.converters.curation import apply_curation, read_curation, write_curation
from probe_kit.suite.converters.pairing import Bundle, Proposal, emit, pair_candidates, sample
from probe_kit.suite.converters.rewriting import picture_problem, propose_wording, rewrite, text_problem
from probe_kit.suite.items import Item, instruction_for, with_groups
from probe_kit.suite.manifest import check_foreign_folder, save_suite
from probe_kit.suite.pictures import Look, look_of
from probe_kit.suite.suite import Suite, new_suite

VERSION = "1.0.0"
# Table of tasks of the paper: what its authors found and what they kept. Concepts, where the source is boards.
PAPER_POOL = {
    "emotion": 5254,
    "attribute": 5386,
    "state": 1066,
    "color": 11,
    "shape": 12798,
    "symmetry": 362,
    "counting": 5001,
    "time": 508,
    "public-info": 14,
    "traffic": 24,
    "celebrity": 316,
    "living-world": 2336,
}
PAPER_ITEMS = {slug: 70 if slug == "celebrity" else 150 for slug in PAPER_POOL}
_POOL_TOLERANCE = 0.2
_PICTURES_KEPT = 512


@dataclass(frozen=True)
class _Source:
    name: str
    categories: tuple[str, ...]
    options: type[ConvertOptions]
    read: Callable[[Path, Sequence[str], Any], SourceContent]
    reuse: bool = False


_ALL = (
    _Source(compbench.SOURCE, compbench.CATEGORIES, CompBenchOptions, compbench.read),
    _Source(iconqa.SOURCE, iconqa.CATEGORIES, IconQaOptions, iconqa.read),
    _Source(mmbench.SOURCE, mmbench.CATEGORIES, MmbenchOptions, mmbench.read),
    _Source(okvqa.SOURCE, okvqa.CATEGORIES, OkVqaOptions, okvqa.read),
    _Source(vlthink.SOURCE, vlthink.CATEGORIES, VlThinkOptions, vlthink.read, reuse=True),
)
SOURCES: dict[str, _Source] = {source.name: source for source in _ALL}
EVERY_SOURCE = (*SOURCES, ACT2ANSWER)
"""The names that `convert` takes as a source."""


def convert(
    source: str,
    root: Path | str,
    out: Path | str,
    *,
    categories: Sequence[str] | None = None,
    n: int = 150,
    seed: int = 0,
    curation: Path | str | None = None,
    emit_curation: Path | str | None = None,
    **options: Any,
) -> Suite:
    """Make a suite from the benchmark in `root`, write it to `out` and load it.

    The same arguments give the same bytes. `stats.json` lists the counts of every stage next to the paper's. Sets
    in Act2Answer's own format (`act2answer`) are converted question by question, whatever `seed` is.

    Args:
        source: Name of the benchmark, one of EVERY_SOURCE.
        root: Folder of the unpacked benchmark.
        out: Folder to write; new or empty, or with this very suite.
        categories: Names of categories, None for all of the source.
        n: Most items per category.
        seed: Seed of the pairs and sides.
        curation: A reviewed file, of which only accepted pairs are emitted; None to use all pairs that need no
            review.
        emit_curation: File to write for a review; None for none.
        **options: Fields of the source's options, such as `min_side` (see `SOURCES`).

    Raises:
        UsageError: For an unknown source, category or option, a number of items below 1, or a root that does not
            exist.
        SuiteError: For a tree that is not as expected, naming file, record and remedy; `out` is then left as it
            was.
    """
    if source not in EVERY_SOURCE:
        raise UsageError(f"unknown source {source!r}; available: {', '.join(EVERY_SOURCE)}.")
    if n < 1:
        raise UsageError(f"n is {n}; expected at least 1 item per category.")
    if source == ACT2ANSWER:
        if curation is not None or emit_curation is not None:
            raise UsageError(f"{source} takes no curation: its questions are converted unchanged.")
        return act2answer.convert_set(Path(root), Path(out), categories, n, options)
    kind, root, out = SOURCES[source], Path(root), Path(out)
    source_options = options_from(kind.options, options)
    requested = kind.categories if categories is None else check_categories(categories, kind.categories)
    if not root.exists():
        raise UsageError(f"{source}: {root} does not exist. Name the folder the benchmark was unpacked to.")
    check_foreign_folder(out)
    conversion = _Conversion(kind, source_options, kind.read(root, requested, source_options), n, seed)
    bundles = {category: conversion.propose(category) for category in requested}
    if emit_curation is not None:
        write_curation(Path(emit_curation), _flat(bundles), conversion.load)
    if curation is not None:
        accepted = apply_curation(_flat(bundles), read_curation(Path(curation)), Path(curation))
        bundles = {category: _review_bundles(proposals, accepted) for category, proposals in bundles.items()}
    else:
        bundles = {category: conversion.without_review(proposals) for category, proposals in bundles.items()}
    return conversion.save(bundles, out, Path(curation) if curation is not None else None)


@dataclass
class _Conversion:
    """One conversion: the content of the source, and how many candidates every stage left."""

    kind: _Source
    options: ConvertOptions
    reading: SourceContent
    n: int
    seed: int

    def __post_init__(self) -> None:
        self.stages: dict[str, Counter[str]] = {}
        self.looks: dict[str, Look] = {}
        self.load = lru_cache(maxsize=_PICTURES_KEPT)(lambda picture: picture.load())

    def propose(self, category: str) -> list[Bundle]:
        """Filter, rewrite and pair the candidates of one category."""
        stage = self.stages[category] = Counter(pool=self.reading.pool[category])
        candidates = sorted(
            (c for c in self.reading.candidates if c.category == category), key=lambda c: (c.source_id, c.question)
        )
        stage["rule_selected"] = len(candidates)
        candidates = [c for c in candidates if self._keep(self._picture_problem(c))]
        stage["image_ok"] = len(candidates)
        worded = [
            replace(c, wording=c.wording or rewrite(c.question, c.answer) or propose_wording(c, self.options))
            for c in candidates
        ]
        usable = [candidate for candidate in worded if self._keep(self._text_problem(candidate))]
        stage["text_ok"] = sum(candidate.wording is not None for candidate in usable)
        stage["needs_edit"] = len(usable) - stage["text_ok"]
        paired = [c for c in usable if c.wording is not None or c.distractor is not None]
        bundles = pair_candidates(
            paired, self.kind.reuse, self.options.paper_polarity, self._alike, self._random(category, "pairs")
        )
        stage["paired"] = sum(map(len, bundles))
        return bundles

    def _random(self, category: str, part: str) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64(derive_seed(self.seed, self.kind.name, category, part)))

    def _keep(self, problem: str | None) -> bool:
        if problem:
            self.reading.reasons[problem] += 1
        return problem is None

    def _picture_problem(self, candidate: Candidate) -> str | None:
        pictures = [picture for picture in (candidate.target, candidate.distractor) if picture]
        for picture in pictures:
            problem = picture_problem(self.load(picture), self.options, picture.least_side)
            if problem:
                return problem
        return (
            "target and distractor are the same picture" if len(pictures) == 2 and self._alike(*pictures) else None
        )

    def _alike(self, first: SourcePicture, second: SourcePicture) -> bool:
        return self._look(first).same_as(self._look(second))

    def _look(self, picture: SourcePicture) -> Look:
        if picture.image_id not in self.looks:
            self.looks[picture.image_id] = look_of(self.load(picture))
        return self.looks[picture.image_id]

    def _text_problem(self, candidate: Candidate) -> str | None:
        """Return what is wrong with a candidate's words; None if nothing is.

        A question without a wording passes: a person may still write one.
        """
        wording = candidate.wording
        if wording is None:
            self.reading.reasons["no rewriting rule matches (needs_edit)"] += 1
            return None
        if candidate.side_word:
            return None if self.options.side_words else "instruction names a side"
        for phrase in filter(None, (wording.phrase, wording.opposite)):
            problem = text_problem(instruction_for(phrase, wording.article), phrase, self.options)
            if problem:
                return problem
        return None

    def without_review(self, bundles: list[Bundle]) -> list[Bundle]:
        """Return the bundles that need no review: worded by a rule, or by a trusted model."""
        accepted = {}
        for proposal in (proposal for bundle in bundles for proposal in bundle):
            if proposal.wording is None or proposal.needs_person:
                continue
            by_model = proposal.wording.proposed_by is not None
            if self.options.trust_llm or not by_model:
                status = "llm-trusted" if by_model else "rules-only"
                accepted[proposal.candidate_id] = replace(proposal, curation_status=status)
        return _review_bundles(bundles, accepted)

    def save(self, bundles: dict[str, list[Bundle]], out: Path, curation: Path | None) -> Suite:
        """Sample, lay out and write; nothing is written if no item is left."""
        items: list[Item] = []
        pictures: dict[str, bytes] = {}
        for category, accepted in bundles.items():
            self.stages[category]["accepted"] = sum(map(len, accepted))
            sampled = sample(accepted, self.n)
            emitted, files = emit(
                self.kind.name, sampled, self.reading, self.load, self._random(category, "sides")
            )
            self.stages[category]["emitted"] = len(emitted)
            items += emitted
            pictures |= files
        if not items:
            raise SuiteError(f"{self.kind.name}: no item left to write. {self._why_none()}")
        extra = {
            "annotation_files": {path.name: _file_sha256(path) for path in self.reading.files},
            "curation_sha256": _file_sha256(curation) if curation else "none",
            "source_url": self.reading.url,
        }
        numbers = {"items_per_category": self.n, "seed": self.seed, "source": self.kind.name}
        options = {name: value for name, value in asdict(self.options).items() if name not in _PLACES}
        suite = new_suite(f"a2a-{self.kind.name}", VERSION, with_groups(items), options | numbers, extra)
        return save_suite(suite, pictures, self._stats(), out)

    def _stats(self) -> dict[str, Any]:
        stats: dict[str, Any] = {
            category: dict(stage) | {"paper_pool": PAPER_POOL[category], "paper_items": PAPER_ITEMS[category]}
            for category, stage in self.stages.items()
        }
        far = [
            f"{category}: pool of {stage['pool']}, the paper has {PAPER_POOL[category]}; releases differ"
            for category, stage in self.stages.items()
            if abs(stage["pool"] - PAPER_POOL[category]) > _POOL_TOLERANCE * PAPER_POOL[category]
        ]
        reasons = dict(sorted(self.reading.reasons.items()))
        return stats | {"reasons": reasons, "notes": self.reading.notes + far}

    def _why_none(self) -> str:
        counts = "; ".join(
            f"{category}: {', '.join(f'{name} {count}' for name, count in stage.items())}"
            for category, stage in self.stages.items()
        )
        reasons = ", ".join(f"{reason} {count}×" for reason, count in self.reading.reasons.most_common(5))
        return (
            f"{counts}. Reasons: {reasons or 'none recorded'}. {' '.join(self.reading.notes)} "
            "Loosen a filter, or review the pairs with emit_curation and curation."
        )


_MOST_FILE_BYTES = 1 << 40
_PLACES = ("image_root", "llm_base", "llm_cache", "instances")  # of this machine, not of the suite


def _flat(bundles: dict[str, list[Bundle]]) -> list[Proposal]:
    return [proposal for of_category in bundles.values() for bundle in of_category for proposal in bundle]


def _review_bundles(bundles: list[Bundle], accepted: dict[str, Proposal]) -> list[Bundle]:
    reviewed = (
        tuple(accepted[p.candidate_id] for p in bundle if p.candidate_id in accepted) for bundle in bundles
    )
    return [bundle for bundle in reviewed if bundle]


def _file_sha256(path: Path) -> str:
    with open_regular(path, _MOST_FILE_BYTES) as file:
        return file_digest(file, "sha256").hexdigest()
