"""What several test folders share: golden references where present, the embedded policy, one recorded run."""

import contextlib
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit._system.imports import one_scan_of_packages
from probe_kit._system.machine import same_scheduling
from tests.support.buckets import bad_server, bucket, bucket_elsewhere, deaf_bucket
from tests.support.made_once import made_once, shared_folder

if TYPE_CHECKING:
    from probe_kit.hooks import Observation
    from probe_kit.hooks.families.pi0.adapter import Pi0
    from probe_kit.runs import Run
    from probe_kit.suite import Suite

__all__ = ["bad_server", "bucket", "bucket_elsewhere", "deaf_bucket"]

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: every core has a worker

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what runs in its background
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests start many processes; without bytecode each would compile the package anew, and each worker the tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

gc.disable()  # until all tests are collected: imports and tests make objects that stay
CHECKOUT = Path(__file__).parents[1]
GOLDEN = Path(__file__).parent / "golden"
FENCE = Path(__file__).parent / "acceptance"
SHARED = Path(os.environ.get("PROBE_KIT_SHARED", CHECKOUT.parent / "shared"))
WAITING = ("test_intervene.py", "test_train.py")
_CHANGED = pytest.StashKey[str]()


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests neither read nor fill the user's cache; what one process draws for it, the others find."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PROBE_KIT_CACHE", str(shared_folder(tmp_path_factory) / "cache"))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_wait_for_the_disk() -> Iterator[None]:
    """No test cuts the power: what was written is read from memory, and processes that are killed lose nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _temporary_working_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Relative paths of commands, such as the default `runs/`, never lead into the checkout."""
    with contextlib.chdir(tmp_path_factory.mktemp("working")):
        yield


@pytest.fixture(scope="session", autouse=True)
def _commands_are_built_once() -> Iterator[None]:
    """Typer builds all commands of the package for every line that is typed, half of a refusal's time."""
    from typer.main import get_command

    with pytest.MonkeyPatch.context() as patch:
        for name in ("typer.main.get_command", "typer.testing._get_command"):
            patch.setattr(name, cache(get_command))
        yield


@pytest.fixture(autouse=True)
def _modules_of_a_test_end_with_it(request: pytest.FixtureRequest) -> Iterator[None]:
    """A later test never imports a module, or finds a path, that lies in the folder of this one."""
    if "tmp_path" not in request.fixturenames:
        yield
        return
    last = next(reversed(sys.modules))  # what is imported later stands behind it; a set of all takes a millisecond
    yield
    # There is none where a fixture skipped the test before it was made, and no arguments after Ctrl-C.
    if (folder := (request.node.funcargs or {}).get("tmp_path")) is None:
        return
    for name in list(takewhile(lambda name: name != last, reversed(sys.modules))):
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(folder)):
            del sys.modules[name]
    sys.path[:] = [path for path in sys.path if not path.startswith(str(folder))]


def _golden(family: str) -> Path:
    """Ours in `golden/`: random weights and what the original implementations put out with them."""
    places = [GOLDEN / family, SHARED / "golden" / family]
    folder = next((candidate for candidate in places if candidate.is_dir()), None)
    if folder is None:
        pytest.skip(f"no golden reference at {' or '.join(map(str, places))} (set PROBE_KIT_SHARED)")
    return folder


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """The whole suite and the fence take every core, unless -n says otherwise; single files run in this process.

    A file's tests stay together: what a file sets up once is not set up once per core.
    """
    if hasattr(config, "workerinput"):  # a core of its own already; it must not ask for more
        return
    fence = [config.invocation_params.dir / folder for folder in config.args] == [FENCE]
    runs_full_suite = (
        fence or config.args_source is pytest.Config.ArgsSource.TESTPATHS
    ) and not config.option.collectonly
    if runs_full_suite and config.pluginmanager.hasplugin("xdist") and config.option.numprocesses is None:
        config.option.numprocesses = len(os.sched_getaffinity(0))
        if config.option.dist == "no":
            config.option.dist = "loadfile"
        config.option.loadscopereorder = False  # xdist would begin with the files of most tests


def pytest_sessionstart(session: pytest.Session) -> None:
    """Note what differs from the last commit before a test runs."""
    if not hasattr(session.config, "workerinput"):
        session.config.stash[_CHANGED] = _changed_files()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run of the whole suite that leaves files in the checkout."""
    before = session.config.stash.get(_CHANGED, None)
    if before is None or session.config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    after = _changed_files()
    if after != before:
        print(f"\nthe tests changed the checkout; before:\n{before}after:\n{after}")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _changed_files() -> str:
    """What `git status` lists, or nothing outside a git checkout."""
    command = ["git", "status", "--porcelain"]
    try:
        return subprocess.run(command, cwd=CHECKOUT, capture_output=True, encoding="utf-8", check=False).stdout
    except FileNotFoundError:
        return ""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort long files first, so that no core ends up alone with one.

    The files of `acceptance/stored` share runs that one process makes. Only one of them comes early, because a
    second process would wait for it. So would `WAITING` for the run of `acceptance/test_extract.py`.
    """
    tests = Path(__file__).parent
    first = [tests / "acceptance" / "stored" / "test_error_codes.py", tests / "acceptance" / "test_fence.py"]

    def rank(item: pytest.Item) -> int:
        if item.path in first:
            return first.index(item.path)
        if item.path.parent == first[0].parent or item.path.name in WAITING:
            return len(first) + 2
        return len(first) + (item.path.parent != tests)

    items.sort(key=rank)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """No test leaves this process a real-time one, as the encoder of AV1 does for root: all others would wait."""
    with same_scheduling():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Tests import transformers and diffusers as they are collected: both look through all installed packages."""
    with one_scan_of_packages():
        return (yield)


def pytest_collection_finish() -> None:
    """What the imported libraries hold stays: looking through it for garbage again and again takes a minute."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def golden_pi0() -> Path:
    return _golden("pi0")


@pytest.fixture(scope="session")
def golden_pi0_fast() -> Path:
    return _golden("pi0_fast")


@pytest.fixture(scope="session")
def golden_openvla() -> Path:
    return _golden("openvla")


@pytest.fixture(scope="session")
def golden_magma() -> Path:
    return _golden("magma")


@pytest.fixture(scope="session")
def golden_spatialvla() -> Path:
    return _golden("spatialvla")


@pytest.fixture(scope="session")
def golden_vlm() -> Path:
    """References of models that answer, one folder each, and of their pictures at real sizes."""
    return _golden("vlm")


@pytest.fixture(scope="session")
def pi0_tiny() -> "Pi0":
    from probe_kit.hooks.families.pi0.adapter import load_pi0_tiny

    return load_pi0_tiny()


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> str:
    """Where torch works: what a GPU does differently is seen on machines that have one."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU on this machine")
    return str(request.param)


@pytest.fixture
def observation() -> "Observation":
    from probe_kit.hooks import Observation

    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    state = np.array([0.29, 0.0, 0.16, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
    return Observation(image, state, "Put the cube on the red shape")


@pytest.fixture(scope="session")
def small_suite(tmp_path_factory: pytest.TempPathFactory) -> "Suite":
    """Twelve Color and twelve Shape items."""
    from probe_kit.suite import build_suite

    return build_suite(tmp_path_factory.mktemp("suite") / "small", ["color", "shape"], 12)


@pytest.fixture(scope="session")
def little_runs(small_suite: "Suite", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of two runs without a model, `run` and `other`, of other seeds, with everything a run can hold."""
    from tests.support.little_run import intervene_on_little_run, probe_little_run, write_little_run

    def make(folder: Path) -> None:
        for seed, name in enumerate(("run", "other")):
            written_run = write_little_run(folder / name, small_suite.select(["color"]), seed)
            probe_little_run(written_run)
            intervene_on_little_run(written_run)

    return made_once(tmp_path_factory, "little", make)


def _recorded(suite: "Suite", tmp_path_factory: pytest.TempPathFactory, name: str, items: int) -> "Run":
    """A real run of pi0-tiny's untrained network with all tokens: episodes of four actions, of two categories."""
    from probe_kit.env import SceneSpec
    from probe_kit.extract import ExtractSettings, extract_run
    from probe_kit.runs import open_run

    settings = ExtractSettings(
        "pi0-tiny", random_weights=True, suite=suite.folder, items=items, scene=SceneSpec(max_steps=4),
        tokens="all", env_workers=0,  # a run this small does not repay processes
    )  # fmt: skip
    return open_run(made_once(tmp_path_factory, name, lambda folder: extract_run(settings, folder)))


@pytest.fixture(scope="session")
def recorded_run(small_suite: "Suite", tmp_path_factory: pytest.TempPathFactory) -> "Run":
    """A real run of 24 episodes; see `_recorded`."""
    return _recorded(small_suite, tmp_path_factory, "recorded", 6)


@pytest.fixture(scope="session")
def trainable_run(small_suite: "Suite", tmp_path_factory: pytest.TempPathFactory) -> "Run":
    """A real run of 48 episodes, of enough groups for probes; see `_recorded`. Only slow tests wait for it."""
    return _recorded(small_suite, tmp_path_factory, "trainable", 12)


@pytest.fixture(scope="session")
def two_steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The embedded checkpoint with two steps of its flow: an inference takes a third of the time of ten steps."""
    from probe_kit.models.embedded import embedded_checkpoint

    folder = shutil.copytree(embedded_checkpoint("pi0-tiny"), tmp_path_factory.mktemp("two-steps") / "pi0-tiny")
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    (folder / "config.json").write_text(json.dumps({**config, "num_inference_steps": 2}), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def shown_run(tmp_path_factory: pytest.TempPathFactory) -> "Run":
    """A run on recordings without a model, twelve episodes of four frames; see `tests.support.recorded_run`."""
    from probe_kit.runs import open_run
    from tests.support.recorded_run import write_recorded_run

    def make(folder: Path) -> None:
        write_recorded_run(folder / "run")

    return open_run(made_once(tmp_path_factory, "shown", make) / "run")


@pytest.fixture(scope="session")
def labelled_run(small_suite: "Suite", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run without a model, four inferences per episode; see `tests.support.labelled_run`."""
    from tests.support.labelled_run import write_labelled_run

    def make(folder: Path) -> None:
        write_labelled_run(folder / "run", small_suite)

    return made_once(tmp_path_factory, "labelled", make) / "run"
