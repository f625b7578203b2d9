"""Options of `probe-kit extract` and `probe-kit ask`, by help panel."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from probe_kit._terminal.console import whole_number
from probe_kit._terminal.options import Names, choices, further_option, read_size, some_of, speed_option
from probe_kit.errors import UsageError
from probe_kit.extract.vqa.phrases import Picture, Query
from probe_kit.hooks import family as hook_family
from probe_kit.hooks.contract.protocol import ProtocolName, Rotation
from probe_kit.runs.layout import AskTokens, Codec, FrameChoice, LaterViews, Tokens, VideoChoice
from probe_kit.scene_names import ArmName, Rendering
from probe_kit.suite.ladder import WORDINGS

_scene_option = partial(typer.Option, rich_help_panel="Scene")
_storage_option = partial(typer.Option, rich_help_panel="Stored data")
_control_option = partial(typer.Option, rich_help_panel="Controls")
_STARTING = ("out_folder", "dry_run", "force", "large")


def settings_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a command but those that say where and whether it starts."""
    return {name: value for name, value in options.items() if name not in _STARTING}


class Sizes(tuple[tuple[int, int], ...]):
    """Comma-separated sizes of pictures, (width, height) in pixels each."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Sizes") -> "Sizes":
        """The sizes of `text`, each WIDTHxHEIGHT; a default that is no text is returned as it is."""
        if not isinstance(text, str):
            return text
        return cls(map(read_size, several("--picture-size", text)))

    def __str__(self) -> str:
        """As they are typed."""
        return ",".join(f"{width}x{height}" for width, height in self)


class Size(tuple[int, int]):
    """One size of a picture, (width, height) in pixels."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: str) -> "Size":
        """The size that WIDTHxHEIGHT names."""
        return cls(read_size(text))


def several(option: str, text: str | Names) -> Names:
    """The parts of a comma-separated option. Raises UsageError for none."""
    parts = Names.parse(text)
    if not parts:
        raise UsageError(f"{option} is empty; name at least one")
    return parts


def _prompts(text: str | Names) -> Names:
    return several("--prompt", text)


def _batch(text: str | int) -> int | str:
    """A number of observations, or `auto`. Raises UsageError for anything else."""
    number = whole_number(str(text))
    if number is None and text != "auto":
        raise UsageError(f"--batch {text!r} is neither a whole number nor auto")
    return "auto" if number is None else number


def _captured_calls(text: str | int) -> int | str:
    """A number of inferences, or `all`. Raises UsageError for anything else."""
    number = whole_number(str(text))
    if number is None and text != "all":
        raise UsageError(f"--captured-calls {text!r} is neither a whole number nor all")
    return "all" if number is None else number


# -- most used ----------------------------------------------------------------------------------------------

OutFolder = Annotated[
    str | None,
    typer.Option(
        "--out", metavar="FOLDER", help="Folder or s3://BUCKET/PREFIX/RUN. Default: runs/<model>-<settings hash>."
    ),
]
AskOutFolder = Annotated[
    str | None,
    typer.Option(
        "--out",
        metavar="FOLDER",
        help="Folder or URL that holds one run per prompt and size. Default: a folder per run below runs/.",
    ),
]
EvenItems = Annotated[
    int | None, typer.Option("--items", help="Number of items per category, an even number. Default: all.")
]
Wordings = Annotated[
    Names | None,
    further_option(
        "--wordings",
        parser=some_of(WORDINGS),
        metavar=f"{choices(WORDINGS)},…",
        help="Wordings of the instruction, comma-separated. Every item is played in each of them with the same "
        "seeds. Default: knowledge, the wording of the item.",
    ),
]
Protocol = Annotated[
    ProtocolName | None,
    further_option(
        "--protocol",
        help="Use scene, checkpoint and options of a published protocol. Your options take precedence.",
    ),
]
AskProtocol = Annotated[
    ProtocolName | None,
    typer.Option("--protocol", help="Use the scene of a published protocol. --scene takes precedence."),
]
Label = Annotated[
    str | None,
    typer.Option(
        "--label", help="Name of the run in tables. Default: the model and the options in which it differs."
    ),
]
Execute = Annotated[
    int | None,
    further_option(
        "--execute", help="Number of actions executed per inference. Default: set by protocol or model."
    ),
]
RotationOfActions = Annotated[
    Rotation | None,
    further_option(
        "--rotation",
        help="roll-pitch-yaw: pass the angles of an action on. axis-angle: convert them, as the release does "
        "for some models. Default: set by protocol, else roll-pitch-yaw.",
    ),
]
CaptureOnly = Annotated[
    bool,
    further_option(
        "--no-act", help="Capture the first inference of each episode without acting. There is no success rate."
    ),
]
AcceptUnits = Annotated[
    bool,
    further_option(
        "--accept-units",
        help="Accept states that lie far outside the statistics of the checkpoint, on any source.",
    ),
]
Dtype = Annotated[
    hook_family.Dtype | None,
    further_option("--dtype", help="Data type of the weights. Default: the data type of the checkpoint."),
]
Prompts = Annotated[
    Names,
    typer.Option(
        "--prompt",
        parser=_prompts,
        metavar="A,B,…",
        help="Prompts, comma-separated: seen, p1, p2 (from the paper), instruction (the words of the policies) "
        "or text files. A file contains {object}, and {A} and {B} for the sides.",
    ),
]
P1_P2_SEEN = Names(("p1", "p2", "seen"))
PictureSizes = Annotated[
    Sizes,
    typer.Option(
        "--picture-size",
        parser=Sizes.parse,
        metavar="WxH,…",
        show_default="224x224",
        help="Picture sizes in pixels, comma-separated. The paper uses 224x224 and 560x480.",
    ),
]
SIZE_224 = Sizes([(224, 224)])

# -- scene --------------------------------------------------------------------------------------------------

MaxSteps = Annotated[int | None, _scene_option("--max-steps", help="Number of actions per episode, at 5 Hz.")]
TileSide = Annotated[
    float | None,
    _scene_option("--tile-side", help="Side of a tile in metres. The paper uses 0.1452, 0.2033 and 0.1162."),
]
LightLevel = Annotated[
    float | None,
    _scene_option("--light-level", help="Brightness of the light; 1 is the default. The paper uses 0.7 and 1.3."),
]
RenderingStyle = Annotated[
    Rendering | None,
    _scene_option("--rendering", help="visual-matching: draw robot, cube and tiles over a photo."),
]
Background = Annotated[
    Path | None, _scene_option("--background", help="Photo for visual-matching. Default: the embedded photo.")
]
PictureSize = Annotated[
    Size | None,
    _scene_option(
        "--picture-size",
        parser=Size.parse,
        metavar="WxH",
        help="Size of the camera image for the policy in pixels, such as 224x224.",
    ),
]
Epsilon = Annotated[
    float | None,
    _scene_option("--epsilon", help="Radius of the target zone in metres. Default: half a tile + 0.01."),
]
Arm = Annotated[ArmName | None, _scene_option("--arm", help="Robot arm.")]
ArmUrdf = Annotated[Path | None, _scene_option("--arm-urdf", help="Your own URDF file of this arm.")]
StartGrasped = Annotated[bool, _scene_option("--start-grasped", help="Start with the cube in the gripper.")]
EarlyStop = Annotated[
    bool, _scene_option("--early-stop", help="End an episode when the released cube is at rest.")
]

# -- stored data --------------------------------------------------------------------------------------------

StoredTokens = Annotated[
    Tokens, _storage_option("--tokens", help="pooled: store pooled views. all: also store every token (large).")
]
AskStoredTokens = Annotated[
    AskTokens,
    _storage_option(
        "--tokens",
        help="none: store answers only. pooled: also store pooled views, for probes. all: also store every token.",
    ),
]
CapturedCalls = Annotated[
    object,
    _storage_option(
        "--captured-calls",
        parser=_captured_calls,
        metavar="N|all",
        help="Number of inferences captured per episode. all: as many as an episode can have.",
    ),
]
LaterViewsKept = Annotated[
    LaterViews,
    _storage_option(
        "--later-views",
        help="mean: of the inferences after the first, store the view mean alone, in bfloat16 (small).",
    ),
]
Frames = Annotated[
    FrameChoice,
    _storage_option(
        "--frames",
        help="ends: store the first and last frame of every episode in small. all: store every frame, for the "
        "viewer and for data sets.",
    ),
]
Video = Annotated[VideoChoice, _storage_option("--video", help="Store a GIF of the first episode or of all.")]
StorageCodec = Annotated[Codec, _storage_option("--codec", help="Compression of stored activations.")]

# -- controls of questions ----------------------------------------------------------------------------------

ShownPicture = Annotated[
    Picture,
    _control_option(
        "--picture",
        help="frame: show the first frame. side-by-side: show both pictures on grey. none: show no picture; "
        "accuracy above 50 % then indicates a leak in the suite.",
    ),
]
AskedObject = Annotated[
    Query,
    _control_option(
        "--query",
        help="target: ask for the object of the instruction. distractor: ask for the object of the other picture. "
        "absent: ask for an object in neither picture (requires --prompt seen; no is correct).",
    ),
]

Large = Annotated[
    bool, _storage_option("--yes", help="Begin a run that would take more than 64 GB before compression.")
]

# -- speed --------------------------------------------------------------------------------------------------

Batch = Annotated[
    object | None,
    speed_option(
        "--batch",
        parser=_batch,
        metavar="N|auto",
        help="Number of observations per model call. Above 1, results repeat up to rounding. auto: measure for "
        "some seconds and choose --batch and --env-workers. Default: auto on a GPU, else 1.",
    ),
]
AskBatch = Annotated[
    int,
    speed_option("--batch", help="Number of questions per model call. Above 1, results repeat up to rounding."),
]
