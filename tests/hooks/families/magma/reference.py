"""A golden reference in the recorded layout, made by other code than ours: loops where the package has tensors,
padding in front of rows, no cache. So that a clean clone can verify, at sizes that no code was tuned to.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torchvision.transforms.functional import normalize, to_tensor

from probe_kit.hooks.families.magma.network import MagmaNetwork
from tests.hooks.families.magma.checkpoints import IDS, config_values, small_network, weights, write_checkpoint

MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
IMAGE, PAD = IDS["<image>"], IDS["<pad>"]
SHORT = [IDS["<|begin_of_text|>"], 33, IDS["<image_start>"], IMAGE, IDS["<image_end>"], 40, 41, 7]
LONG = [*SHORT[:2], 34, 35, 36, *SHORT[2:-1], 42, 8]


def write_reference(
    folder: Path, sizes: tuple[tuple[int, int], tuple[int, int]], steps: int, seed: int, **fields: Any
) -> Path:
    """Checkpoint and recorded outputs for two pictures of these (height, width)."""
    network = small_network(seed=seed, **fields)
    values = config_values(**fields)
    checkpoint = write_checkpoint(folder / "checkpoint", tensors=weights(network), **fields)
    for name in ("tokenizer.json", "tokenizer_config.json", "generation_config.json", "preprocessor_config.json"):
        (checkpoint / name).unlink()
    rng = np.random.default_rng(seed)
    pictures = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in sizes]
    low, high = -rng.random(7), rng.random(7)
    vision = values["vision_config"]
    processor = {"base_img_size": vision["img_size"], "num_crops": vision["max_num_crops"]}
    client = {
        "n_action_bins": 256,
        "tokenizer_vocab_size": values["tokenizer_vocab_size"],
        "norm_stats": {"bridge_orig": {"q01": [*low], "q99": [*high], "mask": [True] * 6 + [False]}},
        "preprocessor": {**processor, "image_mean": MEAN, "image_std": DEVIATION},
        "special_ids": {"eos": IDS["<|eot_id|>"]},
    }
    (checkpoint / "action_config.json").write_text(json.dumps(client), encoding="utf-8")
    with torch.inference_mode():
        arrays = _Recorder(network, vision["img_size"], vision["max_num_crops"]).record(pictures, steps)
    ids = rng.integers(0, 544, (5, 7))
    edges = np.linspace(-1, 1, 256)
    centres = [(edges[k] + edges[k + 1]) / 2 for k in range(255)]
    table = np.array([centres[min(max(values["tokenizer_vocab_size"] - k - 1, 0), 254)] for k in range(544)])
    scaled = 0.5 * (table[ids] + 1) * (high - low) + low
    scaled[:, 6] = table[ids][:, 6]
    arrays |= {"action_token_ids": ids, "normalized_actions": table[ids], "actions": scaled, "detok_table": table}
    np.savez(folder / "reference.npz", **arrays)
    return folder


class _Recorder:
    def __init__(self, network: MagmaNetwork, side: int, crops: int) -> None:
        self.network, self.side, self.crops = network, side, crops
        self.trunk = network.vision_tower.clip_vision_model.trunk
        self.whole = network.config.vision.strategy == "global"

    def record(self, pictures: list[np.ndarray], steps: int) -> dict[str, np.ndarray]:
        first, second = (self.cut(picture) for picture in pictures)
        tokens, more = self.look(*first), self.look(*second)
        arrays: dict[str, Any] = {
            "image1_uint8": pictures[0], "image2_uint8": pictures[1],
            "pixel_values": first[0][None], "pixel_values_2": second[0][None],
            "image_sizes": [[first[1]]], "image_sizes_2": [[second[1]]],
            "input_ids": [LONG], "attention_mask": [[1] * len(LONG)], "text_input_ids": [[3, 40, 50, 9]],
        }  # fmt: skip
        maps = self.trunk.stem(self.trunk_input(*first))
        arrays["stem"] = maps
        for number, stage in enumerate(self.trunk.stages):
            maps = stage(maps)
            arrays[f"stage{number}"] = maps
        arrays["projected"] = self.network.multi_modal_projector(maps.permute(0, 2, 3, 1))
        row = self.merged(LONG, tokens)
        states, logits = self.forward([row])
        arrays |= {"merged_embeds": row[None], "hidden_states": states, "logits": logits}
        arrays["hidden_states_2"], arrays["logits_2"] = self.forward([self.merged(LONG, more)])
        text = self.network.language_model.model.embed_tokens(torch.tensor([3, 40, 50, 9]))
        arrays["text_hidden_states"], arrays["text_logits"] = self.forward([text])
        arrays["batch_hidden_states"], arrays["batch_logits"] = self.forward(
            [self.merged(SHORT, tokens), self.merged(LONG, more)]
        )
        arrays |= self.batch_inputs(first, second)
        arrays |= self.generate(row, steps)
        return {
            name: value.numpy() if isinstance(value, Tensor) else np.asarray(value)
            for name, value in arrays.items()
        }

    def cut(self, picture: np.ndarray) -> tuple[Tensor, tuple[int, int]]:
        """Crops, and (rows, columns): most of the picture shown, then the least waste, tried one by one."""
        high, wide = picture.shape[:2]
        best: tuple[int, int, int, int] | None = None
        for columns in range(1, self.crops + 1):
            for rows in range(1, self.crops + 1):
                if rows * columns > self.crops:
                    continue
                scale = min(columns * self.side / wide, rows * self.side / high)
                shown_pixels = min(int(wide * scale) * int(high * scale), wide * high)
                waste = rows * columns * self.side**2 - shown_pixels
                if best is None or shown_pixels > best[0] or (shown_pixels == best[0] and waste < best[1]):
                    best = (shown_pixels, waste, rows, columns)
        assert best is not None
        rows, columns = best[2:]
        pixels = normalize(to_tensor(Image.fromarray(picture)), list(MEAN), list(DEVIATION))
        large = torch.nn.functional.interpolate(
            pixels[None], size=(rows * self.side, columns * self.side), mode="bilinear"
        )[0]
        crops = [
            large[:, r * self.side : (r + 1) * self.side, c * self.side : (c + 1) * self.side]
            for r in range(rows)
            for c in range(columns)
        ]
        return torch.stack(crops), (rows, columns)

    def trunk_input(self, crops: Tensor, grid: tuple[int, int]) -> Tensor:
        """What the trunk sees."""
        rows, columns = grid
        lines = [torch.cat(list(crops[r * columns : (r + 1) * columns]), dim=2) for r in range(rows)]
        return torch.cat(lines, dim=1)[None] if self.whole else crops

    def look(self, crops: Tensor, grid: tuple[int, int]) -> Tensor:
        """A picture's tokens, place by place."""
        rows, columns = (1, 1) if self.whole else grid
        maps = self.trunk.stages(self.trunk.stem(self.trunk_input(crops, grid)))
        projected = self.network.multi_modal_projector(maps.permute(0, 2, 3, 1))
        separator = self.network.multi_modal_projector.row_seperator[0, 0]
        tokens = []
        for r in range(rows):
            for line in range(projected.shape[1]):
                for c in range(columns):
                    tokens += list(projected[r * columns + c, line])
                tokens.append(separator)
        return torch.stack(tokens)

    def merged(self, ids: list[int], tokens: Tensor) -> Tensor:
        parts = []
        for number in ids:
            word = self.network.language_model.model.embed_tokens(torch.tensor([number]))
            parts.append(tokens if number == IMAGE else word)
        return torch.cat(parts)

    def forward(self, rows: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Hidden states and logits with padding in front, as the original pads."""
        longest = max(map(len, rows))
        embeddings = torch.zeros(len(rows), longest, rows[0].shape[1])
        mask = torch.zeros(len(rows), longest, dtype=torch.long)
        for index, row in enumerate(rows):
            embeddings[index, longest - len(row) :], mask[index, longest - len(row) :] = row, 1
        places = (mask.cumsum(-1) - 1).masked_fill(mask == 0, 1)
        output = self.network.language_model(
            inputs_embeds=embeddings, attention_mask=mask, position_ids=places, output_hidden_states=True
        )
        return torch.stack(output.hidden_states), output.logits

    def batch_inputs(self, first: Any, second: Any) -> dict[str, Any]:
        most = max(len(first[0]), len(second[0]))
        crops = torch.zeros(2, most, 3, self.side, self.side)
        crops[0, : len(first[0])], crops[1, : len(second[0])] = first[0], second[0]
        padding = len(LONG) - len(SHORT)
        return {
            "batch_input_ids": [[PAD] * padding + SHORT, LONG],
            "batch_attention_mask": [[0] * padding + [1] * len(SHORT), [1] * len(LONG)],
            "batch_pixel_values": crops,
            "batch_image_sizes": [[first[1]], [second[1]]],
        }

    def generate(self, row: Tensor, steps: int) -> dict[str, Any]:
        """Greedy without a cache and without ending the turn, as the recording asked the original."""
        ids: list[int] = []
        hidden, scores = [], []
        for _ in range(steps):
            states, logits = self.forward([row])
            hidden.append(states[:, 0, -1])
            scores.append(logits[0, -1])
            allowed = scores[-1].clone()
            allowed[IDS["<|eot_id|>"]] = -1e9
            ids.append(int(allowed.argmax()))
            row = torch.cat([row, self.network.language_model.model.embed_tokens(torch.tensor(ids[-1:]))])
        states, logits = self.forward([row])
        return {
            "generated_ids": ids,
            "generated_step_hidden": torch.stack(hidden),
            "generated_step_logits": torch.stack(scores),
            "teacher_forced_ids": [LONG + ids],
            "teacher_forced_hidden_states": states,
            "teacher_forced_logits": logits,
        }
