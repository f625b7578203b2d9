"""The adapter for InternVLA-M1.

Backbone: the chat with one picture. Bridge: queries that read the backbone's last states and DINOv2's features.
Expert: what the queries found, then the noisy actions, at every DDIM step. Under guidance the head runs every row
twice. `expert` is the half that has the condition, `expert_unconditional` the one that has none, which only serves
to be subtracted.

References of `verify`: B batch, V views, P prompt positions, L backbone layers, S DDIM steps, C conditions, A
actions of a chunk.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import side_files
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.model import Rows, Tap
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.families.internvla import INTERVENTIONS, ActionUnits
from probe_kit.hooks.families.internvla.checkpoint import Parts, find_parts
from probe_kit.hooks.families.internvla.network import (
    VLM_PREFIX,
    InternVLANetwork,
    Schedule,
    build_internvla,
    dino_pixels,
    look,
    prompt,
    uses_guidance,
)
from probe_kit.hooks.families.shared.action_statistics import DIMENSIONS, open_or_closed
from probe_kit.hooks.families.shared.loading import Loaded, load_network
from probe_kit.hooks.families.shared.qwen.adapter import BACKBONE_ROLES, QwenVLA, recorded_inputs
from probe_kit.hooks.families.shared.qwen.network import QWEN2_5_NAMES, QwenInputs
from probe_kit.hooks.families.shared.taps import decoder_tap
from probe_kit.hooks.families.shared.token_decoder import seeded_noise
from probe_kit.hooks.outputs import Arrays, Outputs, Produce, numpy_of, stream_outputs, watch
from probe_kit.models.checkpoint_files import STATISTICS_FILE, rename_tensor

DEFAULT_CHECKPOINT = "InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge"
STEPS, GUIDANCE = 10, 1.5
"""The number of DDIM steps and the scale of guidance with which the released evaluation runs it."""
_BLOCK = ("residual", "attention", "mlp")
_UNCONDITIONAL = "expert_unconditional"


class InternVLA(QwenVLA):
    """A loaded InternVLA-M1.

    It takes one observation per call: its queries read padding, which changes the actions.
    """

    interventions = INTERVENTIONS
    draws_noise = True

    def __init__(
        self,
        loaded: Loaded[InternVLANetwork],
        parts: Parts,
        unnorm_key: str | None,
        steps: int,
        guidance: float,
        tokenizer: str | None,
    ) -> None:
        super().__init__(loaded.network.vlm, parts.vlm, tokenizer, loaded.device)
        self.network, self.parts, self.config = loaded.network, parts, parts.config
        self.guidance, self._unnorm_key = guidance, unnorm_key
        self.schedule = Schedule.of(steps, self.config.head.steps, self.config.head.schedule)
        self.streams = self._streams()
        dino = self.config.dino
        self.further_streams = {
            "vision": self.vision.stream("vision"),
            "vision_dino": Stream(
                "vision_dino", dino.blocks + 1, dino.width, part="vision", quantities=("residual",)
            ),
        }
        expert = ("condition", "action")
        self.role_names = {"backbone": BACKBONE_ROLES, "bridge": ("query",), "expert": expert}
        if uses_guidance(guidance):
            self.role_names[_UNCONDITIONAL] = expert
        units = self.units_or_reason()
        key, numbers = ("none", "none") if isinstance(units, str) else (units.key, units.sha256)
        note = f"cannot act: {units}" if isinstance(units, str) else f"units of {key}"
        options = {
            "unnorm_key": key,
            "action_statistics": numbers,
            "steps": str(len(self.schedule)),
            "guidance": str(guidance),
        }
        self.card = loaded.card(
            "internvla-m1",
            options,
            files=side_files(parts.run) | side_files(parts.vlm, "vlm/"),
            tokenizer=tokenizer,
            notes=(note, *([f"weights of {parts.weights.name}"] if parts.weights.is_file() else [])),
            embodiment=ARM,
            chunk=self.config.head.length,
            execute=1,
            batch=1,
        )

    def _streams(self) -> dict[str, Stream]:
        query, head, steps = self.config.query, self.config.head, len(self.schedule)
        streams = [
            self.backbone_stream(),
            Stream("bridge", query.last - query.first + 1, query.width, part="bridge", quantities=_BLOCK),
            Stream("expert", head.blocks + 1, head.width, steps, part="action", heads=head.heads),
        ]
        if uses_guidance(self.guidance):
            label = "action expert without condition"
            streams.append(
                Stream(
                    _UNCONDITIONAL,
                    head.blocks + 1,
                    head.width,
                    steps,
                    part="action",
                    label=label,
                    probed=False,
                    heads=head.heads,
                )
            )
        return {stream.name: stream for stream in streams}

    @cached_property
    def units(self) -> ActionUnits:
        """The statistics that give actions their units.

        Raises:
            CheckpointError: If there are none, or bad ones.
            UsageError: For a data set that is not there or has to be chosen.
        """
        source = str(self.parts.run / STATISTICS_FILE)
        return ActionUnits.choose(self.parts.statistics(), self._unnorm_key, source)

    def text(self, instruction: str) -> str:
        """Return Qwen's chat around the prompt the run was trained with."""
        return prompt(instruction, self.config.cot)

    def look(self, observation: Observation) -> NDArray[np.uint8]:
        """Return the whole picture, squeezed to a square."""
        return look(observation.image, self.config.picture)

    def patched_picture(self, observation: Observation) -> NDArray[np.uint8]:
        """Return the picture at whole patches.

        Qwen's utilities bring it there with PIL, before its processor sees it.
        """
        picture = self.look(observation)
        rows, columns = self.pictures.grid(*picture.shape[:2])
        size = (columns * self.pictures.patch, rows * self.pictures.patch)
        if picture.shape[:2] == size[::-1]:
            return picture
        return np.array(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC))

    def views(self, observations: Sequence[Observation]) -> Tensor:
        """Return the pictures (B, 3, H, W) float32 for DINOv2."""
        rows = [dino_pixels(self.look(observation), self.config.dino.side) for observation in observations]
        return torch.stack(rows).to(self.device)

    # -- acting ------------------------------------------------------------------------------------------

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one chunk of actions per observation; see the contract."""
        if (reason := self.embodiment_mismatch()) is not None:
            raise CheckpointError(reason)
        return open_or_closed(self.units.restore(self.infer_without_acting(observations, seeds)))

    def embodiment_mismatch(self) -> str | None:
        """Return a reason where there are no statistics, or for other actions than an end-effector delta."""
        units, head = self.units_or_reason(), self.config.head
        if isinstance(units, str):
            return units
        if len(units.low) == head.action_dim == DIMENSIONS:
            return None
        return (
            f"{units.key} has actions of {len(units.low)} dimensions, the head {head.action_dim}; Act2Answer "
            "needs a 7-DoF end-effector delta. Choose another -M unnorm_key"
        )

    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        """Return (B, A, action numbers) as the head puts them out, without units."""
        self.check(observations, seeds)
        head = self.config.head
        noise = seeded_noise(seeds, (head.length, head.action_dim), self.device)
        output: NDArray[np.float32] = (
            self.infer(self.inputs(observations), self.views(observations), noise).cpu().numpy()
        )
        return output

    def infer(self, inputs: QwenInputs, views: Tensor, noise: Tensor) -> Tensor:
        """Return normalised actions (B, A, action numbers); one inference, as `capture` counts it."""
        with torch.inference_mode():
            condition = self.network.read(inputs, views)
            return self.network.denoise(condition, noise, self.schedule, self.guidance)

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of the chat, of the queries, and of conditions and actions."""
        queries, length = self.config.query.queries, self.config.head.length
        expert = [Roles.from_labels([*["condition"] * queries, *["action"] * length])] * len(observations)
        roles = {"backbone": self.backbone_roles(observations), "expert": expert}
        roles["bridge"] = [Roles.from_labels(["query"] * queries)] * len(observations)
        if _UNCONDITIONAL in self.streams:
            roles[_UNCONDITIONAL] = expert
        return {name: roles[name] for name in self.streams}

    def tap(self, site: Site) -> Tap:
        """Return the first norm of the block the site enters, the last norm, or what a block adds."""
        stream = self.stream_of(site).name
        if stream == "backbone":
            return self.backbone_tap(site)
        if stream == "vision":
            return self.vision.tap(site)
        if stream == "vision_dino":
            body = self.network.dino_encoder.body
            return decoder_tap(body.blocks, body.norm, site, entry="norm1")
        return self._bridge_tap(site) if stream == "bridge" else self._expert_tap(site)

    def _bridge_tap(self, site: Site) -> Tap:
        layers, parts = self.network.layer_qformer.layers, {"attention": "cross_attn", "mlp": "mlp"}
        return decoder_tap(layers, layers[-1], site, entry="norm1", added=parts, end="output")

    def _expert_tap(self, site: Site) -> Tap:
        head, parts = self.network.head, {"attention": "attn", "heads": "attn.proj", "mlp": "mlp"}
        rows = Rows(1 if site.stream == _UNCONDITIONAL else 0, 2 if uses_guidance(self.guidance) else 1)
        norm, steps = head.final_layer.norm_final, len(self.schedule)
        return decoder_tap(head.blocks, norm, site, steps, "norm1", parts, rows=rows)


def internvla_units(checkpoint: str, *, unnorm_key: str | None = None, vlm: str | None = None, **_: Any) -> str:
    """Return the data set whose units the actions get, and what says so; see `Family.units`.

    A checkpoint without statistics says so, since it can be captured.
    """
    parts = find_parts(checkpoint, vlm, unread=True)
    if not (statistics := parts.statistics()):
        return f"none: {parts.run} has no {STATISTICS_FILE}"
    source = str(parts.run / STATISTICS_FILE)
    return f"{ActionUnits.choose(statistics, unnorm_key, source).key}, from {source}"


def load_internvla(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    unnorm_key: str | None = None,
    steps: int = STEPS,
    guidance: float = GUIDANCE,
    vlm: str | None = None,
    tokenizer: str | None = None,
    weights: str | None = None,
    weights_seed: int = 0,
) -> InternVLA:
    """Load InternVLA-M1 from a run's folder, one of its weight files, a converted folder, or a hub id.

    The options are those of the family.

    Raises:
        CheckpointError: For a checkpoint that is not there or cannot be loaded.
        WeightsError: For weights that are not exactly the network's.
        UsageError: For an option that cannot be used.
    """
    name = checkpoint or DEFAULT_CHECKPOINT
    parts = find_parts(name, vlm, weights, unread=random_weights)
    if not np.isfinite(guidance) or guidance < 0:
        raise UsageError(f"guidance is {guidance}; expected a scale such as 1.5")

    loaded = load_network(
        partial(build_internvla, parts.config),
        parts.read,
        name,
        parts.run,
        device,
        dtype,
        random_weights,
        weights_seed,
        name_in_module=_name_in_module,
    )
    return InternVLA(loaded, parts, unnorm_key, steps, guidance, tokenizer)


def _name_in_module(name: str) -> str:
    """The network's name of a tensor; runs on transformers before 4.52 have other ones of Qwen2.5-VL."""
    inside = name.removeprefix(VLM_PREFIX)
    return name if inside == name else f"{VLM_PREFIX}{rename_tensor(inside, QWEN2_5_NAMES)}"


# -- verification ---------------------------------------------------------------------------------------------

_INPUTS = ("cfg_scale", "unnorm_q01", "unnorm_q99", "unnorm_mask")


def internvla_outputs(load: Callable[..., InternVLA], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded inputs through the adapter.

    Whole batches are run, padding included: that padding reaches the actions is part of the original. The backbone
    itself is compared at valid positions.
    """
    steps = len(recorded["ddim_timestep_map"]) if "ddim_timestep_map" in recorded else 10
    guidance = float(recorded["cfg_scale"]) if "cfg_scale" in recorded else 1.5
    checkpoint = str(folder / "checkpoint")
    units = next(
        iter(find_parts(checkpoint, None, unread=True).statistics()), None
    )  # nothing compared depends on them
    policy = load(checkpoint, dtype="float32", steps=steps, guidance=guidance, unnorm_key=units)
    inputs, pixels = recorded_inputs(policy, recorded), _pixels(policy, recorded)
    network, noise = policy.network, torch.from_numpy(recorded["in_noise"])
    modules = {
        "merger": policy.tower.merger,
        "dino": network.dino_encoder.body,
        "projected": network.dino_pro,
        "condition": network.layer_qformer,
        "final": network.head.final_layer,
    }
    actions, activations, calls = watch(
        policy, lambda: policy.infer(inputs, pixels, noise), modules, {"head": network.head}
    )
    streams, vision = stream_outputs(policy, activations), policy.further_streams["vision"]
    halves = [f"{stream.name}_resid" for stream in policy.streams.values() if stream.part == "action"]
    passed = [positional for positional, _ in calls["head"]]

    def states() -> NDArray[Any]:
        return np.concatenate([streams["backbone_resid"]()[:-1], streams["backbone_final_norm"]()[None]])

    produced: dict[str, Produce] = {
        **streams,
        "dino_pixels": lambda: numpy_of(pixels),
        "vision_block_out": lambda: streams["vision_resid"]()[1:].reshape(vision.layers - 1, -1, vision.width),
        "vision_merged": lambda: numpy_of(calls["merger"][0]),
        "dino_block_out": lambda: streams["vision_dino_resid"]()[1:],
        "dino_patchtokens": lambda: numpy_of(calls["dino"][0]),
        "dino_projected": lambda: numpy_of(calls["projected"][0]),
        "position_ids": lambda: numpy_of(inputs.positions(policy.vlm.model)),
        "hf_hidden_states": states,
        "qformer_layer_out": lambda: streams["bridge_resid"]()[1:],
        "condition": lambda: numpy_of(calls["condition"][0]),
        "dit_resid": lambda: np.concatenate([streams[half]() for half in halves], axis=2),
        "dit_final_layer": lambda: numpy_of(torch.stack(calls["final"])),
        "ddim_timesteps_passed": lambda: numpy_of(torch.stack([moments for _, moments, *_ in passed])),
        "ddim_timestep_map": lambda: policy.schedule.moments,
        "ddim_alphas_cumprod": lambda: policy.schedule.signal,
        "x_t": lambda: numpy_of(torch.stack([*(noisy[: len(actions)] for noisy, *_ in passed), actions])),
        "actions": lambda: numpy_of(actions),
        "actions_unnormalized": lambda: _units(policy, recorded).restore(numpy_of(actions)),
    }
    remade = {"dino_pixels": "in_dino_pixels"} if "in_images_uint8" in recorded else {}
    valid = recorded["in_attention_mask"].astype(bool)
    masked = dict.fromkeys(("backbone_resid", "backbone_final_norm", "hf_hidden_states"), valid)
    return Outputs(produced, inputs=_INPUTS, remade=remade, valid=masked)


def _pixels(policy: InternVLA, recorded: Arrays) -> Tensor:
    """Return pictures (B x V, 3, H, W) for DINOv2: made of the recorded pictures, or else as recorded."""
    if "in_images_uint8" not in recorded:
        return torch.from_numpy(recorded["in_dino_pixels"])
    pictures = recorded["in_images_uint8"]
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    return torch.stack([dino_pixels(picture, policy.config.dino.side) for picture in flat])


def _units(policy: InternVLA, recorded: Arrays) -> ActionUnits:
    """The recorded statistics, where there are some; else the checkpoint's."""
    names = {"q01": "unnorm_q01", "q99": "unnorm_q99", "mask": "unnorm_mask"}
    if "unnorm_q01" not in recorded:
        return policy.units
    return ActionUnits.of("recorded", {key: recorded[name] for key, name in names.items() if name in recorded})
