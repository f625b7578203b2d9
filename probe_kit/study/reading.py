"""Reading of study files, your own and those of the package."""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.complaints import MISSING, UNKNOWN, complaints_of, join_complaints
from probe_kit._system.escaping import as_argument
from probe_kit.errors import UsageError
from probe_kit.study import schema
from probe_kit.study.archive import RUNS, STUDY_FILE, Pack, open_archive
from probe_kit.study.cells import PlannedRun, PlannedSuite, planned_suite
from probe_kit.study.checks import misfits, unknown_names
from probe_kit.study.expansion import expand
from probe_kit.study.schema import Mistake, Place, StudyFileError, part_in_file
from probe_kit.study.study_folder import StudyFolder

_MOST_BYTES = 1 << 20
"""Largest number of bytes of a study file, which may come with an archive of anyone."""
_DEEP_KEY = re.compile(r"""(?:[\w"'-]+\s*\.\s*){64}""")
"""A dotted key of 64 tables; tomllib takes minutes for one of some ten thousands."""
_NAME_PATTERN = "'^[a-z0-9][a-z0-9._-]{0,59}$'"
"""The pattern of `schema.Name` in pydantic's quotes; a message explains it in words."""


@dataclass(frozen=True)
class LoadedStudy:
    """A study file without mistakes.

    Attributes:
        file: Path of the file.
        cells: The runs that it needs.
        pack: The record of the archive that it was read from, whose runs hold no activations; else None.
        home: The folder of its runs; None for an archive, whose record names its runs.
    """

    file: Path
    study: schema.Study
    suite: PlannedSuite
    cells: tuple[PlannedRun, ...]
    pack: Pack | None = None
    home: StudyFolder | None = None

    @property
    def archive(self) -> Path | None:
        """The folder of the archive, None without one."""
        return None if self.pack is None else self.file.parent

    @property
    def typed(self) -> str:
        """The argument of `probe-kit study` for this study: the name of a shipped one, else the file."""
        return self.file.stem if self.file in shipped_studies().values() else as_argument(self.file)


def find_study(name: str) -> Path:
    """Return the file of this path, or the study of the package of this name.

    Raises:
        UsageError: If there is neither.
    """
    if Path(name).is_file():
        return Path(name)
    shipped = shipped_studies()
    if name in shipped:
        return shipped[name]
    raise UsageError(
        f"there is no study file {name!r}, and the package has no study of that name; give the path of a file, or "
        f"one of {', '.join(sorted(shipped))}"
    )


def shipped_studies() -> dict[str, Path]:
    """Return the study files of the package by name."""
    folder = Path(str(files("probe_kit.study"))) / "studies"
    return {file.stem: file for file in sorted(folder.glob("*.toml"))}


def load_study(name: str | Path) -> LoadedStudy:
    """Read a study file and expand it; loads no model, draws no picture and needs no network.

    Paths in the file are relative to the working directory, as on the command line.

    Args:
        name: A path, the name of a study of the package, or an archive of `pack_study`, as a folder or zip file.

    Raises:
        UsageError: If there is none.
        StudyFileError: If the file has mistakes; it lists all of them with their paths.
        RunDamagedError: For an archive that was changed.
    """
    archive = open_archive(name)
    file = find_study(str(name)) if archive is None else archive / STUDY_FILE
    content = _parse(file)
    try:
        study = schema.Study.model_validate(content)
    except ValidationError as error:
        raise StudyFileError(str(file), content, _mistakes(error, content)) from None
    pack = None if archive is None else Pack.read(archive)
    if pack is None:
        suite, mistakes = planned_suite(study.suite)
    else:  # the suite as it was, whose items are not in the archive
        suite = PlannedSuite(pack.suite.identity, dict(pack.suite.items), None, "the archive")
        mistakes = []
    mistakes += unknown_names(study, suite)
    cells: list[PlannedRun] = []
    if not mistakes:  # all else is about names that exist
        cells, of_settings = expand(study, suite)
        mistakes = [*misfits(study, suite), *of_settings]
    if mistakes:
        raise StudyFileError(str(file), content, mistakes)
    if pack is None:
        home = StudyFolder(study.folder)
        cells = [replace(cell, find_key=home.key) for cell in cells]
        return LoadedStudy(file, study, suite, tuple(cells), home=home)
    keys, runs = {name: run.key for name, run in pack.runs.items()}, str(file.parent / RUNS)
    packed = tuple(replace(cell, packed_key=keys.get(cell.name, "")) for cell in cells)
    return LoadedStudy(file, study.model_copy(update={"out": runs}), suite, packed, pack)


def _parse(file: Path) -> dict[str, Any]:
    """Return the content of a file.

    Raises:
        UsageError: For a text that is no TOML.
    """
    try:
        text = read_regular(file, _MOST_BYTES).decode("utf-8-sig")
        if _DEEP_KEY.search(text):
            raise UsageError(f"{file}: its lists or tables nest too deeply")
        return tomllib.loads(text)
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror}. Give a study file in TOML") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{file} is no UTF-8 text: {error}") from error
    except RecursionError:
        raise UsageError(f"{file}: its lists or tables nest too deeply") from None
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{file}: {error}. The file must be TOML 1.0") from error


# -- mistakes of the schema --------------------------------------------------------------------------------------


def _mistakes(error: ValidationError, content: dict[str, Any]) -> list[Mistake]:
    """Return the complaints about the file, by the path that leads to a value of it."""
    texts: dict[Place, list[str]] = {}  # several of one value, where each choice of a union complains
    for whole_path, complaint in complaints_of(error):
        path = part_in_file(whole_path, content)
        if complaint == MISSING:
            path = (*path, whole_path[-1])
        text = f"unknown key{_near(path)}" if complaint == UNKNOWN else complaint
        words = f"{_NAME_PATTERN} (small letters, digits, dots, hyphens and underscores)"
        texts.setdefault(path, []).append(text.replace(_NAME_PATTERN, words))
    return [Mistake(path, join_complaints(of_value)) for path, of_value in texts.items()]


def _near(path: Place) -> str:
    """Return the key that may have been meant, or else the keys of its table."""
    home = _table_of(path)
    names = [field.alias or name for name, field in home.model_fields.items()]
    near = get_close_matches(str(path[-1]), names, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known here: {', '.join(names)}"


def _table_of(path: Place) -> type[BaseModel]:
    """Return the table that the last name of a path belongs to, by the types of the fields on the way."""
    table: type[BaseModel] = schema.Study
    for name in path[:-1]:
        field = table.model_fields.get(str(name))
        table = next(_models_in(field.annotation), table) if field is not None else table
    return table


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in a type, such as that of `dict[Name, ModelTable]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
