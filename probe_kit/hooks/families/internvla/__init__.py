"""InternVLA-M1, native.

Its page is `docs/qwen-vla.md`; its golden reference is `tests/golden/internvla_m1`.
"""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.card import SourceWeights
from probe_kit.hooks.contract.declared import (
    ACT2ANSWER,
    OWN_SEEDS,
    DeclaredStream,
    Interventions,
    Option,
    ProtocolRow,
    backbone,
    expert,
)
from probe_kit.hooks.contract.sites import QUANTITIES, Stream
from probe_kit.hooks.families.shared.action_statistics import ActionStatistics
from probe_kit.hooks.families.shared.kinds import MERGED, NO_HEAD
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

_UNCONDITIONAL = "action expert without condition"
_HEAD = ("condition", "action")
_BLOCK = ("residual", "attention", "mlp")
INTERVENTIONS = Interventions(
    edits={"backbone": QUANTITIES, "bridge": _BLOCK, "expert": QUANTITIES, "expert_unconditional": QUANTITIES},
    instead={
        "kv": "its queries read hidden states of the backbone and DINOv2's features, no keys and values. The "
        "acting head reads only the end of the bridge: patch the last `bridge` site for the whole, and backbone "
        "sites for what passes through the language model",
        "attention": "its expert attends to the queries only, not to the backbone. Patch backbone "
        "sites of one role instead",
        "tiles": f"{MERGED}Exchange all of `image`",
    },
)
"""The interventions of a policy in which DINOv2's features reach the bridge past the backbone.

Patching backbone sites does not patch everything.
"""

FAMILIES = (
    Family(
        "internvla-m1",
        "InternVLA-M1 (Qwen2.5-VL 3B, DINOv2, querying transformer, guided diffusion head), native",
        "InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge",
        "probe_kit.hooks.families.internvla.adapter:load_internvla",
        embodiment="as the data set of -M unnorm_key; bridge_dataset: WidowX end-effector delta at 5 Hz",
        notes="MIT, Qwen research licence; a .pt file; tokenizer and configuration of Qwen/Qwen2.5-VL-3B-Instruct",
        options=(
            Option("unnorm_key", str, "Data set whose units the actions get.", "the only one"),
            Option("steps", int, "DDIM steps; as many as divide the training's evenly.", "10"),
            Option("guidance", float, "Scale of guidance; 1 or less runs the condition alone.", "1.5"),
            Option(
                "weights", str, "File of a step, by its name.", "the only one, or steps_50000_pytorch_model.pt"
            ),
            Option(
                "vlm", str, "Folder or hub id of its Qwen2.5-VL; no weights.", "as config.yaml says", is_path=True
            ),
            Option(
                "tokenizer", str, "Folder of another tokenizer.json.", "the vision-language model's", is_path=True
            ),
        ),
        protocols={
            ACT2ANSWER: ProtocolRow(
                "InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge",
                execute=1,
                rotation="axis-angle",
                dtype="bfloat16",
                options={"steps": 10, "guidance": 1.5},
                of_checkpoint={"unnorm_key": "bridge_dataset", "weights": "steps_50000_pytorch_model.pt"},
                unmatched=(OWN_SEEDS,),
            )
        },
        abilities=Abilities(
            outputs="probe_kit.hooks.families.internvla.adapter:internvla_outputs",
            units="probe_kit.hooks.families.internvla.adapter:internvla_units",
            interventions=INTERVENTIONS,
            no_words=NO_HEAD,
        ),
        checkpoints=Checkpoints(
            source="qwen2.5-vl",
            source_weights=SourceWeights("Qwen/Qwen2.5-VL-3B-Instruct", parameters=3_754_622_976),
            of_default={"unnorm_key": "bridge_dataset"},
            declared={
                "": (
                    backbone(37, 2048, 130),
                    DeclaredStream(Stream("bridge", 2, 768, part="bridge", quantities=_BLOCK), 64, ("query",)),
                    expert(13, 768, 10, 80, _HEAD),
                    expert(
                        13, 768, 10, 80, _HEAD, name="expert_unconditional", label=_UNCONDITIONAL, probed=False
                    ),
                )
            },
            full_size="probe_kit.hooks.families.internvla.network:full_size_internvla",
            parameters={"": 3_872_703_111},
            hub=(
                ("InternRobotics/InternVLA-M1-Pretrain-RT-1-Bridge", "config.yaml"),
                ("Qwen/Qwen2.5-VL-3B-Instruct", "tokenizer.json"),
            ),
        ),
    ),
)


_GRIPPER, _OPEN = 6, 0.5


class ActionUnits(ActionStatistics):
    """The statistics of a run.

    Its head puts out numbers beyond [-1, 1], and a gripper between open and closed.
    """

    lacking: ClassVar[str] = (
        "the checkpoint has no dataset_statistics.json: its actions have no physical unit. Take the file that the "
        "run was released with"
    )

    def restore(self, values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return values (…, D) in the data set's units: clipped to [-1, 1], the gripper decided, then stretched.

        The gripper is open or closed.
        """
        clipped = np.clip(values.astype(np.float64), -1, 1)
        if clipped.shape[-1] > _GRIPPER:
            clipped[..., _GRIPPER] = clipped[..., _GRIPPER] >= _OPEN
        # In the order of the original's operations, for the last bit.
        return np.where(self.mask, 0.5 * (clipped + 1) * (self.high - self.low) + self.low, clipped)
