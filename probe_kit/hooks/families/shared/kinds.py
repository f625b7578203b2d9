"""Declarations that all families of one kind share, for plans too. Imports no torch and no lerobot."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

from probe_kit.hooks.contract.declared import Interventions, Option
from probe_kit.hooks.contract.observation import OPENNESS
from probe_kit.hooks.contract.sites import QUANTITIES
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Abilities, Checkpoints

FLOW = Interventions(
    edits={"backbone": QUANTITIES, "expert": QUANTITIES},
    unread=("backbone",),
    prompt_kv=True,
    attention=True,
    tiles=True,
    gradients=True,
)
"""The interventions of an action expert that reads the backbone's keys and values, and nothing else of it.

It reads them at every flow-matching step.
"""

TOKENS = Interventions(
    edits={"backbone": QUANTITIES, "action": QUANTITIES},
    unread=("backbone",),
    prompt_kv=True,
    attention=True,
    first_affected_token=1,
    tiles=True,
    readout="per-step",
)
"""The interventions of one decoder that reads the prompt and puts out tokens.

The prompt's own pass chooses the first of them.
"""

MERGED = "it merges patches on their way to the backbone, and does not report which token they become. "
"""The reason why a family does not say what tile a token is of."""
MAPS = replace(
    TOKENS,
    tiles=False,
    instead={"tiles": f"{MERGED}Its tower makes maps of several crops. Exchange all of `image`"},
)
"""The interventions `TOKENS` without tiles, where a picture becomes maps of several crops."""

NO_HEAD = "its checkpoint holds no head of a language model behind the end of its backbone"
"""The reason why a family that acts by an expert has no words for units of its backbone."""
_FAMILIES = "probe_kit.hooks.families"
NO_CHECKPOINTS, NO_ABILITIES = Checkpoints(), Abilities()
"""Declarations of a family that adds nothing to what its kind has."""
TOKENIZER_FOLDER = Option("tokenizer", str, "Folder of another tokenizer.json.", "the checkpoint's", is_path=True)


def lerobot_family(
    name: str,
    description: str,
    checkpoint: str | None,
    adapter: str,
    *,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    abilities: Abilities = NO_ABILITIES,
    **fields: Any,
) -> Family:
    """Return the family of a policy of lerobot.

    Args:
        name: Name of the family.
        description: One line about the family.
        checkpoint: Hub id of the default checkpoint; None for none.
        adapter: `folder.adapter:Class`; the folder is named as lerobot names the policy.
        checkpoints: Its checkpoints; types of the configuration and `full_size` follow from the folder.
        abilities: Its abilities; `outputs` and `words` are those of lerobot's policies.
        **fields: Further fields of `Family`.
    """
    kind, path = adapter.partition(".")[0], f"{_FAMILIES}.{adapter}"
    full_size = checkpoints.full_size or f"{path.partition(':')[0]}:full_size_{kind}"
    checkpoints = replace(checkpoints, config_types=checkpoints.config_types or (kind,), full_size=full_size)
    outputs = abilities.outputs or f"{_FAMILIES}.shared.lerobot.outputs:lerobot_outputs"
    abilities = replace(abilities, outputs=outputs, words=abilities.words or f"{path}.check_words")
    fields = {"checkpoints": checkpoints, "abilities": abilities, **fields}
    return Family(name, description, checkpoint, f"{path}.load", **fields)


def answering_family(
    name: str,
    description: str,
    checkpoint: str | None,
    loader: str,
    *,
    abilities: Abilities = NO_ABILITIES,
    **fields: Any,
) -> Family:
    """Return the family of a VLM that answers and does not act.

    Args:
        name: Name of the family.
        description: One line about the family.
        checkpoint: Hub id of the default checkpoint; None for none.
        loader: `folder.adapter:function`, which loads the model.
        abilities: Its abilities; it answers and does not act.
        **fields: Further fields of `Family`.
    """
    abilities = replace(
        abilities, outputs=abilities.outputs or f"{_FAMILIES}.shared.vlm:vlm_outputs", acts=False, reads=True
    )
    fields = {"embodiment": "none: answers, does not act", "abilities": abilities, **fields}
    return Family(name, description, checkpoint, f"{_FAMILIES}.{loader}", **fields)


# -- names and evaluations of lerobot's policies --------------------------------------------------------------

IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
_EMPTY_CAMERA = "empty_camera"
"""The beginning of the names that lerobot gives to cameras that never get a picture."""


def cameras_of(features: Iterable[str], renames: Mapping[str, str] = MappingProxyType({})) -> tuple[str, ...]:
    """Return the cameras among names of features that a picture can be given for, in their order.

    An empty camera is one of them where `renames` gives its name to a picture of a data set, as lerobot then does.
    """
    pictures = (name for name in features if name.startswith(IMAGES))
    names = ((name, name.removeprefix(IMAGES)) for name in pictures)
    return tuple(
        camera for name, camera in names if name in renames.values() or not camera.startswith(_EMPTY_CAMERA)
    )


def map_text(renames: Mapping[str, str]) -> str:
    """Return a checkpoint's own map of names in words; empty for none."""
    return ", ".join(f"{name} → {renamed}" for name, renamed in renames.items())


def renamed_features(features: Iterable[str], renames: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the names that a data set has, in its order, by the name that a checkpoint gives each.

    As in lerobot, all are renamed at once, so that two can exchange their names; several under one name are two
    features for one input.
    """
    by_name: dict[str, list[str]] = {}
    for feature in features:
        by_name.setdefault(renames.get(feature, feature), []).append(feature)
    return by_name


PictureFit = Literal["padded", "padded-top-left", "squashed"]
PICTURES: tuple[PictureFit, ...] = ("padded", "padded-top-left", "squashed")
EVALUATION_OPTIONS = (
    Option(
        "statistics",
        str,
        "File with p01 and p99 of action and proprio, or bridge (shipped), where the checkpoint has none; "
        "none: its numbers are metres and radians.",
        "the checkpoint's",
        is_path=True,
    ),
    Option(
        "picture",
        str,
        "How pictures come to the network's resolution.",
        "as the checkpoint's layout implies",
        PICTURES,
    ),
    Option("openness", str, "release: as Act2Answer's evaluation has it.", "measured", OPENNESS),
)
"""The fields of `Evaluation` that users of any such policy set."""


@dataclass(frozen=True)
class Evaluation:
    """The treatment of observations and actions around the network; its fields are the options of loaders.

    Attributes:
        statistics: A file, the name of a shipped one, `none` for numbers that are units already, or None for what
            the checkpoint says.
        picture: The way in which a picture comes to the network's resolution; None for what the layout of the
            checkpoint implies.
        openness: The meaning of the state's last number, see `laid_out`.
        unread: Settings of an old config.json that are left out, comma-separated.
    """

    statistics: str | None = None
    picture: PictureFit | None = None
    openness: str = "measured"
    unread: str = ""
