"""How `vlm-tiny` is trained: questions about two pictures, answered in words; at first with heads besides."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from probe_kit.extract.prompts import ORDERS, P1, P2, SEEN, Phrase, sides
from probe_kit.models.embedded.words import END
from probe_kit.suite.items import instruction_for
from vlm_tiny_training.batches import Pair, Pairs, Pixels, laid_out
from vlm_tiny_training.heads import Heads, Looked, capturing
from vlm_tiny_training.painting import Surface
from vlm_tiny_training.training import Stage

SIDES = ("left", "right")
ABSENT = 0.2
"""Of the questions whether something is there, for something that is not."""
MOST_BLUR = 0.25


@dataclass(frozen=True)
class Asks:
    """kinds: of questions, with their shares. heads: whether they are trained along."""

    kinds: Mapping[str, float]
    heads: bool = False


READING = (
    Stage(2200, 1.5e-3, Asks({"describe": 0.2, "place": 0.8}, heads=True), last_rate=8e-4),
    Stage(1300, 1e-3, Asks({"describe": 0.1, "place": 0.15, "seen": 0.25, "p2": 0.25, "p1": 0.25})),
)
"""First what pictures show and where things are, then mostly the prompts of `probe-kit ask`."""


@dataclass(frozen=True)
class Asked:
    """A question, without its frame, and its answer."""

    question: str
    answer: str


def ask(kind: str, pair: Pair, pairs: Pairs, side: int, rng: np.random.Generator) -> Asked:
    """A question of a kind, about a pair whose asked picture lies on `side` (0 left).

    describe: what lies on a side. place: where the cube is to be put, by the policy's own instruction. The others
    are prompts of `probe-kit ask`, with the sides named in either order.
    """
    target = pair.phrases[0]
    if kind == "describe":
        return Asked(f"what {pair.bank.category} is {SIDES[side]}?", target)
    if kind == "place":
        return Asked(instruction_for(target, "the"), SIDES[side])
    order = ORDERS[rng.integers(2)]
    if kind == "seen":
        if rng.random() < ABSENT:
            return Asked(SEEN.render(Phrase(pairs.absent(pair, rng), "the"), order), "No")
        return Asked(SEEN.render(Phrase(target, "the"), order), f"Yes, {SIDES[side]}")
    template = {"p1": P1, "p2": P2}[kind]
    letter = "A" if sides(order)[0] == SIDES[side] else "B"
    return Asked(template.render(Phrase(target, "the"), order), letter)


@dataclass(frozen=True)
class Shown:
    """A pair, the side of its asked picture, and where it is seen."""

    pair: Pair
    side: int
    surface: str
    picture: Pixels


class Learner:
    """Learns to answer."""

    def __init__(self, network: Any, tokenizer: Path, pairs: Pairs, surfaces: Mapping[str, Surface]):
        self._vlm = network
        self._heads = Heads(pairs.phrases(), surfaces)
        self.network: nn.Module = nn.ModuleDict({"vlm": network, "heads": self._heads})
        self._pairs, self._surfaces = pairs, surfaces
        self._tokenizer = Tokenizer.from_file(str(tokenizer))
        self._ids = cache(self._encoded)

    def losses(self, rng: np.random.Generator, setting: Asks, size: int) -> dict[str, Tensor]:
        """Of one batch of questions of one kind."""
        kind = str(rng.choice(list(setting.kinds), p=np.array(list(setting.kinds.values()))))
        samples = [self._draw_sample(rng) for _ in range(size)]
        questions = [ask(kind, sample.pair, self._pairs, sample.side, rng) for sample in samples]
        pictures = blurred(np.stack([sample.picture for sample in samples]), rng)
        with capturing(self._vlm) as captured:
            losses = {kind: self.loss(pictures, questions)}
        if setting.heads:
            columns = (
                [sample.pair for sample in samples],
                [sample.side for sample in samples],
                [sample.surface for sample in samples],
            )
            losses |= self._heads.losses(captured, Looked(*columns), kind != "describe")
        return losses

    def _draw_sample(self, rng: np.random.Generator) -> "Shown":
        pair, side = self._pairs.draw(rng), int(rng.integers(2))
        name = str(rng.choice(list(self._surfaces)))
        return Shown(pair, side, name, laid_out(name, self._surfaces[name], pair, side))

    def loss(self, pictures: Pixels, questions: list[Asked]) -> Tensor:
        """Mean cross-entropy of the answers' tokens, ends included. pictures: (B, 96, 96, 3) in [0, 255]."""
        prompts = [self._ids(f"<bos>{question.question}\n") for question in questions]
        answers = [(*self._ids(question.answer), END) for question in questions]
        longest = max(len(p) + len(a) for p, a in zip(prompts, answers, strict=True))
        ids = torch.zeros(len(questions), longest, dtype=torch.long)
        next_ids = torch.full((len(questions), longest), -100)
        for row, (prompt, answer) in enumerate(zip(prompts, answers, strict=True)):
            end = len(prompt) + len(answer)
            ids[row, :end] = torch.tensor([*prompt, *answer])
            next_ids[row, len(prompt) - 1 : end - 1] = torch.tensor(answer)
        hidden = self._hidden(pictures, ids, torch.tensor([len(prompt) for prompt in prompts]))
        answer_tokens = next_ids != -100
        logits = hidden[answer_tokens] @ self._vlm.model.language_model.embed_tokens.weight.T
        return cross_entropy(logits, next_ids[answer_tokens])

    def _hidden(self, pictures: Pixels, ids: Tensor, prompts: Tensor) -> Tensor:
        """(B, T, width) at the text's positions: the picture and the prompt attend both ways, the answer back."""
        model = self._vlm.model
        picture_features = model.get_image_features(as_tensor(pictures)).pooler_output
        embedded = torch.cat([picture_features, model.language_model.embed_tokens(ids)], dim=1)
        length, patches = embedded.shape[1], picture_features.shape[1]
        position = torch.arange(length)
        of_prompt = position[None] < patches + prompts[:, None]
        allowed = of_prompt[:, None, :] | (position[None, :] <= position[:, None])[None]
        mask = torch.zeros(len(ids), 1, length, length).masked_fill(
            ~allowed[:, None], torch.finfo(torch.float32).min
        )
        positions = (position + 1).expand(len(ids), -1)
        output = model.language_model(
            inputs_embeds=embedded, attention_mask=mask, position_ids=positions, use_cache=False
        )
        return output.last_hidden_state[:, patches:]

    def _encoded(self, text: str) -> tuple[int, ...]:
        encoding = self._tokenizer.encode(text, add_special_tokens=False)
        if "<unk>" in encoding.tokens:
            raise ValueError(f"{text!r} has a word that the tokenizer does not know: {encoding.tokens}")
        return tuple(encoding.ids)


def as_tensor(pictures: Pixels) -> Tensor:
    """(B, 96, 96, 3) in [0, 255] to (B, 3, 96, 96) in [-1, 1], as SigLIP wants them."""
    return torch.from_numpy((pictures / np.float32(127.5) - 1).transpose(0, 3, 1, 2).copy())


def blurred(pictures: Pixels, rng: np.random.Generator) -> Pixels:
    """A little, and each otherwise: pictures come to the model by way of several sizes."""
    share = rng.uniform(0, MOST_BLUR, (len(pictures), 1, 1, 1)).astype(np.float32)
    for axis in (1, 2):
        neighbours = (np.roll(pictures, 1, axis) + np.roll(pictures, -1, axis)) / 2
        pictures = (1 - share) * pictures + share * neighbours
    return pictures
