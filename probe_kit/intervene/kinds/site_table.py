"""Effects of interventions as tables for a console."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, ImageSwapEffect
from probe_kit.intervene.kinds.image_swap.verdict import UseVerdict
from probe_kit.intervene.kinds.instruction_swap.effects import InputSensitivity
from probe_kit.intervene.kinds.site_effects import PatchEffect

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

_LEGEND = (
    "follows: goes to the correct picture, and to the other side once the two are exchanged; against: the "
    f"reverse; net: follows − against, {SMALLEST_EFFECT_OF_INTEREST} of which count; p: exact, by item and by group, the larger one"
)


def following_table(
    rows: Sequence[ImageSwapEffect], verdicts: Mapping[str, UseVerdict], of: str
) -> "ResponsiveTable":
    """One line per category. of: which model, on which suite."""
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

    reasons = dict.fromkeys(f"{name}: {one.reason}" for name, one in verdicts.items() if one.reason)
    return ResponsiveTable(
        title=f"Is it used? {of}, pictures exchanged",
        caption="; ".join([_LEGEND, *reasons]),
        name="category",
        names=tuple(row.category for row in rows),
        styles=("",) * len(rows),
        parts=(
            _following_part("Does the action follow the pictures?", rows),
            Part(
                "Verdict",
                ("verdict",),
                tuple(
                    (Cell(verdicts[row.category].verdict if row.category in verdicts else "–"),) for row in rows
                ),
            ),
        ),
    )


_WORDS_LEGEND = (
    "follows: goes to the correct picture, and to the other one once it is asked for that, with the same "
    "pictures, state and noise; one step: median distance across between where the two actions "
    "bring the hand, and in how many episodes any number changed; with the noise drawn anew for comparison"
)


def words_table(rows: Sequence[ImageSwapEffect], steps: Sequence[InputSensitivity], of: str) -> "ResponsiveTable":
    """One line per category. of: which model, on which suite."""
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

    return ResponsiveTable(
        title=f"Is the question read? {of}",
        caption=_WORDS_LEGEND,
        name="category",
        names=tuple(row.category for row in rows),
        styles=("",) * len(rows),
        parts=(
            _following_part("Does the action follow the words?", rows),
            Part(
                "What one step owes to",
                ("words cm", "pictures cm", "noise cm", "words change it %", "pictures change it %"),
                tuple(
                    tuple(
                        Cell(f"{100 * value:.{digits}f}")
                        for value, digits in (
                            (own.words, 2), (own.pictures, 2), (own.noise, 2), (own.words_changed, 1),
                            (own.pictures_changed, 1),
                        )
                    )
                    for own in steps
                ),
            ),
        ),
    )  # fmt: skip


def _following_part(title: str, rows: Sequence[ImageSwapEffect]) -> "Part":
    from probe_kit._terminal.responsive_table import Part

    columns = ("follows %", "against %", "net [95 %]", "p", "median shift cm", "n (items)")
    return Part(title, columns, tuple(_cells(row) for row in rows))


def _cells(row: ImageSwapEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    low, high = row.net_ci
    texts = (
        f"{100 * row.follow_rate:.1f}", f"{100 * row.reversal_rate:.1f}", f"{row.net:+.2f} [{low:+.2f}, {high:+.2f}]",
        f"{row.follow_p:.2g}", f"{100 * row.median_displacement:.2f}", f"{row.n_episodes} ({row.n_items})",
    )  # fmt: skip
    return tuple(map(Cell, texts))


_CHANGE_LEGEND = (
    "effect: share of what the whole exchange does, n/a where that is not beyond chance; turned: share of "
    "episodes that turn to the side they are pushed to, minus those that turn from it; p: family-wise over all "
    "changes of the category, one-sided; moved: how far tokens were moved, in their own norms"
)


def passing_table(rows: Sequence[PatchEffect], kind: str, of: str) -> "ResponsiveTable":
    """One line per category and change; controls stand beside what they are held against. of: model, suite."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    shown = [row for row in rows if not row.is_control]
    return ResponsiveTable(
        title=f"Where is it used? {of}, {kind}",
        caption=_CHANGE_LEGEND,
        name="category · change",
        names=tuple(f"{row.category} · {row.name}" for row in shown),
        styles=tuple("bold" if row.is_localised else "" for row in shown),
        parts=(
            Part(
                "What the action does",
                ("effect", "turned [95 %]", "left / right", "shift cm", "controls cm", "p", "moved"),
                tuple(_change_cells(row) for row in shown),
            ),
        ),
    )


def _change_cells(row: PatchEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    low, high = row.net_ci
    texts = (
        "n/a" if row.effect is None else f"{row.effect:.2f}", f"{row.net:+.2f} [{low:+.2f}, {high:+.2f}]",
        f"{row.net_left:+.2f} / {row.net_right:+.2f}", f"{100 * row.mean_displacement:+.2f}",
        "–" if row.control_displacement is None else f"{100 * row.control_displacement:+.2f}",
        "–" if row.p_fwe is None else f"{row.p_fwe:.2g}", f"{row.relative_change:.2f}",
    )  # fmt: skip
    return tuple(map(Cell, texts))
