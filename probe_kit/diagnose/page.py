"""The HTML page of a diagnosis: its table, its sentences, and a figure over the sites up to the action."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit.diagnose.results import diagnosis_table
from probe_kit.retention.displays.display import footer, legend_above, panels, plain, series

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from probe_kit.diagnose.results import Diagnosis

_HEAD = (
    "<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>"
    "body{{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}}"
    "table{{border-collapse:collapse}}td,th{{padding:.2rem .6rem;text-align:left}}img{{max-width:100%}}"
    "</style><h1>{title}</h1>"
)


def draw_passage(diagnosis: "Diagnosis") -> "Figure":
    """Draw how far every input comes: relative difference and share carried, over the sites in their order.

    Below them the curve of a target is drawn: its score above chance.
    """
    curves = [diagnosed for diagnosed in diagnosis.inputs if diagnosed.passage]
    names = list(dict.fromkeys(site.name for diagnosed in curves for site in diagnosed.passage))
    knowledge = diagnosis.knowledge
    labels = ["relative difference", "share carried"]
    labels += [f"{knowledge.metric} of {knowledge.target}\nabove chance"] if knowledge else []
    width = max(4.2, 0.28 * len(names))
    figure, axes = panels(len(labels), width=width, height=2.6, columns=1, share=False)
    for at, diagnosed in enumerate(curves):
        x = [names.index(site.name) for site in diagnosed.passage]
        axes[0].plot(x, [site.difference for site in diagnosed.passage], label=diagnosed.name, **_look(at))
        axes[1].plot(x, [site.carried for site in diagnosed.passage], label=diagnosed.name, **_look(at))
    if knowledge:
        sites = [site for site in knowledge.sites if site.name in names]
        heights = [site.score - site.chance for site in sites]
        axes[2].plot([names.index(site.name) for site in sites], heights, "o", color="0.25")
    for panel, label in zip(axes, labels, strict=True):
        plain(panel)
        panel.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
        panel.set_ylabel(label, fontsize=8.5)
    axes[1].axhline(1.0, color="0.45", lw=0.8, ls="--", zorder=0)
    legend_above(figure, axes[0].get_legend_handles_labels()[0])
    footer(figure, f"{diagnosis.label}, {diagnosis.n_frames} frames of {diagnosis.n_groups} groups")
    return figure


def _look(position: int) -> dict[str, Any]:
    line = series(position)
    return {"color": line.colour, "marker": line.marker, "linestyle": line.dash}


def write_page(diagnosis: "Diagnosis", file: Path) -> None:
    """Write one HTML file without external links."""
    from base64 import b64encode

    from markupsafe import Markup, escape

    from probe_kit.retention.displays.shown_figure import picture_of

    table = diagnosis_table(diagnosis)
    items = Markup("").join(Markup("<li>{}</li>").format(line) for line in table.all_notes)
    parts = [_HEAD.format(title=escape(table.title)), replace(table, title="", notes=())._repr_html_()]
    parts.append(Markup("<ul>{}</ul>").format(items))
    if any(diagnosed.passage for diagnosed in diagnosis.inputs):
        content, size = picture_of(draw_passage(diagnosis))
        image = '<img alt="sites on the way to the action" width={} src="data:image/png;base64,{}">'
        parts.append(Markup(image).format(size["width"], b64encode(content).decode()))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(map(str, parts)), encoding="utf-8")
