"""Figures as data that lies in the page itself."""

from base64 import b64encode
from io import BytesIO

from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.displays.report_figures import caption_of

SVG_LIMIT = 600_000
"""Bytes; a figure of more is kept as pixels."""


def data_uri(exhibit: ReportFigure) -> tuple[str, str]:
    """The drawn figure as SVG, or PNG if that would be large, with its caption. A figure gives the same bytes."""
    import matplotlib as mpl

    from probe_kit.retention.displays.base.shown_figure import PRINT_DPI

    with exhibit.drawn() as figure, mpl.rc_context({"svg.hashsalt": "probe_kit", "svg.fonttype": "path"}):
        svg = BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})
        if svg.tell() <= SVG_LIMIT:
            return encode("image/svg+xml", svg.getvalue()), caption_of(figure)
        png = BytesIO()
        figure.savefig(png, format="png", dpi=PRINT_DPI, metadata={"Software": None})
        return encode("image/png", png.getvalue()), caption_of(figure)


def encode(kind: str, content: bytes) -> str:
    """A data URI of bytes of some media type."""
    return f"data:{kind};base64,{b64encode(content).decode()}"
