"""The network, its adapter and its loader."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from probe_kit.errors import InstructionError
from probe_kit.hooks import ModelCard, Observation, Policy, Roles, Site, Stream, Tap
from probe_kit.hooks.checkpoints.checkpoint import content_hashes, side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import Weights, load_weights, read_weights
from probe_kit.models.building import initialise

WIDTH, BLOCKS, STEPS, CHUNK, PATCHES, LETTERS = 16, 2, 2, 4, 16, 48


def encoder() -> nn.TransformerEncoder:
    layer = nn.TransformerEncoderLayer(
        WIDTH, 2, 32, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
    )
    return nn.TransformerEncoder(layer, BLOCKS, nn.LayerNorm(WIDTH), enable_nested_tensor=False)


class EncoderVLA(nn.Module):
    """Both streams are torch's encoders; the expert reads the mean of the backbone's tokens as its first token."""

    def __init__(self) -> None:
        super().__init__()
        self.patches, self.letters = nn.Conv2d(3, WIDTH, 16, 16), nn.Embedding(256, WIDTH)
        self.places, self.when = nn.Embedding(PATCHES + LETTERS, WIDTH), nn.Embedding(STEPS, WIDTH)
        self.state, self.noisy = nn.Linear(8, WIDTH), nn.Linear(7, WIDTH)
        self.backbone, self.expert = encoder(), encoder()
        self.velocity = nn.Linear(WIDTH, 7)

    def forward(self, image: Tensor, letters: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1], (B, LETTERS), (B, 8), noise (B, CHUNK, 7) -> actions (B, CHUNK, 7)."""
        image = functional.interpolate(image, (64, 64), mode="bilinear")
        tokens = torch.cat([self.patches(image).flatten(2).mT, self.letters(letters)], 1) + self.places.weight
        padding = functional.pad(letters == 0, (PATCHES, 0), value=False)
        hidden = self.backbone(tokens, src_key_padding_mask=padding) * ~padding[..., None]
        pooled = hidden.sum(1) / (~padding).sum(1)[:, None]
        for step in range(STEPS):
            prefix = torch.stack([pooled, self.state(state)], 1)
            x = torch.cat([prefix, self.noisy(action) + self.when.weight[step]], 1)
            action = action + self.velocity(self.expert(x))[:, 2:] / STEPS
        return action


class EncoderPolicy(Policy):
    draws_noise = True
    streams = {
        "backbone": Stream("backbone", BLOCKS + 1, WIDTH),
        "expert": Stream("expert", BLOCKS + 1, WIDTH, STEPS),
    }
    role_names = {
        "backbone": ("image.primary", "language", "padding"),
        "expert": ("special", "state", "action"),
    }

    def __init__(self, network: EncoderVLA, card: ModelCard) -> None:
        self.network, self.card = network, card

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        self.check(observations, seeds)
        image = torch.stack(
            [torch.from_numpy(observation.image).permute(2, 0, 1) / 255 for observation in observations]
        )
        state = torch.from_numpy(np.stack([observation.state for observation in observations]))
        noise = [torch.randn(CHUNK, 7, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        with torch.inference_mode():
            raw = self.network(image, self._letters(observations), state, torch.stack(noise))
        return np.asarray(torch.cat([0.02 * raw[..., :6], raw[..., 6:].sigmoid()], -1).numpy())

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        lengths = (self._letters(observations) > 0).sum(1).tolist()
        rows = [["image.primary"] * PATCHES + ["language"] * n + ["padding"] * (LETTERS - n) for n in lengths]
        suffix = Roles.from_labels(["special", "state", *["action"] * CHUNK])
        return {"backbone": [Roles.from_labels(row) for row in rows], "expert": [suffix] * len(rows)}

    def tap(self, site: Site) -> Tap:
        stream = self.stream_of(site)
        stack: nn.TransformerEncoder = getattr(self.network, stream.name)
        fires = stream.iterations or 1
        if site.quantity == "final_norm" or site.layer == BLOCKS:
            assert stack.norm is not None
            return Tap(stack.norm, fires, "output" if site.quantity == "final_norm" else "input")
        block = stack.layers[site.layer]
        if site.quantity == "residual":
            return Tap(block.norm1, fires)
        return Tap(block.dropout1 if site.quantity == "attention" else block.dropout2, fires, "output")

    @staticmethod
    def _letters(observations: Sequence[Observation]) -> Tensor:
        texts = [observation.instruction.encode() for observation in observations]
        if too_long := [text.decode() for text in texts if len(text) > LETTERS]:
            raise InstructionError(f"{too_long[0]!r} has more than {LETTERS} letters; shorten it")
        return torch.tensor([list(text) + [0] * (LETTERS - len(text)) for text in texts])


def load(
    checkpoint: str, device: str = "cpu", dtype: str | None = None, random_weights: bool = False,
    weights_seed: int = 0,
) -> EncoderPolicy:  # fmt: skip
    folder = checkpoint_folder(checkpoint)
    network = EncoderVLA()
    if random_weights:
        initialise(network, weights_seed)
        weights = Weights(
            {name: tensor.clone() for name, tensor in network.state_dict().items()}, f"seed {weights_seed}",
            random=True,
        )  # fmt: skip
    else:
        weights = read_weights(folder)
    audit = load_weights(network, weights, weights.tensors)
    card = ModelCard(
        family="encoder-vla",
        checkpoint=checkpoint,
        weights_sha256=audit.sha256,
        random_weights=audit.random,
        weights_seed=weights_seed if random_weights else None,
        parameters=audit.parameters,
        dtype=dtype or "float32",
        device=device,
        embodiment="7-DoF end-effector delta",
        cameras=("primary",),
        chunk=CHUNK,
        execute=2,
        audit=audit.to_json(),
        settings=content_hashes(side_files(folder)),
    )
    return EncoderPolicy(network.eval().requires_grad_(False), card)


def write_checkpoint(folder: Path) -> Path:
    """Random weights, which the file says."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"type": "encoder-vla"}), encoding="utf-8")
    torch.manual_seed(0)
    save_file(EncoderVLA().state_dict(), folder / "model.safetensors", {"probe_kit.weights": "random, seed 0"})
    return folder
