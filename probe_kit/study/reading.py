"""Reading of study files, your own and those of the package."""

import re
import tomllib
from dataclasses import dataclass, replace
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from probe_kit._system.bounded_files import read_regular
from probe_kit.errors import UsageError
from probe_kit.study import schema
from probe_kit.study.archive import RUNS, STUDY_FILE, Pack, open_archive
from probe_kit.study.cells import Cell
from probe_kit.study.expansion import expand
from probe_kit.study.left_over import LeftOver
from probe_kit.study.mistakes import Mistake, Place, StudyFileError, part_in_file, shortened
from probe_kit.study.planned_suite import PlannedSuite, planned_suite
from probe_kit.study.references import reference_mistakes

_MOST_BYTES = 1 << 20
_DEEP_KEY = re.compile(r"""(?:[\w"'-]+\s*\.\s*){64}""")
"""A dotted key of 64 tables; tomllib takes minutes for one of some ten thousands."""
_NAME_PATTERN = "'^[a-z0-9][a-z0-9._-]{0,59}$'"


@dataclass(frozen=True)
class LoadedStudy:
    """A study file without mistakes. file: where it lies. cells: the runs that it needs.

    pack: the record of the archive that it was read from, whose runs hold no activations; else None.
    """

    file: Path
    study: schema.Study
    suite: PlannedSuite
    cells: tuple[Cell, ...]
    pack: Pack | None = None

    @property
    def archive(self) -> Path | None:
        """The folder of the archive, None without one."""
        return None if self.pack is None else self.file.parent


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
    Raises UsageError if there is none, StudyFileError, which lists all mistakes with their paths, and
    RunDamagedError for an archive that was changed.
    """
    archive = open_archive(name)
    file = find_study(str(name)) if archive is None else archive / STUDY_FILE
    content = _parsed(file)
    try:
        study = schema.Study.model_validate(content)
    except ValidationError as error:
        raise StudyFileError(str(file), content, [*_mistakes(error, content), *_further(error, content)]) from None
    if archive is not None:  # its runs are all it has
        study = study.model_copy(update={"reuse": schema.ReuseTable()})
    pack = None if archive is None else Pack.read(archive)
    suite, mistakes = planned_suite(study.suite) if pack is None else (_packed_suite(pack), [])
    cells, found = _checked(study, suite)
    if mistakes := [*mistakes, *found]:
        raise StudyFileError(str(file), content, mistakes)
    if pack is None:
        return LoadedStudy(file, study, suite, tuple(cells))
    keys, home = {name: run.key for name, run in pack.runs.items()}, str(file.parent / RUNS)
    packed = tuple(replace(cell, packed_key=keys.get(cell.name, "")) for cell in cells)
    return LoadedStudy(file, study.model_copy(update={"out": home}), suite, packed, pack)


def _packed_suite(pack: Pack) -> PlannedSuite:
    """The suite as it was when the study was packed; its items are not in the archive."""
    return PlannedSuite(pack.suite.identity, dict(pack.suite.items), None, "the archive", here=False)


def _parsed(file: Path) -> dict[str, Any]:
    """The content of a file. Raises UsageError for a text that is no TOML."""
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


def _checked(study: schema.Study, suite: PlannedSuite) -> tuple[list[Cell], list[Mistake]]:
    """The cells of a study, and all mistakes that its schema does not show."""
    mistakes = reference_mistakes(study, suite)
    cells, further = expand(study, suite, mistakes)
    found = [*mistakes, *(one for one in further if not (mistakes and one.absent))]
    return cells, list(dict.fromkeys(found))


# -- mistakes of the schema --------------------------------------------------------------------------------------


def _mistakes(error: ValidationError, content: dict[str, Any]) -> list[Mistake]:
    """What pydantic found, in our words where its own name no key or value of the file."""
    found: dict[Place, list[str]] = {}
    for one in error.errors(include_url=False, include_context=True):
        missing = one["type"] == "missing"
        path = part_in_file(one["loc"], content)
        if missing:
            path, text = (*path, one["loc"][-1]), "is missing"
        elif one["type"] == "extra_forbidden":
            text = f"unknown key{_near(path)}"
        else:
            text = f"{_plain(one['msg'])}, not {shortened(repr(one['input']))}"
        found.setdefault(path, []).append(text)
    return [Mistake(path, _joined(texts)) for path, texts in found.items()]


def _joined(texts: list[str]) -> str:
    """What several choices would take of one value, in one sentence."""
    *others, last = texts
    return " or ".join([*(text.rpartition(", not ")[0] for text in others), last])


def _plain(message: str) -> str:
    plain = f"{message[:1].lower()}{message[1:]}".removeprefix("value error, ").replace("input should", "should")
    said = f"{_NAME_PATTERN} (small letters, digits, dots, hyphens and underscores)"
    return plain.replace(_NAME_PATTERN, said)


def _near(path: Place) -> str:
    """What the key may have been meant as, or else what its table knows."""
    home = _table_of(path)
    names = [field.alias or name for name, field in home.model_fields.items()]
    near = get_close_matches(str(path[-1]), names, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known here: {', '.join(names)}"


def _table_of(path: Place) -> type[BaseModel]:
    """The table that the last name of a path stands in."""
    inner = next((one for name, one in _INNER.items() if name in path[2:-1]), None)
    return inner or (schema.Study if len(path) == 1 else _TABLES.get(str(path[0]), schema.Study))


def _further(error: ValidationError, content: dict[str, Any]) -> list[Mistake]:
    """Mistakes of the rest of a file whose wrong values are left out, so that one reading shows all."""
    left = LeftOver(content)
    study = left.validated(error)
    if study is None:
        return []
    suite, mistakes = planned_suite(study.suite)
    return left.own([*mistakes, *_checked(study, suite)[1]])


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
_INNER: dict[str, type[BaseModel]] = {
    "exclude": schema.ExcludeTable,
    "pairs": schema.PairsTable,
    "elsewhere": schema.ElsewhereTable,
}
"""By its key, what a table inside a table may say."""
