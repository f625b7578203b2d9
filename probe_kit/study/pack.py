"""Packing of a study: its runs without activations, its tables, and their sums.

A data set is a folder in the layout of the hub: card, episodes, tables, archive and sums.
"""

import hashlib
import os
import shutil
import time
from collections.abc import Callable, Collection, Hashable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import probe_kit.version
from probe_kit._system.bounded_files import read_regular, read_regular_text
from probe_kit._system.counting import plural
from probe_kit._system.drafts import draft_of, full_disk_in_words, move_draft
from probe_kit._system.escaping import markdown_safe
from probe_kit._system.imports import require
from probe_kit._system.json_text import json_text
from probe_kit.errors import (
    DiskSpaceError,
    ProbeKitError,
    RunIncompleteError,
    SettingsMismatchError,
    StoreError,
    UsageError,
)
from probe_kit.runs import copy_run
from probe_kit.study.archive import (
    PACK_FILE,
    RUNS,
    STUDY_FILE,
    SUMS_FILE,
    TABLES,
    Pack,
    PackedRun,
    PackedSuite,
    check_sums,
    files_of,
    open_archive,
    table_record,
    write_sums,
    write_zip,
)
from probe_kit.study.reading import LoadedStudy, load_study
from probe_kit.study.stored import open_cell, open_stored
from probe_kit.study.tables import make_each, make_table

if TYPE_CHECKING:
    import pandas as pd


Extra = Literal["pictures", "trajectories", "directions"]
EXTRAS: tuple[Extra, ...] = get_args(Extra)
"""Parts that an archive holds on request: frames and videos, trajectories step by step, the weights of probes."""


def pack_study(study: LoadedStudy, out: Path, partial: bool = False, extras: Collection[Extra] = ()) -> Pack:
    """Write the archive of a study to `out`: a zip file if it ends in `.zip`, else a folder.

    Every table of the file can be printed from it alone. Other outcome rules than `disc` need trajectories.

    Args:
        study: The study whose runs are stored.
        out: Path of the archive, at which nothing exists yet.
        partial: Leave out runs and tables that are missing; `pack.json` names them and the reason.
        extras: Further parts of the runs, see EXTRAS.

    Raises:
        UsageError: If `out` exists.
        RunIncompleteError: For missing runs.
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
    (folder / TABLES).mkdir(parents=True)
    tables, no_table = make_each(study.study.tables, lambda name: make_table(study, name, partial), partial)
    missing |= {f"table {name}": why for name, why in no_table.items()}
    for name, table in tables.items():
        record = json_text(table_record(table), indent=1)
        (folder / TABLES / f"{name}.json").write_text(record, encoding="utf-8")
        (folder / TABLES / f"{name}.md").write_text(table.to_markdown() + "\n", encoding="utf-8")
        (folder / TABLES / f"{name}.tex").write_text(table.to_latex(), encoding="utf-8")
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


# -- a data set --------------------------------------------------------------------------------------------------


ARCHIVE, EPISODES, CARD = "study.zip", "episodes.parquet", "README.md"
_COLUMNS = {
    "episode_id": "string", "item_id": "string", "group_id": "string", "category": "string", "layout": "string",
    "wording": "string", "side_correct": "string", "side_placed": "string", "outcome": "string",
    "first_frame_sha256": "string", "item_content_sha256": "string", "distance_correct": "float64",
    "distance_wrong": "float64", "steps": "int64", "seconds_inference": "float64", "seconds_simulation": "float64",
}  # fmt: skip
"""Columns of the episodes of a run that are published, as far as a run has them: no text of an item."""

TRIES = 5
"""Tries of an upload that a server refuses for now, or whose connection breaks."""
_PAUSE = 2.0
"""Seconds before the second try."""
_FOR_NOW = (408, 425, 429, 500, 502, 503, 504)
"""Status codes of a server that may differ a moment later: too slow, too early, too often, out of order."""


def write_data_set(
    study: LoadedStudy, folder: Path, partial: bool = False, licence: str | None = None, again: bool = False
) -> Pack:
    """Write the data set of a study to `folder`, whole or not at all; raises as `pack_study` too.

    Args:
        study: The study whose runs are stored.
        folder: Folder of the data set.
        partial: Leave out runs and tables that are missing.
        licence: The licence in the hub's spelling, such as `cc-by-4.0`; named in the card. None for none.
        again: Accept a folder that holds this very data set, such as after an upload that failed.

    Raises:
        UsageError: If `folder` exists and holds anything else.
        DiskSpaceError: On a full disk.
        MissingExtraError: Without pyarrow.
    """
    require("pyarrow.parquet", "export")
    if folder.exists() and not again:
        raise UsageError(f"{folder} exists; choose another --out or remove it")
    with full_disk_in_words(folder), draft_of(folder) as draft:
        draft.mkdir()
        pack = _write(study, draft, partial, licence)
        if not folder.exists():
            move_draft(draft, folder)
            return pack
        sums = folder / SUMS_FILE
        if not sums.is_file() or data_set_version(folder) != data_set_version(draft):
            raise UsageError(f"{folder} exists and holds something else; choose another --out or remove it")
        check_sums(folder)
    return pack


def _write(study: LoadedStudy, folder: Path, partial: bool, licence: str | None) -> Pack:
    parquet = require("pyarrow.parquet", "export")
    pack = pack_study(study, folder / ARCHIVE, partial)
    packed = load_study(folder / ARCHIVE)  # card and episodes are of what was packed, not of runs that play on
    table = _episodes(packed)
    arrow = require("pyarrow", "export").Table.from_pandas(table, preserve_index=False)
    parquet.write_table(arrow, folder / EPISODES, compression="zstd")
    source = open_archive(folder / ARCHIVE)
    assert source is not None, "it was just written"
    (folder / TABLES).mkdir()
    for file in files_of(source / TABLES):
        shutil.copyfile(file, folder / TABLES / file.name)
    shutil.copyfile(source / PACK_FILE, folder / PACK_FILE)
    (folder / CARD).write_text(_card(packed, pack, table, licence), encoding="utf-8")
    write_sums(folder)
    return pack


def _episodes(study: LoadedStudy) -> "pd.DataFrame":
    """Return a row per episode of every run, with the run's name and the outcome."""
    import pandas as pd

    frames = []
    for cell in study.cells:
        if not cell.packed_key:
            continue
        episodes = open_cell(study, cell, cell.selection, partial=True).run.episodes
        model, way = cell.model, cell.way
        label = study.study.models[model].label or model
        run_columns: dict[str, str | int] = {
            "system": label, "model": model, "way": way, "seed": cell.seed, "run": cell.name,
        }  # fmt: skip
        kinds: dict[Hashable, Any] = {name: kind for name, kind in _COLUMNS.items() if name in episodes}
        frame = episodes[list(kinds)].astype(kinds)
        for at, (name, value) in enumerate(run_columns.items()):
            frame.insert(at, name, value)
        frames.append(frame)
    if not frames:
        raise UsageError("no run of the study is stored, so there is nothing to publish")
    return pd.concat(frames, ignore_index=True)


def _card(study: LoadedStudy, pack: Pack, table: "pd.DataFrame", licence: str | None) -> str:
    """Return `README.md`: the head that the hub reads, then the text for readers."""
    import yaml

    kinds = {str(name): kind.name for name, kind in table.dtypes.items()}
    plain = ("float64", "int64", "bool")
    features = [{"name": name, "dtype": kind if kind in plain else "string"} for name, kind in kinds.items()]
    head: dict[str, Any] = {
        "pretty_name": study.study.name,
        **({} if licence is None else {"license": licence}),
        "tags": ["robotics", "vision-language-action", "interpretability", "probe-kit"],
        "configs": [{"config_name": "episodes", "data_files": EPISODES}],
        "dataset_info": {
            "config_name": "episodes",
            "features": features,
            "splits": [{"name": "train", "num_examples": len(table)}],
        },
    }
    front = yaml.safe_dump(head, sort_keys=False, allow_unicode=True)
    return "\n".join(["---", front.rstrip(), "---", "", *_words(study, pack, len(table)), ""])


def _words(study: LoadedStudy, pack: Pack, episodes: int) -> Iterator[str]:
    yield f"# {markdown_safe(study.study.name)}"
    yield ""
    size = f"{plural(len(pack.runs), 'run')}, {plural(episodes, 'episode')}"
    yield f"A study made with probe_kit {pack.version}: {size}."
    yield markdown_safe(f"Suite: {pack.suite.identity}. Left out: {', '.join(pack.left_out)}.")
    yield ""
    yield f"* `{EPISODES}`: a row per episode of every run"
    yield f"* `{TABLES}/`: every table as JSON, Markdown and LaTeX"
    yield f"* `{ARCHIVE}`: the runs without activations; `probe-kit study table {ARCHIVE}` prints the tables"
    yield f"* `{SUMS_FILE}`: `sha256sum --check {SUMS_FILE}`"
    if pack.missing:
        yield ""
        yield "Not in it:"
        yield ""
        yield from (f"* {markdown_safe(f'{name}: {reason}')}" for name, reason in pack.missing.items())
    yield ""
    yield "## Tables"
    for name in study.study.tables:
        if (record := study.archive and study.archive / TABLES / f"{name}.md") and record.is_file():
            yield ""
            yield read_regular_text(record).rstrip()


def data_set_version(folder: Path) -> str:
    """Return the name of a data set's content: the beginning of the hash of its sums."""
    return hashlib.sha256(read_regular(folder / SUMS_FILE)).hexdigest()[:12]


# -- upload -------------------------------------------------------------------------------------------------------


def publish_data_set(
    folder: Path, repository: str, pull_request: bool = False, private: bool = False, pause: float = _PAUSE
) -> str:
    """Upload a folder of `write_data_set` as a data set; return the address of the commit or pull request.

    The commit is tagged with the version of its content, a pull request is not. The token is the hub's own:
    HF_TOKEN, or that of `hf auth login`. Files that are there already are not sent again.

    Args:
        folder: Folder of the data set.
        repository: `owner/name`, created if it is not there.
        pull_request: Open a pull request in a data set that exists.
        private: Make a new data set private.
        pause: Seconds before the second try, doubled each time.

    Raises:
        StoreError: Where the hub refuses, or cannot be reached in TRIES tries.
    """
    from huggingface_hub import DiscussionWithDetails, HfApi

    api = HfApi(endpoint=os.environ.get("HF_ENDPOINT"), library_name="probe-kit")
    version = data_set_version(folder)

    opened: list[DiscussionWithDetails] = []  # kept between tries, so that no second one is opened

    def upload() -> str:
        if pull_request and not opened:
            opened.append(api.create_pull_request(repository, f"probe_kit study {version}", repo_type="dataset"))
        if not pull_request:
            # None, and not False: an organisation may make what is new private by default.
            api.create_repo(repository, repo_type="dataset", private=private or None, exist_ok=True)
        commit = api.upload_folder(
            repo_id=repository,
            repo_type="dataset",
            folder_path=folder,
            commit_message=f"probe_kit study {version}",
            revision=opened[0].git_reference if opened else None,
        )
        if opened:
            return opened[0].url
        api.create_tag(repository, tag=version, repo_type="dataset", exist_ok=True)
        return str(commit.commit_url)

    return _try_upload(upload, repository, pause)


def _try_upload(upload: Callable[[], str], repository: str, pause: float) -> str:
    """Return the result of an upload that may need several tries."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError

    for attempt in range(TRIES):
        try:
            return upload()
        except (HfHubHTTPError, httpx.TransportError) as error:
            answer = getattr(error, "response", None)
            status = None if answer is None else answer.status_code  # None: the connection broke
            if status is not None and status not in _FOR_NOW:
                advice = (
                    "Log in with `hf auth login`" if status in (401, 403) else "Check the name of the repository"
                )
                raise StoreError(f"the hub refuses {repository}: status {status}. {advice}") from error
            if attempt == TRIES - 1:
                problem = f"status {status}" if status else type(error).__name__
                raise StoreError(f"{repository} could not be uploaded in {TRIES} tries ({problem})") from error
        time.sleep(pause * 2**attempt)
    raise AssertionError("every try returns or raises")
