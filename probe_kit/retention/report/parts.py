"""The parts of pages: templates, pictures, the origin of numbers, and the glossary."""

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

from probe_kit._system.escaping import without_places
from probe_kit._tables.html import environment
from probe_kit._tables.numbers import percent
from probe_kit._tables.table import Table
from probe_kit.retention.behaviour import ask_of
from probe_kit.retention.columns.sentences import VERDICT_HELP, chance_only
from probe_kit.retention.columns.text import TERMS, is_vlm, title_of
from probe_kit.retention.displays.report_figure import ReportFigure, caption_of
from probe_kit.retention.displays.style import ProvenanceLine
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.reader import SIDE, RunReader
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.version import __version__

_HERE = Path(__file__).parent
_ASSETS = {"css": "page.css", "js": "page.js", "episodes_js": "episodes.js"}


def render(template: str, places: tuple[str, ...], **content: Any) -> str:
    """The page; no text in it holds `places` or another absolute path of this machine."""
    from markupsafe import Markup

    assets = {name: Markup((_HERE / file).read_text(encoding="utf-8")) for name, file in _ASSETS.items()}
    return environment(_HERE, places=places).get_template(template).render(**assets, **content)


SVG_LIMIT = 150_000
"""Bytes; a figure of more is kept as pixels."""
PIXELS_PER_INCH = 200
"""Of figures that are kept as pixels."""
_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_ROUNDED = ("d", "x", "y")
"""Attributes in points, of which a hundredth cannot be seen."""
_FONTS = re.compile(r"'[^;]*sans-serif")
"""The fonts of a text, the first of them matplotlib's; a page has those of the machine that shows it."""
_IN_URI = " !$'()*+,-./:;=?@[]_`{|}~"
"""What a URI in double quotes may hold as it is."""


@dataclass(frozen=True)
class Picture:
    """A figure in the page. run: its name, empty for a figure of all runs. caption: what it is about, in full."""

    title: str
    run: str
    reading: str
    source: str
    caption: str
    extra: bool


def arranged(
    exhibits: Sequence[ReportFigure], subject: str, names: Sequence[str], places: tuple[str, ...]
) -> list[list[Picture]]:
    """Figures of one subject by kind: those of several runs side by side.

    All but the first of a kind and run are extra, to be unfolded, and so are those of single runs that another
    figure shows side by side.
    """
    by_title: dict[str, list[Picture]] = {}
    of_subject = [exhibit for exhibit in exhibits if exhibit.subject == subject]
    together = {_kind(exhibit) for exhibit in of_subject if exhibit.run is None}
    for exhibit in of_subject:
        run = "" if exhibit.run is None else names[exhibit.run]
        kind = _kind(exhibit)
        before = [other for pictures in by_title.values() for other in pictures]
        extra = any(other.run == run and other.title.partition(",")[0] == kind for other in before)
        extra |= exhibit.run is not None and f"{kind} side by side" in together
        by_title.setdefault(exhibit.title, []).append(
            Picture(exhibit.title, run, exhibit.reading, *data_uri(exhibit, places), extra)
        )
    return list(by_title.values())


def _kind(exhibit: ReportFigure) -> str:
    return exhibit.title.partition(",")[0]


def data_uri(exhibit: ReportFigure, places: tuple[str, ...] = ()) -> tuple[str, str]:
    """The drawn figure as SVG, or WebP if that would be large, with its caption. A figure gives the same bytes.

    Its ground is transparent, so that the page's colour is behind it. Of `places` and other absolute paths in
    its words the last part is left.
    """
    import matplotlib as mpl
    from matplotlib.text import Text

    with (
        exhibit.drawn() as figure,
        mpl.rc_context({"svg.hashsalt": "probe_kit", "svg.fonttype": "none", "savefig.transparent": True}),
    ):
        for words in figure.findobj(Text):
            words.set_text(without_places(words.get_text(), places))
        file = BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
        svg = compact_svg(file.getvalue())
        if len(svg) <= SVG_LIMIT:
            return f"data:image/svg+xml,{quote(svg, safe=_IN_URI)}", caption_of(figure)
        file = BytesIO()
        pixels = {"lossless": True, "method": 6}
        figure.savefig(file, format="webp", dpi=PIXELS_PER_INCH, pil_kwargs=pixels)
        return encode("image/webp", file.getvalue()), caption_of(figure)


def encode(kind: str, content: bytes) -> str:
    """A data URI of bytes of some media type."""
    return f"data:{kind};base64,{b64encode(content).decode()}"


def compact_svg(svg: bytes) -> bytes:
    """The same drawing without metadata, comments, line breaks, names that nothing uses, and fine decimals."""
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _XLINK)
    root = ElementTree.fromstring(svg)
    for metadata in root.findall(f"{{{_SVG}}}metadata"):
        root.remove(metadata)
    used = set(re.findall(r"#([\w-]+)", svg.decode()))
    for element in root.iter():
        element.text, element.tail = ((text or "").strip() or None for text in (element.text, element.tail))
        if element.get("id") not in used:
            element.attrib.pop("id", None)
        for name in _ROUNDED:
            if name in element.attrib:
                element.set(name, _rounded(element.attrib[name]))
        if "style" in element.attrib:
            element.set("style", _FONTS.sub("sans-serif", element.attrib["style"]))
    return ElementTree.tostring(root)


def _rounded(numbers: str) -> str:
    """Numbers and letters of a path, of two decimals each and without needless spaces."""
    short = re.sub(r"-?\d+\.\d+(?!e)", lambda match: f"{float(match[0]):.2f}".rstrip("0").rstrip("."), numbers)
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", re.sub(r"\s+", " ", short)).strip()


# -- origin of numbers ---------------------------------------------------------------------------------------

PAPER = "arXiv:2606.19297"


def provenance(name: str, run: RunReader, results: Sequence[ProbeResults]) -> dict[str, Any]:
    """Return what a run says about itself and its probes; runs that were not made by probe_kit say less.

    Its name, its line, facts by name, and documents by name as pretty JSON.
    """
    settings, certificate = run.settings, run.certificate
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
    documents |= {
        f"probe settings{_of_target(probes)}": {
            "key": probes.key,
            "created": probes.created,
            **asdict(probes.settings),
        }
        for probes in results
    }
    return {
        "name": name,
        "line": ProvenanceLine.of_run(run).line,
        "facts": [(key, value) for key, value in facts.items() if value],
        "documents": [
            (key, json.dumps(value, indent=2, ensure_ascii=False)) for key, value in documents.items() if value
        ],
    }


def _protocol(settings: Mapping[str, Any]) -> dict[str, str]:
    """The protocol that a run follows, how it differs from the default, and how the run differs from it."""
    protocol = settings.get("protocol")
    if not protocol:
        return {}
    return {
        "protocol": protocol["name"],
        "deviates from it in": _listed(protocol["deviations"]) or "nothing",
        "it differs from the default in": _listed(
            {name: pair[::-1] for name, pair in protocol["differs_from_default"].items()}
        ),
        "of it cannot be matched": "; ".join(protocol["unmatched"]),
    }


def _listed(pairs: Mapping[str, Sequence[str | None]]) -> str:
    changes = (f"{name} {now or 'nothing'} instead of {was or 'nothing'}" for name, (was, now) in pairs.items())
    return "; ".join(changes)


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


# -- warnings ------------------------------------------------------------------------------------------------

_MOSTLY = 0.5  # share of episodes above which something is said first


def warnings_of(mean: RetentionRow, rows: Sequence[RetentionRow]) -> list[str]:
    """Return what would be misread without a word about it, of a run's categories and their mean, in a view."""
    sentences = []
    if mean.run.random_weights:
        sentences.append("The weights are random: the model is untrained. Read every number as “knows nothing”.")
    sentences += _unread(mean) if is_vlm(mean) else _unmoved(mean)
    biased = [
        row
        for row in rows
        if row.success.side_preference is not None and abs(row.success.side_preference - 0.5) > 0.25
    ]
    if biased:
        habit = "The answers have a habit of naming" if is_vlm(mean) else "The policy has a habit of going to"
        sentences.append(f"{habit} one side in {_of(biased, rows)}.")
    if uncontrolled := chance_only(rows):
        sentences.append(f"{uncontrolled}.")
    if mean.controls.leaks:
        sentences.append(
            f"The suite gives answers away without a model ({', '.join(mean.controls.leaks)}): see the "
            "controls before believing a probe."
        )
    return sentences


def _unread(mean: RetentionRow) -> list[str]:
    """Return warnings about a model that was asked."""
    if (mean.success.share_outside or 0) <= _MOSTLY:
        return []
    unread = percent(mean.success.share_outside)
    return [f"No answer could be read in {unread} % of episodes: it may know more than it says."]


def _unmoved(mean: RetentionRow) -> list[str]:
    """Return warnings about a policy."""
    sentences = []
    if (mean.success.share_never_moved or 0) > _MOSTLY:
        sentences.append(
            f"The cube never moved in {percent(mean.success.share_never_moved)} % of episodes: "
            "the policy does not grasp, so its success rate is no measure of what it knows."
        )
    elif (mean.success.share_outside or 0) > _MOSTLY:
        sentences.append(
            f"The cube reached neither picture in {percent(mean.success.share_outside)} % of episodes."
        )
    if mean.success.share_invalid_action:
        sentences.append(
            f"In {percent(mean.success.share_invalid_action)} % of its steps the policy put out "
            "something that is no action."
        )
    return sentences


def _names(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """The shorter of the two lists: those that are in, or those that are not."""
    absent = [row for row in rows if row not in part]
    listed, prefix = (absent, "all but ") if len(absent) < len(part) else (part, "")
    return prefix + ", ".join(title_of(row.category) for row in listed)


def _of(part: Sequence[RetentionRow], rows: Sequence[RetentionRow]) -> str:
    """Return how many of the categories, and which if not all."""
    noun = "category" if len(rows) == 1 else "categories"
    if len(part) == len(rows):
        return f"all {len(rows)} {noun}" if len(rows) > 1 else "the only category"
    names = f" ({_names(part, rows)})" if part else ""
    return f"{len(part) or 'none'} of {len(rows)} {noun}{names}"


# -- glossary ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Words:
    """entries: name, meaning and place of each word, by what they stand in.

    headings: the place of a column's word and meaning; two tables may give a word two meanings. values: the place
    of a cell's text that is a word.
    """

    entries: Mapping[str, tuple[tuple[str, str, str], ...]]
    headings: Mapping[tuple[str, str], str]
    values: Mapping[str, str]


def words_of(tables: Sequence[Table]) -> Words:
    """The words of all columns of `tables` and of the verdicts in them, and terms that are neither."""
    cells = {cell.value for table in tables for row in table.rows for cell in row.cells}
    groups: dict[str, dict[tuple[str, str], None]] = {}
    for table in tables:
        title = re.split("[:,]", table.title)[0]
        entries_of = {(column.text, column.help): None for column in table.headings if column.help}
        groups.setdefault(title, {}).update({word: None for word in entries_of if word not in _all(groups)})
    words = {_word(cell) for cell in cells}
    groups["Verdicts"] = {(name, text): None for name, text in VERDICT_HELP.items() if name in words}
    groups["Further terms"] = {word: None for word in TERMS.items() if word not in _all(groups)}
    places = {word: f"word-{number}" for number, word in enumerate(_all(groups))}
    entries = {
        title: tuple((*word, places[word]) for word in entries_of)
        for title, entries_of in groups.items()
        if entries_of
    }
    of_values = {
        name: anchor for (name, text), anchor in places.items() if (VERDICT_HELP | TERMS).get(name) == text
    }
    return Words(entries, places, {cell: of_values[_word(cell)] for cell in cells if _word(cell) in of_values})


def _word(cell: str) -> str:
    """A verdict without its direction, side and bound."""
    return cell.removeprefix("against: ").partition(" (")[0]


def _all(groups: Mapping[str, Mapping[tuple[str, str], None]]) -> list[tuple[str, str]]:
    return [word for of_table in groups.values() for word in of_table]
