"""A checkpoint whose files never end, or are huge, is refused by name and at once, in every family."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from probe_kit.errors import CheckpointError, MissingExtraError, WeightsError
from probe_kit.hooks.registry import find_family
from tests.support.every_checkpoint import WRITERS, families

SECONDS = 120


@pytest.fixture(autouse=True)
def _bounded_time() -> Iterator[None]:
    def interrupt(*_: object) -> None:
        raise AssertionError(f"still reading after {SECONDS} s")

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def terabyte(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


@pytest.mark.parametrize("make", [pipe, endless_device, terabyte], ids=lambda make: make.__name__)
@pytest.mark.parametrize("family", families())
def test_a_configuration_that_never_ends_is_refused_by_name(
    family: str, make: Callable[[Path], None], tmp_path: Path
) -> None:
    write, options = WRITERS[family]
    checkpoint = write(tmp_path / "made")
    folder = checkpoint if checkpoint.is_dir() else checkpoint.parent
    names = sorted(path.name for path in folder.iterdir() if path.suffix in (".json", ".yaml", ".model", ".jinja"))
    assert names
    for name in names:
        shutil.copy(folder / name, tmp_path / name)
        (folder / name).unlink()
        make(folder / name)
        try:
            with pytest.raises((CheckpointError, WeightsError), match=name.replace(".", r"\.")):
                find_family(family).load(str(checkpoint), options=options)
        except MissingExtraError as error:
            pytest.skip(str(error))
        (folder / name).unlink()
        shutil.copy(tmp_path / name, folder / name)
