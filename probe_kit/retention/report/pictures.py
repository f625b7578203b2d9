"""Figures as data that lies in the page itself."""

import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from urllib.parse import quote
from xml.etree import ElementTree

from probe_kit._terminal.plain_text import without_places
from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.displays.report_figures import caption_of

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
