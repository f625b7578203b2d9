"""Settings of an extraction, and the part of them that identifies the run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args

from probe_kit.env import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.extract.own_environments.env_source import EnvSource
from probe_kit.extract.protocols import has_network, protocol_identity, protocol_row, scene_of
from probe_kit.extract.recordings.lerobot_source import LeRobotSource
from probe_kit.extract.vqa.phrases import Picture, Query
from probe_kit.extract.vqa.templates import P1, Template, find_template
from probe_kit.hashing import sha256_json
from probe_kit.hooks.capturing.edits import Edit, Vectors
from probe_kit.hooks.checkpoints.checkpoint import is_on_hub
from probe_kit.hooks.contract.options import read_pairs
from probe_kit.hooks.contract.protocol import PLAIN, ROTATIONS, Rotation
from probe_kit.runs.label import check_label
from probe_kit.runs.layout import (
    MOST_FRAMES,
    AskTokens,
    Codec,
    FrameChoice,
    LaterViews,
    Tokens,
    VideoChoice,
)
from probe_kit.scene_names import SceneName
from probe_kit.suite.ladder import Wording, check_wordings

# Named by what they lead to (a weights hash, a list of episodes), not by themselves.
_ELSEWHERE = {
    "checkpoint",
    "options",
    "label",
    "weights_seed",
    "suite",
    "categories",
    "items",
    "wordings",
    "scene",
    "edits",
    "vectors",
    "capture_only",
    "protocol",
    "rotation",
    "later_views",
    "source",
    "accept_units",
}
_MOST = {
    "captured_calls": 10_000,
    "execute": 10_000,
    "items": 1_000_000,
    "batch": 4096,
    "workers": 1024,
    "env_workers": 1024,
}
LARGEST = 1_000_000
_MACHINE = {
    "allow_mixed",
    "device",
    "video",
    "frames",
    "batch",
    "calibrate",
    "env_workers",
    "workers",
    "ray",
    "inference_limit",
}


_DEFAULT_SCENE = SceneSpec()
"""This very object stands for a scene that was not chosen."""
SCENE_OPTIONS = (
    "max_steps", "tile_side", "light_level", "rendering", "background", "picture_size", "epsilon", "arm",
    "arm_urdf", "start_grasped", "early_stop",
)  # fmt: skip
"""Options of a command that replace the field of that name in the scene."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run of any kind; the defaults are the command line's.

    model: a family of `probe-kit models`.
    checkpoint: folder or hub id; None for the family's default.
    weights_seed: of a untrained network's weights.
    options: what only some families have, such as `unnorm_key`; what they lead to is in the model's card.
    label: what tables and legends call the run; None for the model and what sets it apart, see `run_label`. It is
    no part of the run's identity.
    suite: suite folder; None for the embedded suite.
    categories: slugs; None for all of the suite. items: items per category; None for all.
    scene: by default the model's own, see `Family.home`.
    tokens: `pooled` stores pooled views only, `all` also every token.

    The rest changes no stored number, only how fast it comes:
    batch: observations per call of the model. With 1, bytes repeat exactly; with more, up to float rounding.
    calibrate: choose batch and env_workers by a measurement of some seconds, see `extract.calibration`.
    frames: `ends` keeps small copies of the first and last frame of every episode, `all` of every frame, `none` of
    none.
    env_workers: processes that simulate and draw; None for two per observation of a batch, 0 for this process.
    workers: processes with a model each, one per GPU where there are several; 0 for this process.
    ray: address of a Ray cluster, or `auto`; the workers then run there.
    inference_limit: seconds that one call of the model may take in a worker, which is ended then; its episodes are
    tried once more and given up by name. None for no limit.
    allow_mixed: continue a run whose episodes were made on another kind of device or with other versions; it is
    then marked as mixed wherever it is shown.
    """

    model: str
    checkpoint: str | None = None
    random_weights: bool = False
    weights_seed: int = 0
    options: Mapping[str, Any] = field(default_factory=dict)
    suite: Path | None = None
    categories: tuple[str, ...] | None = None
    items: int | None = None
    scene: SceneSpec = _DEFAULT_SCENE
    seed: int = 0
    tokens: str = "pooled"
    label: str | None = None
    codec: str = "zstd"
    device: str = "cpu"
    dtype: str | None = None
    frames: FrameChoice = "ends"
    batch: int = 1
    calibrate: bool = False
    env_workers: int | None = None
    workers: int = 0
    ray: str | None = None
    inference_limit: float | None = None
    allow_mixed: bool = False

    tokens_allowed: ClassVar[tuple[str, ...]] = get_args(Tokens)

    def __post_init__(self) -> None:
        if self.scene is _DEFAULT_SCENE:
            object.__setattr__(self, "scene", scene_of(self.model, self._protocol))
        self._check_one_of("tokens", self.tokens_allowed)
        self._check_one_of("codec", get_args(Codec))
        self._check_one_of("frames", get_args(FrameChoice))
        if self.frames == "all" and self.scene.max_steps >= MOST_FRAMES:
            raise UsageError(
                f"--frames all keeps at most {MOST_FRAMES} frames, and episodes of {self.scene.max_steps} actions "
                f"have one more than actions; use --max-steps {MOST_FRAMES - 1} or --frames ends"
            )
        for name, bound in {"items": 1, "batch": 1, "workers": 0, "env_workers": 0}.items():
            self._check_at_least(name, bound)
        self._check_limit()
        if self.label is not None:
            check_label(self.label)

    @classmethod
    def from_options(
        cls,
        *,
        model: str,
        options: Sequence[str] | None = None,
        scene: SceneName | None = None,
        batch: int | Literal["auto"] | None = None,
        **given: Any,
    ) -> Self:
        """Settings from the options of a command; an option that is None has the default of protocol or model.

        options: KEY=VALUE of the family. scene: a preset, of which those of `SCENE_OPTIONS` that are neither None
        nor False replace fields. batch: `auto` calibrates; None is `auto` for a policy on a GPU without given
        env_workers, and else 1. given: other fields by name.
        Raises UsageError and SceneError for values that cannot be used, TypeError for a name that is no field.
        """
        if batch is None:
            batch = "auto" if cls._calibrates_by_default(model, given) else 1
        changes = {name: given.pop(name, None) for name in SCENE_OPTIONS}
        changes = {name: value for name, value in changes.items() if value is not None and value is not False}
        return cls(
            model=model,
            options=read_pairs(options or []),
            scene=scene_of(model, given.get("protocol"), scene, **changes),
            batch=1 if batch == "auto" else batch,
            calibrate=batch == "auto",
            **given,
        )

    @classmethod
    def _calibrates_by_default(cls, model: str, given: Mapping[str, Any]) -> bool:
        """Whether a command without --batch measures which one is fast."""
        del model, given
        return False

    def _check_one_of(self, name: str, allowed: Iterable[str]) -> None:
        if getattr(self, name) not in allowed:
            raise UsageError(f"{name} is {getattr(self, name)!r}; expected one of {', '.join(allowed)}")

    def _check_at_least(self, name: str, bound: int) -> None:
        value, most = getattr(self, name), _MOST.get(name, LARGEST)
        if value is not None and not bound <= value <= most:
            raise UsageError(f"{name} is {value}; expected at least {bound} and at most {most}")

    def _check_limit(self) -> None:
        if self.inference_limit is None:
            return
        if not 0 < self.inference_limit <= LARGEST:
            raise UsageError(f"inference_limit is {self.inference_limit}; expected seconds, up to {LARGEST:,}")
        if not (self.workers or self.ray):
            raise UsageError(
                f"--inference-limit {self.inference_limit:g} needs a process that can be ended: add --workers 1, "
                "or leave it out and end a model that hangs with Ctrl-C"
            )

    def choices(self) -> dict[str, Any]:
        """The settings that change the stored numbers by themselves: neither paths nor the machine."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ELSEWHERE | _MACHINE}

    @property
    def _protocol(self) -> str | None:
        """Whose scene takes the place of the default one."""
        return None

    @property
    def stored_calls(self) -> int:
        """Inferences captured per episode, from the first on."""
        return 1

    @property
    def stored_later(self) -> LaterViews:
        """Pooled views that are stored of the inferences after the first."""
        return "all"

    @property
    def asked_wordings(self) -> tuple[Wording, ...] | None:
        """The wordings that every item is asked in, None for its own words alone."""
        return None

    def films(self, number: int) -> bool:
        """Whether episode `number` of the plan is filmed."""
        del number
        return False

    def marks(self) -> list[str]:
        """What a label says behind the model and its checkpoint."""
        return []


@dataclass(frozen=True)
class ExtractSettings(RunSettings):
    """All settings of `probe-kit extract`; model may also be scripted: `expert`, `expert-mirrored`,
    `idle`.

    wordings: names of `suite.ladder`, each a condition of the run; None for the items' own words alone.
    captured_calls: policy inferences captured per episode, from the first on; `all` is as many as an episode can
    have, once the model is known.
    later_views: `mean` stores of the inferences after the first the view `mean` alone, in bfloat16.
    execute: actions executed per inference; None for the policy's own.
    rotation: what reaches the controller as the rotation of an action, see `ProtocolRow`; None for the protocol's,
    or its angles as they are.
    protocol: a published one, such as `act2answer`: what is not given is as it has it, see `protocols`; its scene
    takes the place of the default one.
    capture_only: capture the first inference of every episode and do not act; for checkpoints of other arms.
    edits: what is changed in the streams at every inference; vectors: their directions and sources, by hash.
    video: GIF of the first episode, of all, or none; changes no stored number.
    accept_units: play or show states that lie far outside the checkpoint's statistics; changes no number.
    source: in place of suite and scene, recordings to show, and the model does not act; or an environment of the
    user's own, in which it acts.
    """

    wordings: tuple[Wording, ...] | None = None
    captured_calls: int | Literal["all"] = 1
    later_views: LaterViews = "all"
    execute: int | None = None
    rotation: Rotation | None = None
    capture_only: bool = False
    protocol: str | None = None
    edits: tuple[Edit, ...] = ()
    vectors: Vectors = field(default_factory=dict)
    video: str = "none"
    accept_units: bool = False
    source: LeRobotSource | EnvSource | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_one_of("video", get_args(VideoChoice))
        if self.captured_calls != "all":
            self._check_at_least("captured_calls", 1)
        self._check_later_views()
        self._check_at_least("execute", 1)
        if self.rotation is not None:
            self._check_one_of("rotation", ROTATIONS)
        if self.wordings is not None:
            check_wordings(self.wordings)

    def _check_later_views(self) -> None:
        self._check_one_of("later_views", get_args(LaterViews))
        if self.later_views == "all":
            return
        if self.captured_calls == 1:
            raise UsageError(
                "--later-views mean is about inferences after the first, and the first alone is captured; add "
                "--captured-calls all, or a number"
            )
        if self.tokens == "all":
            raise UsageError("--later-views mean and --tokens all contradict each other; leave one out")

    @classmethod
    def from_options(
        cls, *, model: str, dataset: str | None = None, episodes: str | None = None, select: str | None = None,
        cameras: Sequence[str] | None = None, rotations: Sequence[str] | None = None,
        instruction: str | None = None, no_pixels: bool = False,
        env: str | None = None, env_options: Sequence[str] | None = None, **given: Any,
    ) -> Self:  # fmt: skip
        """As of every run. dataset: of recordings, env: an environment; the options behind them choose of them.

        See `LeRobotSource` and `EnvSource`. Raises UsageError for options of other sources.
        """
        of_recordings = {
            "--select": select, "--camera": cameras, "--rotate": rotations, "--instruction": instruction,
        }  # fmt: skip
        of_either = {"--episodes": episodes, "--no-pixels": no_pixels}
        if dataset is not None and env is not None:
            raise UsageError("--dataset and --env are two sources; give one")
        if dataset is None:
            _check_not_given({**of_recordings, **({} if env else of_either)}, "recordings", "--dataset FOLDER")
        if env is None:
            _check_not_given({"--env-option": env_options}, "environments", "--env MODULE:CLASS")
        if dataset is not None:
            _check_no_scene(given, "--dataset, which has no scene and captures every chosen frame")
            given["source"] = LeRobotSource.from_options(
                dataset, episodes, select or "every:1", cameras or (), rotations or (),
                instruction=instruction, pixels=not no_pixels,
            )  # fmt: skip
        elif env is not None:
            steps = given.pop("max_steps", None)
            _check_no_scene({**given, "captured_calls": 1}, "--env, which has a scene of its own")
            given["source"] = EnvSource.from_options(env, list(env_options or ()), episodes, steps, not no_pixels)
        return super().from_options(model=model, **given)

    @classmethod
    def _calibrates_by_default(cls, model: str, given: Mapping[str, Any]) -> bool:
        """On a GPU, where a batch of one leaves most of it unused; scripts have no network."""
        on_gpu = str(given.get("device", "cpu")).startswith("cuda") and given.get("source") is None
        return on_gpu and given.get("env_workers") is None and has_network(model)

    def choices(self) -> dict[str, Any]:
        """As of every run, with the later fields: capture without acting, another rotation, and edits."""
        capture_only_part = {"capture_only": True} if self.capture_only else {}
        edits = {"edits": [edit.to_json() for edit in self.edits]} if self.edits else {}
        rotation = {} if self.rotation in (None, PLAIN) else {"rotation": self.rotation}
        later = {} if self.later_views == "all" else {"later_views": self.later_views}
        return super().choices() | capture_only_part | rotation | edits | later

    def most_inferences(self, execute: int) -> int:
        """Inferences that an episode can have with `execute` actions per inference."""
        return -(-self.episode_steps // max(1, execute))

    @property
    def episode_steps(self) -> int:
        """Actions that an episode can have."""
        return self.source.max_steps if isinstance(self.source, EnvSource) else self.scene.max_steps

    def with_every_call(self, execute: int) -> Self:
        """The settings with a number in place of `captured_calls` `all`."""
        return (
            self if self.captured_calls != "all" else replace(self, captured_calls=self.most_inferences(execute))
        )

    def followed(self) -> Self:
        """The settings with all that was not given as their protocol has it for the model; scripts get its scene.

        Raises UsageError for a model that the protocol does not use.
        """
        row = protocol_row(self.model, self.protocol, self.checkpoint)
        if row is None:
            return self
        return replace(
            self,
            checkpoint=self.checkpoint or row.checkpoint,
            options={**row.options_for(self.checkpoint), **self.options},
            execute=self.execute if self.execute or self.capture_only else row.execute,
            rotation=self.rotation if self.rotation or self.capture_only else row.rotation,
            dtype=self.dtype or row.dtype,
        )

    @property
    def _protocol(self) -> str | None:
        return self.protocol

    @property
    def stored_calls(self) -> int:
        """As many as were asked for. Raises UsageError for `all`, of which the number is not known yet."""
        if self.captured_calls == "all":
            raise UsageError("captured_calls is 'all', which has no number before the model is loaded")
        return self.captured_calls

    @property
    def stored_later(self) -> LaterViews:
        """Those that were asked for."""
        return self.later_views

    @property
    def asked_wordings(self) -> tuple[Wording, ...] | None:
        """Those that were asked for."""
        return self.wordings

    def films(self, number: int) -> bool:
        """All episodes, the first one, or none."""
        return self.video == "all" or (self.video == "first" and number == 0)

    def marks(self) -> list[str]:
        """Whether the streams were edited."""
        return [f"edited {sha256_json([edit.to_json() for edit in self.edits])[:6]}"] if self.edits else []


@dataclass(frozen=True)
class AskSettings(RunSettings):
    """All settings of one run of `probe-kit ask`: one model, one prompt, one size of the picture.

    The size of the picture is that of `scene`. tokens may also be `none`, which stores no activations.
    picture: `frame` shows the first frame of the episode, `side-by-side` its two pictures on grey, `none` nothing.
    query: the object asked for, see `QUERIES`. protocol: a published one, whose scene takes the place of the
    default one; it decides nothing else of a question.
    Raises UsageError for an absent object with a prompt that takes no no.
    """

    tokens: str = "none"
    prompt: Template = P1
    picture: str = "frame"
    query: Query = "target"
    protocol: str | None = None

    tokens_allowed: ClassVar[tuple[str, ...]] = get_args(AskTokens)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.calibrate:
            raise UsageError(
                "batch and processes are chosen for runs that act; ask with a number, such as batch=8"
            )
        self._check_one_of("picture", get_args(Picture))
        self._check_one_of("query", get_args(Query))
        if self.query == "absent" and not self.prompt.yes_or_no:
            raise UsageError(
                f"--query absent needs a prompt that can be answered no; {self.prompt.name} does not ask "
                "for yes or no. Use --prompt seen"
            )

    @classmethod
    def per_prompt_and_size(
        cls, prompts: Sequence[str], picture_sizes: Sequence[tuple[int, int]], **options: Any
    ) -> list[Self]:
        """Settings of one run per prompt and picture size, prompts outermost.

        prompts: names or files of templates. picture_sizes: (width, height) in pixels. options: the rest, as in
        `from_options`. Raises UsageError for two runs of one name, and what `from_options` raises.
        """
        templates = [find_template(prompt) for prompt in prompts]
        every = [
            cls.from_options(prompt=template, picture_size=size, **options)
            for template in templates
            for size in picture_sizes
        ]
        names = [settings.short_name for settings in every]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise UsageError(
                f"{', '.join(twice)} is asked for twice; give every prompt and size once, and files own names"
            )
        return every

    @property
    def _protocol(self) -> str | None:
        return self.protocol

    @property
    def short_name(self) -> str:
        """Prompt, size of the picture and what is unusual, as a folder is called."""
        height, width = self.scene.picture_shape
        parts = [self.prompt.name, f"{width}x{height}", self.picture, self.query]
        return "-".join(part for part in parts if part not in ("frame", "target"))

    def choices(self) -> dict[str, Any]:
        """As of every run, and what was asked how."""
        plain = super().choices()
        prompt = plain.pop("prompt")
        height, width = self.scene.picture_shape
        ask = {
            "prompt": prompt.name,
            "template": prompt.text,
            "template_sha256": prompt.sha256,
            "object": plain.pop("query"),
            "picture": plain.pop("picture"),
            "picture_size": f"{width}x{height}",
            "max_new_tokens": prompt.tokens,
        }
        return {**plain, "captured_calls": self.stored_calls, "ask": ask}

    def marks(self) -> list[str]:
        """Prompt and size, and what is unusual about picture and object."""
        height, width = self.scene.picture_shape
        return [
            self.prompt.name,
            f"{width}×{height}" if self.picture != "none" else "no picture",
            *(["side by side"] if self.picture == "side-by-side" else []),
            *([f"asks for the {self.query}"] if self.query != "target" else []),
        ]


def _check_not_given(options: Mapping[str, Any], subject: str, wanted: str) -> None:
    """Raise UsageError for options of a source that was not given."""
    if wrong := [option for option, value in options.items() if value]:
        raise UsageError(f"{', '.join(wrong)} is for {subject}; give {wanted} too, or leave it out")


def _check_no_scene(given: Mapping[str, Any], source: str) -> None:
    """Raise UsageError for options of scenes."""
    changed = [name for name in ("scene", *SCENE_OPTIONS) if given.get(name) not in (None, False)]
    changed += ["captured_calls"] * (given.get("captured_calls", 1) != 1)
    if changed:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
        raise UsageError(f"{options} does not apply with {source}; remove it")


def _short(checkpoint: str) -> str:
    """The last part of a checkpoint's name; a revision may have slashes of its own."""
    name, at, revision = checkpoint.partition("@")
    on_hub = bool(at) and is_on_hub(checkpoint)
    return f"{Path(name).name}@{revision.replace('/', '-')}" if on_hub else Path(checkpoint).name


def run_label(settings: RunSettings) -> str:
    """What tables call the run: checkpoints and options of one family differ in it."""
    asks = isinstance(settings, AskSettings)  # whose runs come in several, all of one label
    if settings.label is not None:
        return " · ".join([settings.label, *(settings.marks() if asks else [])])
    parts = [settings.model]
    source = settings.source if isinstance(settings, ExtractSettings) else None
    if isinstance(settings, ExtractSettings) and settings.protocol is not None:
        said = protocol_identity(settings)["protocol"]
        variant = [said["variant"]] if "variant" in said and "checkpoint" not in said["deviations"] else []
        differing = (f"{name}={run}" for name, (_, run) in said["deviations"].items())
        parts += [settings.protocol, *variant, *differing]
    else:
        parts += [] if settings.checkpoint is None else [_short(settings.checkpoint)]
        parts += [] if source is None else [f"{'in' if isinstance(source, EnvSource) else 'on'} {source.name}"]
        parts += [f"{name}={value}" for name, value in sorted(settings.options.items())]
    if settings.random_weights and settings.weights_seed:
        parts.append(f"twin {settings.weights_seed}")
    return " · ".join([*parts, *settings.marks()])
