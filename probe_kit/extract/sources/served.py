"""Observations that clients send to a policy server as a source: settings of what is served."""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import typer
from pydantic import BeforeValidator, Field, PlainSerializer

from probe_kit._terminal.console import split
from probe_kit._terminal.options import further_option
from probe_kit.errors import UsageError
from probe_kit.extract.sources.conditions import ServedCondition, read_conditions
from probe_kit.extract.sources.recording import Pairs, read_pairs_of, read_turns
from probe_kit.extract.sources.source import SourceSettings

Wire = Literal["openpi", "vla-eval"]
WORDS: Mapping[Wire, str] = {"openpi": "prompt", "vla-eval": "task_description"}
"""The key of the words in an observation, by wire."""
EpisodeRule = Literal["guessed", "words", "connection", "said"]
Keep = Literal["full", "small"]
MOST_CALLS = 64
"""The captured inferences of an episode with `--captured-calls all`: arrays have that length."""
LONGEST_NAME = 200
"""The most characters of a name."""
_option = partial(typer.Option, rich_help_panel="Keys of observations")


def _read_keys(value: Any) -> Any:
    """Return the parts of KEY,KEY as they are written, and a sequence as it is."""
    return split(value) or () if isinstance(value, str) else tuple(value or ())


if TYPE_CHECKING:
    Conditions = tuple[ServedCondition, ...]
else:
    Conditions = Annotated[
        Any,
        BeforeValidator(read_conditions),
        PlainSerializer(lambda conditions: [condition.to_json() for condition in conditions]),
    ]


class ServedSettings(SourceSettings):
    """Observations that arrive at a policy server, in place of a scene.

    Attributes:
        wire: The protocol of the clients.
        cameras: The key of a picture by camera of the model; `/` leads into nested maps. Empty for equal names, or
            the only picture of a model with one camera.
        rotations: The degrees by camera of the model, counterclockwise; `*` names all cameras.
        state: The keys of the state, joined in this order; empty where the policy reads none.
        instruction: The words that the model reads in place of those that clients send; None for theirs.
        every: The step between captured inferences of an episode.
        keep: `full` stores pictures as they arrive; `small` at 32 × 32 alone, which cannot be shown again.
        source_name: The name of what is served; runs of one name count as runs of one data set. None for one
            that is drawn when the run begins.
        rule: What bounds the episodes of clients that do not say so themselves.
        pause: The seconds between two observations after which a new episode begins; None for ten times the
            longest interval so far, at least 5.
        most_calls: The number of captured inferences that `all` stands for.
        conditions: The conditions, of which each episode gets one; empty for episodes that are all alike.
        run: The address of the run whose stored observations are shown again; None for a server.

    Raises:
        UsageError: For a camera or key that is given twice, and for conditions of episodes that are guessed.
    """

    kind: Literal["served"] = "served"
    wire: Annotated[
        Wire,
        typer.Option(
            "--wire",
            help="openpi: the websocket of robots and benchmarks. vla-eval: that harness, which says its "
            "episodes.",
        ),
    ] = "openpi"
    cameras: Annotated[
        Pairs,
        BeforeValidator(partial(read_pairs_of, "--camera", "base=observation/image")),
        typer.Option(
            "--camera",
            metavar="CAMERA=KEY",
            help="Which picture a camera of the model sees; repeatable. Default: equal names, or the only one.",
        ),
    ] = ()
    rotations: Annotated[
        tuple[tuple[str, int], ...],
        BeforeValidator(read_turns),
        _option(
            "--rotate",
            metavar="[CAMERA=]DEGREES",
            help="Rotate pictures by 90, 180 or 270 degrees; repeatable. LIBERO's client has turned them already.",
        ),
    ] = ()
    state: Annotated[
        tuple[str, ...],
        BeforeValidator(_read_keys),
        typer.Option(
            "--state",
            parser=_read_keys,
            metavar="KEY[,KEY…]",
            help="Keys of the state, joined in this order, such as observation/state.",
        ),
    ] = ()
    instruction: Annotated[
        str | None,
        _option("--instruction", help="Instruction that the model reads. Default: the one that clients send."),
    ] = None
    every: Annotated[
        Annotated[int, Field(ge=1, le=MOST_CALLS * 1000)],
        _option("--every", metavar="N", help="Capture every N-th inference of an episode, from the first on."),
    ] = 1
    keep: Annotated[
        Keep,
        _option(
            "--keep",
            help="How pictures are stored. full: as they arrive. small: only at 32 × 32 pixels; `intervene` "
            "and `diagnose` cannot use such a run.",
        ),
    ] = "full"
    source_name: Annotated[
        str | None,
        typer.Option(
            "--source",
            metavar="NAME",
            help="Name of the benchmark or robot, such as libero_spatial@1: runs of one name share a data set.",
        ),
    ] = None
    rule: Annotated[
        EpisodeRule,
        _option(
            "--episodes",
            help="What begins an episode if the client marks none. guessed: a new instruction, a pause, or a "
            "state that returns. words: the same, and each instruction is a group. connection: each "
            "connection. said: refuse such clients.",
        ),
    ] = "guessed"
    pause: Annotated[
        Annotated[float, Field(gt=0, le=86_400)] | None,
        _option(
            "--pause",
            metavar="SECONDS",
            show_default="10 times the longest interval, at least 5",
            help="Seconds without a request that end an episode, if the client marks none.",
        ),
    ] = None
    most_calls: Annotated[
        Annotated[int, Field(ge=1, le=10_000)],
        further_option(
            "--most-calls",
            metavar="N",
            help="Number of inferences that `--captured-calls all` stores per episode, at most.",
        ),
    ] = MOST_CALLS
    conditions: Annotated[
        Conditions,
        _option(
            "--condition",
            metavar="NAME[=FILE]",
            help="Change the streams of some episodes: each gets a condition, drawn in balanced blocks within its "
            "group. none changes nothing; FILE holds edits. Repeatable; needs --episodes said.",
        ),
    ] = ()
    run: Annotated[str | None, Field(exclude=True)] = None

    command: ClassVar[str] = "probe-kit serve"
    opens: ClassVar[str] = "probe_kit.extract.sources.served_source:ServedSource"
    played: ClassVar[str] = "served"
    subject: ClassVar[str] = "served observations"
    loads: ClassVar[str] = "model"
    refuses: ClassVar[tuple[str, ...]] = ("protocol", "rotation", "video", "batch=auto", "edits")
    shows: ClassVar[str] = "a policy server, whose clients act"
    of_run: ClassVar[bool] = True

    def __init__(self, **choices: Any) -> None:
        super().__init__(**choices)

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for what is mapped twice, and for a name that is no plain text."""
        lists: Mapping[str, list[str]] = {
            "camera": [name for name, _ in self.cameras],
            "picture": [key for _, key in self.cameras],
            "key of the state": list(self.state),
        }
        for part, names in lists.items():
            if twice := [name for name in names if names.count(name) > 1]:
                raise UsageError(f"the {part} {twice[0]!r} is given twice; give each once")
        if self.source_name is not None and not (
            self.source_name.isprintable() and 0 < len(self.source_name.strip()) <= LONGEST_NAME
        ):
            raise UsageError(
                f"--source is {self.source_name[:80]!r}; expected 1 to {LONGEST_NAME} printable characters"
            )
        if self.wire == "vla-eval" and self.rule not in ("guessed", "said"):
            raise UsageError(
                f"--episodes {self.rule} does not apply with --wire vla-eval, whose harness says its episodes; "
                "remove it"
            )
        if self.conditions and not self.says_episodes:
            raise UsageError(
                "--condition gives each episode a condition, and a guessed episode may be two. Add --episodes "
                "said, and let clients name their episodes (probe_kit/episode)"
            )
        if self.instruction is not None and not self.instruction.strip():
            raise UsageError("--instruction is empty; give the words, or leave it out")

    @property
    def says_episodes(self) -> bool:
        """Whether only episodes are taken of which the client says where they begin."""
        return self.rule == "said" or self.wire == "vla-eval"

    @property
    def words_key(self) -> str:
        """The key of the words in an observation."""
        return WORDS[self.wire]

    @property
    def name(self) -> str:
        """The name in tables."""
        return self.source_name or "a session"

    def steps(self) -> int:
        """Count the inferences that `--captured-calls all` stands for."""
        return self.most_calls
