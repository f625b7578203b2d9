"""Policies whose wiring is written down: what the action reads, where, and which copies nothing reads.

One network of 24 channels: 8 image tokens, 4 words, 1 state token; 3 blocks whose values are the `kv` that an
acting stream of one block and two or more iterations reads. A category of episodes selects a wiring. Hooks reach
all of it but an action that bypasses the backbone. Pictures of 8 × 8 pixels show the correct side and a second
property.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import ClassVar, Literal

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hashing import derive_seed
from probe_kit.hooks import ModelCard, Observation, Policy, Roles, Site, Stream, Tap
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.hooks.contract.sites import kv_stream
from probe_kit.hooks.families.shared.taps import kv_tap
from probe_kit.intervene import ConditionOutcomes
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.replay import CLEAN_RUN, SOURCE_RUN, Condition, replay
from probe_kit.intervene.scene_session import SceneSession
from probe_kit.models.decoding import PromptKV

WIDTH, BLOCKS, CHUNK, METRES = 24, 3, 4, 0.15
LEFT, RIGHT, IMAGE, WORDS, STATE = slice(0, 4), slice(4, 8), slice(0, 8), slice(8, 12), 12
TOKENS = 13
MARK, ANSWER, COPY, FACTOR, PRODUCT, EACH, OTHER, LOUD = range(8)
NOISE = 10
"""Channels from here on hold noise."""
ORDINARY = 2.13
"""Mean norm of the words at block 1: one for the copy, 14 channels of noise of half a unit."""


@dataclass(frozen=True)
class Inference:
    """What a reading function may use.

    values: (T, D) of every block, behind all hooks. noise: (9,) of the seed. answer: ±1, as an action
    that bypasses the backbone sees it. is_first: of the episode. is_rare: whether the item is one of a quarter.
    """

    values: Sequence[Tensor]
    noise: Tensor
    answer: float
    is_first: bool
    is_rare: bool

    def words(self, channel: int = ANSWER, block: int = 1) -> Tensor:
        """Mean of a channel over the words."""
        return self.values[block][WORDS, channel].mean()

    @property
    def marks(self) -> Tensor:
        """Which half of the image tokens of block 0 is marked."""
        return self.values[0][LEFT, MARK].mean() - self.values[0][RIGHT, MARK].mean()


@dataclass(frozen=True)
class Wiring:
    """read: the action, 1 for the left tile. copies: channels of the words into which block 0 copies the marks,
    and factors. has_product: whether block 0 codes the answer as a product of two channels. is_everywhere: whether
    all tokens begin with it. decoy: with what factor the image tokens begin with it, in the channel of the copy.
    only_at: the one iteration that reads, or the last one; what it read stays. copied_at: the block that copies
    the marks. has_norms: whether the norms of the words tell the answer. items: with this wiring.
    """

    read: Callable[[Inference], Tensor]
    copies: Mapping[int, float] = field(default_factory=dict)
    has_product: bool = False
    is_everywhere: bool = False
    decoy: float = 0.0
    only_at: int | None = None
    copied_at: int = 0
    has_norms: bool = False
    items: int = 12


def _product(inference: Inference) -> Tensor:
    return inference.words(FACTOR) * inference.words(PRODUCT)


def _of_roles(inference: Inference) -> Tensor:
    """Majority of words, image and state of block 1."""
    block_values = inference.values[1]
    return torch.sign(
        sum(
            torch.sign(reading)
            for reading in (
                block_values[WORDS, EACH].mean(),
                block_values[IMAGE, EACH].mean(),
                block_values[STATE, EACH],
            )
        )
    )


def _of_blocks(inference: Inference) -> Tensor:
    """Majority of the words of all blocks."""
    return torch.sign(sum(torch.sign(inference.words(EACH, block)) for block in range(BLOCKS)))


def _with_backup(inference: Inference) -> Tensor:
    """Block 1; block 2 where that is silent."""
    return inference.words() if inference.words().abs() > 0.5 else inference.words(block=2)


def _with_repair(inference: Inference) -> Tensor:
    """Block 1; the marks where its norm is not the ordinary one."""
    norm = inference.values[1][WORDS].norm(dim=-1).mean()
    return inference.marks if (norm - ORDINARY).abs() > 0.5 else inference.words()


def _of_norms(inference: Inference) -> Tensor:
    """The norms of the words of block 1."""
    return torch.sign(inference.values[1][WORDS].norm(dim=-1).mean() - ORDINARY)


def _of_two_roles(inference: Inference) -> Tensor:
    """The words of block 1, and to a smaller part its state."""
    return 0.55 * inference.words(EACH) + 0.45 * inference.values[1][STATE, EACH]


def _where_the_other_lies_left(inference: Inference) -> Tensor:
    """Block 1 if the picture with the second property lies left, else always left."""
    return inference.words() if inference.values[0][IMAGE, OTHER].mean() > 0 else torch.ones(())


ONE_COPY = {ANSWER: 1.0}
WIRINGS: Mapping[str, Wiring] = {
    "copied": Wiring(lambda inference: inference.words(), ONE_COPY),
    "unread": Wiring(lambda inference: torch.sign(inference.noise[8]), {COPY: 1.0}),
    "nonlinear": Wiring(_product, has_product=True),
    "marks": Wiring(lambda inference: inference.marks),
    "other": Wiring(lambda inference: inference.values[0][IMAGE, OTHER].mean()),
    "constant": Wiring(lambda _: torch.ones(())),
    "noise": Wiring(lambda inference: torch.sign(inference.noise[8])),
    "roles": Wiring(_of_roles, is_everywhere=True),
    "blocks": Wiring(_of_blocks, is_everywhere=True),
    "backup": Wiring(_with_backup, ONE_COPY),
    "repair": Wiring(_with_repair, ONE_COPY),
    "bypass": Wiring(lambda inference: torch.tensor(inference.answer), ONE_COPY),
    "elsewhere": Wiring(lambda inference: inference.marks, {COPY: 1.0}),
    "code": Wiring(_product, {COPY: 1.0}, has_product=True, items=24),
    "decoy": Wiring(lambda inference: 2 * inference.words(), {ANSWER: 0.5, LOUD: 4.0}),
    "weak": Wiring(lambda inference: -0.6 + 0.5 * inference.words(), ONE_COPY),
    "shifted": Wiring(lambda inference: -1 + 0.3 * inference.words(), ONE_COPY),
    "faint": Wiring(lambda inference: 0.2 * inference.words(), ONE_COPY),
    "one-sided": Wiring(
        lambda inference: inference.words() if inference.words() > 0 else torch.tensor(0.05), ONE_COPY
    ),
    "rarely": Wiring(
        lambda inference: inference.words() if inference.is_rare else torch.ones(()), ONE_COPY, items=24
    ),
    "trace": Wiring(lambda inference: -0.6 + 0.033 * inference.words(), ONE_COPY),
    "late": Wiring(lambda inference: torch.zeros(()) if inference.is_first else inference.words(), ONE_COPY),
    "against": Wiring(lambda inference: -inference.words(), ONE_COPY),
    "once": Wiring(lambda inference: inference.words(), ONE_COPY, only_at=7),
    "opposite": Wiring(lambda inference: inference.words(block=2), ONE_COPY, decoy=-1.0),
    "half": Wiring(_where_the_other_lies_left, ONE_COPY, items=24),
    "norms": Wiring(_of_norms, has_norms=True),
    "shared": Wiring(_of_two_roles, is_everywhere=True),
    "beside": Wiring(lambda inference: 0.4 * inference.words() + 0.6 * inference.answer, ONE_COPY),
    "opposing": Wiring(lambda inference: 3 * inference.answer - 2 * inference.words(), ONE_COPY),
    "balance": Wiring(lambda inference: 2 * inference.words() - inference.words(block=2), ONE_COPY),
    "behind": Wiring(lambda inference: inference.marks, ONE_COPY, copied_at=1),
    "either": Wiring(lambda inference: inference.words() * (-1 if inference.is_rare else 1), ONE_COPY),
}


class _Block(nn.Module):
    """A place for hooks at what a norm, an attention and an MLP get or give."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.attention, self.mlp = nn.Identity(), nn.Identity(), nn.Identity()


class _Network(nn.Module):
    def __init__(self, iterations: int) -> None:
        super().__init__()
        self.iterations = iterations
        self.blocks = nn.ModuleList(_Block() for _ in range(BLOCKS))
        self.norm, self.prompt_kv = nn.Identity(), PromptKV(BLOCKS)
        self.acting, self.acting_norm = _Block(), nn.Identity()

    def values(self, tokens: Tensor, wiring: Wiring) -> list[Tensor]:
        """(T, D) of every block, from the (1, T, D) embedded tokens."""
        residuals = []
        for number, block in enumerate(self.blocks):
            residual = block.norm(tokens)
            residuals.append(residual[:, None].clone())
            is_copied = number == wiring.copied_at
            change = self._copied(residual, wiring) if is_copied else torch.zeros_like(residual)
            tokens = residual + block.attention(change)
            tokens = tokens + block.mlp(torch.zeros_like(tokens))
        self.norm(tokens)
        keys, values = self.prompt_kv.keys, self.prompt_kv.values
        for passage in keys:
            passage(torch.zeros_like(residuals[0]))
        return [passage(block_residual)[0, 0] for passage, block_residual in zip(values, residuals, strict=True)]

    def act(self, inference: Inference, wiring: Wiring) -> Tensor:
        """The action after the last iteration, 1 for the left tile."""
        last = self.iterations - 1
        only_at = None if wiring.only_at is None else min(wiring.only_at, last)
        tokens = torch.zeros(1, 2, WIDTH)
        for iteration in range(self.iterations):
            passed_on = tokens[0, 1, 0]
            tokens = torch.zeros(1, 2, WIDTH)
            tokens[0, 1, NOISE : NOISE + 7] = inference.noise[:7]
            tokens = self.acting.norm(tokens)
            change = torch.zeros_like(tokens)
            change[0, 1, 0] = wiring.read(inference) if only_at in (None, iteration) else passed_on
            tokens = tokens + self.acting.attention(change)
            tokens = self.acting_norm(tokens + self.acting.mlp(torch.zeros_like(tokens)))
        return tokens[0, 1, 0]

    def _copied(self, residual: Tensor, wiring: Wiring) -> Tensor:
        marks = residual[0, LEFT, MARK].mean() - residual[0, RIGHT, MARK].mean()
        change = torch.zeros_like(residual)
        for channel, factor in wiring.copies.items():
            change[0, WORDS, channel] = factor * marks
        if wiring.has_product:
            change[0, WORDS, PRODUCT] = marks * residual[0, WORDS, FACTOR].mean()
        return change


class WiredPolicy(Policy):
    """Acts by the wiring that the instruction names: `wiring:item`."""

    interventions: ClassVar[Interventions] = Interventions(prompt_kv=True, unread=("backbone",), gradients=True)
    role_names: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "backbone": ("image.primary", "language", "state"), "expert": ("state", "action"),
    }  # fmt: skip

    def __init__(self, iterations: int = 2) -> None:
        self.network = _Network(iterations).eval()
        self.card = ModelCard(
            family="wired", checkpoint="built", weights_sha256="0" * 64, random_weights=False, parameters=0,
            dtype="float32", device="cpu", embodiment="7-DoF end-effector delta", cameras=("primary",),
            chunk=CHUNK, execute=CHUNK,
        )  # fmt: skip
        self.streams = {
            "backbone": Stream("backbone", BLOCKS + 1, WIDTH), "expert": Stream("expert", 2, WIDTH, iterations),
        }  # fmt: skip
        self.prompt_kv = kv_stream(BLOCKS, WIDTH)

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Metres toward the tile in the lateral coordinate; 4 mm of it are noise."""
        self.check(observations, seeds)
        chunks = np.zeros((len(observations), CHUNK, 7), np.float32)
        with torch.inference_mode():
            for row, (observation, seed) in enumerate(zip(observations, seeds, strict=True)):
                chunks[row, :, 1] = float(self._lateral(observation, seed)) / CHUNK
        return chunks

    def differentiable(self, observations: Sequence[Observation], seeds: Sequence[int]) -> Tensor:
        """The same with a graph; what decides by a sign has no slope."""
        self.check(observations, seeds)
        lateral = torch.stack(
            [self._lateral(observation, seed) for observation, seed in zip(observations, seeds, strict=True)]
        )
        chunks = torch.zeros(len(observations), CHUNK, 7)
        chunks[:, :, 1] = lateral[:, None] / CHUNK
        return chunks

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The same of every observation."""
        backbone = Roles.from_labels(["image.primary"] * 8 + ["language"] * 4 + ["state"])
        expert = Roles.from_labels(["state", "action"])
        return {"backbone": [backbone] * len(observations), "expert": [expert] * len(observations)}

    def tap(self, site: Site) -> Tap:
        """Inputs of norms for residuals, outputs of attention and MLP."""
        stream, network = self.stream_of(site), self.network
        if stream is self.prompt_kv:
            return kv_tap(network.prompt_kv, site)
        of_backbone = stream.name == "backbone"
        fires = 1 if of_backbone else network.iterations
        blocks, norm = (network.blocks, network.norm) if of_backbone else ([network.acting], network.acting_norm)
        if site.quantity == "final_norm" or site.layer == len(blocks):
            return Tap(norm, fires, "output" if site.quantity == "final_norm" else "input")
        block = blocks[site.layer]
        if site.quantity == "residual":
            return Tap(block.norm, fires)
        return Tap(getattr(block, site.quantity), fires, "output")

    def _lateral(self, observation: Observation, seed: int) -> Tensor:
        name, _, item = observation.instruction.partition(":")
        wiring, answer, other = WIRINGS[name], _sign(observation, 0), _sign(observation, 1)
        noise = torch.randn(9, generator=torch.Generator().manual_seed(seed))
        values = self.network.values(_embedded(name, item, answer, other), wiring)
        is_first, is_rare = bool(observation.state[0] < 0.01), int(item) % 8 < 2
        action = self.network.act(Inference(values, noise, answer, is_first, is_rare), wiring)
        return action * METRES + 0.004 * noise[7]


def _sign(observation: Observation, colour: int) -> float:
    return 1.0 if observation.image[0, 0, colour] > observation.image[0, 4, colour] else -1.0


def _embedded(name: str, item: str, answer: float, other: float) -> Tensor:
    """(1, T, D) tokens of one observation."""
    draw = np.random.default_rng(derive_seed("wiring", 0, name, item, str(answer)))
    tokens = np.zeros((1, TOKENS, WIDTH), np.float32)
    tokens[0, :, NOISE:] = draw.normal(size=(TOKENS, WIDTH - NOISE)) * 0.5
    tokens[0, LEFT, MARK], tokens[0, RIGHT, MARK] = answer > 0, answer < 0
    tokens[0, IMAGE, OTHER] = other
    if WIRINGS[name].has_product:
        tokens[0, WORDS, FACTOR] = draw.choice([-1.0, 1.0])
    if WIRINGS[name].has_norms:
        tokens[0, WORDS, NOISE:] *= 1.6 if answer > 0 else 0.4
    tokens[0, IMAGE, ANSWER] += WIRINGS[name].decoy * answer
    if WIRINGS[name].is_everywhere:
        tokens[0, :, EACH] = answer
    return torch.from_numpy(tokens)


# -- episodes --------------------------------------------------------------------------------------------------


class WiredSession(SceneSession):
    """A replay session without a simulator: the tiles lie left and right of zero."""

    def __init__(self, iterations: int = 2) -> None:
        self.policy, self.on_fit_progress, self.certificate = WiredPolicy(iterations), None, {}
        inputs = [replay_input for name in WIRINGS for replay_input in replay_inputs(name)]
        columns = {
            "category": [replay_input.category for replay_input in inputs],
            "item_id": [replay_input.item for replay_input in inputs],
        }
        self.run = SimpleNamespace(model="wired", episodes=pd.DataFrame(columns))  # type: ignore[assignment]
        self._middle, self._across = np.zeros(2), np.array([0.0, 1.0])

    def pairs(self, item: str) -> list[Pair]:
        """Both layouts of one item."""
        return [
            replay_input for replay_input in replay_inputs(item.rpartition("-")[0]) if replay_input.item == item
        ]


def replay_inputs(name: str, x: float = 0.0) -> list[Pair]:
    """Two layouts of every item, each a group of its own. x: where the hand is, zero before the first chunk."""
    state = np.array([x, 0, 0.13, 0, 0, 0, 0, 0.8], np.float32)
    pairs = []
    for item in range(WIRINGS[name].items):
        answer = 1.0 if item % 2 else -1.0
        other = float(np.random.default_rng(derive_seed("other", 0, name, str(item))).choice([-1, 1]))
        layouts = [Observation(_picture(sign * answer, sign * other), state, f"{name}:{item}") for sign in (1, -1)]
        for number, sign in enumerate((1.0, -1.0)):
            side: Literal["left", "right"] = "left" if sign * answer > 0 else "right"
            pairs.append(
                Pair(
                    clean=layouts[number],
                    source=layouts[1 - number],
                    seed=1000 + item,
                    toward=-1 if side == "left" else 1,
                    group=f"{name}-{item}",
                    item=f"{name}-{item}",
                    row=len(pairs),
                    episode=f"{name}-{item}:{'os'[number]}",
                    category=name,
                    side=side,
                )
            )
    return pairs


def _picture(answer: float, other: float) -> NDArray[np.uint8]:
    image = np.zeros((8, 8, 3), np.uint8)
    for colour, sign in enumerate((answer, other)):
        image[:, :4, colour], image[:, 4:, colour] = 255 * (sign > 0), 255 * (sign < 0)
    return image


def outcomes_of(
    session: WiredSession, names: Sequence[str], more_conditions: Sequence[Condition] = (), calls: int = 1
) -> ConditionOutcomes:
    """What swapped images and further conditions do, as `run_intervention` stores it.

    calls: inferences of an episode, whose displacements are summed; the hand leaves its place after the first.
    """
    conditions: list[Condition] = [CLEAN_RUN, SOURCE_RUN, *more_conditions]
    inputs = [replay_input for name in names for replay_input in replay_inputs(name)]
    outcomes = replay(session, inputs, conditions)
    for _ in range(calls - 1):
        later = replay(
            session, [replay_input for name in names for replay_input in replay_inputs(name, 0.03)], conditions
        )
        outcomes.displacement[:] += later.displacement
    return replace(outcomes, chunks=None)
