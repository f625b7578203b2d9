"""Valid suites that differ from another one in one thing."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

from probe_kit.suite import Suite, load_suite


def without_twins(suite: Suite) -> Suite:
    """The same questions, of which none is the twin of another."""
    return replace(suite, items=tuple(replace(item, pair_id=item.item_id) for item in suite.items))


def other_version(suite: Suite) -> Suite:
    """The same questions under the next version."""
    return replace(suite, version=f"{suite.version}1", card=suite.card | {"version": f"{suite.version}1"})


def other_name(suite: Suite) -> Suite:
    """The same questions under another name."""
    return replace(suite, name="mine", card=suite.card | {"name": "mine"})


CHANGES = {"other twins": without_twins, "another version": other_version, "another name": other_name}


def save_changed(changed: Suite, folder: Path) -> Suite:
    """Write a changed suite with the pictures of the folder that it was loaded from."""
    shutil.copytree(changed.folder, folder)
    lines = [json.dumps(item.to_json()) for item in changed.items]
    (folder / "items" / "metadata.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    card = changed.card | {"content_sha256": changed.content_sha256}
    (folder / "suite.json").write_text(json.dumps(card), encoding="utf-8")
    return load_suite(folder)
