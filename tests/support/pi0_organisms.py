"""Organisms for diagnoses: the embedded policy with edited weights or wiring, so that the answer is known."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from probe_kit.diagnose.results import Verdict
from probe_kit.intervene.sessions.session import LoadPolicy, ReplaySource, load_policy_of
from probe_kit.models.initialisation import initialise
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

    def masked(attention_mask: Any = None, inputs_embeds: Any = None, **others: Any) -> Any:
        nonlocal prefix
        mask, hidden = attention_mask.clone(), torch.finfo(attention_mask.dtype).min
        if inputs_embeds[1] is None:
            prefix = inputs_embeds[0].shape[1]
            mask[:, :, :patches, patches:] = hidden
        else:
            mask[:, :, :, 0 if pictures else patches : prefix] = hidden
        return forward(attention_mask=mask, inputs_embeds=inputs_embeds, **others)

    joint.forward = masked


def edited(edit: Edit) -> LoadPolicy:
    """A loader of a run's policy that edits it."""

    def load(run: Run, source: ReplaySource) -> "Policy":
        policy: Any = load_policy_of(run, source)
        with torch.no_grad():
            edit(policy)
        return policy  # type: ignore[no-any-return]

    return load


@dataclass(frozen=True)
class Organism:
    """A policy and the truth of its inputs. where: words of the sentence about an input's way."""

    edit: Edit
    truth: Mapping[str, tuple[Verdict, ...]]
    where: Mapping[str, str]
    category: str = "color"


def make_untrained(policy: Any) -> None:
    """Weights are drawn anew."""
    initialise(policy.network, 1)


def leave(_: Any) -> None:
    """Leave the policy as it is."""


_BEFORE = "ends before the first layer"
_BEHIND_KV = "ends behind kv.02; expert.00 is bit-equal"
ORGANISMS = {
    "trained": Organism(leave, {"instruction": ("decides",), "picture": ("decides",)}, {"instruction": "kv.02"}),
    # The words of State turn the action around in 1 frame of 64, which few draws hold.
    "state": Organism(leave, {"instruction": ("moves", *NOTHING), "picture": ("moves", *NOTHING)}, {}, "state"),
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
    "untrained": Organism(make_untrained, {"instruction": NOTHING, "picture": NOTHING}, {}),
}
