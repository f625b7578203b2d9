"""Models to capture: families of a tenth of a billion random parameters, of the released or a checkpoint's size.

The files around the weights are those that the tests write, in the layout of the released ones; their sizes are
raised here, and the weights drawn. So no family, and no trained weights, are needed for it.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tests_of_checkout  # noqa: F401
from numpy.typing import NDArray
from torch import nn

from probe_kit.env import SceneSpec
from probe_kit.hooks import AnswerModel, Model, Policy, load_model
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from tests.hooks.families.magma import checkpoints as magma_checkpoints
from tests.support.every_checkpoint import WRITERS

WIDTH, DEPTH, INNER, HEADS, KEYS, HEAD = 768, 12, 3072, 12, 4, 64
TOWER, TOWER_DEPTH, TOWER_INNER, TOWER_HEADS = 384, 6, 1536, 6
INSTRUCTION = "Put the cube on the red shape"

Values = dict[str, Any]
_TEXT: Values = {
    "hidden_size": WIDTH, "intermediate_size": INNER, "num_hidden_layers": DEPTH, "num_attention_heads": HEADS,
    "num_key_value_heads": KEYS,
}  # fmt: skip
_HEADED: Values = {**_TEXT, "head_dim": HEAD}
_QWEN_TOWER: Values = {
    "depth": TOWER_DEPTH, "hidden_size": TOWER, "intermediate_size": TOWER_INNER, "num_heads": TOWER_HEADS,
    "out_hidden_size": WIDTH,
}  # fmt: skip
_TOWER: Values = {
    "hidden_size": TOWER, "intermediate_size": TOWER_INNER, "num_hidden_layers": TOWER_DEPTH,
    "num_attention_heads": TOWER_HEADS,
}  # fmt: skip
_ROPE: Values = {"rope_scaling": {"mrope_section": [16, 8, 8]}}
_SMALL: Values = {"embed_dim": 16, "num_heads": 2}
_TIMM: Values = {"depth": TOWER_DEPTH, "embed_dim": TOWER, "num_heads": TOWER_HEADS}
_GEMMA: Values = {"depth": DEPTH, "num_heads": HEADS, "num_kv_heads": 1, "head_dim": HEAD}
_GEMMA_2B: Values = {"depth": 18, "num_heads": 8, "num_kv_heads": 1, "head_dim": 256}
_PRISMATIC: Values = {
    "config.json": {
        "text_config": {**_TEXT, "num_key_value_heads": HEADS, "max_position_embeddings": 1024},
        "image_sizes": [224, 224], "timm_model_overrides": [_TIMM, _TIMM],
    }
}  # fmt: skip

LARGER: dict[str, Values] = {
    "pi0": {
        "config.json": {"resize_imgs_with_padding": [224, 224], "chunk_size": 50, "n_action_steps": 50},
        "dims.json": {
            "vlm": {**_GEMMA, "width": WIDTH, "mlp_dim": INNER},
            "expert": {**_GEMMA, "width": 384, "mlp_dim": 1536},
            "vision": {
                "hidden": TOWER, "layers": TOWER_DEPTH, "heads": TOWER_HEADS, "inter": TOWER_INNER,
                "patch": 14,
            },
        },
    },
    "smolvla": {
        "config.json": {
            "resize_imgs_with_padding": [256, 256], "chunk_size": 50, "n_action_steps": 50, "num_steps": 10,
            "num_vlm_layers": DEPTH,
        },
        "vlm/config.json": {
            "text_config": _HEADED, "scale_factor": 2,
            "vision_config": {**_TOWER, "patch_size": 16, "image_size": 256},
        },
        "vlm/processor_config.json": {"image_seq_len": 64},
    },
    "openvla": _PRISMATIC,
    "prismatic": _PRISMATIC,
    "spatialvla": {
        "config.json": {
            "projection_dim": WIDTH, "text_config": {**_HEADED, "query_pre_attn_scalar": HEAD},
            "vision_config": {**_TOWER, "image_size": 224, "projection_dim": WIDTH},
        },
        "preprocessor_config.json": {"size": {"height": 224, "width": 224}},
    },
    "magma": {
        "config.json": {
            "text_config": {**_TEXT, "max_position_embeddings": 4096},
            "vision_config": {
                "img_size": 256, "mm_hidden_size": TOWER,
                "timm_overrides": {"depths": [2, 2, 6, 2], "dims": [48, 96, 192, 384]},
            },
        },
        "preprocessor_config.json": {"base_img_size": 256},
    },
    "xiaomi-r0": {
        "config.json": {
            "vlm_config": {
                "text_config": {**_HEADED, **_ROPE},
                "vision_config": {**_QWEN_TOWER, "deepstack_visual_indexes": [1, 3]},
            },
            "dit_config": {
                "hidden_size": 512, "num_hidden_layers": 6, "head_dim": HEAD, "num_key_value_heads": KEYS,
            },
        }
    },
    "internvla-m1": {
        "../vlm/config.json": {
            "text_config": {**_TEXT, **_ROPE},
            "vision_config": {**_QWEN_TOWER, "fullatt_block_indexes": [2, 5]},
        },
        "config.yaml": {
            "framework": {
                "layer_qformer": {
                    "qformer_start_layer": 9, "qformer_end_layer": 13, "num_query_tokens": 64,
                    "input_dim": WIDTH, "ouptput_dim": TOWER,
                },
                "action_model": {"action_hidden_dim": TOWER, "future_action_window_size": 15},
            }
        },
        "dims.json": {
            "dino": {**_TIMM, "img_size": 518, "patch_size": 14, "px": 224},
            "dit": {"depth": 8, "token_size": TOWER, "num_heads": TOWER_HEADS}, "qformer_heads": TOWER_HEADS,
        },
    },
    "paligemma": {
        "config.json": {
            "text_config": {**_HEADED, "num_key_value_heads": 1},
            "projection_dim": WIDTH, "hidden_size": WIDTH,
            "vision_config": {**_TOWER, "image_size": 224, "projection_dim": WIDTH},
        },
        "preprocessor_config.json": {"size": {"height": 224, "width": 224}},
    },
    "qwen2.5-vl": {
        "config.json": {
            **_TEXT, **_ROPE, "vision_config": {**_QWEN_TOWER, "fullatt_block_indexes": [2, 5]},
        }
    },
    "qwen3-vl": {
        "config.json": {
            "text_config": {**_HEADED, **_ROPE},
            "vision_config": {**_QWEN_TOWER, "deepstack_visual_indexes": [1, 3]},
        }
    },
    "internvl": {
        "config.json": {
            "text_config": _HEADED, "vision_config": {**_TOWER, "image_size": [224, 224]},
        },
        "preprocessor_config.json": {"size": {"height": 224, "width": 224}, "max_patches": 2},
    },
    "ovis2.5": {"config.json": {"llm_config": _HEADED, "vit_config": _TOWER}},
}  # fmt: skip
"""What is made larger, by family and file."""

FULL: dict[str, Values] = {
    "pi0": {
        "config.json": LARGER["pi0"]["config.json"],
        "dims.json": {
            "vlm": {**_GEMMA_2B, "width": 2048, "mlp_dim": 16384},
            "expert": {**_GEMMA_2B, "width": 1024, "mlp_dim": 4096},
            "vision": {"hidden": 1152, "layers": 27, "heads": 16, "inter": 4304, "patch": 14},
        },
    },
    "openvla": {
        "config.json": {
            "text_config": {
                "hidden_size": 4096, "intermediate_size": 11008, "num_hidden_layers": 32,
                "num_attention_heads": 32, "num_key_value_heads": 32, "max_position_embeddings": 2048,
            },
            "image_sizes": [224, 224],
            "timm_model_overrides": [
                {"depth": 24, "embed_dim": 1024, "num_heads": 16},
                {"depth": 27, "embed_dim": 1152, "num_heads": 16},
            ],
        }
    },
    "qwen3-vl": {
        "config.json": {
            "text_config": {
                "hidden_size": 2560, "intermediate_size": 9728, "num_hidden_layers": 36,
                "num_attention_heads": 32, "num_key_value_heads": 8, "head_dim": 128,
                "rope_scaling": {"mrope_section": [24, 20, 20]},
            },
            "vision_config": {
                "depth": 24, "hidden_size": 1024, "intermediate_size": 4096, "num_heads": 16,
                "out_hidden_size": 2560, "num_position_embeddings": 2304, "deepstack_visual_indexes": [5, 11, 17],
            },
        }
    },
}  # fmt: skip
"""The released sizes of pi0, OpenVLA and Qwen3-VL-4B, without their vocabularies, by family and file."""

_FLOW_GEMMA: Values = {"dims.json": {"vlm": {"depth": 18}, "expert": {"depth": 18}, "vision": {"layers": 27}}}
_TWO_TOWERS: Values = {
    "config.json": {
        "text_config": {"num_hidden_layers": 32},
        "timm_model_overrides": [{**_SMALL, "depth": 24}, {**_SMALL, "depth": 27}],
    }
}  # fmt: skip

DEEP: dict[str, Values] = {
    "pi0": {**_FLOW_GEMMA, "config.json": {"num_steps": 10}},
    "pi05": {**_FLOW_GEMMA, "config.json": {"num_inference_steps": 10}},
    "pi0-fast": {"dims.json": {"vlm": {"depth": 18}, "vision": {"layers": 27}}},
    "molmoact2": {
        "config.json": {"num_inference_steps": 10},
        "vlm/config.json": {
            "text_config": {"num_hidden_layers": 36}, "vit_config": {"num_hidden_layers": 27},
            "action_expert_config": {"num_layers": 36},
        },
    },
    "groot": {
        "config.json": {"num_inference_timesteps": 4},
        "base/config.json": {
            "select_layer": 16, "num_inference_timesteps": 4, "diffusion_model_cfg": {"num_layers": 32},
            "vl_self_attention_cfg": {"num_layers": 4},
        },
        "base/vlm/config.json": {"text_config": {"num_hidden_layers": 28}, "vision_config": {"depth": 24}},
    },
    "xvla": {
        "config.json": {
            "depth": 24, "num_denoising_steps": 10,
            "florence_config": {"text_config": {"encoder_layers": 12}, "vision_config": {"depths": [1, 1, 9, 1]}},
        }
    },
    "eo1": {
        "config.json": {
            "num_denoise_steps": 10,
            "vlm_config": {
                "text_config": {"num_hidden_layers": 36, "layer_types": ["full_attention"] * 36},
                "vision_config": {"depth": 32},
            },
        }
    },
    "smolvla": {
        "config.json": {"num_steps": 10, "num_vlm_layers": 16},
        "vlm/config.json": {"text_config": {"num_hidden_layers": 32}, "vision_config": {"num_hidden_layers": 12}},
    },
    "openvla": _TWO_TOWERS,
    "prismatic": _TWO_TOWERS,
    "spatialvla": {
        "config.json": {
            "text_config": {"num_hidden_layers": 26}, "vision_config": {"num_hidden_layers": 27},
            "vision_zoe_config": {
                "backbone_config": {
                    "num_hidden_layers": 24, "out_features": ["stage6", "stage12", "stage18", "stage24"],
                }
            },
        }
    },
    "magma": {
        "config.json": {
            "text_config": {"num_hidden_layers": 32},
            "vision_config": {"timm_overrides": {"depths": [3, 4, 30, 3]}},
        }
    },
    "xiaomi-r0": {
        "config.json": {
            "vlm_config": {"text_config": {"num_hidden_layers": 36}, "vision_config": {"depth": 24}},
            "dit_config": {"num_hidden_layers": 16},
        }
    },
    "internvla-m1": {
        "../vlm/config.json": {"text_config": {"num_hidden_layers": 36}, "vision_config": {"depth": 32}},
        "config.yaml": {
            "framework": {"layer_qformer": {"qformer_start_layer": 36, "qformer_end_layer": 37}}
        },
        "dims.json": {"dino": {"depth": 12}, "dit": {"depth": 12}},
    },
}  # fmt: skip
"""The depths and steps of the released acting families, at the widths of the tests, by family and file."""


@dataclass(frozen=True)
class Subject:
    """A model and one inference of it.

    Attributes:
        infer: One inference; its numbers must not change by capture.
        roles: Of its batch.
    """

    model: Model
    infer: Callable[[], NDArray[np.float32]]
    roles: Mapping[str, Sequence[Roles]]

    @property
    def layers(self) -> list[nn.Module]:
        """The layer modules of every stored stream."""
        taps = [self.model.tap(site).module for site in self.model.sites() if not site.iteration]
        names = {id(module): name for name, module in self._network.named_modules()}
        layer_names = {names[id(tap)].rpartition(".")[0]: None for tap in taps if id(tap) in names}
        numbered = [name for name in layer_names if name.rpartition(".")[2].isdigit()]
        return [self._network.get_submodule(name) for name in numbered]

    @property
    def stacks(self) -> list[nn.Module]:
        """Modules with `layers` and a configuration that knows `output_hidden_states`."""
        return [
            module
            for module in self._network.modules()
            if isinstance(getattr(module, "layers", None), nn.ModuleList)
            and hasattr(getattr(module, "config", None), "output_hidden_states")
            and any(layer is candidate for layer in self.layers for candidate in module.layers)
        ]

    @property
    def _network(self) -> nn.Module:
        return next(value for value in vars(self.model).values() if isinstance(value, nn.Module))


def subject(
    family: str,
    folder: Path,
    device: str,
    dtype: str | None,
    batch: int,
    checkpoint: str | None = None,
    sizes: Mapping[str, Values] = LARGER,
) -> Subject:
    """A family as `sizes` has it, written to `folder`, or at the size of a checkpoint; weights are random."""
    options: Mapping[str, Any] = {}
    if checkpoint is None:
        checkpoint, options = str(written(family, folder / "files", sizes)), WRITERS[family][1]
    model = load_model(family, checkpoint, device, dtype, random_weights=True, **options)
    scene = SceneSpec()
    picture, state = np.zeros((*scene.picture_shape, 3), np.uint8), np.zeros(8, np.float32)
    example = Observation(picture, state, INSTRUCTION, scene.intrinsics)
    observations = [example] * min(batch, model.card.batch or batch)
    if isinstance(model, Policy):
        policy = model  # named, for the closure
        return Subject(
            policy,
            lambda: policy.infer_without_acting(observations, list(range(len(observations)))),
            policy.roles(observations),
        )
    assert isinstance(model, AnswerModel)
    questions = [Prompt(observation, "Which of them is red?", ("a", "b")) for observation in observations]
    return Subject(model, lambda: model.read(questions).option_logits, model.asked_roles(questions))


def written(family: str, folder: Path, sizes: Mapping[str, Values] = LARGER) -> Path:
    """The files of a checkpoint as `sizes` has it, without weights; where it lies."""
    write, _ = WRITERS[family]
    if family == "magma":  # weights that steer its answers fit the tiny network only
        write = partial(magma_checkpoints.write_checkpoint, steered=False, shards=1)
    checkpoint = write(folder)
    _enlarge(checkpoint, sizes[family])
    return checkpoint


@contextmanager
def hidden_states(subject: Subject) -> Iterator[list[int]]:
    """Switch on hidden states in every stack; yields how many each call returned."""
    stacks, counts = subject.stacks, []

    def count(_module: nn.Module, _inputs: Any, output: Any) -> None:
        counts.append(len(getattr(output, "hidden_states", None) or ()))

    handles = [stack.register_forward_hook(count) for stack in stacks]
    before = [stack.config.output_hidden_states for stack in stacks]
    try:
        for stack in stacks:
            stack.config.output_hidden_states = True
        yield counts
    finally:
        for stack, value in zip(stacks, before, strict=True):
            stack.config.output_hidden_states = value
        for handle in handles:
            handle.remove()


def _enlarge(folder: Path, larger: Mapping[str, Values]) -> None:
    """Raise sizes in the files around the weights, and remove those weights."""
    import yaml

    for name, changes in larger.items():
        path = folder / name
        as_json = path.suffix == ".json"
        text = path.read_text(encoding="utf-8")
        values = _merged(json.loads(text) if as_json else yaml.safe_load(text), changes)
        path.write_text(json.dumps(values) if as_json else yaml.safe_dump(values), encoding="utf-8")
    for path in (*folder.rglob("*.safetensors"), *folder.rglob("*.index.json")):
        if not path.name.startswith("policy_"):  # statistics of lerobot's processors
            path.unlink()


def _merged(values: Any, changes: Values) -> Any:
    return {
        **values,
        **{
            name: _merged(values.get(name, {}), change) if isinstance(change, dict) else change
            for name, change in changes.items()
        },
    }
