"""The parts of a run's settings: model, capture, task, machine. Each part says whether it identifies the run.

Two runs are the same run if the settings that identify them are equal. `capture` and `task` identify a run as they
are. The model and the source (in `sources/`) do so by what they lead to: a hash of weights, and a list of rows.
`machine` never does. Each field is declared here once: its annotation holds the option of the command line, and
study files have the same fields.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import typer
from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, TypeAdapter

from probe_kit._system.machine import AUTO, device_here
from probe_kit._terminal import options as common
from probe_kit._terminal.console import whole_number
from probe_kit._terminal.field_options import Part
from probe_kit._terminal.options import further_option, speed_option
from probe_kit.errors import UsageError
from probe_kit.extract.prompts import P1, PictureShown, Query, Template, find_template
from probe_kit.hooks import family as hook_family
from probe_kit.hooks.capturing.edits import Edit, Vectors
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.declared import ProtocolName, Rotation, read_pairs
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.layout import AskTokens, Codec, FrameChoice, LaterViews, Tokens, VideoChoice

LARGEST = 1_000_000
MOST_CALLS = 10_000
stored_option = partial(typer.Option, rich_help_panel="Stored data")
control_option = partial(typer.Option, rich_help_panel="Controls")


def option_of(annotated: Any) -> Any:
    """Return the option of an alias in `_terminal.options`, for a field of another type than its texts."""
    return annotated.__metadata__[0]


def count_or(word: str, option: str) -> Callable[[Any], Any]:
    """Return a parser of a whole number or `word`, which raises UsageError for anything else."""

    def parse(text: Any) -> Any:
        number = whole_number(str(text))
        if number is None and text != word:
            raise UsageError(f"{option} {text!r} is neither a whole number nor {word}")
        return word if number is None else number

    return parse


def read_options(value: Any) -> Any:
    """Return KEY=VALUE texts as a dictionary, and a dictionary as it is."""
    return read_pairs(value) if isinstance(value, Sequence) and not isinstance(value, str) else dict(value or {})


def is_here(text: str | None) -> bool:
    """Whether a setting, such as a checkpoint, is a folder or file of this machine."""
    if text in (None, "", EMBEDDED):
        return False
    try:
        return Path(str(text)).expanduser().exists()
    except (OSError, RuntimeError):  # no path at all, or ~name of an unknown user
        return False


OptionsByName = Annotated[dict[str, Any], BeforeValidator(read_options)]


WeightsDtype = Annotated[
    hook_family.Dtype | None,
    further_option("--dtype", help="Data type of the weights. Default: the data type of the checkpoint."),
]


SCRIPTED: Mapping[str, str] = {
    "expert": "scripted: knows the answer and puts the cube on it; proves environment and scoring",
    "expert-mirrored": "scripted: knows the answer and puts the cube on the other picture",
    "idle": "scripted: does nothing; what a rule gives it is owed to no answer",
}
"""The policies without a network, which take the place of a family, and what each does."""


class ModelSettings(Part):
    """The model that acts or answers, and its weights.

    Attributes:
        family: A name of `probe-kit models`, or a script.
        checkpoint: A folder or hub id; None for the family's default.
        options: Options of the family, such as `unnorm_key`.
        random_weights: Whether the weights are untrained, as a control.
        weights_seed: The seed of untrained weights.
        dtype: The data type of the weights; None for the checkpoint's.
    """

    family: Annotated[str, option_of(common.ModelName)]
    checkpoint: common.Checkpoint = None
    options: Annotated[OptionsByName, option_of(common.ModelOptions)] = Field(default={})
    random_weights: common.RandomWeights = False
    weights_seed: Annotated[common.WeightsSeed, Field(ge=0)] = 0
    dtype: WeightsDtype = None

    def files(self) -> dict[str, Path]:
        """Return the files and folders of this machine that options name, by option."""
        from probe_kit.hooks.registry import get_family

        family = get_family(self.family)
        names = [option.name for option in (() if family is None else family.options) if option.is_path]
        # The same text may be a word of the family, such as a data set's name.
        return {name: Path(str(self.options[name])) for name in names if is_here(self.options.get(name))}


# -- capture ------------------------------------------------------------------------------------------------


class Capture(Part):
    """The stored activations of a model that acts.

    Attributes:
        tokens: `pooled` stores pooled views only, `all` also every token.
        captured_calls: The number of inferences captured per episode, from the first on; `all` is as many as an
            episode can have, once the model is loaded.
        later_views: `mean` stores of the inferences after the first the view `mean` alone, in bfloat16.
        codec: The compression of stored activations.
    """

    tokens: Annotated[
        Tokens,
        stored_option(
            "--tokens",
            help="pooled: store activations pooled over tokens, such as their mean. all: also store every token "
            "(large).",
        ),
    ] = "pooled"
    captured_calls: Annotated[
        Annotated[int, Field(ge=1, le=MOST_CALLS)] | Literal["all"],
        stored_option(
            "--captured-calls",
            parser=count_or("all", "--captured-calls"),
            metavar="N|all",
            help="Number of inferences captured per episode. all: as many as an episode can have.",
        ),
    ] = 1
    later_views: Annotated[
        LaterViews,
        stored_option(
            "--later-views",
            help="What to store of each inference after the first. all: the same as of the first. mean: only "
            "the mean over tokens, in bfloat16 (small).",
        ),
    ] = "all"
    codec: Annotated[Codec, stored_option("--codec", help="Compression of stored activations.")] = "zstd"

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for later inferences that are not captured, and for tokens of means."""
        if self.later_views == "all":
            return
        if self.captured_calls == 1:
            raise UsageError(
                "--later-views mean is about inferences after the first, and the first alone is captured; add "
                "--captured-calls all, or a number"
            )
        if self.tokens == "all":
            raise UsageError("--later-views mean and --tokens all contradict each other; leave one out")


class AskCapture(Part):
    """The stored activations of a model that answers: of its only inference, or nothing."""

    tokens: Annotated[
        AskTokens,
        stored_option(
            "--tokens",
            help="none: store answers only. pooled: also store activations pooled over tokens, for "
            "probes. all: also "
            "store every token.",
        ),
    ] = "none"
    codec: Codec = "zstd"
    captured_calls: ClassVar[int] = 1
    later_views: ClassVar[LaterViews] = "all"


# -- tasks --------------------------------------------------------------------------------------------------


def read_edit(value: Any) -> Any:
    """Return an edit from its entry in a file; one that is an edit is returned as it is."""
    if not isinstance(value, Mapping):
        return value
    sites = tuple(Site.parse(site) for site in value.get("sites", ()))
    return Edit(**{**value, "sites": sites, "roles": tuple(value.get("roles") or ()) or None})


if TYPE_CHECKING:
    PlainEdit = Edit
else:
    PlainEdit = Annotated[Edit, BeforeValidator(read_edit), PlainSerializer(Edit.to_json)]


class ActTask(Part):
    """The task of a policy: to act, or to be captured only.

    Attributes:
        protocol: A published protocol, such as `act2answer`, which decides what is not chosen, see `protocols`.
            None for no protocol.
        execute: The number of actions executed per inference; None for the policy's own.
        rotation: The form in which the rotation of an action reaches the controller, see `ProtocolRow`; None for
            the protocol's, or its angles as they are.
        capture_only: Whether the first inference of every episode is captured and the policy does not act.
        edits: The changes of the streams at every inference.
        vectors: The directions and sources of the edits, by hash.
    """

    protocol: Annotated[
        ProtocolName | None,
        further_option(
            "--protocol",
            help="Use scene, checkpoint and options of a published protocol. Your options take precedence.",
        ),
    ] = None
    execute: Annotated[
        Annotated[int, Field(ge=1, le=MOST_CALLS)] | None,
        further_option(
            "--execute", help="Number of actions executed per inference. Default: set by protocol or model."
        ),
    ] = None
    rotation: Annotated[
        Rotation | None,
        further_option(
            "--rotation",
            help="How the rotation of an action reaches the arm. roll-pitch-yaw: as it is. axis-angle: "
            "converted, as the released evaluation does for some models. Default: set by protocol, else "
            "roll-pitch-yaw.",
        ),
    ] = None
    capture_only: Annotated[
        bool,
        further_option(
            "--no-act",
            help="Capture the first inference of each episode without acting. There is no success rate.",
        ),
    ] = False
    edits: tuple[PlainEdit, ...] = ()
    if TYPE_CHECKING:
        vectors: Vectors = {}
    else:
        vectors: Annotated[Any, Field(exclude=True)] = {}


def _template(value: Any) -> Any:
    return find_template(value) if isinstance(value, str) else value


PromptTemplate = Annotated[Template, BeforeValidator(_template)]


class AskTask(Part):
    """The task of a model that answers: prompt, picture and object.

    Attributes:
        protocol: A published protocol, whose scene takes the place of the default one; it decides nothing else of
            a question.
        prompt: A template, or its name or file.
        picture: `frame` shows the first frame of the episode, `side-by-side` its two pictures on grey, `none`
            nothing.
        query: The object that is asked for, see `QUERIES`.

    Raises:
        UsageError: For an absent object with a prompt to which "no" is no answer.
    """

    execute: ClassVar[None] = None
    capture_only: ClassVar[bool] = False

    protocol: Annotated[
        ProtocolName | None,
        typer.Option("--protocol", help="Use the scene of a published protocol. --scene takes precedence."),
    ] = None
    prompt: PromptTemplate = P1
    picture: Annotated[
        PictureShown,
        control_option(
            "--picture",
            help="frame: show the first frame. side-by-side: show both pictures on grey. none: show no picture; "
            "accuracy above 50 % then indicates a leak in the suite.",
        ),
    ] = "frame"
    query: Annotated[
        Query,
        control_option(
            "--query",
            help="target: ask for the object of the instruction. distractor: ask for the object of the other "
            "picture. absent: ask for an object in neither picture (requires --prompt seen; no is correct).",
        ),
    ] = "target"

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for an absent object if the prompt cannot be answered with "no"."""
        if self.query == "absent" and not self.prompt.yes_or_no:
            raise UsageError(
                f"--query absent needs a prompt that can be answered no; {self.prompt.name} does not ask "
                "for yes or no. Use --prompt seen"
            )


# -- machine ------------------------------------------------------------------------------------------------


class Machine(Part):
    """Settings that change no stored number: the speed of a run, and the pictures that are stored for people.

    Attributes:
        device: The device of the model. `auto` becomes one of this machine, see `device_here`; with `ray` too.
        frames: `ends` stores small copies of the first and last frame of every episode, `all` of every frame,
            `none` none.
        env_workers: The number of processes that simulate and draw; None for two per observation of a batch, 0 for
            this process.
        workers: The number of processes with a model each, one per GPU where there are several; 0 for this
            process.
        ray: The address of a Ray cluster, or `auto`; the workers then run there. None for this machine.
        inference_limit: The seconds that one call of the model may take in a worker. A worker that takes longer is
            ended; its episodes are tried once more, and given up by name. None for no limit.
        capture_memory: The most memory of the device, in megabytes, for activations that wait to be pooled: those
            of all layers of one iteration of a stream, and their copy. None waits for all layers.
        allow_mixed: Continue a run whose episodes were made on another kind of device or with other versions. The
            run is then marked as mixed wherever tables name it.
        accept_ignored_inputs: Accept a model that neither another picture nor another instruction changes.
    """

    device: Annotated[common.Device, AfterValidator(device_here), Field(validate_default=True)] = AUTO
    frames: Annotated[
        FrameChoice,
        stored_option(
            "--frames",
            help="ends: store a small copy of the first and last frame of every episode. all: store "
            "every frame, for "
            "the viewer and for data sets.",
        ),
    ] = "ends"
    env_workers: Annotated[Annotated[int, Field(ge=0, le=1024)] | None, option_of(common.EnvWorkers)] = None
    workers: Annotated[common.Workers, Field(ge=0, le=1024)] = 0
    ray: common.RayAddress = None
    inference_limit: Annotated[
        Annotated[float, Field(gt=0, le=LARGEST)] | None, option_of(common.InferenceLimit)
    ] = None
    capture_memory: Annotated[
        Annotated[float, Field(gt=0, le=LARGEST)] | None,
        further_option(
            "--capture-memory",
            metavar="MB",
            help="Device memory, in megabytes, for activations before they are pooled. With less, fewer "
            "layers are pooled at once. Default: enough for all layers of one iteration.",
        ),
    ] = None
    allow_mixed: common.AllowMixed = False
    accept_ignored_inputs: Annotated[
        bool,
        further_option(
            "--accept-ignored-inputs",
            help="Accept a model whose output stays the same whatever picture and instruction it gets.",
        ),
    ] = False

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for a limit without a worker process that could be ended."""
        if self.inference_limit is not None and not self.elsewhere:
            raise UsageError(
                f"--inference-limit {self.inference_limit:g} needs a process that can be ended: add --workers 1, "
                "or leave it out and end a model that hangs with Ctrl-C"
            )

    @property
    def capture_bytes(self) -> int | None:
        """`capture_memory` in bytes."""
        return None if self.capture_memory is None else int(1e6 * self.capture_memory)

    @property
    def elsewhere(self) -> bool:
        """Whether processes other than this one hold the model."""
        return bool(self.workers or self.ray)


class ActMachine(Machine):
    """The machine settings of a model that acts.

    Attributes:
        batch: The number of observations per call of the model. With 1, bytes repeat exactly; with more, up to
            float rounding. `auto` chooses batch and env_workers by a measurement of some seconds, see
            `calibration`. None is `auto` for a policy on a GPU without a number of env_workers, and else 1.
        video: The episodes of which a GIF is stored: the first, all, or none.
        accept_units: Play or show states that lie far outside the checkpoint's statistics.
    """

    batch: Annotated[
        Annotated[int, Field(ge=1, le=4096)] | Literal["auto"] | None,
        speed_option(
            "--batch",
            parser=count_or("auto", "--batch"),
            metavar="N|auto",
            help="Number of observations per model call. Above 1, results repeat up to rounding. auto: measure "
            "for some seconds and choose --batch and --env-workers. Default: auto on a GPU, else 1.",
        ),
    ] = None
    video: Annotated[VideoChoice, stored_option("--video", help="Store a GIF of the first episode or of all.")] = (
        "none"
    )
    accept_units: Annotated[
        bool,
        further_option(
            "--accept-units",
            help="Accept robot states far outside the checkpoint's statistics. Such states often have other "
            "units, such as degrees in place of radians.",
        ),
    ] = False


class AskMachine(Machine):
    """The machine settings of a model that answers.

    Attributes:
        batch: The number of questions per call of the model.
    """

    batch: Annotated[
        int,
        Field(ge=1, le=4096),
        speed_option(
            "--batch", help="Number of questions per model call. Above 1, results repeat up to rounding."
        ),
    ] = 1
    video: ClassVar[VideoChoice] = "none"
    accept_units: ClassVar[bool] = False


def _plain_scene(scene: Any) -> dict[str, Any]:
    return asdict(scene)


def _scene(value: Any) -> Any:
    """Return a scene from its entry in a file; one that is a scene is returned as it is."""
    from probe_kit.env import SceneSpec

    return value if isinstance(value, SceneSpec) else TypeAdapter(SceneSpec).validate_python(value)


if TYPE_CHECKING:
    from probe_kit.env import SceneSpec

    Scene = SceneSpec
else:
    Scene = Annotated[Any, BeforeValidator(_scene), PlainSerializer(_plain_scene)]
    """A `SceneSpec`, whose package is loaded with the first scene, so that help comes without a simulator."""
