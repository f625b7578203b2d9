"""Pairing of candidates to items: pairs of pictures, the target of each, sampling, and the sides."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from PIL import Image

from probe_kit.hashing import sha256_json
from probe_kit.suite.converters.candidates import Candidate, SourceContent, SourcePicture, Wording
from probe_kit.suite.items import Item, Side, instruction_for, other_side
from probe_kit.suite.suite import Picture, make_item, squared_picture


@dataclass(frozen=True)
class Proposal:
    """One possible item that asks the question of `candidate`.

    `wording` is None if a person has to write it; `curation_status` is its status in the review.
    """

    candidate: Candidate
    candidate_id: str
    source_id: str
    pair_key: str
    target: SourcePicture
    distractor: SourcePicture
    wording: Wording | None
    target_concept: str
    distractor_concept: str
    construction: str
    needs_person: bool
    polarity: str = "none"
    curation_status: str = "rules-only"

    @property
    def instruction(self) -> str:
        """The imperative; empty without a wording."""
        return instruction_for(self.wording.phrase, self.wording.article) if self.wording else ""


Bundle = tuple[Proposal, ...]


def pair_candidates(
    candidates: Sequence[Candidate],
    reuse: bool,
    paper_polarity: bool,
    alike: Callable[[SourcePicture, SourcePicture], bool],
    rng: np.random.Generator,
) -> list[Bundle]:
    """Pair candidates to proposals, in bundles that stay together, in random order.

    Questions that bring both pictures keep them. Half of those with an opposite ask for it, so that the pictures
    alone do not give the answer. The others are paired two by two and asked both ways.

    Args:
        candidates: Candidates of one category.
        reuse: Whether to make every pair of candidates with one picture, instead of using every picture once.
        paper_polarity: Whether to keep every comparison as the source asks it.
        alike: Function that returns whether two pictures are too much the same.
        rng: Generator of the order, the couples and the opposites.
    """
    native = [candidate for candidate in candidates if candidate.distractor is not None]
    single = [candidate for candidate in candidates if candidate.distractor is None]
    negate = rng.permutation(len(native)) % 2 == 1
    bundles: list[Bundle] = [
        (_native(candidate, bool(negated) and not paper_polarity),)
        for candidate, negated in zip(native, negate, strict=True)
    ]
    if reuse:
        couples = [(first, second) for first, second in combinations(single, 2) if _may_meet(first, second)]
        couples = [couples[int(index)] for index in rng.permutation(len(couples))]
    else:
        couples = _disjoint_couples(single, rng)
    bundles += [
        (_ask(first, second), _ask(second, first))
        for first, second in couples
        if not alike(first.target, second.target)
    ]
    return [bundles[int(index)] for index in rng.permutation(len(bundles))]


def _native(candidate: Candidate, negated: bool) -> Proposal:
    """Make the proposal of a candidate with both pictures; `negated` asks for the opposite, if there is one."""
    assert candidate.distractor is not None
    wording = candidate.wording
    phrase, opposite = (wording.phrase, wording.opposite) if wording else (candidate.question, None)
    concepts = phrase, opposite or f"not {phrase}"
    pictures = candidate.target, candidate.distractor
    if wording is not None and opposite is not None and negated:
        concepts, pictures = concepts[::-1], pictures[::-1]
        wording = replace(wording, phrase=opposite, opposite=phrase)
    return Proposal(
        candidate,
        _candidate_id(candidate.category, candidate.source_id),
        source_id=candidate.source_id,
        pair_key=candidate.source_id,
        target=pictures[0],
        distractor=pictures[1],
        wording=wording,
        target_concept=concepts[0],
        distractor_concept=concepts[1],
        construction=candidate.construction,
        needs_person=candidate.needs_person,
        polarity="none" if not opposite else "neg" if negated else "pos",
    )


def _ask(candidate: Candidate, other: Candidate) -> Proposal:
    """Make the proposal that asks for one of two candidates, with the other's picture as the wrong one."""
    recolored = "recolored" in (candidate.construction, other.construction)
    return Proposal(
        candidate,
        _candidate_id(candidate.category, candidate.source_id, other.source_id),
        source_id=f"{candidate.source_id}|{other.source_id}",
        pair_key="+".join(sorted((candidate.source_id, other.source_id))),
        target=candidate.target,
        distractor=other.target,
        wording=candidate.wording,
        target_concept=candidate.concept,
        distractor_concept=other.concept,
        construction="recolored" if recolored else candidate.construction,
        needs_person=candidate.needs_person or other.needs_person,
    )


def _candidate_id(category: str, *source_ids: str) -> str:
    return f"{category}-{sha256_json(list(source_ids))[:12]}"


def _may_meet(first: Candidate, second: Candidate) -> bool:
    return (
        first.concept != second.concept
        and first.target.image_id != second.target.image_id
        and not first.forbids & second.shows
        and not second.forbids & first.shows
    )


def _disjoint_couples(
    candidates: Sequence[Candidate], rng: np.random.Generator
) -> list[tuple[Candidate, Candidate]]:
    """Pair candidates inside one family; every picture is in at most one pair, with the next free fitting one."""
    waiting: dict[str, list[Candidate]] = {}
    used: set[str] = set()
    couples = []
    for index in rng.permutation(len(candidates)):
        candidate = candidates[int(index)]
        if candidate.target.image_id in used:
            continue
        used.add(candidate.target.image_id)
        free = waiting.setdefault(candidate.family, [])
        partner = next((other for other in free if _may_meet(candidate, other)), None)
        if partner is None:
            free.append(candidate)
        else:
            free.remove(partner)
            couples.append((partner, candidate))
    return couples


def sample(bundles: Sequence[Bundle], count: int) -> list[Bundle]:
    """Return the first bundles with at most `count` proposals in all."""
    sampled: list[Bundle] = []
    capacity = count
    for bundle in bundles:
        if len(bundle) <= capacity:
            sampled.append(bundle)
            capacity -= len(bundle)
    return sampled


def emit(
    source: str, bundles: Sequence[Bundle], reading: SourceContent, render: Callable[[SourcePicture], Image.Image],
    rng: np.random.Generator,
) -> tuple[list[Item], dict[str, bytes]]:  # fmt: skip
    """Make the items of the bundles, without groups, and their pictures by file name.

    Twins keep the places of their two pictures; all sides balance.
    """
    store: dict[str, Picture] = {}

    def store_picture(picture: SourcePicture) -> Picture:
        if picture.image_id not in store:
            store[picture.image_id] = squared_picture(picture.image_id, render(picture), picture.operation)
        return store[picture.image_id]

    items = [
        _item(source, proposal, side, store_picture(proposal.target), store_picture(proposal.distractor), reading)
        for proposal, side in _with_sides(bundles, rng)
    ]
    return items, {entry.file_name: entry.png for entry in store.values()}


def _with_sides(bundles: Sequence[Bundle], rng: np.random.Generator) -> Iterator[tuple[Proposal, Side]]:
    """Yield each proposal with the side of its target; phrases alternate, and their remainders balance."""
    lean: Counter[str] = Counter()
    side_of_first: dict[str, Side] = {}
    for bundle in sorted(bundles, key=lambda bundle: bundle[0].instruction):
        first = bundle[0]
        surplus = lean[first.instruction] or lean[""]
        side: Side = "right" if surplus > 0 or (surplus == 0 and rng.integers(2)) else "left"
        side_of_first[first.candidate_id] = side
        for proposal in bundle:
            step = 1 if _side(proposal, first, side) == "left" else -1
            lean.update({proposal.instruction: step, "": step})
    for bundle in bundles:
        for proposal in bundle:
            yield proposal, _side(proposal, bundle[0], side_of_first[bundle[0].candidate_id])


def _side(proposal: Proposal, first: Proposal, side_of_first: Side) -> Side:
    """Return the side of a proposal's target, given that of the first in its bundle.

    Twins keep their pictures in place, so the one that asks for the other picture asks for the other side.
    """
    return side_of_first if proposal.target == first.target else other_side(side_of_first)


def _item(
    source: str, proposal: Proposal, side: Side, target: Picture, distractor: Picture, reading: SourceContent
) -> Item:
    left, right = (target, distractor) if side == "left" else (distractor, target)
    assert proposal.wording is not None
    category = proposal.candidate.category
    content = {
        "instruction": proposal.instruction,
        "correct_side": side,
        "left": left.pixels_sha256,
        "right": right.pixels_sha256,
        "source_id": proposal.source_id,
    }
    return make_item(
        f"{source}-{category}-{sha256_json(content)[:10]}",
        category,
        side,
        (left, right),
        construction=proposal.construction,
        instruction=proposal.instruction,
        object_phrase=proposal.wording.phrase,
        object_article=proposal.wording.article,
        polarity=proposal.polarity,
        target_concept=proposal.target_concept,
        distractor_concept=proposal.distractor_concept,
        pair_id=f"{source}-{category}-{sha256_json(proposal.pair_key)[:12]}",
        rule_id=proposal.wording.rule_id,
        curation_status=proposal.curation_status,
        license=reading.license,
        attribution=reading.attribution,
        redistributable=reading.redistributable,
        contains_real_face=proposal.target.real_face or proposal.distractor.real_face,
        source={
            "benchmark": source,
            "version": reading.revision,
            "split": reading.split,
            "source_id": proposal.source_id,
            "url": reading.url,
            "question": proposal.candidate.question,
            "left_original_pixels_sha256": left.original_pixels,
            "right_original_pixels_sha256": right.original_pixels,
            "picture_operation": left.operation,
        },
        side_word=proposal.candidate.side_word,
    )
