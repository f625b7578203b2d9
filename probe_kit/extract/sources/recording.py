"""Frames of a LeRobotDataset as a source: settings of what is shown."""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import typer
from pydantic import BeforeValidator, Field

from probe_kit._system.table_cells import is_count
from probe_kit.errors import UsageError
from probe_kit.extract.sources.source import REFUSED_WITHOUT_ACTING, SourceSettings
from probe_kit.hooks.families.shared.kinds import ACTION, IMAGES, STATE

TURNS = (90, 180, 270)
"""The degrees by which pictures can be rotated, counterclockwise."""
MOST_EPISODES = 1_000_000
_RANGE = re.compile(r"(\d{1,18})(?::(\d{1,18}))?")
_EVERY = re.compile(r"every:([1-9]\d{0,17})")
_HUB = re.compile(r"[\w.-]+/[\w.-]+(@[\w./-]+)?")
_option = partial(typer.Option, rich_help_panel="Recordings")

Pairs = tuple[tuple[str, str], ...]


def read_episodes(value: Any) -> Any:
    """Return indices, each once and in order: of `0:5` (0 to 4), `7`, several such with commas, or numbers.

    Raises:
        UsageError: For a text that names no episodes, or for negative numbers.
    """
    if value is None:
        return None
    if not isinstance(value, str):
        numbers = tuple(sorted({int(number) for number in value}))
        if not numbers or numbers[0] < 0:
            raise UsageError(f"episodes are {list(numbers)[:5]}; expected indices from 0 on, at least one")
        return numbers
    several: list[int] = []
    for part in filter(None, (text.strip() for text in value.split(","))):
        matched = _RANGE.fullmatch(part)
        start, stop = (int(matched[1]), int(matched[2] or int(matched[1]) + 1)) if matched else (0, 0)
        if not start < stop <= MOST_EPISODES:
            raise UsageError(
                f"--episodes {value!r}: {part!r} is no range of episodes; expected START:STOP, such as 0:5 for "
                "the first five, or single indices"
            )
        several += range(start, stop)
    if not several:
        raise UsageError(f"--episodes {value!r} names none; expected START:STOP, such as 0:5")
    return tuple(sorted(set(several)))


def episodes_text(episodes: Sequence[int]) -> str:
    """Return ascending episodes as `read_episodes` reads them, such as `0:5,7`."""
    runs: list[list[int]] = []
    for episode in episodes:
        if runs and episode == runs[-1][1]:
            runs[-1][1] += 1
        else:
            runs.append([episode, episode + 1])
    return ",".join(str(start) if stop == start + 1 else f"{start}:{stop}" for start, stop in runs)


Episodes = Annotated[
    tuple[int, ...] | None,
    BeforeValidator(read_episodes),
    _option(
        "--episodes",
        parser=str,
        metavar="START:STOP",
        help="Episodes of the data set or environment, such as 0:5 for the first five. Default: all.",
    ),
]
Pixels = Annotated[
    bool,
    _option(
        " /--no-pixels",
        show_default=False,
        help="Store no thumbnails of 32 × 32 pixels. Two controls of your labels then cannot be run.",
    ),
]


def _every(value: Any) -> Any:
    """Return N of `every:N`, or a number as it is. Raises UsageError."""
    if not isinstance(value, str):
        return value
    matched = _EVERY.fullmatch(value)
    if matched is None:
        raise UsageError(f"--select {value!r}; expected every:N, such as every:5")
    return int(matched[1])


def read_pairs_of(option: str, example: str, value: Any) -> Any:
    """Return CAMERA=VALUE texts, a dictionary, or pairs, as pairs. Raises UsageError."""
    if isinstance(value, Mapping):
        return tuple(value.items())
    pairs = []
    for text in value or ():
        name, equals, setting = text.partition("=") if isinstance(text, str) else (text[0], "=", text[1])
        if not (name and equals and setting):
            raise UsageError(f"{option} {text!r}; expected CAMERA=VALUE, such as {option} {example}")
        pairs.append((name, setting))
    return tuple(pairs)


EVERY_CAMERA = "*"
"""The camera of a rotation that names none: all of them."""

Cameras = Annotated[
    Pairs,
    BeforeValidator(partial(read_pairs_of, "--camera", f"base={IMAGES}top")),
    _option(
        "--camera",
        metavar="CAMERA=FEATURE",
        help="Which picture of the data set or environment a camera of the model sees; repeatable. Default: the "
        "mapping in the checkpoint's files, else equal names.",
    ),
]


def _features(value: Any) -> Any:
    pairs = read_pairs_of("--feature", f"{STATE}=state", value)
    if strange := [name for name, _ in pairs if name not in (STATE, ACTION)]:
        raise UsageError(
            f"--feature {strange[0]}=…: expected {STATE} or {ACTION}, such as --feature {STATE}=state. Pictures "
            "are mapped with --camera"
        )
    return pairs


def read_turns(value: Any) -> Any:
    """Return CAMERA=DEGREES texts, and degrees without a camera, as pairs. Raises UsageError."""
    turns = []
    several = [value] if isinstance(value, int | str) else value
    if isinstance(several, Sequence):  # degrees without a camera
        several = [
            f"{EVERY_CAMERA}={text}"
            if isinstance(text, int) or (isinstance(text, str) and "=" not in text)
            else text
            for text in several
        ]
    for camera, degrees in read_pairs_of("--rotate", "base=180", several):
        if not is_count(str(degrees)):
            which = "" if camera == EVERY_CAMERA else f"{camera}="
            raise UsageError(f"--rotate {which}{degrees}; expected degrees, such as {which}180")
        turns.append((camera, int(degrees)))
    if wrong := [turn for _, turn in turns if turn not in TURNS]:
        raise UsageError(
            f"pictures are rotated by {wrong[0]} degrees; expected one of {', '.join(map(str, TURNS))}"
        )
    names = [camera for camera, _ in turns]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"--rotate gives {twice[0]} twice; give every camera once")
    return tuple(turns)


Rotations = Annotated[
    tuple[tuple[str, int], ...],
    BeforeValidator(read_turns),
    typer.Option(
        "--rotate",
        metavar="[CAMERA=]DEGREES",
        help="Rotate pictures counterclockwise by 90, 180 or 270 degrees, such as 180 if they are upside "
        "down. CAMERA=DEGREES rotates those of one camera; repeatable.",
        rich_help_panel="Recordings",
    ),
]


def degrees_of(rotations: Iterable[tuple[str, int]], camera: str) -> int:
    """Return the degrees by which the pictures of a camera are rotated, 0 for none; its own count before all."""
    degrees = dict(rotations)
    return degrees.get(camera, degrees.get(EVERY_CAMERA, 0))


class LeRobotSource(SourceSettings):
    """Frames of a LeRobotDataset in place of a scene.

    Attributes:
        folder: The data set's folder, or USER/NAME@COMMIT of the hub.
        episodes: Indices of episodes; None for all.
        every: The step between shown frames: of each episode frame 0 and each so many frames on.
        cameras: The feature of the data set by camera of the model; empty where both have one, where the names are
            equal, or where the checkpoint's own files map them.
        features: The feature of the data set by `observation.state` or `action`, where it has another name there.
        rotations: The degrees by camera of the model, counterclockwise; `*` names all cameras.
        instruction: The words that the model reads in place of the task of a frame; None for that task.
        pixels: Whether pictures at 32 × 32 are stored for controls.
        single: Whether every frame is a row of its own, of which some can be chosen; no option gives it.

    Raises:
        UsageError: For what no data set can have.
    """

    kind: Literal["lerobot"] = "lerobot"
    folder: Annotated[
        str,
        BeforeValidator(str),
        _option(
            "--dataset",
            metavar="FOLDER",
            help="Show frames of a LeRobotDataset (3.0) in place of a suite: a folder, or USER/NAME@COMMIT of the "
            "hub. The model does not act.",
        ),
    ]
    episodes: Episodes = None
    every: Annotated[
        int,
        Field(ge=1),
        BeforeValidator(_every),
        _option(
            "--select",
            parser=str,
            metavar="every:N",
            show_default=False,
            help="Which frames of an episode to show, such as every:5. Default: every:1.",
        ),
    ] = 1
    cameras: Cameras = ()
    features: Annotated[
        Pairs,
        BeforeValidator(_features),
        _option(
            "--feature",
            metavar="NAME=FEATURE",
            help=f"Which feature of the data set is {STATE} or {ACTION}; repeatable. Default: equal names.",
        ),
    ] = ()
    rotations: Rotations = ()
    instruction: Annotated[
        str | None,
        _option("--instruction", help="The instruction that the model reads. Default: the task of each frame."),
    ] = None
    pixels: Pixels = True
    single: bool = False

    command: ClassVar[str] = "--dataset FOLDER"
    opens: ClassVar[str] = "probe_kit.extract.sources.recording_source:RecordingSource"
    moves: ClassVar[Mapping[str, str]] = {"folder": "Folder of the run's recordings, if it was moved."}
    played: ClassVar[str] = "on"
    subject: ClassVar[str] = "recordings"
    loads: ClassVar[str] = "recordings"
    decides: ClassVar[tuple[str, ...]] = ("captured_calls",)
    refuses: ClassVar[tuple[str, ...]] = REFUSED_WITHOUT_ACTING
    shows: ClassVar[str] = "--dataset, which shows recorded frames and executes no action"

    def __init__(self, folder: str | Path, **choices: Any) -> None:
        super().__init__(**{"folder": folder, **choices})

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for a camera, a feature or a name that is mapped twice."""
        features: Iterable[tuple[str, list[str]]] = (
            ("camera", [name for name, _ in self.cameras]),
            ("feature", list(dict(self.cameras).values())),
            ("name", [name for name, _ in self.features]),
            ("feature", list(dict(self.features).values())),
        )
        for part, names in features:
            if twice := [name for name in names if names.count(name) > 1]:
                raise UsageError(f"the {part} {twice[0]!r} is mapped twice; give each once")

    @property
    def is_local(self) -> bool:
        """Whether the source names a folder, not a data set of the hub."""
        return Path(self.folder).expanduser().exists() or not _HUB.fullmatch(self.folder)

    @property
    def name(self) -> str:
        """The name in tables; the folder's place on this machine is no part of a run."""
        return Path(self.folder).expanduser().resolve().name if self.is_local else self.folder.partition("@")[0]

    def files(self) -> dict[str, Path]:
        """Return the folder of recordings on this machine."""
        return {"folder": Path(self.folder).expanduser()} if self.is_local else {}
