"""The units of feed-forward blocks in the words of the vocabulary.

A feed-forward block adds Σ_j a_j(x) · v_j to the residual stream: the activation a_j of unit j times its value
vector v_j, a column of the block's last matrix. The vector can be read as the logit lens reads a residual: the
model's final norm and head turn it into a score for every token (Geva, Caciularu, Wang, Goldberg: Transformer
feed-forward layers build predictions by promoting concepts in the vocabulary space, EMNLP 2022; of policies: Häon,
Stocking, Chuang, Tomlin: Mechanistic interpretability for steering vision-language-action models, CoRL 2025).

The words of a unit say what its vector would promote if nothing came behind it. They are no evidence that the
policy uses it: steer along the vector (`probe-kit intervene --kind steer`) and look at the actions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks.contract.sites import Site

if TYPE_CHECKING:
    from torch import Tensor, nn

    from probe_kit.hooks.contract.model import Model, Unembedding
    from probe_kit.hooks.family import Family

STREAM = "backbone"
"""The stream whose blocks are read: the decoder of the prompt."""
TOKENS = 10
"""Default number of first tokens of a unit."""
SHUFFLES = 1000
"""Default number of shuffles of the embedding."""
_UNITS_AT_ONCE = 256
"""Value vectors that are scored together: at 257,000 tokens in float32 they take 263 MB."""


@dataclass(frozen=True)
class WordMatch:
    """The units whose first tokens hold one of some words, against a shuffled embedding.

    Attributes:
        words: The words.
        token_ids: The ids of the tokens that spell them, in any case and with or without a space in front.
        units: Number of units with one of these tokens among their first ones.
        expected: Expected number of such units if the rows of the embedding were shuffled, exactly:
            U · (1 − C(V − m, k) / C(V, k)) for U units, V tokens, m of them these, and k first tokens.
        p: Share of shuffles, and of the unshuffled embedding, with at least as many units; at least
            1 / (1 + shuffles).
        shuffles: Number of shuffles.
    """

    words: tuple[str, ...]
    token_ids: tuple[int, ...]
    units: int
    expected: float
    p: float
    shuffles: int


@dataclass(frozen=True)
class ValueWords:
    """The first tokens of every unit of some feed-forward blocks of a model's backbone.

    U units of all these blocks in order, k tokens each.

    Attributes:
        family: Name of the model family.
        weights: sha256 of the model's weights.
        blocks: (U,) block of every unit, counted from 0.
        units: (U,) number of every unit in its block, counted from 0.
        token_ids: (U, k) ids of the tokens with the highest scores, the highest first.
        scores: (U, k) float32 logits of these tokens for the value vector behind the model's final norm, which
            removes its length.
        texts: Text of every token by its id.
        scored: Number V of tokens that have a text and are scored.
    """

    family: str
    weights: str
    blocks: NDArray[np.int64]
    units: NDArray[np.int64]
    token_ids: NDArray[np.int64]
    scores: NDArray[np.float32]
    texts: tuple[str, ...]
    scored: int

    def __len__(self) -> int:
        return len(self.units)

    def words_of(self, row: int) -> list[str]:
        """Return the texts of the first tokens of one unit, without space around them."""
        return [self.texts[number].strip() or repr(self.texts[number]) for number in self.token_ids[row]]

    def tokens_of_words(self, words: Sequence[str]) -> NDArray[np.int64]:
        """Return the ids of the tokens that spell one of `words`, in any case, with or without a space in front.

        Raises:
            UsageError: For a word that no single token spells.
        """
        by_word: dict[str, list[int]] = {}
        for number, text in enumerate(self.texts):
            if word := text.strip().casefold():
                by_word.setdefault(word, []).append(number)
        plain = [word.strip().casefold() for word in words]
        if absent := [word for word in plain if word not in by_word]:
            pieces = sorted((word for word in by_word if word and absent[0].startswith(word)), key=len)
            longest = f" Its longest beginning that is a token is {pieces[-1]!r}." if pieces else ""
            raise UsageError(
                f"no single token of {self.family} spells {', '.join(map(repr, absent))}; a unit promotes tokens, "
                f"so that only words of one token can be searched.{longest}"
            )
        return np.array(sorted(number for word in dict.fromkeys(plain) for number in by_word[word]), np.int64)

    def matches(self, words: Sequence[str]) -> NDArray[np.int64]:
        """Return (U,) the number of first tokens of every unit that spell one of `words`; raises as above."""
        of_unit: NDArray[np.int64] = np.isin(self.token_ids, self.tokens_of_words(words)).sum(axis=1)
        return of_unit

    def match(self, words: Sequence[str], shuffles: int = SHUFFLES, seed: int = 0) -> WordMatch:
        """Count the units whose first tokens hold one of `words`, and compare with shuffled embeddings.

        A shuffle gives every token the row of another. Units keep the rows that they promote, so that rows which
        many units promote stay so, and only the words on them change.

        Args:
            words: Words that single tokens spell.
            shuffles: Number of shuffles.
            seed: Seed of the shuffles.

        Raises:
            UsageError: For a word that no single token spells, and for fewer shuffles than one.
        """
        if shuffles < 1:
            raise UsageError(f"--shuffles is {shuffles}; expected 1 or more")
        ids = self.tokens_of_words(words)
        first, draw = self.token_ids.shape[1], np.random.default_rng(seed)
        candidates = np.array([number for number, text in enumerate(self.texts) if text], np.int64)
        is_word = np.zeros(len(self.texts), bool)

        def count(of_tokens: NDArray[np.int64]) -> int:
            is_word[:] = False
            is_word[of_tokens] = True
            return int(is_word[self.token_ids].any(axis=1).sum())

        units = count(ids)
        drawn = [count(draw.choice(candidates, len(ids), replace=False)) for _ in range(shuffles)]
        # C(V − m, k) / C(V, k): the probability that none of a unit's k tokens is one of m among V.
        none = float(np.prod([(self.scored - len(ids) - at) / (self.scored - at) for at in range(first)]))
        return WordMatch(
            tuple(words), tuple(ids.tolist()), units, len(self) * (1 - max(none, 0.0)),
            (1 + sum(number >= units for number in drawn)) / (1 + shuffles), shuffles,
        )  # fmt: skip

    def direction_name(self, row: int) -> str:
        """Return the name under which `write` stores the value vector of a unit, such as `mlp-03-unit-117`."""
        return f"mlp-{self.blocks[row]:02d}-unit-{self.units[row]}"

    def write(self, path: Path, model: "Model", rows: Sequence[int]) -> None:
        """Write the value vectors of some units as a file of directions, which `intervene --direction` reads.

        Each names the site that the block's output enters, such as `backbone.04` for block 3, and the weights.

        Args:
            path: File that ends in `.safetensors` or `.npz`.
            model: The model whose units these are.
            rows: Rows of this object.

        Raises:
            UsageError: For another ending.
        """
        from probe_kit.runs.direction_files import write_directions

        names = [self.direction_name(row) for row in rows]
        common = {"role": "", "space": "raw", "weights": self.weights}
        about = {
            name: {"site": f"{STREAM}.{self.blocks[row] + 1:02d}", **common}
            for name, row in zip(names, rows, strict=True)
        }
        of_block = {block: value_vectors(model, int(block)) for block in set(self.blocks[list(rows)].tolist())}
        vectors = {
            name: of_block[int(self.blocks[row])][int(self.units[row])].float().cpu().numpy()
            for name, row in zip(names, rows, strict=True)
        }
        write_directions(path, vectors, about)


def value_words(
    model: "Model",
    blocks: Sequence[int] | None = None,
    tokens: int = TOKENS,
    progress: Callable[[int, int], None] | None = None,
) -> ValueWords:
    """Read every unit of the feed-forward blocks of a model's backbone in the words of its vocabulary.

    Args:
        model: The model.
        blocks: Blocks of the backbone, counted from 0; None for all.
        tokens: Number of first tokens that are kept of every unit.
        progress: Function that is called with the number of units read so far and of all.

    Raises:
        UnsupportedInterventionError: For a model whose backbone has no vocabulary, and for a block whose
            feed-forward part does not end in one linear map.
        UsageError: For a block that the backbone does not have, and for fewer tokens than one or more than there
            are.
    """
    import torch

    head, texts = _vocabulary_of(model)
    stream = model.streams[STREAM]
    numbers = range(stream.layers - 1) if blocks is None else blocks
    if outside := [block for block in numbers if not 0 <= block < stream.layers - 1]:
        raise UsageError(
            f"block {outside[0]} is not one of the {stream.layers - 1} blocks of {model.card.family}'s {STREAM}, "
            "which are counted from 0"
        )
    scored = sum(map(bool, texts))
    if not 1 <= tokens <= scored:
        raise UsageError(f"{tokens} first tokens were requested; expected 1 to {scored}, the tokens of the model")
    vectors = [value_vectors(model, block) for block in dict.fromkeys(numbers)]
    total, ids, scores = sum(map(len, vectors)), [], []
    without_text = torch.tensor([not text for text in texts])
    for of_block in vectors:
        for start in range(0, len(of_block), _UNITS_AT_ONCE):
            logits = head.logits(of_block[start : start + _UNITS_AT_ONCE]).float()
            best = logits.masked_fill(without_text.to(logits.device), -torch.inf).topk(tokens, dim=-1)
            ids.append(best.indices.cpu().numpy())
            scores.append(best.values.cpu().numpy())
            if progress is not None:
                progress(sum(map(len, ids)), total)
    counts = [len(of_block) for of_block in vectors]
    return ValueWords(
        family=model.card.family,
        weights=str(model.card.weights_sha256 or ""),
        blocks=np.repeat(np.array([*dict.fromkeys(numbers)], np.int64), counts),
        units=np.concatenate([np.arange(count) for count in counts]),
        token_ids=np.concatenate(ids),
        scores=np.concatenate(scores),
        texts=texts,
        scored=scored,
    )


def check_family(family: "Family") -> None:
    """Refuse, before anything is loaded, a family whose units cannot be read in words.

    Raises:
        UnsupportedInterventionError: For such a family.
    """
    if family.abilities.no_words:
        raise UnsupportedInterventionError(
            f"probe-kit words cannot read {family.name}: {family.abilities.no_words}. {_ELSEWHERE}"
        )


_ELSEWHERE = "Take a family with words, such as pi0, openvla or its VLM (docs/capture.md lists them)"


def _vocabulary_of(model: "Model") -> "tuple[Unembedding, tuple[str, ...]]":
    """Return the head that reads the backbone in tokens, and the text of each token that it scores.

    Raises:
        UnsupportedInterventionError: For a model that has none.
    """
    head = model.word_head
    if head is None or STREAM not in head.streams:
        raise UnsupportedInterventionError(
            f"{model.card.family} has no vocabulary in its backbone: its checkpoint holds no head of a language "
            f"model that turns the backbone's residuals into tokens, and no embedding that is shared with one. "
            f"{_ELSEWHERE}"
        )
    texts = model.token_texts()
    if texts is None:
        raise UnsupportedInterventionError(f"{model.card.family} does not say which text its tokens stand for")
    rows = _rows_of(head.head)
    return head, (*texts[:rows], *[""] * (rows - len(texts)))


def _rows_of(head: "nn.Module") -> int:
    """Return the number of tokens that a head scores."""
    (weight,) = (parameter for parameter in head.parameters() if parameter.dim() == 2)
    return int(weight.shape[0])


def value_vectors(model: "Model", block: int) -> "Tensor":
    """Return the value vectors (F, D) of one feed-forward block of the backbone, in the model's dtype.

    They are the columns of the linear map that comes last in the block's feed-forward part. That it comes last is
    proved: what it puts out for random input is what the whole part adds to the stream, bit for bit.

    Args:
        model: The model.
        block: Block of the backbone, counted from 0.

    Raises:
        UnsupportedInterventionError: For a feed-forward part that ends otherwise, such as in a norm (Gemma 2).
    """
    import torch

    part = model.tap(Site(STREAM, block, "mlp")).module
    width, outputs = model.streams[STREAM].width, {}
    linear = [
        module for module in part.modules() if isinstance(module, torch.nn.Linear) and module.out_features == width
    ]

    def keep(module: "nn.Module", _: Any, output: "Tensor") -> None:
        outputs[module] = output

    handles = [module.register_forward_hook(keep) for module in linear]
    try:
        weight = next(part.parameters())
        generator = torch.Generator().manual_seed(0)
        random = torch.randn(1, 2, width, generator=generator).to(weight)
        with torch.inference_mode():
            added = part(random)
    finally:
        for handle in handles:
            handle.remove()
    last = [module for module in linear if module in outputs and torch.equal(outputs[module], added)]
    if len(last) != 1:
        raise UnsupportedInterventionError(
            f"the feed-forward part of block {block} of {model.card.family} ({type(part).__name__}) does not end "
            "in one linear map, so that its units add no vectors of their own to the stream. Read residuals with "
            "the logit lens instead"
        )
    return last[0].weight.detach().T
