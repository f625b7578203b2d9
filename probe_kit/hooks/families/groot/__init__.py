"""GR00T N1.7 through lerobot.

Its page is `docs/pi0.md`; its golden reference is `tests/golden/groot`.
"""

from probe_kit.hooks.contract.declared import TEXT, DeclaredStream, Interventions, Option, backbone, expert
from probe_kit.hooks.contract.sites import QUANTITIES, Stream
from probe_kit.hooks.families.shared.kinds import MERGED, NO_HEAD, lerobot_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements

RESIZES = ("nvidia", "lerobot")
"""The code that brings pictures to their size, in two ways."""
BRIDGE = ("residual", "attention", "mlp")
INTERVENTIONS = Interventions(
    edits={"backbone": QUANTITIES, "bridge": BRIDGE, "expert": QUANTITIES},
    gradients=True,
    instead={
        "kv": "its expert reads the end of the bridge, no keys and values of the backbone. Patch the last "
        "`bridge` site for the whole prompt, and backbone sites for single roles",
        "attention": "its expert attends to the end of the bridge, whose tokens have mixed. Patch `bridge` "
        "sites of one role instead",
        "tiles": f"{MERGED}Exchange all of `image`",
    },
)
"""The interventions of an expert that reads the whole backbone through the bridge, also its last residual."""

FAMILIES = (
    lerobot_family(
        "groot",
        "GR00T N1.7 (Qwen3-VL cut behind layer 16, bridge, diffusion transformer) through lerobot",
        "nvidia/GR00T-N1.7-3B",
        "groot.adapter:Groot",
        embodiment="as the checkpoint's statistics",
        notes=(
            "A checkpoint of lerobot, or one in NVIDIA's own layout with -M embodiment=TAG. It names a "
            "vision-language model, whose tokenizer and processor files are fetched, not its weights, or given as "
            "-M vlm=FOLDER. No remote code. One observation per call: its bridge reads padding"
        ),
        options=(
            Option("embodiment", str, "Tag in NVIDIA's layout, such as libero_sim.", "the only one"),
            Option("letterbox", bool, "Black bars make pictures square first.", "as the files say, or false"),
            Option("resize", str, "Whose code resizes pictures.", "as the layout", RESIZES),
            Option(
                "vlm", str, "Folder or hub id of its Qwen3-VL; no weights.", "as config.json says", is_path=True
            ),
        ),
        checkpoints=Checkpoints(
            full_size="probe_kit.hooks.families.groot.network:full_size_groot",
            hub=(("nvidia/Cosmos-Reason2-2B", "tokenizer.json"),),
            config_types=("groot", "Gr00tN1d7"),
            instead=tuple(
                (kind, f"It is a GR00T {version}, and only N1.7 is read here: take a fine-tune of N1.7")
                for version, kinds in (
                    ("N1", ("gr00t_n1", "GR00T_N1")),
                    ("N1.5", ("gr00t_n1_5", "GR00T_N1_5", "gr00t_n1d5", "Gr00tN1d5")),
                    ("N1.6", ("gr00t_n1_6", "GR00T_N1_6", "gr00t_n1d6", "Gr00tN1d6")),
                )
                for kind in kinds
            ),
            parameters={"": 3_144_016_000},
            declared={
                "": (
                    backbone(17, 2048, 110, camera="image", sums=False),
                    DeclaredStream(
                        Stream("bridge", 5, 2048, part="bridge", quantities=BRIDGE), 110, ("image.image", *TEXT)
                    ),
                    expert(33, 1536, 4, 41, ("state", "action")),
                )
            },
        ),
        requirements=Requirements(always_float32=True, packages=(("diffusers", "groot"),)),
        abilities=Abilities(interventions=INTERVENTIONS, no_words=NO_HEAD),
    ),
)
