"""Checks of edits."""

import numpy as np
import torch

from probe_kit.hooks.capturing.capture_context import capture, edit
from probe_kit.hooks.conformance.check import check, require, require_bits
from probe_kit.hooks.conformance.subject import Subject
from probe_kit.hooks.contract.sites import Site, Stream


@check(
    "Rewriting a site with itself changes no output, and zeros in its place do.",
    "Tap the tensor that the block itself reads, not a copy: an edit is written into that tensor.",
)
def an_identity_edit_changes_nothing_and_zeroing_changes_the_output(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    plain = subject.run(observations)
    for stream in model.streams.values():
        if not stream.probed:
            continue
        site = stream.sites()[1]
        with edit(model, {site: lambda activation: activation}):
            same = subject.run(observations)
        require_bits(same, plain, f"outputs with {site} rewritten by itself", "those without")
        with edit(model, dict.fromkeys(_everywhere(stream, site), torch.zeros_like)):
            changed = subject.run(observations)
        require(
            bool(np.abs(changed - plain).max() > 0),
            f"zeros at {site} change no output",
            "other outputs: the stream is on the way to them",
        )
    require_bits(subject.run(observations), plain, "outputs after the edits", "those before")


def _everywhere(stream: Stream, site: Site) -> list[Site]:
    """The site at every iteration: one action token of several may decide nothing that is printed."""
    return [candidate for candidate in stream.sites() if candidate.layer == site.layer]


@check(
    "A capture inside an edit reads what the edit left.",
    "Let a site be read and written at the same end of one module.",
)
def an_edit_is_what_a_capture_inside_it_reads(subject: Subject) -> None:
    model, site = subject.model, subject.model.sites()[1]
    with edit(model, {site: torch.zeros_like}), capture(model, [site]) as tape:
        subject.run(subject.batch)
    most = float(tape[site].abs().max())
    require(most == 0, f"{site} holds values up to {most:.3g} behind an edit to zeros", "zeros")
