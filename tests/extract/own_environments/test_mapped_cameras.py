"""Which picture of an environment a camera gets: by the contract, a name, a rename map or `--camera`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import OwnEnvironmentError
from probe_kit.extract import EnvironmentSettings, Step
from probe_kit.extract.sources.environment_source import (
    EnvironmentSource,
    arrange_pictures,
    mapped_pictures,
    open_environment,
)
from probe_kit.hooks import Observation
from probe_kit.hooks.contract.card import DeclaredInputs
from probe_kit.hooks.families.shared.kinds import IMAGES
from tests.support.reach_env import TwoCameras

EXCHANGED = {f"{IMAGES}a": f"{IMAGES}b", f"{IMAGES}b": f"{IMAGES}a"}
MAPS: dict[str, tuple[tuple[str, ...], tuple[str, ...], dict[str, str]]] = {
    "exchanged": (("a", "b"), ("a", "b"), EXCHANGED),
    "other names": (
        ("base", "wrist"),
        ("a", "b"),
        {f"{IMAGES}b": f"{IMAGES}base", f"{IMAGES}a": f"{IMAGES}wrist"},
    ),
    "one other name": (("base", "b"), ("a", "b"), {f"{IMAGES}a": f"{IMAGES}base"}),
    "an empty camera": (("a", "empty_camera_0"), ("a", "b"), {f"{IMAGES}b": f"{IMAGES}empty_camera_0"}),
    "fewer cameras": (("b",), ("a", "b"), {}),
    "another order": (("b", "a"), ("a", "b"), {}),
}


class Named(TwoCameras):
    """The same pictures; the first has a name too, as those of lerobot's environments have."""

    first_camera = "front"


NAMED = f"{__name__}:{Named.__name__}"


@pytest.mark.parametrize("case", MAPS)
def test_named_pictures_reach_the_cameras_that_lerobot_gives_them(case: str) -> None:
    from lerobot.processor.rename_processor import RenameObservationsProcessorStep

    cameras, pictures, renames = MAPS[case]
    pictures_by_key = {f"{IMAGES}{name}": name for name in pictures}
    renamed: Any = RenameObservationsProcessorStep(rename_map=renames).observation(dict(pictures_by_key))
    expected = {camera: renamed[f"{IMAGES}{camera}"] for camera in cameras}
    pairs = mapped_pictures((), DeclaredInputs(cameras, renames=renames), pictures, True, "kitchen")
    in_order = dict(zip(cameras, pictures, strict=False))  # what the contract gives where nothing is mapped
    assert dict(pairs or in_order.items()) == expected


@pytest.mark.parametrize(
    ("cameras", "pictures", "renames", "typed", "expected"),
    [
        (("base", "wrist"), ("image", "wrist"), {}, (), ()),
        (("base",), ("image", "wrist"), {}, (), ()),
        (("base", "wrist"), ("image", "side"), {f"{IMAGES}side": f"{IMAGES}wrist"}, (),
         (("base", "image"), ("wrist", "side"))),
        (("base", "wrist"), ("image", "side"), {f"{IMAGES}side": f"{IMAGES}wrist"},
         (("base", "side"), ("wrist", "image")), (("base", "side"), ("wrist", "image"))),
        (("base", "wrist"), ("image", "wrist"), {}, (("wrist", f"{IMAGES}image"), ("base", "wrist")),
         (("base", "wrist"), ("wrist", "image"))),
    ],
    ids=["as the contract says", "a camera less", "renamed", "typed over the map", "typed as features"],
)  # fmt: skip
def test_without_a_first_name_the_contract_counts_then_the_map_and_over_all_what_is_typed(
    cameras: tuple[str, ...], pictures: tuple[str, ...], renames: dict[str, str], typed: Any, expected: Any
) -> None:
    assert mapped_pictures(typed, DeclaredInputs(cameras, renames=renames), pictures, False, "kitchen") == expected


@pytest.mark.parametrize(
    ("typed", "renames", "message"),
    [
        ((("base", "top"),), {}, r"kitchen: --camera base=top: there is no such picture \(the model has base"),
        ((("top", "image"),), {}, r"--camera top=image: there is no such camera"),
        ((("wrist", "image"),), {}, r"first camera gets no picture .*--camera base=image"),
        ((), {f"{IMAGES}image": f"{IMAGES}base", f"{IMAGES}side": f"{IMAGES}base"},
         r"gives .*image and .*side to the camera base.*Choose with --camera base="),
    ],
)  # fmt: skip
def test_names_that_decide_nothing_are_refused_with_the_way(
    typed: Any, renames: dict[str, str], message: str
) -> None:
    inputs = DeclaredInputs(("base", "wrist"), renames=renames)
    with pytest.raises(OwnEnvironmentError, match=message):
        mapped_pictures(typed, inputs, ("image", "side"), True, "kitchen")


def test_a_step_has_the_pictures_of_the_cameras_and_the_lens_of_the_first_picture_alone() -> None:
    front, wrist = (np.full((2, 3, 3), value, np.uint8) for value in (1, 2))
    lens = np.eye(3, dtype=np.float32)
    step = Step(Observation(front, np.zeros(2, np.float32), "push", lens, {"wrist": wrist}))
    same = arrange_pictures(step, (("base", "front"), ("side", "wrist")), "front", "kitchen").observation
    exchanged = arrange_pictures(step, (("base", "wrist"), ("side", "front")), "front", "kitchen").observation
    assert (same.image, same.cameras["side"], same.intrinsics) == (front, wrist, lens)
    assert (exchanged.image is wrist, exchanged.cameras["side"] is front, exchanged.intrinsics) == (
        True,
        True,
        None,
    )
    assert arrange_pictures(step, (), "front", "kitchen") is step
    with pytest.raises(OwnEnvironmentError, match=r"kitchen shows front, wrist, and no 'top'\. Correct"):
        arrange_pictures(step, (("base", "top"),), "front", "kitchen")


@pytest.mark.parametrize(
    ("pairs", "rotations", "turns"),
    [
        ({"base": "wrist", "wrist": "front"}, ["base=180"], {"wrist": 2}),
        ({"base": "wrist", "wrist": "front"}, ["wrist=90"], {"front": 1}),
        ({"base": "front", "wrist": "wrist"}, ["base=270", "wrist=90"], {"front": 3, "wrist": 1}),
        ({"base": "wrist", "wrist": "front"}, ["180", "wrist=90"], {"wrist": 2, "front": 1}),
        ({"base": "wrist"}, ["180"], {"wrist": 2, "front": 2}),
    ],
)
@pytest.mark.parametrize("by", ["option", "rename map"])
def test_a_rotation_of_a_camera_turns_the_picture_that_it_is_given(
    by: str, pairs: dict[str, str], rotations: Sequence[str], turns: dict[str, int]
) -> None:
    """Also where only the checkpoint's map says which picture that is."""
    renames = {f"{IMAGES}{picture}": f"{IMAGES}{camera}" for camera, picture in pairs.items()}
    typed = pairs if by == "option" else {}
    source = EnvironmentSettings(NAMED, cameras=typed, rotations=rotations).open()
    assert isinstance(source, EnvironmentSource)
    inputs = DeclaredInputs(tuple(pairs), renames={name: to for name, to in renames.items() if name != to})
    decided = source._begin(inputs, True)
    assert decided.seen is not None
    plain = open_environment(EnvironmentSettings(NAMED))
    observation = plain.reset(next(iter(plain.episodes()))).observation  # type: ignore[union-attr]
    pictures = {"front": observation.image, **observation.cameras}
    by_camera = {**dict(zip(pairs, [decided.seen.image], strict=False)), **decided.seen.cameras}
    assert [*by_camera] == [*pairs]
    for camera, picture in pairs.items():
        np.testing.assert_array_equal(by_camera[camera], np.rot90(pictures[picture], turns.get(picture, 0)))
