"""Figures as data that lies in the page itself."""

from base64 import b64encode
from io import BytesIO

from probe_kit.retention.displays.gallery import Exhibit

SVG_LIMIT = 600_000
"""Bytes; a figure of more is kept as pixels."""
_PIXELS_PER_INCH = 200


def data_uri(exhibit: Exhibit) -> str:
    """The drawn figure as SVG, or as PNG if that would be large. The same figure gives the same bytes."""
    import matplotlib as mpl

    with exhibit.drawn() as figure, mpl.rc_context({"svg.hashsalt": "probe_kit", "svg.fonttype": "path"}):
        svg = BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})
        if svg.tell() <= SVG_LIMIT:
            return encode("image/svg+xml", svg.getvalue())
        png = BytesIO()
        figure.savefig(png, format="png", dpi=_PIXELS_PER_INCH, metadata={"Software": None})
        return encode("image/png", png.getvalue())


def encode(kind: str, content: bytes) -> str:
    """A data URI of bytes of some media type."""
    return f"data:{kind};base64,{b64encode(content).decode()}"
