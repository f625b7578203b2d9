"""Checks of streams, sites and capture."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.errors import CaptureError, SiteNeverFiredError, UnknownSiteError
from probe_kit.hooks.capturing.capture_context import capture
from probe_kit.hooks.capturing.changed_outputs import reason_of_change, same_bits
from probe_kit.hooks.conformance.check import CheckFailedError, check, refused, require, require_bits
from probe_kit.hooks.conformance.subject import Subject
from probe_kit.hooks.contract.sites import PARTS, Site

_SUM = ("residual", "attention", "mlp")


@check(
    "Every stream declares its name, part, label and quantities.",
    "Correct `streams` of the adapter: Stream(name, layers, width, part=…).",
)
def streams_declare_what_they_are(subject: Subject) -> None:
    model = subject.model
    for name, stream in model.every_stream().items():
        require(stream.name == name, f"the stream {stream.name!r} under the key {name!r}", "one name")
        require(stream.part in PARTS, f"{name} has part {stream.part!r}", f"one of {', '.join(PARTS)}")
        require(bool(stream.label), f"{name} has no label", "a label that people read")
        require(
            "residual" in stream.quantities or stream is model.prompt_kv,
            f"{name} has the quantities {', '.join(stream.quantities)}",
            "residual among them",
        )
    require(bool(subject.probed_backbone.layers), "a backbone without layers", "at least one layer")


@check(
    "The sites of a model are complete, ordered and without doubles.",
    "Let `Model.sites` come from the declared streams; count one layer more than there are blocks.",
)
def sites_are_complete_ordered_and_without_doubles(subject: Subject) -> None:
    sites = subject.model.sites()
    require(len(set(sites)) == len(sites) > 0, f"{len(sites)} sites, {len(set(sites))} different", "no doubles")
    for name, stream in subject.model.streams.items():
        stream_sites = [site for site in sites if site.stream == name]
        many = stream.layers * (stream.iterations or 1)
        require(
            stream_sites == stream.sites(),
            f"{name}: {len(stream_sites)} sites in another order",
            "those of Stream.sites()",
        )
        require(
            len(stream_sites) == many, f"{name}: {len(stream_sites)} sites", f"layers times iterations, {many}"
        )


@check(
    "Every site of every quantity fires as often as its tap promises.",
    "Tap the first submodule that a block calls, and correct `fires` or the stream's layers and iterations.",
)
def every_site_of_every_quantity_fires_as_often_as_promised(subject: Subject) -> None:
    streams = subject.model.every_stream().values()
    sites = [site for stream in streams for quantity in stream.captured for site in stream.sites(quantity)]
    with capture(subject.model, sites) as tape:
        subject.run(subject.batch)
    missing = [str(site) for site in sites if site not in tape]
    require(not missing, f"no activation at {', '.join(missing)}", "one at every site")


@check(
    "Activations have the shape (batch, tokens, width) of their stream.",
    "Correct the stream's width, the tap's `tokens` and `view`, or the number of positions in `roles`.",
)
def activations_have_the_shape_of_their_stream(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    roles = subject.roles_of(observations)
    with capture(model, model.sites()) as tape:
        subject.run(observations)
    require(roles.keys() == model.streams.keys(), f"roles of {list(roles)}", f"roles of {list(model.streams)}")
    for name, stream in model.streams.items():
        lengths = {len(row) for row in roles[name]}
        require(len(lengths) == 1, f"rows of {name} with {sorted(lengths)} positions", "equally long rows")
        expected = (len(observations), *lengths, stream.width)
        for site in stream.sites():
            shape = tuple(tape[site].shape)
            require(shape == expected, f"{site} has the shape {shape}", f"{expected}")


@check(
    "What the blocks add makes the next residual: residual + attention + mlp = residual of the next layer.",
    "Tap `attention` and `mlp` where they are added, or declare the stream with sums=False.",
)
def what_blocks_add_makes_the_next_residual(subject: Subject) -> None:
    """Compare the sum in every stream that declares all three quantities, those of vision towers too."""
    subject.require_float32()
    observations, roles = subject.batch, subject.roles_of(subject.batch)
    streams = {**subject.model.streams, **subject.model.further_streams}
    summing = {
        name: stream for name, stream in streams.items() if stream.sums and set(_SUM) <= set(stream.quantities)
    }
    sites = [site for stream in summing.values() for quantity in _SUM for site in stream.sites(quantity)]
    if not sites:
        return
    with capture(subject.model, sites) as tape:
        subject.run(observations)
    for name, stream in summing.items():
        # A tower has no roles: all of its positions are of pictures.
        valid = torch.from_numpy(np.stack([row.valid for row in roles[name]])) if name in roles else ...
        for site in stream.sites("attention"):
            parts = [tape[replace(site, quantity=quantity)].double().cpu() for quantity in _SUM]
            following = tape[replace(site, layer=site.layer + 1, quantity="residual")].double().cpu()
            apart = float((parts[0] + parts[1] + parts[2] - following)[valid].abs().max())
            limit = subject.tolerance * (1 + float(following[valid].abs().max()))
            require(
                apart <= limit, f"at block {site.layer} of {name} the sum is off by {apart:.3g}", f"≤ {limit:.3g}"
            )


@check(
    "Capturing every site changes no output, bit for bit.",
    "Take all randomness from the seeds, and keep no state between calls.",
)
def capturing_changes_no_output_bit_for_bit(subject: Subject) -> None:
    observations = subject.batch

    def captured() -> NDArray[np.float32]:
        with capture(subject.model, subject.model.sites()):
            return subject.run(observations)

    plain, hooked = subject.run(observations), captured()
    if not same_bits(plain, hooked):
        raise CheckFailedError(
            f"the outputs with and without hooks differ by up to {np.abs(plain - hooked).max():.3g}",
            "no difference, bit for bit",
            reason_of_change(lambda: subject.run(observations), plain, captured),
        )


@check(
    "Hooks are gone after an exception inside a capture.",
    "Register no hooks of your own, and keep no state between calls.",
)
def hooks_are_gone_after_an_exception(subject: Subject) -> None:
    model, observations = subject.model, subject.batch
    plain = subject.run(observations)
    with refused("an exception in a capture", KeyError, says="body"), capture(model, model.sites()):
        raise KeyError("body")
    require_bits(subject.run(observations), plain, "outputs after the exception", "those before it")
    with refused("a capture without an inference", SiteNeverFiredError), capture(model, model.sites()[:1]):
        pass


@check(
    "A capture inside a capture of the same model is refused.",
    "Let `tap` name modules of this model only.",
)
def nested_captures_are_refused(subject: Subject) -> None:
    model, sites = subject.model, subject.model.sites()[:1]
    with capture(model, sites):
        with refused("a capture inside a capture", CaptureError), capture(model, sites):
            pass
        subject.run(subject.batch)


@check(
    "A site that the model does not have is refused.",
    "Call `self.stream_of(site)` first in `tap`; it raises UnknownSiteError.",
)
def an_unknown_site_is_refused(subject: Subject) -> None:
    stream = next(iter(subject.model.streams))
    for site in (Site(stream, 999), Site(stream, 0, "nonsense"), Site("nowhere", 0)):
        with refused(f"tap({site})", UnknownSiteError):
            subject.model.tap(site)
