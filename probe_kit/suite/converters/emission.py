"""From accepted proposals to items: sampling, assignment to left and right, and encoding of pictures."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from PIL import Image

from probe_kit.hashing import sha256_json
from probe_kit.suite.converters.candidates import Reading, SourcePicture
from probe_kit.suite.converters.pairing import Bundle, Proposal
from probe_kit.suite.items import Item, Side, other_side
from probe_kit.suite.making import Picture, make_item, squared_picture


def sample(bundles: Sequence[Bundle], count: int) -> list[Bundle]:
    """The first bundles with at most `count` proposals in all."""
    chosen: list[Bundle] = []
    left = count
    for bundle in bundles:
        if len(bundle) <= left:
            chosen.append(bundle)
            left -= len(bundle)
    return chosen


def emit(
    source: str, bundles: Sequence[Bundle], reading: Reading, render: Callable[[SourcePicture], Image.Image],
    rng: np.random.Generator,
) -> tuple[list[Item], dict[str, bytes]]:  # fmt: skip
    """The items of the bundles without groups, and their pictures by file name.

    Twins keep their two pictures where they are; all sides balance.
    """
    store: dict[str, Picture] = {}

    def stored(picture: SourcePicture) -> Picture:
        if picture.image_id not in store:
            store[picture.image_id] = squared_picture(picture.image_id, render(picture), picture.operation)
        return store[picture.image_id]

    items = [
        _item(source, proposal, side, stored(proposal.target), stored(proposal.distractor), reading)
        for proposal, side in _with_sides(bundles, rng)
    ]
    return items, {entry.file_name: entry.png for entry in store.values()}


def _with_sides(bundles: Sequence[Bundle], rng: np.random.Generator) -> Iterator[tuple[Proposal, Side]]:
    """Each proposal with the side of its target: phrases alternate, and their remainders balance each other."""
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
    """Twins keep their pictures in place, so the one that asks for the other picture asks for the other side."""
    return side_of_first if proposal.target == first.target else other_side(side_of_first)


def _item(
    source: str, proposal: Proposal, side: Side, target: Picture, distractor: Picture, reading: Reading
) -> Item:
    left, right = (target, distractor) if side == "left" else (distractor, target)
    assert proposal.wording is not None
    content = {
        "instruction": proposal.instruction,
        "correct_side": side,
        "left": left.pixels_sha256,
        "right": right.pixels_sha256,
        "source_id": proposal.source_id,
    }
    return make_item(
        f"{source}-{proposal.category}-{sha256_json(content)[:10]}",
        proposal.category,
        side,
        (left, right),
        construction=proposal.construction,
        instruction=proposal.instruction,
        object_phrase=proposal.wording.phrase,
        object_article=proposal.wording.article,
        polarity=proposal.polarity,
        target_concept=proposal.target_concept,
        distractor_concept=proposal.distractor_concept,
        pair_id=f"{source}-{proposal.category}-{sha256_json(proposal.pair_key)[:12]}",
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
            "question": proposal.question,
            "left_original_pixels_sha256": left.original_pixels,
            "right_original_pixels_sha256": right.original_pixels,
            "picture_operation": left.operation,
        },
        side_word=proposal.side_word,
    )
