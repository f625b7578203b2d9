"""A folder of pictures with a table of instructions as a source: one inference about each line of the table."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from hashlib import blake2b, sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import BeforeValidator

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.table_cells import group_names
from probe_kit._system.text_tables import MOST_BYTES, TextTable, open_table
from probe_kit._tables.label_table import LabelTable
from probe_kit.errors import RecordingError, UsageError
from probe_kit.extract.sources.player import SIDE, Answer, InputsPlayer, Opens, frames_of_episode
from probe_kit.extract.sources.recording import Pixels
from probe_kit.extract.sources.source import (
    REFUSED_WITHOUT_ACTING,
    Played,
    Source,
    SourceSettings,
    predicted_once,
)
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation
from probe_kit.hooks.contract.sites import CAMERA
from probe_kit.runs.input_content import FILE, MOST_EPISODES, content_notes
from probe_kit.runs.layout import CAPTURE_ONLY, CLASSES, DATASET, OTHER_ACTIONS, RECORDED_EPISODES, TRUTHS
from probe_kit.runs.plan import Row
from probe_kit.suite.pictures import decode_bytes

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.hooks.contract.card import DeclaredInputs

PICTURE, INSTRUCTION, ID, GROUP = "picture", "instruction", "id", "group"
"""The columns of the table; the first two are required, and all others become labels."""
Cells = dict[str, str | None]
"""A line of the table by heading; None for a missing cell."""
_DIGITS = 16
_option = partial(typer.Option, rich_help_panel="Pictures")


class PictureFolder(SourceSettings):
    """Pictures in place of a scene: the model predicts once about each, and nothing moves.

    Attributes:
        folder: The folder of the pictures.
        table: A CSV file with the columns `picture` (a file in the folder) and `instruction`. The columns `id` and
            `group` name a line and what folds keep together. Every other column holds numbers, truth values or
            texts, and becomes a label.
        pixels: Whether pictures at 32 × 32 are stored for controls.
    """

    kind: Literal["pictures"] = "pictures"
    folder: Annotated[
        str,
        BeforeValidator(str),
        _option(
            "--pictures",
            metavar="FOLDER",
            help="Show the pictures of this folder in place of a suite. Needs --table.",
        ),
    ]
    table: Annotated[
        str,
        BeforeValidator(str),
        _option(
            "--table",
            metavar="FILE",
            help="CSV file with the columns picture and instruction; further columns are labels.",
        ),
    ]
    pixels: Pixels = True

    command: ClassVar[str] = "--pictures FOLDER --table FILE"
    shows: ClassVar[str] = "--pictures, of which each is shown once and no action is executed"
    opens: ClassVar[str] = "probe_kit.extract.sources.pictures:PictureSource"
    moves: ClassVar[Mapping[str, str]] = {
        "folder": "Folder of the run's pictures, if it was moved.",
        "table": "Table of the run's pictures, if it was moved.",
    }
    played: ClassVar[str] = "on"
    subject: ClassVar[str] = "pictures"
    loads: ClassVar[str] = "pictures"
    decides: ClassVar[tuple[str, ...]] = ("captured_calls",)
    refuses: ClassVar[tuple[str, ...]] = REFUSED_WITHOUT_ACTING

    def __init__(self, folder: str | Path, table: str | Path | None = None, **choices: Any) -> None:
        if table is None:
            raise UsageError("--pictures needs --table FILE, a CSV file with the columns picture and instruction")
        super().__init__(**{"folder": folder, "table": table, **choices})

    @property
    def name(self) -> str:
        """The name of the folder; its place on this machine is no part of a run."""
        return Path(self.folder).expanduser().resolve().name

    def files(self) -> dict[str, Path]:
        """Return the folder of the pictures, and the table."""
        return {"folder": Path(self.folder).expanduser(), "table": Path(self.table).expanduser()}


@dataclass(frozen=True)
class PictureLine:
    """A line of the table.

    Attributes:
        content: The hash of the picture's bytes.
        numbers: The cells as `_code_columns` returns them.
    """

    picture: Path
    content: str
    numbers: tuple[float, ...]


class PictureSource(Source[PictureFolder]):
    """The lines of a table, whose pictures were all read once.

    Attributes:
        prediction: The shape (chunk, D) of a prediction of the checked policy.
    """

    executes = False
    groups = "groups of pictures"

    def __init__(
        self,
        settings: PictureFolder,
        columns: Sequence[str],
        names: Mapping[str, list[str]],
        lines: Sequence[tuple[Cells, PictureLine]],
        digest: str,
    ) -> None:
        """Keep the lines of a table.

        Args:
            settings: The folder and the table.
            columns: The names of the columns that become labels.
            names: The names that a run stores: of columns of truth values, and of the classes of columns of texts.
            lines: The cells of every line, and the line.
            digest: The hash of the table's file.
        """
        self.settings, self.columns, self._names, self.lines = settings, tuple(columns), dict(names), list(lines)
        self._digest = digest
        self.cameras: list[str] = []
        self.prediction: tuple[int, int] = (0, 0)
        first = self.lines[0][1]
        self._shape = read_picture(first).shape

    @classmethod
    def open(cls, settings: PictureFolder, selects_only: bool) -> Self:
        """Read the table and all its pictures. Raises RecordingError for a line that cannot be shown."""
        del selects_only
        table, folder = Path(settings.table).expanduser(), Path(settings.folder).expanduser()
        # Hashed once, where it is read: a table that is changed later would name a run that never showed it.
        digest = sha256(read_regular(table, MOST_BYTES)).hexdigest()[: 2 * _DIGITS]
        read = open_table(table, (PICTURE, INSTRUCTION))
        if not {PICTURE, INSTRUCTION} <= set(read.names):
            columns = ", ".join(read.names) or "no line"
            raise UsageError(f"--table {table} has {columns}; expected the columns {PICTURE} and {INSTRUCTION}")
        if hostile := [name for name in read.names if UNSAFE.search(name)]:
            raise RecordingError(f"{read.where(read.line)} has the heading {hostile[0]!r}; expected plain text")
        names = [name for name in read.names if name and name not in (PICTURE, INSTRUCTION, ID, GROUP)]
        texts = _with_groups(read, list(read.rows()))
        values, coded_names = _code_columns(read, texts, names)
        lines = [
            (text, _line(text, folder, read.where(number), tuple(column[row] for column in values)))
            for row, (number, text) in enumerate(texts)
        ]
        if not lines:
            raise UsageError(f"--table {table} has no line below its heading; expected one per picture")
        ids = [_id(text, number) for number, (text, _) in enumerate(lines)]
        if twice := [name for name, count in Counter(ids).items() if count > 1]:
            raise RecordingError(f"{table.name} has the id {twice[0]!r} twice; give each line its own")
        return cls(settings, names, coded_names, lines, digest)

    def decided(self) -> Mapping[str, Any]:
        """Return settings by which the only inference of a picture is captured and nothing acts."""
        return {"captured_calls": 1, "capture_only": True, "frames": "none"}

    def rows(self, seed: int) -> tuple[Row, ...]:
        """Return a row per line, with the columns of a recorded episode of one frame."""
        rows = []
        for number, (text, line) in enumerate(self.lines):
            name = _id(text, number)
            columns = {
                "episode_id": name,
                "item_id": name,
                "category": "all",
                "group_id": text.get(GROUP) or name,
                "instruction": text[INSTRUCTION],
                PICTURE: text[PICTURE],
                "source_episode": number,
                "first_frame": 0,
                "frame_step": 1,
                "frames": 1,
                "recorded_frames": 1,
                "policy_seed": derive_seed(seed, "policy", name),
                "content_blake2b": line.content,
            }
            rows.append(Row(number, columns, line, (0,)))
        return tuple(rows)

    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Show the policy its first camera, and let it predict once about nothing.

        Raises:
            RecordingError: For a policy that reads a state of another width than zeros can stand for.
        """
        del accept_units
        if policy.state_numbers not in (None, ARM_NUMBERS):
            raise RecordingError(
                f"{self.name} has pictures and no state; {policy.card.checkpoint} reads {policy.state_numbers} "
                "numbers. Take recordings with a state (--dataset), or a model that reads none"
            )
        self.cameras = list(policy.card.cameras[:1])
        policy = policy.with_cameras(self.cameras)
        chunk = predicted_once(policy, self.example(self.instructions[0]))
        self.prediction = chunk.shape[0], chunk.shape[1]
        return self, policy

    def shown_cameras(self, declared: "DeclaredInputs | None" = None) -> tuple[str, ...]:
        """Return the first camera: a row has one picture."""
        return (declared.cameras if declared else (CAMERA,))[:1]

    def for_cameras(self, cameras: Sequence[str]) -> Self:
        """Show the pictures to the model's first camera."""
        self.cameras = list(cameras[:1])
        return self

    def example(self, instruction: str) -> Observation:
        """Return a blank picture of the first one's shape."""
        return Observation(np.zeros(self._shape, np.uint8), np.zeros(ARM_NUMBERS, np.float32), instruction)

    def play(self, played: Played) -> Opens:
        """Open a player of the pictures."""
        del played
        return partial(PicturePlayer, self.settings.pixels)

    def identity(self, execute: int) -> dict[str, Any]:
        """Return the table by its content; rows hold the hashes of pictures."""
        # A table may have no numbers, and Zarr has no array without any.
        shapes = {"columns": [len(self.columns)]} if self.columns else {}
        shapes |= {"prediction": list(self.prediction)} if execute else {}
        shapes |= {"pixels": [1, SIDE, SIDE, 3]} if self.settings.pixels else {}
        data_set = {
            "kind": "pictures",
            "meta_blake2b": self._digest,
            "fps": 1.0,
            "frames": "every:1",
            "cameras": [[camera, PICTURE, "image"] for camera in self.cameras],
            "rotations": [],
            "instruction": None,
            "inputs": shapes,
            "columns": list(self.columns),
            "names": self._names,
        }
        return {DATASET: data_set}

    def selection(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the selected lines of the table."""
        lines = [row.columns["source_episode"] for row in rows]
        selected = {"name": self.name, "episodes": lines, RECORDED_EPISODES: len(self.lines)}
        return {"recording": {**selected, OTHER_ACTIONS: "pictures have no actions"}}

    def content_notes(self) -> tuple[str, ...]:
        """Return a sentence for pictures of one colour, and for files that are all alike, in some files."""
        return self._content_notes

    @cached_property
    def _content_notes(self) -> tuple[str, ...]:
        lines, frames = list({line.picture: line for _, line in self.lines}.values()), []
        at = np.linspace(0, len(lines) - 1, min(len(lines), MOST_EPISODES)).round().astype(int)
        for line in (lines[number] for number in at):
            with suppress(RecordingError):  # a picture that cannot be read costs its own line when it is shown
                frames.append(frames_of_episode(line.picture.name, [[read_picture(line)]]))
        return tuple(content_notes(frames, self.cameras[:1] or [PICTURE], unit=FILE))

    def targets(self) -> tuple[str, ...]:
        """Return the columns of the table that become labels."""
        return tuple(f"dataset.{name}" for name in self.columns)

    def describe(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return folder, columns and pictures."""
        return {
            "pictures": f"{len(rows)} of {terminal_safe(self.name)}",
            "camera": terminal_safe(", ".join(self.cameras)) or "the first of the model",
            "labels": terminal_safe(", ".join(self.columns)) or "none",
        }


class PicturePlayer(InputsPlayer):
    """A player that shows a picture, and keeps what is predicted about it; with `pixels` also a small copy."""

    def __init__(self, pixels: bool) -> None:
        self._pixels = pixels

    def begin(self, row: Row, film: bool) -> Answer:
        """Show the picture of a line. Raises RecordingError if the file changed since the run was planned."""
        del film
        self.row = row
        self._clear()
        picture = read_picture(row.content)
        if row.content.numbers:
            self._keep("columns", row.content.numbers)
        self._keep_pictures([picture], self._pixels)
        return Observation(picture, np.zeros(ARM_NUMBERS, np.float32), row.instruction)

    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Keep the chunk that was predicted, and end."""
        self._keep("prediction", actions)
        return self._ending({"outcome": CAPTURE_ONLY})


def read_picture(line: PictureLine) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) uint8. Raises RecordingError for a file that changed, or is no picture."""
    content, where = _read(line.picture), line.picture.name
    if _digest(content) != line.content:
        raise RecordingError(f"{where} was changed after the run was planned; leave the pictures as they are")
    return np.asarray(decode_bytes(content, f"{where}:", RecordingError, "Write it again as PNG.")).copy()


def _code_columns(
    table: TextTable, lines: Sequence[tuple[int, Cells]], names: Sequence[str]
) -> tuple[list[list[float]], dict[str, list[str]]]:
    """Return the columns that become labels as numbers, and the names that a run stores of them.

    A number is NaN where the cell is empty. True and false are 1 and 0; a text is its position in alphabetical
    order.

    Raises:
        UsageError: For a cell that breaks a rule of labels.
    """
    read = LabelTable.of_lines(table, lines, names)
    values: list[list[float]] = []
    truths: list[str] = []
    classes: dict[str, list[str]] = {}
    for name in names:
        cells = read.values(name)
        if texts := sorted({cell for cell in cells if isinstance(cell, str)}):
            classes[CLASSES + name] = texts
        elif any(isinstance(cell, bool) for cell in cells):
            truths.append(name)
        code_of = {text: code for code, text in enumerate(texts)}
        values.append(
            [np.nan if cell is None else float(code_of[cell] if isinstance(cell, str) else cell) for cell in cells]
        )
    return values, {**({TRUTHS: truths} if truths else {}), **classes}


def _with_groups(table: TextTable, lines: list[tuple[int, Cells]]) -> list[tuple[int, Cells]]:
    """Return the lines with one spelling per group. Raises UsageError for two spellings of probably one group."""
    grouped = [(number, text) for number, text in lines if text.get(GROUP)]
    spelled = group_names(
        [text[GROUP] for _, text in grouped], lambda row: table.where(grouped[row][0], GROUP), UsageError
    )
    names = {number: name for (number, _), name in zip(grouped, spelled, strict=True)}
    return [(number, text | {GROUP: names.get(number)}) for number, text in lines]


def _line(text: Cells, folder: Path, where: str, numbers: tuple[float, ...]) -> PictureLine:
    """Return a line of the table. Raises RecordingError naming what is wrong with it."""
    for name in (PICTURE, INSTRUCTION, ID, GROUP):  # labels are checked by `LabelTable`
        cell = text.get(name) or ""
        if UNSAFE.search(cell) or (not cell and name in (PICTURE, INSTRUCTION)):
            raise RecordingError(f"{where} has the {name} {cell!r}; expected plain text")
    path = Path(text[PICTURE] or "")
    if path.is_absolute() or ".." in path.parts:
        raise RecordingError(f"{where} names {path}; expected a file in the folder of --pictures")
    if not (folder / path).resolve().is_relative_to(folder.resolve()):
        raise RecordingError(
            f"{where} names {path}, a link to a file outside the folder of --pictures; expected a file in it. "
            "Copy the picture into the folder (cp -L)"
        )
    return PictureLine(folder / path, _digest(_read(folder / path)), numbers)


def _id(text: Cells, number: int) -> str:
    return text.get(ID) or f"picture-{number:06d}"


def _read(path: Path) -> bytes:
    try:
        return read_regular(path)
    except OSError as error:
        raise RecordingError(
            f"{path.name} cannot be read: {error.strerror}. Correct the table or --pictures"
        ) from error


def _digest(content: bytes) -> str:
    return blake2b(content, digest_size=_DIGITS).hexdigest()
