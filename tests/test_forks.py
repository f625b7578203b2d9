"""A side of a picture is a target like any other: code asks what it needs to know, not whether one is a side.

A target says how its chance is known and whether its accuracies are balanced, a row which label it is of. A run
says by its source whether it is of the scene.
"""

import re

from tests.support.parsed import PACKAGE

QUESTIONS = re.compile(r"\w*(?:is_side|has_sides|is_of_sides|lacks_sides|needs_sides)\b")
MOST = 60


def test_few_places_ask_whether_a_target_or_a_run_has_sides() -> None:
    files = [path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".jinja")]
    mentions = {
        str(path.relative_to(PACKAGE)): len(questions)
        for path in files
        if (questions := QUESTIONS.findall(path.read_text(encoding="utf-8")))
    }
    assert sum(mentions.values()) < MOST, (
        f"{mentions}; ask `Target.chance` or `balanced`, `RetentionRow.label`, or `run.source.is_scene`"
    )


def test_sides_and_labels_share_the_columns_of_backbone_and_action() -> None:
    from probe_kit.retention.columns.columns import TABLES

    fields = [column.key for group in TABLES["Retention"] for column in group.columns]
    assert len(fields) == len(set(fields)), "a field has one column, whatever the target"
    streams = {part: [key for key in fields if key.startswith(f"{part}.")] for part in ("backbone", "action")}
    field_names = {part: [key.partition(".")[2] for key in keys] for part, keys in streams.items()}
    assert set(field_names["backbone"]) - set(field_names["action"]) == {"exceeds"}
    assert set(field_names["action"]) - set(field_names["backbone"]) == {"first_peak"}
