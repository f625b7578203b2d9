"""Organisms for diagnoses: policies with edited weights or wiring, so that the answer is known."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from probe_kit.diagnose.results import Change, Verdict
from probe_kit.extract import ExtractSettings
from probe_kit.extract.extraction import prepare
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.pi0.adapter import load_pi0_tiny
from probe_kit.hooks.families.shared.lerobot.packing import MASK, TOKENS
from probe_kit.intervene.open_session import load_policy_of
from probe_kit.intervene.sessions import LoadPolicy, ReplayFiles
from probe_kit.models.building import initialise
from probe_kit.runs import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

Edit = Callable[[Any], None]
NOTHING: tuple[Verdict, ...] = ("no effect", "open")


def _backbone(policy: Any) -> Any:
    return policy.network.model.paligemma_with_expert.paligemma.model


def _count_patches(policy: Any) -> int:
    """The number of picture tokens, which come first among those of the backbone."""
    return int(_backbone(policy).vision_tower.vision_model.embeddings.position_embedding.weight.shape[0])


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
    patches = _count_patches(policy)
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


def _hide_from_blocks(policy: Any, blocks: Sequence[int], *, words: bool = False) -> None:
    """Hide the picture's tokens from these blocks of the action expert, and the words too where `words`."""
    joint = policy.network.model.paligemma_with_expert
    patches = _count_patches(policy)

    def masked(module: Any, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        del module
        mask = keywords["attention_mask"].clone()
        # Behind the backbone's tokens are those of the expert itself: as many as there are queries.
        hidden = mask.shape[-1] - mask.shape[-2] if words else patches
        mask[..., :hidden] = torch.finfo(mask.dtype).min
        return arguments, {**keywords, "attention_mask": mask}

    for block in blocks:
        attention = joint.gemma_expert.model.layers[block].self_attn
        attention.register_forward_pre_hook(masked, with_kwargs=True)


def _change_prefix(policy: Any, change: Callable[[Any], Any] | None, cached: Callable[[Any], None]) -> None:
    """Change the mask of the backbone's own pass, and the keys and values that it leaves behind."""
    joint = policy.network.model.paligemma_with_expert
    forward = joint.forward

    def changed(attention_mask: Any = None, inputs_embeds: Any = None, **other_items: Any) -> Any:
        is_prefix = inputs_embeds[1] is None
        mask = change(attention_mask.clone()) if is_prefix and change else attention_mask
        outputs = forward(attention_mask=mask, inputs_embeds=inputs_embeds, **other_items)
        if is_prefix:
            cached(outputs[1])
        return outputs

    joint.forward = changed


def keep_words_from_pictures(policy: Any) -> None:
    """No word reads a picture token in the backbone."""
    patches = _count_patches(policy)

    def masked(mask: Any) -> Any:
        mask[:, :, patches:, :patches] = torch.finfo(mask.dtype).min
        return mask

    _change_prefix(policy, masked, lambda _: None)


def read_pictures_in_the_last_block(policy: Any) -> None:
    """Only block 2 of the expert reads picture tokens, and no word carries what they say."""
    keep_words_from_pictures(policy)
    _hide_from_blocks(policy, (0, 1))


def read_words_only(policy: Any) -> None:
    """No block of the expert reads picture tokens, and no word carries what they say."""
    keep_words_from_pictures(policy)
    _hide_from_blocks(policy, (0, 1, 2))


TILE_TOKENS = (3, 5, 6, 7, 8, 9, 10, 11)
"""Picture tokens of `pi0-tiny` that show the tiles, one for each word of an instruction of Color."""


def read_pictures_through_words(policy: Any) -> None:
    """The words' keys and values are those of the tiles, and the expert reads no picture token itself."""
    patches = _count_patches(policy)
    words = slice(patches, patches + len(TILE_TOKENS))

    def relay(cache: Any) -> None:
        for layer in cache.layers:
            for tensor in (layer.keys, layer.values):
                tensor[:, :, words] = tensor[:, :, list(TILE_TOKENS)]

    _change_prefix(policy, None, relay)
    _hide_from_blocks(policy, (0, 1, 2))


def read_nothing(policy: Any) -> None:
    """The expert reads no token of the backbone: state and noise alone decide."""
    _hide_from_blocks(policy, (0, 1, 2), words=True)


Reading = Mapping[str, tuple[int, int] | bool]
"""By role whether it is read; the first and last layer, where the edit and not the weights decide them."""
READERS: Mapping[str, tuple[Edit, Reading]] = {
    "the picture in block 2": (read_pictures_in_the_last_block, {"image": (2, 2)}),
    "words only": (read_words_only, {"image": False, "language": True}),
    "the picture through the words": (read_pictures_through_words, {"image": False, "language": True}),
    "nothing": (read_nothing, {"image": False, "language": False}),
}
"""Policies for a knockout, and what they read of the instructions and pictures of Color."""


def is_true_of(truth: tuple[int, int] | bool, layers: tuple[int, int] | None) -> bool:
    """Whether the layers in which a role is said to be read, None for none, are the truth."""
    return layers == truth if isinstance(truth, tuple) else (layers is not None) == truth


def reader_run(edit: Edit, out: Path, seed: int, items: int = 12) -> tuple[Run, LoadPolicy]:
    """The beginning of episodes that an edited policy plays, and the loader of that policy."""
    policy: Any = load_pi0_tiny()
    with torch.no_grad():
        edit(policy)
    settings = ExtractSettings(
        "pi0-tiny",
        categories=("color",),
        items=items,
        env_workers=0,
        seed=seed,
        max_steps=10,
        accept_ignored_inputs=True,
    )
    return prepare(settings, out, model=policy).run(out, progress=lambda *_: None), edited(edit)


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

    def load(run: Run, source: ReplayFiles) -> "Policy":
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
