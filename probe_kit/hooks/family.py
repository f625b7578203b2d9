"""A model family: its name, loader, verification, options and requirements. Imports no torch."""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, get_args

from probe_kit._system.imports import install_command
from probe_kit._system.machine import AUTO, check_device_name, device_here, what_is_here
from probe_kit.errors import (
    CheckpointError,
    InstructionError,
    MissingExtraError,
    UnsupportedInterventionError,
    UsageError,
)
from probe_kit.hooks.checkpoints.checkpoint import (
    CONFIG_FILE,
    hub_name,
    is_on_hub,
    missing_weights,
    pin_revision,
    recorded_commits,
    without_revision,
)
from probe_kit.hooks.checkpoints.folders import check_files, checkpoint_folder, with_adapters_named
from probe_kit.hooks.checkpoints.third_party import import_loader, import_object, while_loading
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.declared import (
    RELEASED,
    DeclaredStream,
    DefaultScene,
    InterventionKind,
    Option,
    ProtocolRow,
    check_options,
)
from probe_kit.hooks.family_parts import Abilities, Checkpoints, Requirements
from probe_kit.hooks.outline import Outline, bytes_to_fetch, configuration_folder, is_complete, outline_of
from probe_kit.models.bounds import MOST_STEPS

if TYPE_CHECKING:
    from probe_kit.hooks.contract.model import Model

Dtype = Literal["float32", "bfloat16"]
DTYPES: tuple[Dtype, ...] = get_args(Dtype)
SIZE = "size"
"""The option that chooses one of a family's `sizes`."""


@dataclass(frozen=True)
class Family:
    """A model family by name.

    Functions are named as `module:function` and are imported only when used.

    Attributes:
        default_checkpoint: Hub id, or None for the embedded one.
        loader: `loader(checkpoint, device, dtype, random_weights)` gives a Model, and takes `weights_seed` if its
            untrained networks can differ.
        streams: Layers and iterations in words, of a family that declares none.
        options: Further keyword arguments that the loader takes.
        protocols: Published protocols that use the family, by name, with what they use it with.
        home: The scene it acts in, or is asked about, when none is named.
        checkpoints: Its checkpoints and what is released.
        abilities: What its models do, and the functions that say so of a checkpoint.
        requirements: What has to be there before it can be loaded.

    Raises:
        UsageError: If an option is not declared as an `Option`.
    """

    name: str
    description: str
    default_checkpoint: str | None
    loader: str
    streams: str = ""
    embodiment: str = "7-DoF end-effector delta"
    notes: str = ""
    options: tuple[Option, ...] = ()
    protocols: Mapping[str, ProtocolRow] = MappingProxyType({})
    home: DefaultScene = RELEASED
    checkpoints: Checkpoints = field(default_factory=Checkpoints)
    abilities: Abilities = field(default_factory=Abilities)
    requirements: Requirements = field(default_factory=Requirements)

    def __post_init__(self) -> None:
        for option in self.options:
            if not isinstance(option, Option):
                raise UsageError(
                    f"the family {self.name} declares its option as {option!r}; an option has a type and "
                    f"help: Option({str(option)!r}, str, 'what it does') from probe_kit.hooks"
                )
        if self.checkpoints.sizes:
            names = tuple(name for name, _ in self.checkpoints.sizes)
            help_text = f"A released size ({', '.join(names)}) instead of --checkpoint."
            size = Option(SIZE, str, help_text, names[0], names)
            object.__setattr__(self, "options", (*self.options, size))

    def check_words(self, texts: Iterable[str], checkpoint: str | None = None) -> None:
        """Raise InstructionError for a text with a word that the default checkpoint does not know."""
        if not self.abilities.vocabulary or checkpoint is not None:
            return
        vocabulary = import_module(self.abilities.vocabulary)
        readable = set(vocabulary.known_words())
        unknown = {text: [word for word in vocabulary.words_in(text) if word not in readable] for text in texts}
        bad = {text: words for text, words in unknown.items() if words}
        if bad:
            text, words = next(iter(bad.items()))
            more = f", and {len(bad) - 1} further texts have such words" if len(bad) > 1 else ""
            raise InstructionError(
                f"{self.name} does not know {', '.join(map(repr, words))} in {text!r}{more}. `probe-kit models "
                "--words` lists the words it knows; other models read any text"
            )

    def known_words(self) -> list[str]:
        """Return the words that an instruction may hold, sorted; empty for a family that reads any text."""
        words = import_module(self.abilities.vocabulary).known_words() if self.abilities.vocabulary else ()
        return sorted(word for word in words if word.strip())

    def load(
        self,
        checkpoint: str | None,
        device: str = AUTO,
        dtype: str | None = None,
        random_weights: bool = False,
        options: Mapping[str, Any] = MappingProxyType({}),
        weights_seed: int = 0,
    ) -> "Model":
        """Load a model.

        Switches off torch's fused encoder in this process, because hooks would change its rounding.

        Args:
            checkpoint: Folder or hub id; None loads the default one.
            device: Device in torch's spelling, such as `cuda:0`. `auto` takes a GPU where torch finds one.
            dtype: One of `DTYPES`; None leaves the choice to the loader.
            random_weights: Whether the network stays untrained.
            options: By name, as text or values.
            weights_seed: Seed of an untrained network's weights.

        Raises:
            UsageError: For an option it lacks, and for a device, dtype or seed that cannot be used.
            CheckpointError: For a checkpoint that is not there or cannot be loaded.
        """
        device = device_here(device)
        loader_options = self.check(checkpoint, device, dtype, random_weights, options, weights_seed)
        location = self.location(checkpoint, loader_options.pop(SIZE, None))
        _check_device(device)
        from probe_kit.hooks.capturing.capture_context import switch_off_fused_encoder

        switch_off_fused_encoder()
        load = import_loader(self.name, self.loader)
        if weights_seed:
            if "weights_seed" not in inspect.signature(load).parameters:
                raise UsageError(f"{self.name} has one untrained network only: its loader takes no weights_seed")
            loader_options["weights_seed"] = weights_seed
        with while_loading(self.name, str(location or "what it brings")), recorded_commits() as commits:
            model: Model = load(location, device, dtype, random_weights, **loader_options)
            _check_streams(model, str(location))
            with suppress(Exception):  # a file that is missing is named when it is needed
                model.read_late_files()
        # Options that the adapter does not record itself are part of the identity too.
        option_texts = {name: str(value) for name, value in loader_options.items() if name != "weights_seed"}
        merged = model.card.audit.get("adapter")
        model.card = replace(
            model.card,
            checkpoint=pin_revision(model.card.checkpoint),
            settings={**option_texts, **model.card.settings},
            notes=_notes((*model.card.notes, *([merged] if merged else []), *_note_on_states(model))),
            repositories=_other_commits(commits, location),
            **self._source_of(model.card, location),
        )
        return model

    def _source_of(self, card: ModelCard, location: str | None) -> dict[str, Any]:
        """The source fields of the card: an untrained network has none, a foreign checkpoint an unknown one."""
        if card.random_weights:
            return {"source": None, "source_weights": None}
        is_own_checkpoint = without_revision(location) in (
            self.default_checkpoint,
            *(row.checkpoint for first in self.protocols.values() for row in first.rows),
        )
        return {
            "source": self.checkpoints.source,
            "source_weights": self.checkpoints.source_weights if is_own_checkpoint else None,
        }

    def check(
        self,
        checkpoint: str | None = None,
        device: str = AUTO,
        dtype: str | None = None,
        random_weights: bool = False,
        options: Mapping[str, Any] = MappingProxyType({}),
        weights_seed: int = 0,
        fetch: bool = True,
    ) -> dict[str, Any]:
        """Check everything about `load` that can be wrong without weights, in a second instead of a minute.

        Args:
            checkpoint: As for `load`.
            device: As for `load`; its presence is checked with `fetch` only.
            dtype: As for `load`.
            random_weights: As for `load`; then no weights are looked for.
            options: As for `load`.
            weights_seed: As for `load`; it belongs to random weights.
            fetch: Download a checkpoint that is on the hub, and look for its weights. Without it, only files that
                are here are looked at, and no weights.

        Returns:
            The options as the loader gets them.

        Raises:
            UsageError: As loading would, for an argument that cannot be used.
            MissingExtraError: As loading would, for a package that is not installed.
            CheckpointError: As loading would, for a checkpoint that is not there or not of this family.
            WeightsError: As loading would, for missing weights and for two sets of them.
        """
        loader_options = check_options(self.name, self.options, options)
        if weights_seed and not random_weights:
            raise UsageError(
                "weights_seed belongs to an untrained network; ask for random weights too, or leave it out"
            )
        if dtype not in (None, *DTYPES):
            raise UsageError(f"dtype is {dtype!r}; expected one of {', '.join(DTYPES)}")
        check_device_name(device, present=fetch)
        for module, extra in self._missing_packages():
            raise MissingExtraError(
                f"{self.name} needs {module}, which is not installed; `{install_command(extra)}`"
            )
        location = self.location(checkpoint, loader_options.get(SIZE))
        if location is None and self.requirements.needs_checkpoint:
            raise UsageError(f"{self.name} has no default checkpoint; pass a folder or hub id as --checkpoint")
        if (
            self.checkpoints.declared
            and location is not None
            and not is_on_hub(location)
            and not Path(location).exists()
        ):
            checkpoint_folder(location)  # says that it is not there, or finds the user's home
        if location is not None and self.checkpoints.config_types and (fetch or not is_on_hub(location)):
            with while_loading(self.name, location):
                weights = fetch and not random_weights
                check_files(
                    checkpoint_folder(location, self.checkpoints.files),
                    self.checkpoints.config_types,
                    weights,
                    self.checkpoints.instead,
                )
        return self._with_defaults(loader_options, location)

    def _with_defaults(self, loader_options: Mapping[str, Any], location: str | None) -> dict[str, Any]:
        """The options with those that belong to the default checkpoint, where it is the one."""
        is_default = location is not None and without_revision(location) == self.default_checkpoint
        return {**(self.checkpoints.of_default if is_default else {}), **loader_options}

    def declared_streams(self, options: Mapping[str, Any]) -> tuple[DeclaredStream, ...] | None:
        """Return the streams of the size that `options` choose; None for a family that declares none."""
        size = check_options(self.name, self.options, options).get(SIZE)
        return self.checkpoints.declared.get(size or next(iter(self.checkpoints.declared), ""))

    def streams_text(self) -> str:
        """The streams of the default size in words, with its name where there are several."""
        size, declared = next(iter(self.checkpoints.declared.items()), ("", ()))
        text = ", ".join(map(str, declared)) or self.streams
        return f"{text} ({size})" if size else text

    def streams_json(self) -> dict[str, dict[str, int]]:
        """Return the shapes of the streams of the default size by name; empty for a family that declares none."""
        declared = next(iter(self.checkpoints.declared.values()), ())
        return {part.stream.name: {**part.stream.shape_json(), "tokens": part.tokens} for part in declared}

    def weights_bytes(
        self, options: Mapping[str, Any], dtype: Dtype = "float32", parameters: int | None = None
    ) -> int | None:
        """Return the bytes of the weights of the released size that `options` choose.

        Args:
            options: The options of the family, by name.
            dtype: The dtype of the weights.
            parameters: Another count of parameters; None takes that of the released size.

        Returns:
            None where the count is not declared.
        """
        size = check_options(self.name, self.options, options).get(SIZE)
        count = parameters or self.checkpoints.parameters.get(size or next(iter(self.checkpoints.parameters), ""))
        return None if count is None else count * {"float32": 4, "bfloat16": 2}[dtype]

    def memory_bytes(self, options: Mapping[str, Any], dtype: Dtype, parameters: int | None = None) -> int | None:
        """Return the bytes that `weights_bytes` gives for the weights in memory when `dtype` is chosen."""
        return self.weights_bytes(options, "float32" if self.requirements.always_float32 else dtype, parameters)

    def outline(
        self, checkpoint: str | None, options: Mapping[str, Any] = MappingProxyType({}), dtype: str | None = None
    ) -> Outline | None:
        """The model without numbers, of the configuration in a folder or in the hub's cache; None where none is.

        None also for a family that declares no streams, whose models are loaded. Asks no network. Raises what
        loading raises for a checkpoint in a folder.
        """
        if not self.checkpoints.declared:
            return None
        location, loader_options = self._locate(checkpoint, options)
        if (folder := configuration_folder(location)) is None:
            return None  # before the loader is imported, and torch with it
        load = import_loader(self.name, self.loader)
        with while_loading(self.name, str(location)):
            values = self._with_defaults(loader_options, location)
            return outline_of(self.name, load, str(location), folder, dtype, values)

    def is_here(self, checkpoint: str | None, options: Mapping[str, Any]) -> bool:
        """Whether a checkpoint with its weights is in a folder or in the hub's cache; asks no network."""
        location = self.location(checkpoint, options.get(SIZE))
        return location is None or is_complete(location)

    def bytes_to_fetch(self, checkpoint: str | None, options: Mapping[str, Any]) -> int | None:
        """Return the bytes of weights that have to be downloaded, as an index in the cache has them.

        None where there is no index, and for an embedded checkpoint.
        """
        location = self.location(checkpoint, options.get(SIZE))
        return None if location is None else bytes_to_fetch(location)

    def check_acting(self, checkpoint: str | None, options: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Raise UsageError for a checkpoint of the hub whose actions no arm here can execute, before a download.

        Its own configuration decides where it is here, else the family's list of released checkpoints. One whose
        weights are here is left to its loading.
        """
        location = self.location(checkpoint, options.get(SIZE))
        if location is None or is_complete(location):
            return
        outline = self.outline(checkpoint, options)
        reason = None if outline is None else outline.misfit()
        if (outline is None or outline.model is None) and (
            bare := without_revision(location)
        ) in self.checkpoints.not_acting:
            reason = f"{bare} puts out numbers that no arm here can execute"
        if reason is not None:
            raise UsageError(f"{reason}. Plan and capture it with --no-act, or pass a fine-tune as --checkpoint")

    def check_instructions(
        self, checkpoint: str | None, instructions: Sequence[str], options: Mapping[str, Any], fetch: bool = True
    ) -> None:
        """Raise InstructionError for an instruction that the model cannot read, before its network is loaded.

        Args:
            checkpoint: Folder or hub id; None for the default one.
            instructions: The texts to read.
            options: The options of the family, by name.
            fetch: Download small files that are not here; without it, nothing is checked then.
        """
        location, loader_options = self._locate(checkpoint, options)
        if self.abilities.words is None or (not fetch and location is not None and is_on_hub(location)):
            return
        check = import_loader(self.name, self.abilities.words)
        with while_loading(self.name, str(location or "what it brings")):
            check(location, instructions, **loader_options)

    def whose_units(
        self, checkpoint: str | None, options: Mapping[str, Any] = MappingProxyType({}), fetch: bool = True
    ) -> str:
        """Return the data set or robot whose units the actions get, and what says so; "" where there is one way.

        Args:
            checkpoint: Folder or hub id; None for the default one.
            options: The options of the family, by name.
            fetch: Download small files that are not here; without it, the answer is "" for a checkpoint on the
                hub.

        Raises:
            UsageError: Where several are there and none was chosen.
        """
        location, loader_options = self._locate(checkpoint, options)
        if self.abilities.units is None or location is None or (not fetch and is_on_hub(location)):
            return ""
        describe_units = import_loader(self.name, self.abilities.units)
        with while_loading(self.name, location):
            return with_adapters_named(
                str(describe_units(location, **self._with_defaults(loader_options, location)))
            )

    def check_intervention(self, kind: InterventionKind) -> None:
        """Refuse, before anything is loaded, what the family does not support.

        Raises:
            UnsupportedInterventionError: For a kind that the family does not support, and for a family that does
                not act.
        """
        if not self.abilities.acts:
            raise UnsupportedInterventionError(
                f"{self.name} does not support interventions ({kind}): it answers and does not act, and "
                "interventions compare actions. Take a family that acts (`probe-kit models` lists which do)"
            )
        self.abilities.interventions.check(kind, self.name)

    def interventions_json(self) -> dict[str, Any] | None:
        """The supported interventions as plain values; None for a family that does not act.

        The key `asked_as` has the same in the words of `probe-kit intervene`, values by option.
        """
        interventions = self.abilities.interventions
        return {**interventions.to_json(), "asked_as": interventions.asked_as()} if self.abilities.acts else None

    def location(self, checkpoint: str | None, size: str | None = None) -> str | None:
        """Return the checkpoint to load: `checkpoint`, that of a `size`, or the default.

        Raises:
            UsageError: If both a checkpoint and a size are given.
        """
        if size is None:
            return checkpoint or self.default_checkpoint
        if checkpoint is not None:
            raise UsageError(
                f"a checkpoint ({checkpoint}) and -M size={size} were given; a size stands for a checkpoint, so "
                "leave one of them out"
            )
        return dict(self.checkpoints.sizes)[size]

    def folder_here(self, checkpoint: str | None, options: Mapping[str, Any]) -> Path:
        """The folder that a local checkpoint has, or an embedded one; of a hub id it need not exist."""
        location = self.location(checkpoint, options.get(SIZE))
        if location is not None:
            return Path(location).expanduser()
        from probe_kit.models.embedded import embedded_checkpoint

        return embedded_checkpoint(self.name)

    def check_purpose(self, purpose: Literal["outputs", "full_size"]) -> None:
        """Raise UsageError if the family has no function for `purpose`; nothing is imported."""
        if self._function(purpose) is None:
            raise UsageError(f"{self.name} has no {purpose.replace('_', '-')}; it cannot be verified this way")

    def function(self, purpose: Literal["outputs", "full_size"]) -> Callable[..., Any]:
        """The family's function for `purpose`.

        Raises:
            UsageError: If it has none.
        """
        self.check_purpose(purpose)
        return import_loader(self.name, str(self._function(purpose)))

    def _function(self, purpose: Literal["outputs", "full_size"]) -> str | None:
        return self.abilities.outputs if purpose == "outputs" else self.checkpoints.full_size

    def _locate(self, checkpoint: str | None, options: Mapping[str, Any]) -> tuple[str | None, dict[str, Any]]:
        """The checkpoint, and the options as the loader gets them."""
        loader_options = check_options(self.name, self.options, options)
        return self.location(checkpoint, loader_options.pop(SIZE, None)), loader_options

    def renames(self) -> tuple[tuple[str, str], ...]:
        """Return pairs that turn names of tensors in released files into the network's; empty if they agree."""
        return () if self.checkpoints.stored_names is None else tuple(import_object(self.checkpoints.stored_names))

    def missing(self) -> str:
        """Return requirements that this machine lacks, the default checkpoint included; empty if it is ready."""
        lacking = [f"extra {extra}" for extra in dict.fromkeys(extra for _, extra in self._missing_packages())]
        if self.requirements.needs_checkpoint:
            lacking.append("a checkpoint of yours (--checkpoint)")
        default, files = self.default_checkpoint, self.checkpoints.hub
        if default is not None and default not in dict(files):
            files = ((default, CONFIG_FILE), *files)
        absent = [name for name, file in files if self._is_absent(name, file)]
        if absent:
            lacking.append(f"download of {', '.join(absent)}")
        return " and ".join(lacking)

    def _is_absent(self, repository: str, file: str) -> bool:
        """Whether the hub's cache lacks a file, or the weights beside the default checkpoint's config."""
        from huggingface_hub import try_to_load_from_cache

        name, inside, _ = hub_name(repository) or (repository, "", "")
        cached = try_to_load_from_cache(name, f"{inside}/{file}" if inside else file)
        needs_weights = repository == self.default_checkpoint and bool(self.checkpoints.config_types)
        return not isinstance(cached, str) or (needs_weights and bool(missing_weights(Path(cached).parent)))

    def _missing_packages(self) -> list[tuple[str, str]]:
        return [(module, extra) for module, extra in self.requirements.packages if find_spec(module) is None]


def _note_on_states(model: "Model") -> tuple[str, ...]:
    """A note on states that are read and compared with no statistics; empty where there are none."""
    from probe_kit.hooks.contract.model import Policy

    if not isinstance(model, Policy) or model.state_numbers is None or (why := model.unguarded_state) is None:
        return ()
    return (f"units of states are not compared with statistics: {why}",)


def _notes(notes: Iterable[str]) -> tuple[str, ...]:
    """Return every note once, with the names that adapters' folders have."""
    return tuple(dict.fromkeys(map(with_adapters_named, notes)))


def _other_commits(commits: Mapping[str, str], location: str | None) -> dict[str, str]:
    """The commits of repositories besides that of the checkpoint at `location`, which names its own."""
    checkpoint_name = None if location is None else hub_name(location)
    return {
        name: commit
        for name, commit in sorted(commits.items())
        if checkpoint_name is None or name != checkpoint_name.repository
    }


def _check_streams(model: "Model", location: str) -> None:
    """Raise CheckpointError for a model that would loop without end: its counts come from files and options."""
    for name, stream in model.streams.items():
        if (most := max(stream.layers, stream.iterations or 0)) > MOST_STEPS:
            raise CheckpointError(
                f"{location}: the stream {name} has {most} layers or iterations; expected at most {MOST_STEPS}. "
                "Take the original file, or fewer steps"
            )


def _check_device(device: str) -> None:
    """Raise UsageError for a device that this machine does not have."""
    import torch

    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # what torch raises: unknown, absent
        reason = str(error).partition("\n")[0]
        raise UsageError(f"device {device!r} cannot be used: {reason}. {what_is_here()}") from error
