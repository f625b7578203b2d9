"""Figures in the page: small, the same drawing, and without a path of the machine that drew them."""

import re
from io import BytesIO
from urllib.parse import unquote
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from probe_kit.retention.displays.base.report_figure import ReportFigure
from probe_kit.retention.report import parts
from probe_kit.retention.report.parts import compact_svg, data_uri

SVG = "{http://www.w3.org/2000/svg}"


def drawing(points: int = 40) -> Figure:
    """A curve, hatched bars and words."""
    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.plot(np.linspace(0, 1, points), np.random.default_rng(0).random(points), marker="o")
    axes.bar([0.2, 0.6], [0.5, 0.7], 0.2, hatch="///", color="#56B4E9")
    axes.set_title("checkpoint of /home/jane/models/mine & more")
    return figure


def exhibit(points: int = 40) -> ReportFigure:
    return ReportFigure("name", "title", "behaviour", "Reading.", None, lambda: drawing(points))


def svg_of(figure: Figure) -> bytes:
    file = BytesIO()
    with mpl.rc_context({"svg.hashsalt": "x", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg")
    return file.getvalue()


def numbers(svg: ElementTree.Element, name: str) -> list[float]:
    texts = [one.attrib[name] for one in svg.iter() if name in one.attrib]
    return [float(found) for text in texts for found in re.findall(r"-?\d+(?:\.\d+)?", text)]


def test_a_compact_drawing_has_the_same_shapes_places_and_words() -> None:
    before = svg_of(drawing())
    after = compact_svg(before)
    assert len(after) < 0.8 * len(before)
    old, new = ElementTree.fromstring(before), ElementTree.fromstring(after)
    drawn = [one.tag for one in old.iter() if "metadata" not in one.tag and one.tag.startswith(SVG)]
    assert [one.tag for one in new.iter()] == drawn
    for name in ("d", "x", "y"):
        assert numbers(new, name) == pytest.approx(numbers(old, name), abs=0.0051)
    words = [[one.text for one in svg.iter(f"{SVG}text")] for svg in (old, new)]
    assert words[0] == words[1] != []


def test_what_a_compact_drawing_refers_to_is_in_it() -> None:
    after = compact_svg(svg_of(drawing())).decode()
    used = set(re.findall(r"#([a-z][\w-]+)", after)) - set(re.findall(r"#([0-9a-f]{6})\b", after))
    assert used
    assert all(f'id="{name}"' in after for name in used)


def test_a_figure_is_vectors_with_a_transparent_ground_and_no_path() -> None:
    source, _ = data_uri(exhibit())
    kind, _, text = source.partition(",")
    assert kind == "data:image/svg+xml"
    assert '"' not in text
    root = ElementTree.fromstring(unquote(text))
    assert "checkpoint of mine & more" in [one.text for one in root.iter(f"{SVG}text")]
    assert "/home" not in unquote(text)
    ground = next(one for one in root.iter(f"{SVG}path"))
    assert "fill: none" in ground.attrib["style"] or "opacity: 0" in ground.attrib["style"]
    assert data_uri(exhibit())[0] == source, "the same figure, the same bytes"


def test_a_large_figure_is_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "SVG_LIMIT", 1000)
    source, _ = data_uri(exhibit())
    assert source.startswith("data:image/webp;base64,")
