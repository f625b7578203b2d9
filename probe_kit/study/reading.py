"""Reading of study files, your own and those of the package."""

import tomllib
from dataclasses import dataclass, replace
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path

from pydantic import BaseModel, ValidationError

from probe_kit.errors import UsageError
from probe_kit.study import schema
from probe_kit.study.archive import RUNS, STUDY_FILE, Pack, open_archive
from probe_kit.study.cells import Cell
from probe_kit.study.expansion import expand
from probe_kit.study.mistakes import Mistake, StudyFileError
from probe_kit.study.planned_suite import PlannedSuite, planned_suite
from probe_kit.study.references import reference_mistakes

_WORDS = {
    "extra_forbidden": "unknown key",
    "missing": "is missing",
}


@dataclass(frozen=True)
class LoadedStudy:
    """A study file without mistakes. file: where it lies. cells: the runs that it needs.

    archive: the folder of an archive that it was read from, whose runs hold no activations; else None.
    """

    file: Path
    study: schema.Study
    suite: PlannedSuite
    cells: tuple[Cell, ...]
    archive: Path | None = None


def find_study(name: str) -> Path:
    """The file of this path, or the study of the package of this name. Raises UsageError if there is neither."""
    if Path(name).is_file():
        return Path(name)
    shipped = shipped_studies()
    if name in shipped:
        return shipped[name]
    raise UsageError(
        f"there is no study file {name!r}, and no study of the package of that name; the package has "
        f"{', '.join(sorted(shipped))}"
    )


def shipped_studies() -> dict[str, Path]:
    """The study files of the package by name."""
    return {file.name.removesuffix(".toml"): file for file in _shipped()}


def _shipped() -> list[Path]:
    folder = Path(str(files("probe_kit.study"))) / "studies"
    return [file for file in sorted(folder.iterdir()) if file.suffix == ".toml"]


def load_study(name: str | Path) -> LoadedStudy:
    """Read a study file and expand it; loads no model, draws no picture and needs no network.

    Paths in the file are relative to the working directory, as on the command line.
    name: a path, the name of a study of the package, or an archive of `pack_study`, as a folder or zip file.
    Raises UsageError if there is none, StudyFileError, which lists all mistakes with their lines, and
    RunDamagedError for an archive that was changed.
    """
    archive = open_archive(name)
    file = find_study(str(name)) if archive is None else archive / STUDY_FILE
    try:
        text = file.read_text(encoding="utf-8")
        study = schema.Study.model_validate(tomllib.loads(text))
    except UnicodeDecodeError as error:
        raise UsageError(f"{file} is no UTF-8 text: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{file}: {error}. The file is TOML 1.0") from error
    except ValidationError as error:
        raise StudyFileError(str(file), text, _mistakes(error)) from None
    if archive is not None:  # its runs are all it has
        study = study.model_copy(update={"reuse": schema.ReuseTable()})
    suite, mistakes = planned_suite(study.suite) if archive is None else (_packed_suite(archive), [])
    mistakes += reference_mistakes(study, suite)
    if not mistakes:
        cells, mistakes = expand(study, suite)
    if mistakes:
        raise StudyFileError(str(file), text, mistakes)
    if archive is None:
        return LoadedStudy(file, study, suite, tuple(cells))
    keys, home = Pack.read(archive).keys, str(archive / RUNS)
    packed = tuple(replace(cell, packed_key=keys.get(cell.name, "")) for cell in cells)
    return LoadedStudy(file, study.model_copy(update={"out": home}), suite, packed, archive)


def _packed_suite(archive: Path) -> PlannedSuite:
    """The suite as it was when the study was packed; its items are not in the archive."""
    suite = Pack.read(archive).suite
    return PlannedSuite(str(suite["identity"]), dict(suite["items"]), None, "the archive", here=False)


def _mistakes(error: ValidationError) -> list[Mistake]:
    """What pydantic found, in our words where its own name no key or value of the file."""
    found = []
    for one in error.errors(include_url=False, include_context=True):
        path = tuple(part for part in one["loc"] if part != "[key]")
        text = _WORDS.get(one["type"]) or f"{_plain(one['msg'])}, not {one['input']!r}"
        if one["type"] == "extra_forbidden":
            text = f"unknown key{_near(path)}"
        found.append(Mistake(path, text))
    return found


def _plain(message: str) -> str:
    return f"{message[:1].lower()}{message[1:]}".replace("input should", "should")


def _near(path: tuple[str | int, ...]) -> str:
    """What the key may have been meant as, or else what its table knows."""
    home = schema.Study if len(path) == 1 else _TABLES.get(str(path[0]), schema.Study)
    if "exclude" in path[:-1]:
        home = schema.ExcludeTable
    if path[0] == "comparisons" and "pairs" in path[:-1]:
        home = schema.PairsTable
    names = [field.alias or name for name, field in home.model_fields.items()]
    near = get_close_matches(str(path[-1]), names, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known here: {', '.join(names)}"


_TABLES: dict[str, type[BaseModel]] = {
    "suite": schema.SuiteTable,
    "reuse": schema.ReuseTable,
    "models": schema.ModelTable,
    "conditions": schema.ConditionTable,
    "asks": schema.AskTable,
    "runs": schema.BlockTable,
    "probes": schema.ProbesTable,
    "comparisons": schema.ComparisonTable,
    "drift": schema.DriftTable,
    "tables": schema.TableTable,
    "figures": schema.FigureTable,
}
"""By the first name of a path, what the tables there may say."""
