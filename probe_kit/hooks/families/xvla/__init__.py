"""X-VLA through lerobot.

Its page is `docs/pi0.md`; its golden reference is `tests/golden/xvla`.
"""

from probe_kit.hooks.contract.declared import TEXT, DeclaredStream, Interventions, Option, expert
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.families.shared.kinds import MERGED, NO_HEAD, lerobot_family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

PICTURES = ("padded", "squashed")
"""The ways in which pictures come to the network's resolution: of lerobot, and of the authors."""
BLOCK = ("residual", "attention", "mlp")
INTERVENTIONS = Interventions(
    edits={"backbone": BLOCK, "expert": BLOCK},
    gradients=True,
    instead={
        "kv": "its expert reads the end of the backbone as tokens of its own, no keys and values. Patch the last "
        "`backbone` site for the whole, and roles of `expert` sites for single pictures and words",
        "attention": "its expert attends to the prompt's tokens inside its own sequence. Patch `expert` sites of "
        "one role instead",
        "tiles": f"{MERGED}Exchange all of `image`",
    },
)
"""The interventions of a policy in which all cameras but the first reach the expert past the backbone."""

FAMILIES = (
    lerobot_family(
        "xvla",
        "X-VLA (Florence-2 encoder, soft-prompted transformer) through lerobot",
        "lerobot/xvla-base",
        "xvla.adapter:Xvla",
        embodiment="as the checkpoint's action space; the released ones are absolute poses",
        notes=(
            "A checkpoint in lerobot's layout. Its configuration holds Florence-2's; the tokenizer "
            "facebook/bart-large is fetched where no tokenizer.json lies beside it. -M domain=N chooses the soft "
            "prompts of another robot. Pictures are padded as config.json says; the authors squash them to 224 x "
            "224, bicubic (-M picture=squashed). Absolute poses cannot act here: --no-act"
        ),
        options=(
            Option(
                "picture",
                str,
                "How pictures come to the network's resolution.",
                "padded where config.json has resize_imgs_with_padding",
                PICTURES,
            ),
            Option("domain", int, "Number of the robot's soft prompts.", "as policy_preprocessor.json says"),
        ),
        checkpoints=Checkpoints(
            hub=(("facebook/bart-large", "tokenizer.json"),),
            parameters={"": 879_851_096},
            not_acting=("lerobot/xvla-base", "2toINF/X-VLA-WidowX"),
            declared={
                "": (
                    DeclaredStream(
                        Stream("backbone", 13, 1024, quantities=BLOCK, sums=False), 114, ("image.image", *TEXT)
                    ),
                    expert(25, 1024, 10, 276, ("action", "image.image", *TEXT, "soft_prompt"), quantities=BLOCK),
                )
            },
        ),
        abilities=Abilities(interventions=INTERVENTIONS, no_words=NO_HEAD),
    ),
)
