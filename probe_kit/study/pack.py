"""Packing of a study: its runs without activations, its tables, and their sums."""

import json
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Literal, get_args

import probe_kit.version
from probe_kit._system.drafts import draft_of, full_disk_in_words, move_draft
from probe_kit.errors import (
    DiskSpaceError,
    ProbeKitError,
    RunIncompleteError,
    SettingsMismatchError,
    UsageError,
)
from probe_kit.runs import copy_run
from probe_kit.study.archive import (
    PACK_FILE,
    RUNS,
    STUDY_FILE,
    TABLES,
    Pack,
    PackedRun,
    PackedSuite,
    table_record,
    write_sums,
    write_zip,
)
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.stored import open_stored
from probe_kit.study.tables import make_each, make_table

Extra = Literal["pictures", "trajectories", "directions"]
EXTRAS: tuple[Extra, ...] = get_args(Extra)
"""What an archive holds on request: frames and videos, what happened step by step, the weights of probes."""


def pack_study(study: LoadedStudy, out: Path, partial: bool = False, extras: Collection[Extra] = ()) -> Pack:
    """Write the archive of a study to `out`: a zip file if it ends in `.zip`, else a folder.

    Every table of the file can be printed from it alone. Other outcome rules than `disc` need trajectories.
    partial: leave out runs and tables that are missing; `pack.json` names them and the reason. extras: see EXTRAS.
    Raises UsageError where anything lies at `out`, and RunIncompleteError for missing runs.
    """
    if out.exists():
        raise UsageError(f"{out} exists; choose another --out or remove it")
    with full_disk_in_words(out), draft_of(out) as draft:
        folder = draft if out.suffix != ".zip" else draft.with_name("pack")  # beside it, and removed with it
        pack = _pack(study, folder, partial, extras)
        if folder != draft:
            write_zip(folder, draft)
        move_draft(draft, out)
    return pack


def _pack(study: LoadedStudy, folder: Path, partial: bool, extras: Collection[Extra]) -> Pack:
    missing = {cell.name: cell.unavailable for cell in study.cells if cell.unavailable}
    runs: dict[str, PackedRun] = {}
    for cell in study.cells:
        if cell.unavailable:
            continue
        try:
            run = open_stored(study, cell, partial)
            copy_run(
                run.location,
                cell.location(str(folder / RUNS)),
                allow_partial=partial,
                **{extra: extra in extras for extra in EXTRAS},
            )
            runs[cell.name] = PackedRun(key=cell.key, settings_sha256=run.settings_sha256)
        except (SettingsMismatchError, DiskSpaceError):
            raise  # a wrong run is not a missing one, and a full disk is full
        except ProbeKitError as error:
            if not partial:
                raise RunIncompleteError(
                    f"{cell.name} cannot be packed: {error}. Finish it with `probe-kit study run {study.typed}`, "
                    "or leave it out (--partial)"
                ) from error
            missing[cell.name] = str(error)
    missing |= _write_tables(study, folder / TABLES, partial)
    pack = Pack(
        study=study.study.name,
        version=probe_kit.version.__version__,
        suite=PackedSuite(identity=study.suite.identity, items=dict(study.suite.items)),
        runs=runs,
        missing=missing,
        left_out=["activations", *(extra for extra in EXTRAS if extra not in extras)],
    )
    shutil.copyfile(study.file, folder / STUDY_FILE)
    (folder / PACK_FILE).write_text(pack.to_json(), encoding="utf-8")
    write_sums(folder)
    return pack


def _write_tables(study: LoadedStudy, folder: Path, partial: bool) -> dict[str, str]:
    """Write every table in three formats; return why others are missing."""
    folder.mkdir(parents=True)
    tables, missing = make_each(study.study.tables, lambda name: make_table(study, name, partial), partial)
    for name, table in tables.items():
        record = json.dumps(table_record(table), indent=1, ensure_ascii=False)
        (folder / f"{name}.json").write_text(record, encoding="utf-8")
        (folder / f"{name}.md").write_text(table.to_markdown() + "\n", encoding="utf-8")
        (folder / f"{name}.tex").write_text(table.to_latex(), encoding="utf-8")
    return {f"table {name}": why for name, why in missing.items()}
