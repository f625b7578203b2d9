"""Quantities in which SpatialVLA is compared with its golden reference.

B batch, P patches, T prompt tokens with the picture's, L blocks, N output tokens.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.capturing.capture_context import ActivationCache
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.spatialvla.actions import STEP_TOKENS
from probe_kit.hooks.families.spatialvla.adapter import (
    SCENE,
    LoadedSpatialVLA,
    SpatialVLA,
    Speech,
    choose_statistics,
    load_checkpoint,
)
from probe_kit.hooks.families.spatialvla.network import (
    Sight,
    depth_input,
    known_cameras,
    point_places,
    prepare_picture,
)
from probe_kit.hooks.outputs import (
    Arrays,
    Outputs,
    Produce,
    generation_outputs,
    numpy_of,
    pass_outputs,
    stack_layers,
    watch,
)

TOLERANCE = 5e-5
_INPUTS = (
    "image_uint8", "intrinsic_raw", "input_ids", "attention_mask", "batch_input_ids", "batch_attention_mask",
    "batch_pixel_values", "batch_intrinsic", "forced_ids", "tok_actions",
)  # fmt: skip


def spatialvla_outputs(_: Callable[..., Any], folder: Path, recorded: Arrays) -> Outputs:
    """Compare a reference of a policy, at the tolerance that ZoeDepth's long chain of convolutions needs."""
    loaded = load_checkpoint(str(folder / "checkpoint"), "cpu", "float32", random_weights=False)
    valid: dict[str, NDArray[np.bool_]] = {}
    if "batch_attention_mask" in recorded:
        mask = recorded["batch_attention_mask"].astype(bool)
        valid = dict.fromkeys(("batch_hidden_states", "batch_logits"), mask)
    return Outputs(_Reference(loaded, recorded).produced(), TOLERANCE, _INPUTS, valid=valid)


class _Reference:
    """The recorded inputs, run through the adapter."""

    def __init__(self, loaded: LoadedSpatialVLA, recorded: Arrays) -> None:
        self.loaded, self.recorded = loaded, recorded
        generated = recorded.get("generated_ids")
        self.policy = self._policy(STEP_TOKENS * loaded.chunk if generated is None else generated.size)
        self.seen = [
            Observation(recorded["image_uint8"], np.zeros(8, np.float32), "", recorded.get("intrinsic_raw"))
        ]
        self.prompt: list[int] = recorded["input_ids"].ravel().tolist()
        self.pictures, self.cameras = self.policy.pictures(self.seen), self.policy.cameras(self.seen)

    def _policy(self, steps: int) -> SpatialVLA:
        """Return the ordinary adapter, capturing every one of `steps` tokens."""
        loaded = self.loaded
        speech = Speech.of(loaded.config, loaded.folder, None, lowercase=True, tokenizer=None)
        camera = _camera(loaded, self.recorded)
        return SpatialVLA(loaded, speech, choose_statistics(loaded, None), camera, steps, steps, constrained=False)

    def produced(self) -> dict[str, Produce]:
        """Return functions that make every output the adapter can make, whether recorded or not."""
        return {**self._sight(), **self._language(), **self._tokens()}

    # -- picture, depth, space ---------------------------------------------------------------------------

    @cached_property
    def _sight_of_pictures(self) -> Sight:
        with torch.inference_mode():
            return self.policy.network.look(self.pictures, self.cameras)

    def _sight(self) -> dict[str, Produce]:
        config, settings = self.policy.config, self.policy.picture_settings
        image, patch = self.recorded["image_uint8"], int(self.policy.config.vision.patch_size)
        produced: dict[str, Produce] = {
            "pixel_values": lambda: _numpy(self.pictures),
            "pixel_values_224": lambda: prepare_picture(image, replace(settings, side=224))[None],
            "intrinsic": lambda: _numpy(self.cameras[0]),
            "siglip_hidden_states": lambda: stack_layers(self._spoken[1], self.policy.further_streams["vision"])[
                0
            ],
            "siglip_last_hidden_state": lambda: _numpy(self._sight_of_pictures.tower),
            # The original divides by what Gemma-2 multiplies with; see `SpatialVLANetwork.embed`.
            "image_features": lambda: _numpy(self._sight_of_pictures.features) / np.sqrt(config.text.hidden_size),
        }
        if config.depth is None:
            return produced
        return produced | {
            "zoe_pixel_values_sub": lambda: self._thinned(depth_input(self.pictures), "zoe_pixel_values_sub"),
            "depth_raw_sub": lambda: self._thinned(self._depth().raw, "depth_raw_sub"),
            "domain_logits": lambda: _numpy(self._depth().domains),
            "depth": lambda: _numpy(self._depth().metres),
            "uv_h": lambda: _numpy(point_places(config.side, patch, config.points)),
            "xyz": lambda: _numpy(self._sight_of_pictures.points),
            "position_embedding_3d": lambda: _numpy(self._sight_of_pictures.positions),
        }

    def _depth(self) -> Any:
        return self._sight_of_pictures.depth

    def _thinned(self, full_map: Tensor, name: str) -> NDArray[Any]:
        """Return every n-th pixel of a large map, as it is recorded."""
        every = max(1, round(full_map.shape[-1] / self.recorded[name].shape[-1]))
        return _numpy(full_map[..., ::every, ::every])

    # -- language model ----------------------------------------------------------------------------------

    def _run(self, policy: SpatialVLA, fed: Tensor | None = None) -> tuple[dict[str, Produce], ActivationCache]:
        """Return the quantities of the prompt, and of output tokens `fed` in the place of the policy's own."""
        decoded, activations, _ = watch(
            policy, lambda: policy.generate(self.pictures, self.cameras, [self.prompt], fed)
        )
        return generation_outputs(policy, "action", activations, decoded), activations

    @cached_property
    def _spoken(self) -> tuple[dict[str, Produce], ActivationCache]:
        return self._run(self.policy)

    @cached_property
    def _forced(self) -> dict[str, Produce]:
        fed = torch.from_numpy(self.recorded["forced_ids"].reshape(1, -1))
        return self._run(self._policy(fed.shape[1] + 1), fed)[0]

    def _language(self) -> dict[str, Produce]:
        return {
            **self._spoken[0],
            "logits": self._prompt_logits,
            **pass_outputs(batch=self._batch),
            "forced_step_logits": lambda: self._forced["generated_step_logits"](),
            "forced_step_hidden": lambda: self._forced["generated_step_hidden"](),
        }

    @torch.inference_mode()
    def _prompt_logits(self) -> NDArray[Any]:
        packed = self.policy.pack([self.prompt])
        embeddings = self.policy.network.embed(packed.ids, self._sight_of_pictures.features)
        return _numpy(self.policy.network(embeddings, packed.mask).logits)

    @torch.inference_mode()
    def _batch(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return hidden states and logits of the recorded batch, packed as the adapter packs it.

        They are put into the recorded layout, in which padding stands elsewhere. One head measures the depth of
        all rows, as when it was recorded.
        """
        recorded, network = self.recorded, self.policy.network
        mask = recorded["batch_attention_mask"].astype(bool)
        rows = [ids[valid].tolist() for ids, valid in zip(recorded["batch_input_ids"], mask, strict=True)]
        packed = self.policy.pack(rows)
        pictures, cameras = (torch.from_numpy(recorded[f"batch_{n}"]) for n in ("pixel_values", "intrinsic"))
        features = network.look(pictures, cameras, vote=True).features
        output = network(network.embed(packed.ids, features), packed.mask)
        ours = _numpy(torch.stack(output.hidden_states)), _numpy(output.logits)
        states = np.zeros((len(ours[0]), *mask.shape, ours[0].shape[-1]), np.float32)
        logits = np.zeros((*mask.shape, ours[1].shape[-1]), np.float32)
        states[:, mask], logits[mask] = ours[0][:, packed.mask.numpy()], ours[1][packed.mask.numpy()]
        return states, logits

    # -- actions -----------------------------------------------------------------------------------------

    def _tokens(self) -> dict[str, Produce]:
        bins, policy = self.policy.bins, self.policy
        every = np.repeat(np.arange(policy.config.text.vocab_size)[:, None], STEP_TOKENS, axis=1)
        produced: dict[str, Produce] = {
            "decode_table": lambda: bins.values(every),
            "actions_from_generated": lambda: policy.actions(
                self._spoken[0]["generated_ids"]().reshape(-1, STEP_TOKENS)
            ),
        }
        if "tok_actions" in self.recorded:
            ids = bins.ids(self.recorded["tok_actions"])
            chunk = ids[: self.loaded.chunk]
            produced |= {
                "tok_ids": lambda: ids,
                "tok_decoded": lambda: bins.values(ids),
                "action_ids_from_tok": lambda: chunk,
                "actions_from_tok_ids": partial(policy.actions, chunk),
            }
        return produced


def _camera(loaded: LoadedSpatialVLA, recorded: Arrays) -> str:
    """Return the key of the recorded camera; `scene` if the checkpoint knows none like it.

    The key does not depend on what took the picture.
    """
    matrix = recorded.get("intrinsic_raw")
    for key, camera in known_cameras(loaded.processor, loaded.processor_file).items():
        if matrix is not None and np.array_equal(camera.matrix.astype(np.float32), matrix.astype(np.float32)):
            return key
    return SCENE


def _numpy(tensor: Tensor | None) -> NDArray[Any]:
    """Return an array; NaN for what is not there, which equals nothing."""
    return np.full(1, np.nan) if tensor is None else numpy_of(tensor)
