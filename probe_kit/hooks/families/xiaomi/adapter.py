"""The adapter for Xiaomi-Robotics-R0.

Backbone: the chat with one picture. Expert: a sink, the state, the action chunk; each layer reads the keys and
values of one of the backbone's last layers. The expert's stream is normalised twice in every layer, so nothing in
it only adds. `residual` is the stream entering a layer, normed by the layer before. `attention` and `mlp` are what
its halves add, gated; `middle` is the normed sum between them.

References of `verify`: B batch, P prompt positions, L backbone layers, T expert positions, S Euler steps.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, ObservationError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import SMALL_FILES, chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation, laid_out
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.families.shared.action_statistics import DIMENSIONS, open_or_closed
from probe_kit.hooks.families.shared.loading import DTYPES, Loaded, load_network
from probe_kit.hooks.families.shared.qwen.adapter import BACKBONE_ROLES, QwenVLA, recorded_inputs
from probe_kit.hooks.families.shared.qwen.network import QwenInputs
from probe_kit.hooks.families.shared.taps import Note, decoder_tap, kv_tap, recording_weights
from probe_kit.hooks.families.shared.token_decoder import seeded_noise
from probe_kit.hooks.families.xiaomi import INTERVENTIONS
from probe_kit.hooks.families.xiaomi.network import (
    DEFAULT_ROBOT,
    STATISTICS_FILE,
    STEPS,
    Robot,
    RobotUnits,
    XiaomiConfig,
    XiaomiNetwork,
    build_xiaomi,
    look,
    prompt,
    read_units,
    robot_of,
)
from probe_kit.hooks.outputs import Arrays, Outputs, Produce, euler_path, numpy_of, stream_outputs, watch

DEFAULT_CHECKPOINT = "XiaomiRobotics/Xiaomi-Robotics-0-SimplerEnv-WidowX"
_PARTS = {"attention": "attn_gate", "heads": "attn.o_proj", "middle": "middle_layernorm", "mlp": "mlp_gate"}
EXECUTE = 4
"""The number of actions that the released evaluation executes before it infers again."""


class Xiaomi(QwenVLA):
    """A loaded Xiaomi-Robotics-R0."""

    interventions = INTERVENTIONS
    draws_noise = True
    fast_pictures: ClassVar[bool] = False
    state_numbers = ARM_NUMBERS

    def __init__(
        self,
        loaded: Loaded[XiaomiNetwork],
        config: XiaomiConfig,
        robot: str | None,
        steps: int,
        tokenizer: str | None,
        openness: str = "measured",
    ) -> None:
        super().__init__(loaded.network.vlm, loaded.folder, tokenizer, loaded.device)
        self.openness = openness
        self.network, self.config, self.steps = loaded.network, config, steps
        self._robot = robot
        layers, first = len(self.network.dit.layers), cast(Any, self.network.dit.layers[0])
        self.streams = {
            # DeepStack adds pictures between its first blocks.
            "backbone": replace(self.backbone_stream(), sums=False),
            "expert": Stream(
                "expert",
                layers + 1,
                config.flow.width,
                steps,
                part="action",
                quantities=("residual", "attention", "middle", "mlp"),
                sums=False,
                heads=int(first.attn.heads),
            ),
        }
        self.further_streams = {"vision": self.vision.stream("vision")}
        self.prompt_kv = self.backbone_kv()
        self.role_names = {"backbone": BACKBONE_ROLES, "expert": ("special", "state", "action")}
        units = self.units_or_reason()
        if isinstance(units, str):
            chunk, note, name, numbers = config.action_length, f"cannot act: {units}", "none", "none"
        else:
            chunk, note, name, numbers = len(units.mean), f"robot: {units.robot}", units.robot, units.sha256
        options = {"robot": name, "action_statistics": numbers, "steps": str(steps)}
        if openness != "measured":
            options["openness"] = openness
        execute = min(EXECUTE, chunk)
        self.card = loaded.card(
            "xiaomi-r0",
            options,
            tokenizer=tokenizer,
            notes=(note,),
            embodiment=ARM,
            chunk=chunk,
            execute=execute,
        )

    # -- the robot ---------------------------------------------------------------------------------------

    def units_or_reason(self) -> RobotUnits | str:
        """Return the statistics, or why there are none; a robot that was named has to have them."""
        return self.units if self._robot is not None else super().units_or_reason()

    @cached_property
    def units(self) -> RobotUnits:
        """The statistics that give actions units and the chunk its length.

        Raises:
            CheckpointError: If there are none.
            UsageError: For a robot that is not there or has to be chosen.
        """
        return read_units(self.folder, self._robot, self.config.action_dim)

    @cached_property
    def robot(self) -> Robot:
        """The robot as whose scene pictures are shown; the default one where no statistics name a robot.

        Raises:
            UsageError: For a robot that Act2Answer's arm cannot stand in for.
        """
        units = self.units_or_reason()
        return robot_of(DEFAULT_ROBOT if isinstance(units, str) else units.robot)

    def text(self, instruction: str) -> str:
        """The released prompt."""
        return prompt(instruction, self.robot.heading)

    def look(self, observation: Observation) -> NDArray[np.uint8]:
        """The middle of the picture, at the size the robot's pictures have."""
        return look(observation.image, self.robot)

    @property
    def unguarded_state(self) -> str | None:
        """The reason why states are not compared: the release has statistics of actions alone."""
        return f"the state is read as it is, and {STATISTICS_FILE} has statistics of actions alone"

    # -- acting ------------------------------------------------------------------------------------------

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one chunk of actions per observation; see the contract."""
        units = self.units
        return open_or_closed(units.restore(self.infer_without_acting(observations, seeds))[..., :DIMENSIONS])

    def embodiment_mismatch(self) -> str | None:
        """Return the reason why there are no statistics; None where there are some."""
        units = self.units_or_reason()
        return units if isinstance(units, str) else None

    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        """Return (B, chunk, action numbers) as the flow puts them out, without units.

        They are all numbers where nothing says which are used.
        """
        self.check(observations, seeds)
        units = self.units_or_reason()
        numbers = self.config.action_dim
        used = np.ones((self.card.chunk, numbers), np.float32) if isinstance(units, str) else units.used
        noise = seeded_noise(seeds, (self.card.chunk, numbers), self.device)
        mask = torch.from_numpy(used).expand_as(noise.cpu()).to(self.device)
        output: NDArray[np.float32] = (
            self.infer(self.inputs(observations), self.state(observations), mask, noise).cpu().numpy()
        )
        return output

    def state(self, observations: Sequence[Observation]) -> Tensor:
        """Return the state (B, 1, state numbers) float32: the robot's own layout, filled up with zeros.

        Raises:
            ObservationError: For a state of more numbers than the checkpoint reads.
        """
        rows = torch.zeros(len(observations), self.config.state_length, self.config.state_dim)
        for row, observation in zip(rows, observations, strict=True):
            arm_state = laid_out(np.asarray(observation.state, np.float32), ARM_NUMBERS, self.openness)
            numbers = self.robot.state(arm_state)
            if len(numbers) > self.config.state_dim:
                raise ObservationError(
                    f"the state has {len(numbers)} numbers; this checkpoint reads {self.config.state_dim}"
                )
            row[0, : len(numbers)] = torch.from_numpy(numbers)
        return rows.to(self.device)

    def infer(self, inputs: QwenInputs, state: Tensor, used: Tensor, noise: Tensor) -> Tensor:
        """Return normalised actions (B, A, action numbers); one inference, as `capture` counts it.

        Args:
            inputs: The packed prompts.
            state: (B, 1, state numbers) float32.
            used: Mask of the numbers that an action has, in the shape of `noise`.
            noise: (B, A, action numbers).
        """
        with torch.inference_mode():
            actions: Tensor = self.network(inputs, state, used, noise, self.steps)
        return actions

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of the chat; then those of sink, state and actions."""
        states = ["state"] * self.config.state_length
        expert = Roles.from_labels(["special", *states, *["action"] * self.card.chunk])
        return {"backbone": self.backbone_roles(observations), "expert": [expert] * len(observations)}

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Record attention that is computed once more from what a layer of the expert is given.

        It is noted under the block whose keys the layer reads.
        """
        layers: Any = self.network.dit.layers
        first, first_action = len(self.language.layers) - len(layers), 1 + self.config.state_length

        def acting(layer: int, iteration: int, weights: Tensor) -> None:
            note(first + layer, iteration, weights[:, :, first_action:, : weights.shape[-1] - weights.shape[2]])

        return recording_weights(
            [layer.attn for layer in layers], acting, lambda module, inputs, _, __: module.weights(*inputs)
        )

    def tap(self, site: Site) -> Tap:
        """Return the tap of a site, with the quantities that the module's first lines describe.

        The backbone's sites are inputs: they hold what DeepStack added.
        """
        stream = self.stream_of(site)
        if stream is self.prompt_kv:
            return kv_tap(self.network.prompt_kv, site)
        if stream.name == "backbone":
            return self.backbone_tap(site)
        return self.vision.tap(site) if stream.name == "vision" else self._expert_tap(site)

    def _expert_tap(self, site: Site) -> Tap:
        layers: Any = self.network.dit.layers
        return decoder_tap(layers, layers[-1], site, self.steps, added=_PARTS, end="output")


def xiaomi_units(checkpoint: str, *, robot: str | None = None, **_: Any) -> str:
    """Return the robot whose units the actions get, and what says so; see `Family.units`.

    A checkpoint without statistics says so, since it can be captured.
    """
    folder = checkpoint_folder(checkpoint, SMALL_FILES)
    try:
        units = read_units(folder, robot, XiaomiConfig.from_folder(folder).action_dim)
    except CheckpointError as error:
        return f"none: {error}"
    return f"{units.robot}, from {folder / STATISTICS_FILE}"


def load_xiaomi(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    robot: str | None = None,
    steps: int = STEPS,
    tokenizer: str | None = None,
    openness: str = "measured",
    weights_seed: int = 0,
) -> Xiaomi:
    """Load Xiaomi-Robotics-R0 from a folder or hub id.

    The options are those of the family.

    Raises:
        CheckpointError: For a checkpoint that is not there or cannot be loaded.
        WeightsError: For weights that are not exactly the network's.
        UsageError: For an option that cannot be used.
    """
    if steps < 1:
        raise UsageError(f"{steps} Euler steps make no action; expected 1 or more")
    name = checkpoint or DEFAULT_CHECKPOINT
    folder = checkpoint_folder(name)
    config = XiaomiConfig.from_folder(folder)

    kind = chosen_dtype(dtype, config.dtype, DTYPES) if dtype or config.dtype else None
    loaded = load_network(
        partial(build_xiaomi, config),
        lambda: read_weights(folder),
        name,
        folder,
        device,
        kind,
        random_weights,
        weights_seed,
    )
    return Xiaomi(loaded, config, robot, steps, tokenizer, openness)


# -- verification ---------------------------------------------------------------------------------------------

_NORMS = ("norm_mean", "norm_std")


def xiaomi_outputs(load: Callable[..., Xiaomi], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded inputs through the adapter.

    The backbone is compared at valid positions only: padding holds plausible numbers that nothing reads.
    """
    steps = len(recorded["denoise_times"]) if "denoise_times" in recorded else 5
    policy = load(str(folder / "checkpoint"), dtype="float32", steps=steps)
    inputs = recorded_inputs(policy, recorded)
    state, mask, noise = (torch.from_numpy(recorded[f"in_{name}"]) for name in ("state", "action_mask", "noise"))
    blocks, dit = policy.language.layers, policy.network.dit.layers
    modules: dict[str, nn.Module] = {
        **{f"block{number}": block for number, block in enumerate(blocks)},
        **{f"dit{number}": block for number, block in enumerate(dit)},
        "velocity": policy.network.action_output_layer,
        "model": policy.vlm.model,
        "merger": policy.tower.merger,
    }
    actions, activations, calls = watch(policy, lambda: policy.infer(inputs, state, mask, noise), modules)
    streams, vision = stream_outputs(policy, activations), policy.vision.stream("vision")
    cache = calls["model"][0].past_key_values.layers
    produced: dict[str, Produce] = {
        **streams,
        "position_ids": lambda: numpy_of(inputs.positions(policy.vlm.model)),
        "vision_resid": lambda: streams["vision_resid"]().reshape(vision.layers, -1, vision.width),
        "vision_merged": lambda: numpy_of(calls["merger"][0]),
        "backbone_layer_input": streams["backbone_resid"],
        "backbone_layer_output": lambda: _outputs(calls, "block", len(blocks))[0],
        "kv_keys": lambda: numpy_of(torch.stack([layer.keys for layer in cache])),
        "kv_values": lambda: numpy_of(torch.stack([layer.values for layer in cache])),
        "dit_layer_input": lambda: streams["expert_resid"]()[:, :-1],
        "dit_layer_output": lambda: _outputs(calls, "dit", len(dit)),
        "velocity": lambda: numpy_of(torch.stack(calls["velocity"])),
        "x_t": lambda: euler_path(noise, calls["velocity"], lambda velocity: velocity * (1.0 / steps)),
        "denoise_times": lambda: np.array([step / steps for step in range(steps)], np.float32),
        "actions": lambda: numpy_of(actions),
        "actions_unnormalized": lambda: _restore_actions(policy, numpy_of(actions), recorded),
    }
    return Outputs(produced, inputs=_NORMS, valid=_valid(policy, recorded["in_attention_mask"].astype(bool)))


def _outputs(calls: Mapping[str, list[Tensor]], kind: str, blocks: int) -> NDArray[Any]:
    """Return the outputs (calls, blocks, …) of every block of a stack."""
    rows = zip(*(calls[f"{kind}{number}"] for number in range(blocks)), strict=True)
    return numpy_of(torch.stack([torch.stack(row) for row in rows]))


def _valid(policy: Xiaomi, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Return the masks of valid positions: (B, P) for streams, (B, heads, P) for keys and values."""
    heads = int(policy.vlm.config.text_config.num_key_value_heads)
    cached = np.repeat(mask[:, None], heads, axis=1)
    streams = ("backbone_layer_input", "backbone_layer_output", "backbone_final_norm")
    return dict.fromkeys(streams, mask) | dict.fromkeys(("kv_keys", "kv_values"), cached)


def _restore_actions(policy: Xiaomi, actions: NDArray[Any], recorded: Arrays) -> NDArray[Any]:
    """Return actions in units of the recorded statistics, where there are some; else of the checkpoint's."""
    if not set(_NORMS) <= set(recorded):
        return policy.units.restore(actions)
    mean, deviation = (np.asarray(recorded[name], np.float64) for name in _NORMS)
    mean, deviation = (part.reshape(part.shape[-2:]) for part in (mean, deviation))
    return RobotUnits("recorded", mean, deviation).restore(actions)
