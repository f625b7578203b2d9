"""The parts of a model family's declaration: its checkpoints, abilities and requirements. Imports no torch.

Functions are named as `module:function` and are imported only when used.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from probe_kit.hooks.checkpoints.checkpoint import PATTERNS
from probe_kit.hooks.contract.card import SourceWeights
from probe_kit.hooks.contract.declared import ALL_EDITS, DeclaredStream, Interventions


@dataclass(frozen=True, kw_only=True)
class Checkpoints:
    """The checkpoints of a family, and what is released.

    Attributes:
        config_types: The values that `type` or `model_type` in the config.json of its checkpoints may have. It is
            empty if they have none, and then only the loader recognises one.
        instead: For other such types that people may take for one of them, what to do.
        files: Patterns of the files of a hub repository that are needed.
        hub: The repositories that the default checkpoint is loaded from, hub ids with a file each whose presence
            tells; default its config.json.
        sizes: Hub ids of the released sizes by name, the default one first; `size` is then an option, instead of a
            checkpoint.
        declared: Streams of the released sizes, by name of the size, which is empty where there is one. A plan is
            made of them where no weights are read.
        parameters: Count of the released sizes, by name.
        full_size: `full_size()` gives the network of the released size on the meta device; it takes the name of
            one where there are `sizes`.
        of_default: Options that belong to the default checkpoint, and to no other; they count where they are not
            given.
        not_acting: Released checkpoints whose actions no arm here can execute, for plans without their
            configuration.
        source: Name of the VLM whose network this policy grew from, if it is one of ours.
        source_weights: The weights from which the default checkpoint, and those of protocols, grew.
        stored_names: `module:constant`, how names of tensors in released files become those of the network, see
            `probe_kit.models.checkpoint_files`.
        unstored: Tensors of a checkpoint that the network does not have, by name or prefix ending in a dot;
            `verify --keys` prints them.
    """

    config_types: tuple[str, ...] = ()
    instead: tuple[tuple[str, str], ...] = ()
    files: tuple[str, ...] = PATTERNS
    hub: tuple[tuple[str, str], ...] = ()
    sizes: tuple[tuple[str, str], ...] = ()
    declared: Mapping[str, tuple[DeclaredStream, ...]] = MappingProxyType({})
    parameters: Mapping[str, int] = MappingProxyType({})
    full_size: str | None = None
    of_default: Mapping[str, Any] = MappingProxyType({})
    not_acting: tuple[str, ...] = ()
    source: str | None = None
    source_weights: SourceWeights | None = None
    stored_names: str | None = None
    unstored: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Abilities:
    """The abilities of a family's models.

    Attributes:
        acts: Whether it is a Policy.
        reads: Whether it is an AnswerModel.
        interventions: The interventions that its policy supports.
        words: `module:function(checkpoint, instructions, **options)` that raises InstructionError for what cannot
            be read, from the checkpoint's small files alone; see `Family.check_instructions`.
        units: `module:function(checkpoint, **options)` that says whose units the actions get, and where they
            stand, from the small files. It raises UsageError where that has to be chosen.
        vocabulary: Module with `known_words` and `words_in`, of a family whose default checkpoint knows few words;
            empty for one that reads any text.
        no_words: The reason why feed-forward units of its backbone cannot be read as tokens, which is said before
            anything is loaded; empty where they can be, and where only a loaded model tells.
        outputs: `outputs(loader, folder, recorded arrays)` gives the `Outputs` that a golden reference is compared
            with; None for a family that compares nothing.
    """

    acts: bool = True
    reads: bool = False
    interventions: Interventions = ALL_EDITS
    words: str | None = None
    units: str | None = None
    vocabulary: str = ""
    no_words: str = ""
    outputs: str | None = None


@dataclass(frozen=True, kw_only=True)
class Requirements:
    """The requirements for a model of a family to be loaded.

    Attributes:
        packages: Modules of an extra that it needs, with the name of that extra.
        needs_checkpoint: Whether nothing is there by default, so that a checkpoint has to be named.
        always_float32: Whether weights stay in float32 whatever dtype is chosen.
    """

    packages: tuple[tuple[str, str], ...] = ()
    needs_checkpoint: bool = False
    always_float32: bool = False
