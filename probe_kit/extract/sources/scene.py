"""The scene as a source: settings of what is played there."""

from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import typer
from pydantic import BeforeValidator, Field

from probe_kit._terminal import options as common
from probe_kit._terminal.field_options import FieldOption, Part, options_of, plain
from probe_kit._terminal.options import choices as listed_choices
from probe_kit._terminal.options import further_option, read_size, some_of
from probe_kit.errors import UsageError
from probe_kit.extract.parts import LARGEST, Scene, option_of
from probe_kit.extract.sources.source import SourceSettings
from probe_kit.runs.run_source import OF_SCENE
from probe_kit.scene_names import ArmName, Rendering
from probe_kit.suite.items import WORDINGS, Wording, check_wordings

if TYPE_CHECKING:
    from probe_kit.env import SceneSpec

_option = partial(typer.Option, rich_help_panel="Scene")


def _size(value: Any) -> Any:
    try:
        return read_size(value) if isinstance(value, str) else value
    except UsageError:  # pydantic names the field of a ValueError, and the value
        raise ValueError("should be a text such as 224x224") from None


class SceneOptions(Part):
    """The changes that a command or a study makes to a scene: a preset, and fields of `SceneSpec`.

    None and False leave the preset's value.

    Attributes:
        scene: The preset; None for the protocol's or the model's own.
    """

    scene: common.Scene = None
    max_steps: Annotated[
        int | None,
        _option(
            "--max-steps",
            help="Number of actions per episode; in the scene at 5 Hz. Default: that of the scene, or of the "
            "environment.",
        ),
    ] = None
    tile_side: Annotated[
        float | None,
        _option("--tile-side", help="Side of a tile in metres. The paper uses 0.1452, 0.2033 and 0.1162."),
    ] = None
    light_level: Annotated[
        float | None,
        _option("--light-level", help="Brightness of the light; 1 is the default. The paper uses 0.7 and 1.3."),
    ] = None
    rendering: Annotated[
        Rendering | None,
        _option(
            "--rendering", help="How the scene is drawn. visual-matching: robot, cube and tiles over a photo."
        ),
    ] = None
    background: Annotated[
        Path | None,
        _option(
            "--background", help="Photo of the table for --rendering visual-matching. Default: the embedded photo."
        ),
    ] = None
    picture_size: Annotated[
        tuple[int, int] | None,
        BeforeValidator(_size),
        _option(
            "--picture-size",
            parser=read_size,
            metavar="WxH",
            help="Size of the camera image for the policy in pixels, such as 224x224.",
        ),
    ] = None
    epsilon: Annotated[
        float | None,
        _option("--epsilon", help="Radius of the target zone in metres. Default: half a tile plus 0.01 m."),
    ] = None
    arm: Annotated[ArmName | None, _option("--arm", help="Robot arm.")] = None
    arm_urdf: Annotated[
        Path | None, _option("--arm-urdf", help="URDF file to load instead of the built-in one of --arm.")
    ] = None
    start_grasped: Annotated[bool, _option("--start-grasped", help="Start with the cube in the gripper.")] = False
    early_stop: Annotated[
        bool, _option("--early-stop", help="End an episode when the released cube is at rest.")
    ] = False

    @property
    def changes(self) -> dict[str, Any]:
        """The fields of the scene that are changed."""
        return plain(
            {name: value for name, value in self if name in SceneOptions.model_fields and name != "scene"}
        )


class SceneSettings(SourceSettings):
    """Questions of a suite in the built-in scene.

    Attributes:
        suite: The suite's folder; None for the embedded suite.
        categories: Slugs of categories; None for all of the suite.
        items: The number of items per category; None for all.
        wordings: Names of `suite.items.WORDINGS`, each a condition of the run; None for the items' own words
            alone.
        scene: The scene, by default the model's own, see `Family.home`.
    """

    kind: Literal["scene"] = "scene"
    suite: common.SuiteFolder = None
    categories: Annotated[tuple[str, ...] | None, option_of(common.Categories)] = None
    items: Annotated[
        Annotated[int, Field(ge=1, le=LARGEST)] | None,
        typer.Option("--items", help="Number of items per category, an even number. Default: all."),
    ] = None
    wordings: Annotated[
        tuple[Wording, ...] | None,
        further_option(
            "--wordings",
            parser=some_of(WORDINGS),
            metavar=f"{listed_choices(WORDINGS)},…",
            help="Wordings of the instruction, comma-separated. Every item is played in each of them with the "
            "same seeds. Default: knowledge, the wording of the item.",
        ),
    ] = None
    scene: Scene

    opens: ClassVar[str] = "probe_kit.extract.sources.scene_source:SceneSource"
    moves: ClassVar[Mapping[str, str]] = {
        f"{OF_SCENE}background": "Photo of the run's scene, if it was moved.",
        f"{OF_SCENE}arm_urdf": "URDF file of the run's arm, if it was moved.",
    }
    subject: ClassVar[str] = "scenes"
    loads: ClassVar[str] = "suite"

    def model_post_init(self, _: Any) -> None:
        """Raise UsageError for wordings that come twice, or an empty list of them."""
        if self.wordings is not None:
            check_wordings(self.wordings)

    @property
    def scene_spec(self) -> "SceneSpec":
        """The scene that is played."""
        spec: SceneSpec = self.scene
        return spec

    @property
    def picture_words(self) -> str:
        """The size of the camera's picture, WIDTHxHEIGHT."""
        height, width = self.scene.picture_shape
        return f"{width}x{height}"

    def steps(self) -> int:
        """Count the actions that an episode can have."""
        return self.scene.max_steps

    @classmethod
    def command_options(cls) -> dict[str, FieldOption]:
        """Return the options of a command by the field that they give."""
        return super().command_options() | {
            f"{OF_SCENE}{option.field}": option for option in options_of(SceneOptions)
        }

    @classmethod
    def replaced_by(cls, typed: Collection[str]) -> set[str]:
        """Return the fields whose values typed parameters replace: a preset takes the place of the whole scene."""
        fields = super().replaced_by(typed)
        if f"{OF_SCENE}scene" in fields:
            fields |= {field for field in cls.command_options() if field.startswith(OF_SCENE)}
        return fields

    @classmethod
    def with_files(cls, values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
        """Return settings as values, with other texts for `files`."""
        of_scene = {name.removeprefix(OF_SCENE): file for name, file in files.items() if name.startswith(OF_SCENE)}
        suite = {name: file for name, file in files.items() if not name.startswith(OF_SCENE)}
        return {**values, **suite, "scene": {**values["scene"], **of_scene}}

    def files(self) -> dict[str, Path]:
        """Return the suite, where it is a folder, and the files of the scene by its field."""
        scene = {f"{OF_SCENE}{name}": getattr(self.scene, name) for name in ("arm_urdf", "background")}
        return {name: path for name, path in ({"suite": self.suite} | scene).items() if path is not None}
