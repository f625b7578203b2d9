"""The adapter for pi0.5.

Prefix: every camera's patches, then a prompt with the instruction and the state as digits.
Suffix: the action chunk, with the time of the flow step in the expert's adaptive norms.

Source: arXiv 2504.16054, through lerobot's `PI05Policy`.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor, nn

from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.families.shared.lerobot.config_fields import Inert
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy
from probe_kit.hooks.families.shared.lerobot.stacks import Stack
from probe_kit.hooks.families.shared.lerobot.state_prompt import StatePrompt
from probe_kit.models.lerobot.pi0 import Pi0Size
from probe_kit.models.lerobot.pi0_keys import current_pi05_keys
from probe_kit.models.lerobot.pi05 import build_pi05


class GatedStack(Stack):
    """The expert, whose blocks add what they compute through a gate."""

    def tap(self, site: Site) -> Tap:
        """Return the tap; a block's addition is read behind its gate."""
        if site.quantity in ("attention", "mlp") and site.layer < len(self.layers):
            return Tap(getattr(self.layers[site.layer], f"{site.quantity}_gate"), self.iterations or 1, "output")
        return super().tap(site)


class Pi05(StatePrompt, Pi0):
    """A loaded pi0.5."""

    family = "pi05"
    config_type = "pi05"
    takes_unread = False
    newer_fields: ClassVar[Inert] = {
        "use_visual_memory": (False,),
        "use_proprioceptive_memory": (False,),
        "rtc_training_max_delay": (0,),
        **dict.fromkeys(("memory_frames", "memory_stride", "memory_temporal_attention_every")),
    }
    known_steps = (
        CROP,
        "pi05_prepare_state_tokenizer_processor_step",
    )

    prompt_end = "Action: "
    suffix_roles = ("action",)

    @classmethod
    def network_of(cls, config: Any, size: Pi0Size | None) -> nn.Module:
        """lerobot's policy of this size."""
        network: nn.Module = build_pi05(config, size)
        return network

    @classmethod
    def current_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Older names brought to today's."""
        return current_pi05_keys(tensors)

    def _stacks(self) -> dict[str, Stack]:
        stacks = super()._stacks()
        return {**stacks, "expert": GatedStack(**vars(stacks["expert"]))}

    suffix_labels = LerobotPolicy.suffix_labels
