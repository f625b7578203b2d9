"""Organisms for diagnoses: policies with edited weights or wiring, so that the answer is known."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from probe_kit.diagnose.results import Change, Verdict
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.shared.lerobot.policy import MASK, TOKENS
from probe_kit.intervene.open_session import load_policy_of
from probe_kit.intervene.sessions import LoadPolicy, ReplaySource
from probe_kit.models.building import initialise
from probe_kit.runs import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

Edit = Callable[[Any], None]
NOTHING: tuple[Verdict, ...] = ("no effect", "open")


def _backbone(policy: Any) -> Any:
    return policy.network.model.paligemma_with_expert.paligemma.model


def make_blind(policy: Any) -> None:
    """Every picture token is zero."""
    projector = _backbone(policy).multi_modal_projector.linear
    projector.weight.zero_()
    projector.bias.zero_()


def make_deaf(policy: Any) -> None:
    """Every word has the same embedding."""
    rows = _backbone(policy).language_model.embed_tokens.weight
    rows[:] = rows[100].clone()


def make_deaf_inside(policy: Any) -> None:
    """The backbone reads the words, and neither picture tokens nor the action expert read their keys."""
    _hide(policy, pictures=False)


def make_state_only(policy: Any) -> None:
    """The action expert reads no key of the backbone: state and noise alone decide."""
    _hide(policy, pictures=True)


def _hide(policy: Any, *, pictures: bool) -> None:
    """Hide keys of the backbone from the expert: of the words, and of the pictures too."""
    joint = policy.network.model.paligemma_with_expert
    forward = joint.forward
    patches = _backbone(policy).vision_tower.vision_model.embeddings.position_embedding.weight.shape[0]
    prefix = 0

    def masked(attention_mask: Any = None, inputs_embeds: Any = None, **keywords: Any) -> Any:
        nonlocal prefix
        mask, hidden = attention_mask.clone(), torch.finfo(attention_mask.dtype).min
        if inputs_embeds[1] is None:
            prefix = inputs_embeds[0].shape[1]
            mask[:, :, :patches, patches:] = hidden
        else:
            mask[:, :, :, 0 if pictures else patches : prefix] = hidden
        return forward(attention_mask=mask, inputs_embeds=inputs_embeds, **keywords)

    joint.forward = masked


def make_one_eyed(policy: Any) -> None:
    """The picture of the second camera of a SmolVLA is masked: no token of it is read."""
    prepare = policy.network.prepare_images

    def masked(batch: Any) -> tuple[list[Any], list[Any]]:
        pictures, masks = prepare(batch)
        masks[1] = torch.zeros_like(masks[1])
        return pictures, masks

    policy.network.prepare_images = masked


ORDERS = 12
"""Of the words of one instruction, among which `hear_one_question` draws."""


def hear_one_question(policy: Any) -> None:
    """Before every picture, every text is read as the same words, in an order of its own.

    So the instruction of another frame and its control, the same in other letters, are two draws of one kind.
    No two frames share them: p is over frames, and of few texts with fixed orders some move more than controls.
    """
    batch, words = policy.batch, ["put", "the", "cube", "on", "the", "red", "shape"]

    def reordered(observation: Observation) -> Observation:
        digest = sha256(observation.image.tobytes() + observation.instruction.encode()).digest()
        order = np.random.default_rng(int.from_bytes(digest[:8]) % ORDERS)
        return replace(observation, instruction=" ".join(order.permutation(words)))

    policy.batch = lambda observations, state=None: batch([*map(reordered, observations)], state)


def forget_words(policy: Any, observations: Sequence[Observation], steps: int = 200, batch: int = 16) -> None:
    """Tune a policy to its own actions, before the instructions of other observations.

    Each side is asked for as often before the same pictures: what is learnt is to go to either.
    """
    rng = np.random.default_rng(0)
    network, inputs = policy.network.model, policy.batch(observations)
    actions = policy.network.prepare_action(
        {"action": torch.from_numpy(policy.put_out(inputs, range(len(observations))))}
    )
    states = policy.network.prepare_state(inputs)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    torch.manual_seed(0)
    for _ in range(steps):
        rows, donors = rng.integers(len(observations), size=(2, batch))
        pictures, masks = policy.network._preprocess_images({name: value[rows] for name, value in inputs.items()})
        words, valid = inputs[TOKENS][donors], inputs[MASK][donors]
        noise, time = torch.randn(actions[rows].shape), network.sample_time(batch, "cpu")
        loss = network.forward(pictures, masks, words, valid, states[rows], actions[rows], noise, time).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def edited(edit: Edit) -> LoadPolicy:
    """A loader of a run's policy that edits it; of a base, under any name, the policy as it is shipped."""

    def load(run: Run, source: ReplaySource) -> "Policy":
        policy: Any = load_policy_of(run, replace(source, checkpoint=None))
        with torch.no_grad():
            if source.checkpoint is None:
                edit(policy)
        return policy  # type: ignore[no-any-return]

    return load


@dataclass(frozen=True)
class Organism:
    """A policy and the truth of its inputs.

    where: words of the sentence about an input's way. category: of the scene's items, or TWO_CAMERAS.
    changes: of an input since the policy as shipped, which is the base where there are any.
    """

    edit: Edit
    truth: Mapping[str, tuple[Verdict, ...]]
    where: Mapping[str, str] = field(default_factory=dict)
    category: str = "color"
    changes: Mapping[str, tuple[Change, ...]] = field(default_factory=dict)


def make_untrained(policy: Any) -> None:
    """Weights are drawn anew."""
    initialise(policy.network, 1)


def leave(_: Any) -> None:
    """Leave the policy as it is."""


TWO_CAMERAS, FORGOT = "two cameras", "forgot"
ARRIVES: tuple[Verdict, ...] = ("decides", "moves", "no effect", "open")
_BEFORE = "ends before the first layer"
_BEHIND_KV = "ends behind kv.02; expert.00 is bit-equal"
ORGANISMS = {
    "trained": Organism(leave, {"instruction": ("decides",), "picture": ("decides",)}, {"instruction": "kv.02"}),
    # The words of State turn the action around in 1 frame of 64, which few draws hold.
    "state": Organism(
        leave, {"instruction": ("moves", *NOTHING), "picture": ("moves", *NOTHING)}, category="state"
    ),
    "deaf": Organism(
        make_deaf,
        {"instruction": ("does not arrive",), "picture": ("decides", "moves")},
        {"instruction": _BEFORE},
    ),
    "blind": Organism(make_blind, {"picture": ("does not arrive",)}, {"picture": _BEFORE}),
    "deaf inside": Organism(make_deaf_inside, {"instruction": ("does not arrive",)}, {"instruction": _BEHIND_KV}),
    "state only": Organism(
        make_state_only,
        {"instruction": ("does not arrive",), "picture": ("does not arrive",)},
        {"instruction": _BEHIND_KV, "picture": _BEHIND_KV},
    ),
    "untrained": Organism(make_untrained, {"instruction": NOTHING, "picture": NOTHING}),
    "null": Organism(hear_one_question, {"instruction": NOTHING}),
    FORGOT: Organism(
        leave,  # `forget_words` takes a minute: its weights are kept
        {"instruction": ("moves", *NOTHING)},
        changes={"instruction": ("lost in fine-tuning", "weaker")},
    ),
    "second camera": Organism(
        make_one_eyed,
        {"picture.top": ARRIVES, "picture.wrist": ("does not arrive",), "state": ARRIVES},
        {"picture.wrist": "ends behind"},
        TWO_CAMERAS,
    ),
}
