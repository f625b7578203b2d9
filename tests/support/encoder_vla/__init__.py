"""A third party's family on torch's own nn.TransformerEncoder; tests install it beside those of probe_kit."""

from probe_kit.hooks import Checkpoints, Family, Requirements

FAMILY = Family(
    "encoder-vla",
    "torch's own encoder",
    None,
    "encoder_vla.policy:load",
    streams="backbone 3 layers, expert 3 layers x 2 iterations",
    requirements=Requirements(needs_checkpoint=True),
    checkpoints=Checkpoints(config_types=("encoder-vla",)),
)
