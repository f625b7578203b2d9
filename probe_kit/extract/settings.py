"""Settings of a run, by parts: `model`, `source`, `capture`, `task`, `machine`.

Every name of a field is in one part only, so that Python's keyword arguments and options of a command need no
part: `ExtractSettings("pi0-tiny", items=12, batch=8)`. A file has them by part; see `extract --print-config`.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NoReturn, Self

import typer
from pydantic import AfterValidator, BeforeValidator, SerializeAsAny

from probe_kit._system.machine import AUTO, device_here
from probe_kit._terminal import options as common
from probe_kit._terminal.field_options import Part, options_of
from probe_kit.errors import UsageError
from probe_kit.extract.parts import (
    ActMachine,
    ActTask,
    AskCapture,
    AskMachine,
    AskTask,
    Capture,
    ModelSettings,
    is_here,
    read_options,
)
from probe_kit.extract.prompts import INSTRUCTION, find_template
from probe_kit.extract.protocols import has_network, protocol_identity, protocol_row, scene_of
from probe_kit.extract.sources.kinds import SOURCES, kind_of, kinds_typed
from probe_kit.extract.sources.scene import SceneOptions, SceneSettings
from probe_kit.extract.sources.source import SourceSettings
from probe_kit.hashing import sha256_json
from probe_kit.hooks.checkpoints.checkpoint import is_on_hub
from probe_kit.hooks.contract.declared import PLAIN
from probe_kit.runs.layout import MOST_FRAMES

if TYPE_CHECKING:
    from probe_kit.env import SceneSpec
    from probe_kit.suite.items import Wording

_PARTS = ("model", "capture", "task", "machine")
PAPER_PROMPTS = ("p1", "p2", "seen")
DEFAULT_SIZE = (224, 224)
SCENE = SceneSettings.model_fields["kind"].default
CONFIG = "config"
"""The part of a run's stored settings that holds them as they were requested, by part."""


def _read_source(value: Any) -> Any:
    """Return settings of a source from the part of a file, by its kind. Raises UsageError for what is no part."""
    if value is None or isinstance(value, SourceSettings):
        return value
    fields = _fields_of("source", value)
    return kind_of(fields)(**fields)


def _fields_of(part: str, values: Any) -> dict[str, Any]:
    """Return the fields of a part. Raises UsageError for what is no part, such as a text in a file."""
    if not isinstance(values, Mapping | Part):
        raise UsageError(f"{part} is {values!r}; expected its settings by name, as --print-config writes them")
    return dict(values)


def _checked_label(label: str | None) -> str | None:
    """Return the label. Raises UsageError for one that tables cannot show."""
    if label is not None:
        from probe_kit.runs.root import check_label

        check_label(label)
    return label


def _model_of(settings: "type[Settings]", part: str) -> Any:
    """Return the model of a part; the base class, which is never made, has several."""
    return settings.model_fields[part].annotation


class Settings(Part):
    """Settings of a run of any kind; the defaults are the command line's.

    They are a request: what protocol, source and model decide is not in them yet. `states.py` has the types of
    settings in which it is.

    Attributes:
        asks: Whether the model answers questions, and does not act.
        seed: The seed from which the seeds of all rows derive.
        label: The name of the run in tables and legends; None for the model and what sets it apart, see
            `run_label`.
    """

    asks: ClassVar[bool] = False

    model: ModelSettings
    source: Annotated[SerializeAsAny[SourceSettings], BeforeValidator(_read_source)]
    capture: Capture | AskCapture
    task: ActTask | AskTask
    machine: ActMachine | AskMachine
    seed: common.Seed = 0
    label: Annotated[
        str | None,
        AfterValidator(_checked_label),
        typer.Option(
            "--label", help="Name of the run in tables. Default: the model and the options in which it differs."
        ),
    ] = None

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for more frames of an episode than one picture holds."""
        steps = self.source.steps()
        stores_all = self.machine.frames == "all" and "frames=all" not in self.source.refuses
        if stores_all and steps >= MOST_FRAMES:
            raise UsageError(
                f"--frames all keeps at most {MOST_FRAMES} frames, and episodes of {steps} actions have one more "
                f"than actions; use --max-steps {MOST_FRAMES - 1} or --frames ends"
            )

    def __init__(self, model: Any = None, checkpoint: str | None = None, **values: Any) -> None:
        """Take parts, or fields of any part by their names.

        Args:
            model: The name of a family, or the part `model`.
            checkpoint: The field `checkpoint` of the model; None leaves it out.
            **values: Parts, or fields of any part, by name.

        Raises:
            UsageError: For values that cannot be used.
            SceneError: For values that no scene can have.
            TypeError: For a name that is no field.
        """
        fields = {} if checkpoint is None else {"checkpoint": checkpoint}
        super().__init__(**self._by_part(model, fields | values))

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Give `help` and editors every keyword with its default: fields of all parts by their names."""
        models = [*(_model_of(cls, part) for part in _PARTS), SceneSettings, SceneOptions, cls]
        fields = {name: info for model in models for name, info in model.model_fields.items() if name != "kind"}
        defaults = {name: None if info.is_required() else info.default for name, info in fields.items()}
        names = ["model", *(name for name in defaults if name not in ("family", "model"))]
        kind = Parameter.POSITIONAL_OR_KEYWORD
        cls.__signature__ = Signature([Parameter(name, kind, default=defaults.get(name)) for name in names])

    @classmethod
    def _by_part(cls, model: Any, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of `__init__` by part, with a scene for a source that has one."""
        places = {name: part for part in _PARTS for name in _model_of(cls, part).model_fields}
        places |= dict.fromkeys((*SceneSettings.model_fields, *SceneOptions.model_fields), "source")
        places |= dict.fromkeys(cls.model_fields, "")
        by_part: dict[str, dict[str, Any]] = {part: {} for part in ("", "source", *_PARTS)}
        for name, value in (("family", model), *values.items()) if isinstance(model, str) else values.items():
            if name not in places:
                near = get_close_matches(name, places, n=1)
                raise TypeError(
                    f"{cls.__name__} has no setting {name!r}" + (f"; is it {near[0]}?" if near else "")
                )
            by_part[places[name]][name] = value
        parts, scene = by_part.pop(""), by_part.pop("source")
        parts |= {} if model is None or isinstance(model, str) else {"model": model}
        for part, fields in by_part.items():
            parts[part] = _fields_of(part, parts.get(part, {})) | fields
        if "family" not in parts["model"]:
            raise UsageError("no model is named; give --model NAME, which `probe-kit models` lists")
        parts["source"] = _with_scene(parts, scene)
        if (device := parts["machine"].get("device", AUTO)) == AUTO:
            parts["machine"]["device"] = device_here(device) if has_network(parts["model"]["family"]) else "cpu"
        return parts

    @classmethod
    def names(cls) -> set[str]:
        """Return the names of all fields but those of a source."""
        return {*cls.model_fields}.union(*(_model_of(cls, part).model_fields for part in _PARTS))

    def changed(self, **values: Any) -> Self:
        """Return the settings with other fields, by their names; fields of a scene replace those of the scene."""
        return type(self)(**(dict(self) | values))

    @classmethod
    def option_models(cls) -> Iterator[Any]:
        """Yield the models whose fields are the options of a command that makes these settings."""
        yield from (_model_of(cls, part) for part in _PARTS)
        yield from (cls, SceneOptions, *SOURCES)

    @classmethod
    def of_command(
        cls, typed: Mapping[str, Any], file: Mapping[str, Any] | None = None, **further_fields: Any
    ) -> Self:
        """Return the settings of a command.

        Args:
            typed: The values that were typed, by parameter.
            file: Settings by part, which typed ones replace; None for the defaults.
            **further_fields: Fields that no option gives, by name.

        Raises:
            UsageError: For two sources, for options of another source, and as `__init__` raises it.
            SceneError: For values that no scene can have.
        """
        parts = [
            option for part in (*(_model_of(cls, part) for part in _PARTS), cls) for option in options_of(part)
        ]
        values = further_fields | {
            option.field: typed[option.parameter] for option in parts if option.parameter in typed
        }
        source_options = {
            name: value for name, value in typed.items() if name not in {option.parameter for option in parts}
        }
        try:
            before = None if file is None else cls(**{"model": values.get("family"), **file})
        except TypeError as error:  # a name in the file that is no part
            raise UsageError(f"--config: {error}") from error
        kind, fields = cls._typed_source(source_options, None if before is None else before.source)
        if before is not None and values.get("family") in (None, before.model.family):
            values = _merge_fields(before.model, values)
        if kind is SceneSettings:
            values |= fields
        else:
            if refused := [name for name in values if name in kind.decides]:
                _refuse(refused, kind)
            former = None if before is None else before.source
            values["source"] = (
                former.changed(**_merge_fields(former, fields)) if isinstance(former, kind) else kind(**fields)
            )
        return cls(values.pop("family", None), **values) if before is None else before.changed(**values)

    @classmethod
    def _typed_source(
        cls, typed: Mapping[str, Any], before: SourceSettings | None
    ) -> tuple[type[SourceSettings], dict[str, Any]]:
        """Return the kind of source that options name, and the values of its fields."""
        options = {
            kind: {option.parameter: option for option in kind.command_options().values()} for kind in SOURCES
        }
        kinds = kinds_typed(typed)
        if len(kinds) > 1:
            raise UsageError(f"{' and '.join(kinds.values())} are {len(kinds)} sources; give one")
        kind = next(iter(kinds), SceneSettings if before is None else type(before))
        if strange := [name for name in typed if name not in options[kind]]:
            if kind is not SceneSettings:
                _refuse(strange, kind)
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in strange)
            other = next(kind for kind in SOURCES if strange[0] in options[kind])
            raise UsageError(f"{flags} is for {other.subject}; give {other.command} too, or leave it out")
        return kind, {options[kind][name].field: value for name, value in typed.items()}

    @property
    def scene(self) -> "SceneSpec":
        """The scene that is played. Raises UsageError for another source."""
        return self.source.scene_spec

    @property
    def wordings(self) -> "tuple[Wording, ...] | None":
        """The wordings in which every item is asked, None for its own words alone."""
        wordings: tuple[Wording, ...] | None = dict(self.source).get("wordings")
        return wordings

    def config(self) -> dict[str, Any]:
        """Return all settings by part as plain values, of which `--config` makes them again."""
        by_part: dict[str, Any] = json.loads(self.model_dump_json())
        return by_part

    def stored_config(self) -> dict[str, Any]:
        """Return all settings by part as a run stores them, without machine, label and folders of this machine.

        The process that plays records where these files lie.
        """
        config = {name: part for name, part in self.config().items() if name not in ("machine", "label")}
        model = config["model"]
        if is_here(model["checkpoint"]):
            model["checkpoint"] = None
        model["options"] |= {name: path.name for name, path in self.model.files().items()}
        files = {field: path.name for field, path in self.source.files().items()}
        return {**config, "source": self.source.with_files(config["source"], files)}

    def identity(self) -> dict[str, Any]:
        """Return seed, capture and task, and what was requested of the model; neither machine nor label.

        What model and source lead to, weights and rows, is known once they are opened.
        """
        model = {
            "model": self.model.family,
            "random_weights": self.model.random_weights,
            "dtype": self.model.dtype,
        }
        calls = {"captured_calls": self.capture.captured_calls}
        return {**model, "seed": self.seed, **self.capture.model_dump(mode="json"), **calls}

    def changed_fields(self) -> dict[str, Any]:
        """Return the fields of all parts but the source that differ from their defaults, by name."""
        parts = [getattr(self, part) for part in _PARTS]
        values = {
            name: value for part in parts for name, value in part if value != type(part).model_fields[name].default
        }
        return {
            name: value for name, value in values.items() if name != "family" and (name, value) != ("batch", 1)
        }

    def most_inferences(self, execute: int) -> int:
        """Return how many inferences an episode can have with `execute` actions per inference."""
        return -(-self.source.steps() // max(1, execute))

    def followed(self) -> Self:
        """Return the settings with all that a protocol decides; of a question it decides the scene alone."""
        return self

    def follows(self) -> dict[str, Any]:
        """Return the protocol that the task follows, as a run stores it; empty without one."""
        return {}

    def refuse(self, names: Iterable[str], why: str) -> None:
        """Raise UsageError for fields that were chosen and have no effect.

        Args:
            names: Names of fields, or NAME=VALUE where only that value has no effect.
            why: The remainder of the sentence.
        """
        changed, wrong = self.changed_fields(), []
        offered = (option for part in _PARTS for option in options_of(type(getattr(self, part))))
        flags = {option.field: option.flag for option in offered}
        for name, _, value in (text.partition("=") for text in names):
            if name == "options":
                wrong += [f"-M {key}" for key in changed.get(name, {})]
            elif name in changed and (not value or changed[name] == value):
                wrong.append(" ".join(filter(None, (flags.get(name, name), value))))
        if wrong:
            raise UsageError(f"{', '.join(wrong)} {why}")

    def folder_name(self, digest: str) -> str:
        """Return the default name of a run's folder, from the digest of what the run depends on."""
        return f"{self.model.family}-{digest}"

    def marks(self) -> list[str]:
        """Return the parts of a label behind the model and its checkpoint."""
        return []


class ExtractSettings(Settings):
    """All settings of `probe-kit extract`; the model may also be scripted: `expert`, `expert-mirrored`, `idle`.

    The part `source` may be recordings to show, in place of suite and scene, and the model does not act. It may
    also be an environment of the user's own, in which the model acts.
    """

    capture: Capture
    task: ActTask
    machine: ActMachine

    def __init__(self, model: Any = None, checkpoint: str | None = None, **values: Any) -> None:
        super().__init__(model, checkpoint, **values)

    @classmethod
    def _by_part(cls, model: Any, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values by part, with a number or `auto` for a batch that was not typed."""
        parts = super()._by_part(model, values)
        machine = parts["machine"]
        if machine.get("batch") is None:
            on_gpu = str(machine["device"]).startswith("cuda") and machine.get("env_workers") is None
            # A source whose player is measured does not refuse to be.
            calibrates = "batch=auto" not in parts["source"].refuses
            measures = on_gpu and calibrates and has_network(parts["model"]["family"])
            machine["batch"] = "auto" if measures else 1
        return parts

    def identity(self) -> dict[str, Any]:
        """Return the identity of every run, with the task."""
        task = {"execute": None, **self.task.model_dump(mode="json", exclude_none=True, exclude={"protocol"})}
        rotation = {"rotation": self.task.rotation or PLAIN}
        return {**super().identity(), **task, **rotation, **self.follows()}

    def follows(self) -> dict[str, Any]:
        """Return the protocol, and where the run differs from it."""
        return protocol_identity(self.model, self.task, self.source)

    def followed(self) -> Self:
        """Return the settings with all that was not chosen as their protocol sets it for the model.

        Raises:
            UsageError: For a model that the protocol does not use.
        """
        row, model, task = protocol_row(self.model, self.task.protocol), self.model, self.task
        if row is None:
            return self
        return self.changed(
            checkpoint=model.checkpoint or row.checkpoint,
            options={**row.options_for(model.checkpoint), **model.options},
            execute=task.execute if task.execute or task.capture_only else row.execute,
            rotation=task.rotation if task.rotation or task.capture_only else row.rotation,
            dtype=model.dtype or row.dtype,
        )

    def marks(self) -> list[str]:
        """Return a mark where the streams were edited."""
        edits = self.task.edits
        return [f"edited {sha256_json([edit.to_json() for edit in edits])[:6]}"] if edits else []


class AskSettings(Settings):
    """All settings of one run of `probe-kit ask`: one model, one prompt, one size of the picture.

    The size of the picture is that of `scene`. Other sources have no objects and no sides: a model is asked with
    the words of its instruction about the first observation of each row.
    """

    asks = True

    capture: AskCapture
    task: AskTask
    machine: AskMachine

    def model_post_init(self, context: Any) -> None:
        """Raise UsageError for a question about objects or sides if the source has none."""
        super().model_post_init(context)
        source = self.source
        if source.is_scene:
            return
        if not self.task.prompt.is_instruction:
            raise UsageError(
                f"--prompt {self.task.prompt.name} asks for an object of a suite, and {source.subject} have none. "
                "Use --prompt instruction, or a file that contains {instruction}"
            )
        self.refuse(("picture=side-by-side", "query"), f"does not apply with {source.shows}; remove it")

    def __init__(self, model: Any = None, checkpoint: str | None = None, **values: Any) -> None:
        super().__init__(model, checkpoint, **values)

    @classmethod
    def per_prompt_and_size(
        cls,
        prompts: Iterable[str] | None,
        picture_sizes: Sequence[tuple[int, int]] | None,
        typed: Mapping[str, Any],
        file: Mapping[str, Any] | None = None,
    ) -> list[Self]:
        """Return the settings of one run per prompt and picture size, prompts outermost.

        Args:
            prompts: Names or files of templates; None for those of the file, else those of the paper, or for the
                instruction on a source without objects.
            picture_sizes: (width, height) in pixels, of a scene; None for the file's, else 224 x 224.
            typed: The values that were typed, by parameter.
            file: Settings by part, which typed ones replace; None for the defaults.

        Raises:
            UsageError: For two runs of one name, and as `of_command` raises it.
        """
        parameters = {option.parameter for kind in SOURCES for option in options_of(kind)}
        options = {name: value for name, value in typed.items() if name in parameters}
        kind, _ = cls._typed_source(options, None if file is None else _read_source(file.get("source")))
        if kind.command and picture_sizes is not None:
            _refuse(["picture_size"], kind)
        sizes: list[dict[str, Any]] = [{"picture_size": size} for size in picture_sizes or [DEFAULT_SIZE]]
        if kind.command or (file is not None and picture_sizes is None):
            sizes = [{}]
        chosen_prompts = prompts or ([INSTRUCTION.name] if kind.command else PAPER_PROMPTS)
        templates: list[dict[str, Any]] = [{"prompt": find_template(prompt)} for prompt in chosen_prompts]
        if file is not None and prompts is None:
            templates = [{}]
        every = [cls.of_command(typed, file, **template, **size) for template in templates for size in sizes]
        names = [settings.short_name for settings in every]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise UsageError(
                f"{', '.join(twice)} is asked for twice; give every prompt and size once, and files own names"
            )
        return every

    @property
    def short_name(self) -> str:
        """The prompt, the size of the picture and what is unusual, as in a folder's name."""
        task = self.task
        parts = [task.prompt.name, self.source.picture_words, task.picture, task.query]
        return "-".join(part for part in parts if part not in ("", "frame", "target"))

    def folder_name(self, digest: str) -> str:
        """Return the default name of a run's folder, with prompt and size of the picture."""
        return f"ask-{self.model.family}-{self.short_name}-{digest}"

    def identity(self) -> dict[str, Any]:
        """Return the identity of every run, with the task."""
        prompt = self.task.prompt
        ask = {
            "prompt": prompt.name,
            "template": prompt.text,
            "template_sha256": prompt.sha256,
            "object": self.task.query,
            "picture": self.task.picture,
            "picture_size": self.source.picture_words,
            "max_new_tokens": prompt.tokens,
        }
        return {**super().identity(), "ask": ask}

    def marks(self) -> list[str]:
        """Return prompt and size, and what is unusual about picture and object."""
        task, size = self.task, self.source.picture_words.replace("x", "×")
        return [
            task.prompt.name,
            *filter(None, [size if task.picture != "none" else "no picture"]),
            *(["side by side"] if task.picture == "side-by-side" else []),
            *([f"asks for the {task.query}"] if task.query != "target" else []),
        ]


def _merge_fields(former: Part, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return typed fields, in which KEY=VALUE options replace those of equal keys alone."""
    if "options" not in fields:
        return dict(fields)
    return {**fields, "options": {**dict(former)["options"], **read_options(fields["options"])}}


def _refuse(names: Iterable[str], source: type[SourceSettings]) -> NoReturn:
    """Raise UsageError for options that a source does not have."""
    flags = ", ".join(f"--{name.replace('_', '-')}" for name in names)
    raise UsageError(f"{flags} does not apply with {source.shows}; remove it")


def _with_scene(parts: Mapping[str, Any], fields: dict[str, Any]) -> Any:
    """Return the source of settings by part, with `fields` of a scene and its questions, by name.

    Raises:
        UsageError: For such fields with another source.
    """
    former = _fields_of("source", parts.get("source") or {})
    if former.get("kind", SCENE) != SCENE:
        settings = _read_source(parts["source"])
        if refused := [name for name, value in fields.items() if value not in (None, False)]:
            _refuse(refused, type(settings))
        return settings
    changes = {name: fields.pop(name) for name in SceneOptions.model_fields if name in fields and name != "scene"}
    changes = SceneOptions(**changes).changes
    scene = fields.pop("scene", None) or former.get("scene")
    if scene is None or isinstance(scene, str):
        model, task = dict(parts["model"]), dict(parts["task"])
        scene = scene_of(model["family"], task.get("protocol"), scene, **changes)
    elif changes:
        scene = replace(SceneSettings(scene=scene).scene, **changes)
    return SceneSettings(**{**former, **fields, "scene": scene})


def _short(checkpoint: str) -> str:
    """Return the last part of a checkpoint's name; a revision may have slashes of its own."""
    name, at, revision = checkpoint.partition("@")
    on_hub = bool(at) and is_on_hub(checkpoint)
    return f"{Path(name).name}@{revision.replace('/', '-')}" if on_hub else Path(checkpoint).name


def run_label(settings: Settings) -> str:
    """Return the name of the run in tables: checkpoints and options of one family differ in it."""
    if settings.label is not None:
        # A model is asked in several runs of one label.
        return " · ".join([settings.label, *(settings.marks() if settings.asks else [])])
    model, parts = settings.model, [settings.model.family]
    if followed := settings.follows().get("protocol"):
        is_variant = "variant" in followed and "checkpoint" not in followed["deviations"]
        differing = (f"{name}={run}" for name, (_, run) in followed["deviations"].items())
        parts += [followed["name"], *([followed["variant"]] if is_variant else []), *differing]
    else:
        parts += [] if model.checkpoint is None else [_short(model.checkpoint)]
        parts += settings.source.marks()
        parts += [f"{name}={value}" for name, value in sorted(model.options.items())]
    if model.random_weights and model.weights_seed:
        parts.append(f"twin {model.weights_seed}")
    return " · ".join([*parts, *settings.marks()])
