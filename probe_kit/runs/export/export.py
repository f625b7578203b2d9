"""Export of a run for tools that read another format: a file, or a folder.

Everything is written row by row, so that a run larger than memory can be exported; every row passes its checksum
on the way. The sha256 of a file is written beside it, and those of a folder into it, in the form that
`sha256sum --check` reads.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from probe_kit._system.drafts import draft_of, full_disk_in_words, write_whole
from probe_kit.errors import UsageError
from probe_kit.runs.direction_files import check_direction_file
from probe_kit.runs.export.class_means import write_class_means
from probe_kit.runs.export.lerobot_dataset import write_lerobot
from probe_kit.runs.export.matrices import write_sae
from probe_kit.runs.export.tables import write_parquet
from probe_kit.runs.export.vectors import StreamChoice, choose
from probe_kit.runs.export.whole_arrays import write_h5, write_safetensors
from probe_kit.runs.layout import MEAN_VIEW, ExportFormat, SaeDtype
from probe_kit.runs.run import Run, open_run
from probe_kit.runs.store import Location
from probe_kit.version import __version__

SUMS = "SHA256SUMS"
"""The hashes of all other files of a folder."""


def export_run(
    path: Path | str | Location,
    style: ExportFormat,
    out: Path,
    allow_partial: bool = False,
    *,
    sites: Sequence[str] | None = None,
    view: str | None = None,
    dtype: SaeDtype = "bfloat16",
    seed: int = 0,
) -> Path:
    """Write the run at `path` to `out`, whole or not at all, with sha256 of every file; returns `out`.

    h5: `<stream>/pooled`, `<stream>/later`, `<stream>/tokens`, and a dataset per column under `episodes`.
    safetensors: the same with a dot, the last two true bfloat16; episodes in the metadata.
    Axes of both are (episode, call, [iteration,] layer, view or token, feature).
    lerobot: a LeRobotDataset, of a run with `--frames all`.

    Three formats hold the vectors that `sites` and `view` choose, see `choose`.
    parquet: a row per vector with episode, group, inference, frame, site, view, role and token.
    directions: a vector per category, view and site, see `write_class_means`; a .safetensors or .npz.
    sae: a folder with a memory map (N, D) per site in a drawn order, an index, and the scale of every site.
    Default are all sites, and all pooled views in Parquet, `mean` in matrices. dtype, seed: of `sae` alone.

    Raises UsageError for another format, an option that a format does not have, or a file that exists;
    UnknownSiteError, MissingExtraError, RunDamagedError, DiskSpaceError.
    """
    check_format(style)
    if style not in OF_VECTORS and (sites is not None or view is not None):
        raise UsageError(
            f"--sites or --view with --format {style}, which holds all that was stored; leave them out, or "
            f"use one of {', '.join(OF_VECTORS)}"
        )
    if style != SAE and (dtype != "bfloat16" or seed):
        raise UsageError(f"--dtype or --seed with --format {style}; leave them out, or use --format sae")
    if style == DIRECTIONS:
        check_direction_file(out)
    if out.exists():
        raise UsageError(f"{out} exists; choose another --out or remove it")
    run = open_run(path, allow_partial)
    if not run.streams and style != LEROBOT:
        raise UsageError(f"{path} has no activations to export; its episodes are in `open_run(...).episodes`")
    with full_disk_in_words(out), draft_of(out) as draft:
        if style in OF_VECTORS:
            choices = choose(run, sites, view or (MEAN_VIEW if style == SAE else None))
            if style == DIRECTIONS:
                write_class_means(run, choices, draft)
            elif style == SAE:
                write_sae(run, choices, draft, _about(run, choices), dtype, seed)
            else:
                write_parquet(run, choices, draft, _about(run, choices))
        else:
            WHOLE[style](run, draft)
        if draft.is_dir():
            _write_sums(draft)
        else:
            write_whole(out.with_name(f"{out.name}.sha256"), f"{_digest(draft)}  {out.name}\n")
        return draft.rename(out)  # last: the file never lies there without its hash


def check_format(style: str) -> None:
    """Raise UsageError for a format that is not offered."""
    if style not in FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(FORMATS)}")


def _about(run: Run, choices: Sequence[StreamChoice]) -> str:
    """JSON of what vectors were made of: sites and views, the run's settings, and what it was made with."""
    return json.dumps(
        {
            "probe_kit": __version__,
            "run": run.label,
            "settings": run.settings,
            "settings_sha256": run.settings_sha256,
            "commits": run.stamp,
            "provenances": run.provenances,
            "sites": [str(site) for choice in choices for site in choice.sites],
            "views": {choice.name: choice.views for choice in choices},
        }
    )


def _write_sums(folder: Path) -> None:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{_digest(path)}  {path.relative_to(folder).as_posix()}\n" for path in files]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8", newline="\n")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


LEROBOT: ExportFormat = "lerobot"
"""The format that holds frames and actions, and no activations."""
WHOLE: dict[ExportFormat, Callable[[Run, Path], None]] = {
    "h5": write_h5,
    "safetensors": write_safetensors,
    LEROBOT: write_lerobot,
}
"""Formats that hold all that was stored."""
SAE: ExportFormat = "sae"
DIRECTIONS: ExportFormat = "directions"
OF_VECTORS: tuple[ExportFormat, ...] = ("parquet", SAE, DIRECTIONS)
"""Formats that hold chosen vectors."""
FORMATS: tuple[ExportFormat, ...] = (*WHOLE, *OF_VECTORS)
