"""Xiaomi-Robotics-R0: Qwen3-VL and a flow transformer that reads its keys and values, in torch and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is. Capture and
actions are in its adapter in `probe_kit.hooks`. One pass of Qwen3-VL reads the prompt, then several passes of the
flow transformer read its cache; their output is a velocity of the actions.

B batch, P prompt positions, A actions of a chunk, T = 1 + states + A positions of the flow transformer, D width, H
heads of size E, K cached heads.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field, InstanceOf, model_validator
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]
from torch import Tensor, nn
from torch.nn import functional
from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration
from transformers.models.qwen3_vl.modeling_qwen3_vl import Qwen3VLTextRMSNorm, apply_rotary_pos_emb, repeat_kv

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.families.shared.qwen.network import IMAGE, QwenInputs, qwen3_vl_config
from probe_kit.models.bounds import check_deviations
from probe_kit.models.building import Gate, TimeEmbedder, build_empty, fill_rotary, without_precision
from probe_kit.models.checkpoint_files import chosen_name, processor_files
from probe_kit.models.config_file import STORED_TYPE, ConfigFile, Count, part
from probe_kit.models.decoding import PromptKV

MODEL_TYPE = "mibot"


class FlowConfig(ConfigFile):
    """The sizes of the flow transformer: layers, width, size of a head, and heads in the cache it reads."""

    layers: Count = Field(default=16, validation_alias="num_hidden_layers")
    width: Count = Field(default=1024, validation_alias="hidden_size")
    head_dim: Count = 128
    cached_heads: Count = Field(default=8, validation_alias="num_key_value_heads")


class XiaomiConfig(ConfigFile):
    """A checkpoint's configuration.

    Attributes:
        vlm: Transformers' configuration of Qwen3-VL.
        state_length: Number of positions of the state.
        state_dim: Numbers per position of the state.
        action_length: Actions of a chunk, where no robot's statistics say otherwise.
        action_dim: Numbers per action.
    """

    model_types = (MODEL_TYPE,)
    network = "Xiaomi-Robotics-R0"

    vlm: Annotated[InstanceOf[Qwen3VLConfig], part(lambda values: Qwen3VLConfig(**without_precision(values)))] = (
        Field(validation_alias="vlm_config")
    )
    flow: FlowConfig = Field(default=FlowConfig(), validation_alias="dit_config")
    state_length: Count = 1
    state_dim: Count
    action_length: Count = 30
    action_dim: Count
    dtype: str | None = STORED_TYPE

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Check that the flow transformer can read the cache of the VLM's last layers, head by head."""
        flow, text = self.flow, self.vlm.text_config
        pairs = (
            ("head_dim", flow.head_dim, text.head_dim),
            ("num_key_value_heads", flow.cached_heads, text.num_key_value_heads),
        )
        wrong = [f"{name} {ours}, the VLM's cache has {theirs}" for name, ours, theirs in pairs if ours != theirs]
        if flow.layers > text.num_hidden_layers:
            wrong.append(f"{flow.layers} layers, the VLM has only {text.num_hidden_layers}")
        if flow.width % flow.head_dim or (flow.width // flow.head_dim) % flow.cached_heads:
            wrong.append(
                f"hidden_size {flow.width} is no multiple of {flow.cached_heads} heads of {flow.head_dim}"
            )
        if wrong:
            raise ValueError(f"dit_config does not fit vlm_config: {'; '.join(wrong)}")
        return self


# -- the flow transformer -------------------------------------------------------------------------------------

Cache = tuple[Tensor, Tensor]
"""Keys and values of one layer of the vision-language model, (B, K, P, E) each, keys after rotation."""
Angles = tuple[Tensor, Tensor]
"""Cosines and sines of the own positions, (B, T, E) each."""

_MODULATIONS = 6


class Projector(nn.Module):
    """A linear layer, or several with tanh-GELUs between them."""

    def __init__(self, inputs: int, outputs: int, layers: int = 2, bias: bool = False) -> None:
        super().__init__()
        stack: list[nn.Module] = [nn.Linear(inputs, outputs, bias=bias)]
        for _ in range(layers - 1):
            stack += [nn.GELU(approximate="tanh"), nn.Linear(outputs, outputs, bias=bias)]
        self.layers = nn.Sequential(*stack)

    def forward(self, features: Tensor) -> Tensor:
        """Return the output of the layers, (…, outputs) from (…, inputs)."""
        return cast(Tensor, self.layers(features))


class Attention(nn.Module):
    """The attention over the prompt's cached keys and values and the own ones behind them."""

    def __init__(self, width: int, head_dim: int, cached_heads: int) -> None:
        super().__init__()
        self.head_dim, self.heads = head_dim, width // head_dim
        self.repeats = self.heads // cached_heads
        self.qkv_proj = nn.Linear(width, 3 * width)
        self.o_proj = nn.Linear(width, width, bias=False)
        self.q_norm = Qwen3VLTextRMSNorm(head_dim)
        self.k_norm = Qwen3VLTextRMSNorm(head_dim)

    def forward(self, stream: Tensor, cache: Cache, rotation: Angles, mask: Tensor) -> Tensor:
        """Return the mixed positions (B, T, D).

        Args:
            stream: (B, T, D) stream of the flow transformer.
            cache: Keys and values of the prompt.
            rotation: Cosines and sines of the own positions.
            mask: (B, 1, T, P + T) bool, True where a position is seen.
        """
        query, key, value = self._parts(stream, cache, rotation)
        read = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return cast(Tensor, self.o_proj(read.transpose(1, 2).flatten(2)))

    def weights(self, stream: Tensor, cache: Cache, rotation: Angles, mask: Tensor) -> Tensor:
        """Return the attention weights of `forward`, (B, H, T, P + T) float32, computed once more."""
        query, key, _ = self._parts(stream, cache, rotation)
        logits = query.float() @ key.float().transpose(2, 3) * self.head_dim**-0.5
        return functional.softmax(logits.masked_fill(~mask, -torch.inf), dim=-1)

    def _parts(self, stream: Tensor, cache: Cache, rotation: Angles) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries (B, H, T, E), and keys and values (B, H, P + T, E), the prompt's first."""
        batch, length, _ = stream.shape
        parts = self.qkv_proj(stream).view(batch, length, 3, self.heads, self.head_dim)
        query, key, value = parts.unbind(2)
        query, key = (part.transpose(1, 2) for part in (self.q_norm(query), self.k_norm(key)))
        query, key = apply_rotary_pos_emb(query, key, *rotation)
        prompt_key, prompt_value = (repeat_kv(part, self.repeats) for part in cache)
        values = torch.cat([prompt_value, value.transpose(1, 2)], dim=-2)
        return query, torch.cat([prompt_key, key], dim=-2), values


class GatedMLP(nn.Module):
    """A SwiGLU, four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(width, 4 * width, bias=False)
        self.up_proj = nn.Linear(width, 4 * width, bias=False)
        self.down_proj = nn.Linear(4 * width, width, bias=False)

    def forward(self, stream: Tensor) -> Tensor:
        """Return the output of the layers, (B, T, D) from (B, T, D)."""
        return cast(Tensor, self.down_proj(functional.silu(self.gate_proj(stream)) * self.up_proj(stream)))


class Layer(nn.Module):
    """A layer: attention, then an MLP.

    Each writes into the stream through a gate, and the sum is normalised at once. There is therefore no stream
    that only adds: the output of a layer has passed two norms in it.
    """

    def __init__(self, width: int, head_dim: int, cached_heads: int) -> None:
        super().__init__()
        self.attn = Attention(width, head_dim, cached_heads)
        self.mlp = GatedMLP(width)
        self.input_layernorm = Qwen3VLTextRMSNorm(width)
        self.middle_layernorm = Qwen3VLTextRMSNorm(width)
        self.post_layernorm = Qwen3VLTextRMSNorm(width)
        self.final_layernorm = Qwen3VLTextRMSNorm(width)
        self.attn_gate, self.mlp_gate = Gate(), Gate()
        self.adaln_table = nn.Parameter(torch.zeros(_MODULATIONS, width))

    def forward(self, stream: Tensor, cache: Cache, rotation: Angles, moment: Tensor, mask: Tensor) -> Tensor:
        """Return the stream behind the layer, (B, T, D).

        Args:
            stream: (B, T, D) stream before the layer.
            cache: Keys and values of the prompt.
            rotation: Cosines and sines of the own positions.
            moment: (B, 6, D) code of the moment, the same for all layers.
            mask: (B, 1, T, P + T) bool, True where a position is seen.
        """
        modulation = (self.adaln_table + moment).chunk(_MODULATIONS, dim=1)
        shift, scale, gate = modulation[:3]
        read = self.attn(self.input_layernorm(stream) * (1 + scale) + shift, cache, rotation, mask)
        stream = self.middle_layernorm(stream + self.attn_gate(read, gate))
        shift, scale, gate = modulation[3:]
        written = self.mlp(self.post_layernorm(stream) * (1 + scale) + shift)
        return cast(Tensor, self.final_layernorm(stream + self.mlp_gate(written, gate)))


class FlowTransformer(nn.Module):
    """A stack of layers; layer k reads the cache of the k-th of the last layers of the vision-language model."""

    def __init__(self, layers: int, width: int, head_dim: int, cached_heads: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Layer(width, head_dim, cached_heads) for _ in range(layers))

    def forward(
        self, stream: Tensor, caches: list[Cache], rotation: Angles, moment: Tensor, mask: Tensor
    ) -> Tensor:
        """Return the stream behind the last layer, (B, T, D).

        Args:
            stream: (B, T, D) stream before the first layer.
            caches: Keys and values of the prompt, one pair per layer.
            rotation: Cosines and sines of the own positions.
            moment: (B, 6, D) code of the moment.
            mask: (B, 1, T, P + T) bool, True where a position is seen.
        """
        for layer, cache in zip(self.layers, caches, strict=True):
            stream = layer(stream, cache, rotation, moment, mask)
        return stream


# -- the network ----------------------------------------------------------------------------------------------

STEPS = 5
"""Euler steps of the released software."""
_THOUSANDTHS = 1000


@dataclass(frozen=True)
class FlowPrompt:
    """The parts of the prompt that the flow transformer keeps.

    Attributes:
        caches: Keys and values of every layer that it reads.
        mask: (B, P) bool, False at padding.
        ends: (3, B, 1) int64, the last position along time, height and width.
    """

    caches: list[Cache]
    mask: Tensor
    ends: Tensor


class XiaomiNetwork(nn.Module):
    """The network Xiaomi-Robotics-R0 under the parameter names of its released files."""

    def __init__(self, config: XiaomiConfig) -> None:
        super().__init__()
        flow = config.flow
        self.vlm: Any = Qwen3VLForConditionalGeneration._from_config(config.vlm, attn_implementation="eager")
        self.dit = FlowTransformer(flow.layers, flow.width, flow.head_dim, flow.cached_heads)
        self.state_projector = Projector(config.state_dim, flow.width)
        self.action_projector = Projector(config.action_dim, flow.width)
        self.action_output_layer = Projector(flow.width, config.action_dim)
        self.t_embedder = TimeEmbedder(flow.width, bias=False)
        self.t_projector = Projector(flow.width, 6 * flow.width, layers=1, bias=True)
        self.sink = nn.Embedding(1, flow.width)
        self.prompt_kv = PromptKV(int(config.vlm.text_config.num_hidden_layers))

    def read(self, inputs: QwenInputs) -> FlowPrompt:
        """Read the prompt in one pass of the vision-language model, whose output head is not called.

        Nothing reads the head's output.
        """
        keywords = inputs.keywords(self.vlm.model)
        cache = self.vlm.model(**keywords, use_cache=True).past_key_values
        self.prompt_kv(cache.layers)
        caches = [(layer.keys, layer.values) for layer in cache.layers[-len(self.dit.layers) :]]
        return FlowPrompt(caches, inputs.mask.bool(), keywords["position_ids"].amax(dim=-1, keepdim=True))

    def velocity(self, prompt: FlowPrompt, state: Tensor, actions: Tensor, moment: Tensor) -> Tensor:
        """Return the velocity of the actions, (B, A, action numbers).

        Args:
            prompt: Kept parts of the prompt.
            state: (B, states, state numbers) state of the robot.
            actions: (B, A, action numbers) moving actions.
            moment: (B,) moment of the flow in [0, 1].
        """
        states, moving = self.state_projector(state), self.action_projector(actions)
        stream = torch.cat([self.sink.weight.expand(len(moving), -1, -1), states, moving], dim=1)
        time = self.t_projector(self.t_embedder(moment * _THOUSANDTHS)).unflatten(-1, (6, -1))
        length = stream.shape[1]
        positions = torch.arange(length, device=stream.device) + prompt.ends + 1
        rotation = self.vlm.model.language_model.rotary_emb(stream, positions)
        stream = self.dit(stream, prompt.caches, rotation, time, _mask(prompt.mask, length))
        velocity: Tensor = self.action_output_layer(stream[:, -actions.shape[1] :])
        return velocity

    def forward(
        self, inputs: QwenInputs, state: Tensor, used: Tensor, noise: Tensor, steps: int = STEPS
    ) -> Tensor:
        """Return the normalised actions, (B, A, action numbers) float32.

        They result from Euler steps from noise at moment 0 to moment 1. The path is summed in float32 whatever the
        weights are.

        Args:
            inputs: Prompts with their pictures.
            state: (B, states, state numbers) state of the robot.
            used: (B, A, action numbers), 1 where the robot has the number. It masks the moving actions that the
                network reads, not its output.
            noise: (B, A, action numbers) float32.
            steps: Number of Euler steps.
        """
        prompt = self.read(inputs)
        dtype = self.sink.weight.dtype
        path = noise.float()
        for step in range(steps):
            moment = torch.ones(len(path), device=path.device) * step / steps
            noisy = (path * used).to(dtype)
            path = path + self.velocity(prompt, state.to(dtype), noisy, moment).float() * (1.0 / steps)
        return path


def _mask(prompt: Tensor, length: int) -> Tensor:
    """Return the mask (B, 1, T, P + T) bool: own positions see the prompt and own positions up to themselves."""
    causal = torch.ones(length, length, dtype=torch.bool, device=prompt.device).tril()
    before = prompt[:, None, :].expand(-1, length, -1)
    return torch.cat([before, causal.expand(len(prompt), -1, -1)], dim=-1)[:, None]


def build_xiaomi(config: XiaomiConfig, dtype: torch.dtype, device: str = "meta") -> XiaomiNetwork:
    """Return the network in eval mode; see `build_empty`."""
    network = build_empty(lambda: XiaomiNetwork(config), dtype, device)
    fill_rotary(network.vlm)
    return network


def full_size_xiaomi() -> XiaomiNetwork:
    """Return the released size on the meta device: Qwen3-VL-4B and 16 layers of flow transformer."""
    values = {"vlm_config": qwen3_vl_config("4B"), "state_dim": 32, "action_dim": 32}
    return build_xiaomi(XiaomiConfig.read(values, "released"), torch.float32)


# -- robots ---------------------------------------------------------------------------------------------------

DEFAULT_ROBOT = "bridge_delta"
STATISTICS_FILE = "preprocessor_config.json"
_UNUSED = 1e-5
"""Deviation below which a number is none that the robot has."""
# A hand that points down, as turns of the base frame's axes.
_POINTING_DOWN = Rotation.from_matrix([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])


@dataclass(frozen=True)
class RobotUnits:
    """The units of one robot: per step of a chunk and number of an action its mean and deviation.

    Attributes:
        robot: Name of the robot in the file.
        mean: (A, D) float64 mean.
        deviation: (A, D) float64 deviation.
    """

    robot: str
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @property
    def used(self) -> NDArray[np.float32]:
        """The mask (A, D): 1 where the robot has the number, 0 where it only fills up."""
        return (self.deviation > _UNUSED).astype(np.float32)

    @property
    def sha256(self) -> str:
        """The hash of the numbers."""
        return sha256_json([self.mean.tolist(), self.deviation.tolist()])

    def restore(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return normalised actions (…, A, D) in the robot's units."""
        return np.asarray(actions * self.deviation + self.mean, np.float64)


def read_units(folder: Path, robot: str | None, numbers: int) -> RobotUnits:
    """Return the statistics of one robot in a checkpoint's processor; without a name, of the only one.

    They are `action_config` of `preprocessor_config.json`, or of `processor_config.json` and its part
    `image_processor`, into which transformers 5 saves the same values.

    Args:
        folder: Folder of the checkpoint.
        robot: A name of the file, or the beginning of just one.
        numbers: Numbers per action, as config.json has it.

    Raises:
        CheckpointError: If there are none, they do not fit, or two files have different ones.
        UsageError: For an unknown robot, and for several without a choice.
    """
    by_robot, file = _action_config(folder)
    name = _choose(robot, by_robot, file)
    mean, deviation = (np.asarray(by_robot[name].get(part, []), np.float64) for part in ("mean", "std"))
    mean, deviation = (part[0] if part.ndim == 3 and len(part) == 1 else part for part in (mean, deviation))
    if mean.ndim != 2 or mean.shape != deviation.shape or mean.shape[1] != numbers:
        raise CheckpointError(
            f"{file}: {name} has mean {mean.shape} and std {deviation.shape}; expected (steps, {numbers}) each"
        )
    if not np.isfinite([mean, deviation]).all():
        raise CheckpointError(f"{file}: the statistics of {name} are not finite")
    check_deviations(mean, deviation, f"{file}, {name}")
    return RobotUnits(name, mean, deviation)


def _action_config(folder: Path) -> tuple[Mapping[str, Any], str]:
    """Return the statistics by robot, and the name of the file that has them.

    Raises:
        CheckpointError: For files without any, or with different ones.
    """
    stored = {source: values.get("action_config") for source, values in processor_files(folder).items()}
    sources = [source for source, by_robot in stored.items() if by_robot]
    if not sources:
        raise CheckpointError(
            f"{folder / STATISTICS_FILE} has no action_config: the actions have no physical unit and no length. "
            "Take the file that the checkpoint was released with"
        )
    if different := [source for source in sources[1:] if stored[source] != stored[sources[0]]]:
        raise CheckpointError(
            f"{sources[0]} and {different[0]} have different statistics in action_config. Remove the one that "
            "does not belong to these weights"
        )
    return stored[sources[0]] or {}, sources[0]


def _choose(robot: str | None, by_robot: Mapping[str, Any], source: str) -> str:
    beginning = [] if robot is None else [name for name in by_robot if name.startswith(robot)]
    return chosen_name(by_robot, beginning[0] if len(beginning) == 1 else robot, "robot", source)


@dataclass(frozen=True)
class Robot:
    """A robot's way of showing its scene and writing its state.

    Attributes:
        name: Beginning of the names of its statistics.
        heading: Name of its camera in the prompt.
        width: Width of its picture in pixels.
        height: Height of its picture in pixels.
        state: Function from the observation's eight numbers to its own.
    """

    name: str
    heading: str
    width: int
    height: int
    state: Callable[[NDArray[np.float32]], NDArray[np.float32]]


def _bridge_state(state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the observation's own layout.

    It is position, roll-pitch-yaw against a hand that points down, 0, openness.
    """
    return np.asarray(state, np.float32)


def _fractal_state(state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return position, orientation of the hand as a quaternion x y z w, closedness."""
    turned = Rotation.from_euler("xyz", state[3:6]) * _POINTING_DOWN
    return np.asarray(np.concatenate([state[:3], turned.as_quat(), 1 - state[7:8]]), np.float32)


_ROBOTS = (
    Robot("bridge", "Base View", 256, 256, _bridge_state),
    Robot("fractal", "Ego View", 320, 256, _fractal_state),
)


def robot_of(name: str) -> Robot:
    """Return the robot whose statistics are called `name`, such as bridge_delta.

    Raises:
        UsageError: For robots with other cameras and other states than Act2Answer's arm can have.
    """
    for robot in _ROBOTS:
        if name.startswith(robot.name):
            return robot
    raise UsageError(
        f"robot {name!r} sees through other cameras and has another state than Act2Answer's arm; "
        f"choose a robot of {' or '.join(robot.name for robot in _ROBOTS)}"
    )


# -- inputs ---------------------------------------------------------------------------------------------------

CROP = 0.95
"""Share of each side that stays; the rest is cut off equally around it."""


def look(picture: NDArray[np.uint8], robot: Robot) -> NDArray[np.uint8]:
    """Return the middle of a picture (H, W, 3) uint8, (height, width, 3) uint8 as the robot's pictures are.

    It is resized with PIL's bicubic filter, cropped, and enlarged to that size again with PIL's bilinear filter.
    """
    size = (robot.width, robot.height)
    scaled = Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC)
    width, height = (int(side * CROP) for side in size)
    column, top = (robot.width - width) // 2, (robot.height - height) // 2
    middle = scaled.crop((column, top, column + width, top + height))
    return np.array(middle.resize(size, Image.Resampling.BILINEAR))


def prompt(instruction: str, heading: str) -> str:
    """Return the whole text, with one image slot.

    The model answers with actions, so its words are given and empty.
    """
    return (
        "<|im_start|>user\nThe following observations are captured from multiple views.\n"
        f"# {heading}\n{IMAGE}\n"
        f"Generate robot actions for the task:\n{_sentence(instruction)} /no_cot<|im_end|>\n"
        "<|im_start|>assistant\n<cot></cot><|im_end|>\n"
    )


def _sentence(instruction: str) -> str:
    """Return the instruction with a capital and a full stop, as in training."""
    text = instruction.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")
