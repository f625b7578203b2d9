"""Configuration files of checkpoints as models of pydantic: every number has a type and bounds."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from probe_kit._system.bounded_files import load_json
from probe_kit._system.complaints import in_words
from probe_kit.errors import CheckpointError

Count = Annotated[int, Field(ge=1, lt=1 << 31)]
"""Number of blocks, heads, features or pixels."""
Index = Annotated[int, Field(ge=0, lt=1 << 31)]
"""Id of a token, or a position."""


class ConfigFile(BaseModel):
    """The content of a configuration file that describes a network, each field under the file's own name.

    A field that is null counts as missing. Further fields of the file are not read.

    Attributes:
        model_types: Values of `model_type` that the file may hold.
        network: Name of the network, for messages.
    """

    model_config = ConfigDict(
        frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False, protected_namespaces=()
    )
    model_types: ClassVar[tuple[str, ...]] = ()
    network: ClassVar[str] = "network"

    @model_validator(mode="before")
    @classmethod
    def _without_null(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def from_folder(cls, folder: Path) -> Self:
        """Read `folder/config.json`.

        Raises:
            CheckpointError: If it is missing or describes another model.
        """
        file = folder / "config.json"
        if not file.is_file():
            raise CheckpointError(f"{file} is missing; {folder} is not a {cls.network} checkpoint")
        return cls.from_json(load_json(file), str(file))

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "config") -> Self:
        """Read the content of a `config.json`.

        Raises:
            CheckpointError: For another model, and for fields that `read` refuses; the message names `source`.
            TypeError: For a class without `model_types`: it would refuse every file.
        """
        if not cls.model_types:
            raise TypeError(f"{cls.__name__} has no model_types; name those of its config.json")
        if (model_type := values.get("model_type")) not in cls.model_types:
            raise CheckpointError(
                f"{source} holds a {model_type!r} model; expected {' or '.join(cls.model_types)} ({cls.network}). "
                "Pass the right --model"
            )
        return cls.read(values, source)

    @classmethod
    def read(cls, values: Mapping[str, Any], source: str) -> Self:
        """Read the fields.

        Raises:
            CheckpointError: For a field that is missing, of another type, or out of bounds.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise CheckpointError(
                f"{source} does not describe {cls.network}: {in_words(error, most=None)}. Take the original file"
            ) from None


STORED_TYPE = Field(default=None, validation_alias=AliasChoices("torch_dtype", "dtype"))
"""The precision of the weights, None if the file does not say."""


def part(make: Callable[[dict[str, Any]], Any], model_type: str = "") -> BeforeValidator:
    """Return the validator of a part that transformers describes, made from its values in the file.

    A part that is made already is taken as it is.

    Args:
        make: Function that makes the part from its values.
        model_type: `model_type` that the values must have; empty for any.
    """

    def checked(values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        if model_type and values.get("model_type", model_type) != model_type:
            raise ValueError(f"describes a {values['model_type']} model; expected {model_type}")
        try:
            return make({**values, **({"model_type": model_type} if model_type else {})})
        except (TypeError, AttributeError, KeyError, ArithmeticError) as error:
            raise ValueError(f"cannot be read by transformers ({type(error).__name__}: {error})") from error

    return BeforeValidator(checked)
