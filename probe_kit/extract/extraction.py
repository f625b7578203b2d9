"""The loop: plan, load, roll out every remaining episode, commit each."""

import platform
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from PIL import Image

from probe_kit.extract.controllers import SCRIPTED, Controller, PolicyController, ScriptedController
from probe_kit.extract.layout import RUN_FILE, VIDEOS
from probe_kit.extract.plan import Plan, PlannedEpisode, make_plan, refuse_if_full
from probe_kit.extract.rollout import Rollout, roll_out
from probe_kit.extract.run import Run, open_run
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.writer import RunWriter
from probe_kit.identity import sha256_json
from probe_kit.suite import Suite, default_suite, load_suite

Progress = Callable[[int, int, str], None]
_PACKAGES = ("probe-kit", "torch", "lerobot", "transformers", "pybullet", "zarr", "numcodecs", "numpy")
_FILM_SIZE = (320, 240)


@dataclass(frozen=True)
class Extraction:
    """A prepared extraction: the model is loaded and the plan is made, nothing is written."""

    settings: ExtractSettings
    plan: Plan
    controller: Controller

    def identity(self) -> dict[str, Any]:
        """Everything that names the stored numbers; two runs with equal identity are interchangeable."""
        suite = self.plan.suite
        return {
            **self.settings.choices(),
            **self.controller.identity,
            "suite": {"identity": suite.identity, "content_sha256": suite.content_sha256},
            "categories": list(suite.categories),
            "items": len(suite.items),
            "scene": self.settings.scene.to_json(),
        }

    def default_name(self) -> str:
        """Folder name that repeats for the same settings, so that the same command finds its run again."""
        return f"{self.settings.model}-{sha256_json(self.identity())[:8]}"

    def run(self, out: Path, force: bool = False, progress: Progress | None = None) -> Run:
        """Roll out and commit every episode that is not committed yet, then open the run.

        progress: called with (episodes done, episodes planned, outcome of the last one).
        Raises SettingsMismatchError or DiskSpaceError before anything is written, and whatever an episode
        raises; committed episodes stay, and the same call continues behind them.
        """
        if not force and not (out / RUN_FILE).is_file():
            refuse_if_full(self.plan, out)
        writer = RunWriter(out, self.plan, self.identity())
        remaining = writer.remaining()
        if remaining:
            self._roll_out_all(writer, remaining, progress)
        return open_run(out)

    def _roll_out_all(self, writer: RunWriter, remaining: list[PlannedEpisode], progress: Progress | None) -> None:
        from probe_kit.env import Act2AnswerEnv

        total = len(self.plan.episodes)
        env = Act2AnswerEnv(self.settings.scene)
        with closing(env), _torch_threads(self.controller.threads):
            for done, planned in enumerate(remaining, start=total - len(remaining) + 1):
                film = self.settings.video == "all" or (self.settings.video == "first" and planned.index == 0)
                rollout = roll_out(
                    env, self.controller, planned.episode, planned.scene_seed, planned.policy_seed, film
                )
                writer.write_certificate({**self.controller.certificate(), **_versions()})
                writer.write(planned, rollout)
                if film:
                    _save_film(writer.path / VIDEOS, planned, rollout)
                if progress:
                    progress(done, total, rollout.outcome["outcome"])


def prepare(settings: ExtractSettings) -> Extraction:
    """Find the suite, load the model and plan the episodes.

    Raises what these raise: UnknownModelError, UnknownCategoryError, SuiteError, WeightsError …
    """
    if settings.model not in SCRIPTED:
        _find_family(settings.model)
    suite = _suite(settings)
    controller = _controller(settings, suite)
    with_tokens = settings.tokens == "all"
    plan = make_plan(suite, controller.streams, settings.seed, settings.captured_calls, with_tokens)
    return Extraction(settings, plan, controller)


def extract_run(settings: ExtractSettings, out: Path, progress: Progress | None = None) -> Run:
    """Extract a run into folder `out`, or continue the one that is there."""
    return prepare(settings).run(out, progress=progress)


def _find_family(name: str) -> None:
    """Refuse an unknown model before the suite is built."""
    from probe_kit.hooks.registry import find_family

    find_family(name, tuple(SCRIPTED))


def _suite(settings: ExtractSettings) -> Suite:
    if settings.suite is None:
        return default_suite().select(settings.categories, settings.items)
    return load_suite(settings.suite).select(settings.categories, settings.items)


def _controller(settings: ExtractSettings, suite: Suite) -> Controller:
    if settings.model in SCRIPTED:
        return ScriptedController(settings.model)
    from probe_kit.hooks import load_policy

    policy = load_policy(
        settings.model, settings.checkpoint, settings.device, settings.dtype, settings.random_weights
    )
    instructions = sorted({item.instruction for item in suite.items})
    return PolicyController(
        policy, settings.model, instructions, settings.execute, settings.captured_calls, settings.tokens == "all"
    )


@contextmanager
def _torch_threads(count: int | None) -> Iterator[None]:
    if count is None:
        yield
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _versions() -> dict[str, Any]:
    return {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "versions": {package: version(package) for package in _PACKAGES},
    }


def _save_film(folder: Path, planned: PlannedEpisode, rollout: Rollout) -> None:
    folder.mkdir(exist_ok=True)
    frames = [Image.fromarray(frame).resize(_FILM_SIZE, Image.Resampling.LANCZOS) for frame in rollout.frames]
    name = f"{planned.index:08d}-{planned.episode.item.category}-{rollout.outcome['outcome']}.gif"
    frames[0].save(folder / name, save_all=True, append_images=frames[1:], duration=200, loop=0)
