"""The origin of the numbers, and how to cite them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from probe_kit.retention.behaviour.vlm_answers import ask_of
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.runs.reader import SIDE, RunReader
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.version import __version__

PAPER = "arXiv:2606.19297"


@dataclass(frozen=True)
class Provenance:
    """One run's identity. facts: name and value. documents: name and pretty JSON."""

    name: str
    line: str
    facts: tuple[tuple[str, str], ...]
    documents: tuple[tuple[str, str], ...]


def provenance(name: str, run: RunReader, results: Sequence[ProbeResults]) -> Provenance:
    """Return what a run says about itself and its probes; runs that were not made by probe_kit say less."""
    settings = run.settings
    certificate = run.certificate
    facts = {
        "run": run.label,
        "model": run.model,
        "weights": "random: untrained" if run.random_weights else "",
        "weights sha256": run.weights_sha256 or "none (scripted)",
        "suite": run.suite,
        "episodes": str(len(run.episodes)),
        "streams": "; ".join(_stream(run, stream) for stream in run.streams) or "none",
        **_protocol(settings),
        "run settings sha256": run.settings_sha256,
        "hooks on equals hooks off": {True: "yes, bit for bit", None: ""}.get(
            certificate.get("hooks_on_equals_hooks_off"), "no"
        ),
        "mixed": ", ".join(run.mixed),
        **({f"probes{_of_target(probes)}": probes.key for probes in results} or {"probes": "none"}),
    }
    documents = {"run settings": settings, "certificate": certificate}
    documents |= {f"probe settings{_of_target(probes)}": _probe_settings(probes) for probes in results}
    return Provenance(
        name,
        ProvenanceLine.of_run(run).line,
        tuple((key, value) for key, value in facts.items() if value),
        tuple((key, json.dumps(value, indent=2, ensure_ascii=False)) for key, value in documents.items() if value),
    )


def _protocol(settings: Mapping[str, Any]) -> dict[str, str]:
    """The protocol that a run follows, how it differs from the default, and how the run differs from it."""
    protocol = settings.get("protocol")
    if not protocol:
        return {}
    return {
        "protocol": protocol["name"],
        "deviates from it in": _listed(protocol["deviations"], "instead of") or "nothing",
        "it differs from the default in": _listed(
            {name: pair[::-1] for name, pair in protocol["differs_from_default"].items()}, "instead of"
        ),
        "of it cannot be matched": "; ".join(protocol["unmatched"]),
    }


def _listed(pairs: dict[str, list[str | None]], between: str) -> str:
    return "; ".join(
        f"{name} {now or 'nothing'} {between} {was or 'nothing'}" for name, (was, now) in pairs.items()
    )


def citation(runs: Sequence[RunReader]) -> tuple[str, str]:
    """A sentence for a methods section, and BibTeX; of the protocol only for runs of its scene."""
    lines = "; ".join(ProvenanceLine.of_run(run).line.replace(" · ", ", ") for run in runs)
    of_scene = any(SIDE in run.episodes for run in runs)
    protocol = f" under the Act2Answer protocol ({PAPER})" if of_scene else ""
    asked_alone = all(ask_of(run) is not None for run in runs)
    shares = "Accuracies of answers about" if asked_alone else "Success rates from"
    limits = f" {shares} a PyBullet scene are comparable with each other, not with those of other simulators."
    sentence = f"Evaluated with probe_kit {__version__}{protocol}: {lines}.{limits if of_scene else ''}"
    software = (
        "@software{probe_kit,\n"
        "  title   = {probe\\_kit: where a Vision-Language-Action model knows the answer, and where it is lost},\n"
        f"  version = {{{__version__}}},\n"
        "  license = {Apache-2.0}\n}"
    )
    paper = (
        "\n\n@misc{act2answer,\n"
        "  title         = {Does {VLA} Even Know the Basics?},\n"
        "  eprint        = {2606.19297},\n"
        "  archivePrefix = {arXiv}\n}"
    )
    return sentence, software + (paper if of_scene else "")


def _stream(run: RunReader, name: str) -> str:
    stream = run.streams[name]
    steps = f" × {stream.iterations} iterations" if stream.iterations else ""
    return f"{name} {stream.layers} layers{steps}, width {stream.width}"


def _of_target(probes: ProbeResults) -> str:
    return "" if probes.settings.is_side else f" of {probes.settings.target}"


def _probe_settings(probes: ProbeResults) -> dict[str, Any]:
    return {"key": probes.key, "created": probes.created, **asdict(probes.settings)}
