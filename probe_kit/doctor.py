"""Checks of this installation, with a suggested fix for each failure; printed by `probe-kit doctor`.

The requirements of the demo are tried, not looked up: one child process draws a scene, another lets the embedded
policy act. They are processes of their own because native code prints to stdout, and because its crash is a
finding as well.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from probe_kit._system.counting import plural
from probe_kit._system.imports import install_command
from probe_kit._system.machine import cores_here
from probe_kit.errors import SceneError

State = Literal["ok", "note", "missing"]

DEMO_DISK = 100e6
"""Bytes the demo leaves, with room to spare (13 MB when last measured)."""
ROOMY_DISK = 20e9
DEMO_MEMORY = 2e9
PATIENCE = 120
"""Seconds a trial may take."""
TRY_AGAIN = "The machine is busy. Run `probe-kit doctor` again when it is quiet; the demo will be slow until then"
HUB_TIMEOUT = 3
TOKENIZERS = {"pi0": "google/paligemma-3b-pt-224", "smolvla": "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"}
_PYTHONS = ((3, 12), (3, 14))  # from, and below


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Attributes:
        state: `ok`, `note` (something cannot be used, the demo can), or `missing` (the demo cannot run).
        advice: The fix, empty if there is nothing to do.
    """

    subject: str
    state: State
    result: str
    advice: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the finding as `probe-kit doctor --json` prints it."""
        return asdict(self)


def examine() -> list[CheckResult]:
    """Run every check, in the order a newcomer needs it.

    Takes ten seconds or more, as it loads torch and a simulator.
    """
    with ThreadPoolExecutor(3) as pool:
        scene, policy, hub = pool.submit(_scene), pool.submit(_policy), pool.submit(_hub)
        quick = [_python(), _processor(), _memory(), _disk()]
        return [*quick, *scene.result(), *policy.result(), hub.result(), *_tokenizers(), *_extras()]


# -- the machine -----------------------------------------------------------------------------------------------


def _python() -> CheckResult:
    low, below = _PYTHONS
    described = f"{sys.version.split()[0]} on {sys.platform}"
    if low <= sys.version_info[:2] < below:
        return CheckResult("python", "ok", described)
    return CheckResult("python", "missing", described, "Use Python 3.12 or 3.13: `uv venv --python 3.12`")


def _processor() -> CheckResult:
    count = cores_here()
    advice = "" if count > 1 else "Two cores halve the time of the demo: simulation and inference overlap"
    return CheckResult("processor", "ok" if count > 1 else "note", f"{plural(count, 'core')} usable", advice)


def _memory() -> CheckResult:
    available = _available_memory()
    if available is None:
        return CheckResult("memory", "note", "cannot be read on this system", "The demo needs about 2 GB")
    described = f"{available / 1e9:.1f} GB available"
    if available < DEMO_MEMORY:
        return CheckResult(
            "memory", "note", described, "The demo needs about 2 GB; close something, or it may be killed"
        )
    return CheckResult("memory", "ok", described)


def _available_memory() -> float | None:
    """Return the available bytes by Linux's count; elsewhere all of the machine's, or None."""
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        match = re.search(r"MemAvailable:\s+(\d+) kB", meminfo.read_text(encoding="utf-8"))
        if match:
            return float(match[1]) * 1024
    if "SC_PHYS_PAGES" in os.sysconf_names:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    return None


def _disk() -> CheckResult:
    free = shutil.disk_usage(Path.cwd()).free
    described = f"{free / 1e9:.1f} GB free here"
    if free < DEMO_DISK:
        return CheckResult(
            "disk", "missing", described, f"The demo needs {DEMO_DISK / 1e6:.0f} MB: run it elsewhere (--out)"
        )
    if free < ROOMY_DISK:
        return CheckResult(
            "disk", "note", described, "Enough for the demo; a full-size model and its runs want 20 GB and more"
        )
    return CheckResult("disk", "ok", described)


# -- trials in processes of their own --------------------------------------------------------------------------


def draw_scene() -> dict[str, Any]:
    """Draw one picture of the default scene, as an episode does.

    Raises:
        SceneError: If the picture is blank.
    """
    from probe_kit.env import Act2AnswerEnv
    from probe_kit.env.simulation import import_pybullet

    env = Act2AnswerEnv()
    try:
        env.reset(seed=0)
        started = time.perf_counter()
        env.advance([0.0] * 7)
        picture = env.render()
        seconds = time.perf_counter() - started
    finally:
        env.close()
    if picture.std() < 5:
        raise SceneError(f"the picture is blank: its deviation is {picture.std():.1f} of 255")
    height, width, _ = picture.shape
    return {
        "pybullet": version("pybullet"),
        "numpy": bool(import_pybullet().isNumpyEnabled()),
        "size": f"{width} × {height}",
        "seconds": seconds,
    }


def let_policy_act() -> dict[str, Any]:
    """Load the embedded policy, infer actions once, and report the devices that torch can compute on."""
    import numpy as np
    import torch

    from probe_kit.hooks import Observation, load_policy

    started = time.perf_counter()
    policy = load_policy("pi0-tiny")
    state = np.zeros(8, np.float32)
    policy.act([Observation(np.zeros((480, 640, 3), np.uint8), state, "Put the cube on the red shape")], [0])
    cards = range(torch.cuda.device_count()) if torch.cuda.is_available() else range(0)
    return {
        "torch": torch.__version__,
        "lerobot": version("lerobot"),
        "seconds": time.perf_counter() - started,
        "gpus": [
            {
                "name": torch.cuda.get_device_name(card),
                "gigabytes": torch.cuda.get_device_properties(card).total_memory / 1e9,
            }
            for card in cards
        ],
    }


def _scene() -> list[CheckResult]:
    advice = "pybullet is compiled on installation: it needs a C++ compiler, and numpy at that time"
    trial = _trial("simulator", "draw_scene", advice)
    if isinstance(trial, CheckResult):
        return [trial]
    simulator = CheckResult("simulator", "ok", f"pybullet {trial['pybullet']} with numpy")
    if not trial["numpy"]:
        advice = f"Build it again beside numpy: `{install_command(rebuild='pybullet')}`"
        described = f"pybullet {trial['pybullet']} without numpy: pictures cost three times as much"
        simulator = CheckResult("simulator", "note", described, advice)
    drawn = (
        f"TinyRenderer (no GPU, no display needed; EGL is not used), {trial['size']} in {trial['seconds']:.2f} s"
    )
    return [simulator, CheckResult("renderer", "ok", drawn)]


def _policy() -> list[CheckResult]:
    trial = _trial("policy", "let_policy_act", f"Install again: `{install_command()}`")
    if isinstance(trial, CheckResult):
        return [trial]
    acted = f"pi0-tiny acts (torch {trial['torch']}, lerobot {trial['lerobot']})"
    return [CheckResult("policy", "ok", acted), _gpu(trial["gpus"])]


def _gpu(gpus: list[dict[str, Any]]) -> CheckResult:
    if not gpus:
        advice = "The demo needs none; pi0 wants a GPU of 16 GB or more, and drivers that torch finds"
        return CheckResult("gpu", "note", "none that torch can use", advice)
    described = ", ".join(f"{gpu['name']} with {gpu['gigabytes']:.0f} GB" for gpu in gpus)
    return CheckResult("gpu", "ok", described)


def _trial(subject: str, function: str, advice: str) -> "dict[str, Any] | CheckResult":
    """Return the result of a function of this module in a process of its own, or the finding that it failed.

    A trial without an answer in time is no failure: the machine is busy, and installing again would not help.

    Args:
        subject: Subject of the finding.
        function: Name of the function, which takes no arguments and returns what JSON can hold.
        advice: The fix where the function failed.
    """
    code = f"import json, probe_kit.doctor as d; print('\\n' + json.dumps(d.{function}()))"
    try:
        process = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, encoding="utf-8", errors="replace",
            timeout=PATIENCE, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return CheckResult(subject, "note", f"not known: no answer within {PATIENCE} s{_load()}", TRY_AGAIN)
    if process.returncode != 0:
        words = process.stderr.strip().splitlines() or ["no message"]
        return CheckResult(subject, "missing", f"ended with code {process.returncode}: {words[-1]}", advice)
    answer: dict[str, Any] = json.loads(process.stdout.strip().splitlines()[-1])
    return answer


def _load() -> str:
    """Return the number of processes that wanted a core in the last minute, where the system counts them."""
    return f", with {os.getloadavg()[0]:.0f} processes at work" if hasattr(os, "getloadavg") else ""


# -- what can be downloaded or added ---------------------------------------------------------------------------


def _hub() -> CheckResult:
    from huggingface_hub import constants

    address = constants.ENDPOINT
    if constants.HF_HUB_OFFLINE:
        return CheckResult("hub", "note", "offline mode (HF_HUB_OFFLINE)", "Unset it to download checkpoints")
    try:
        urlopen(Request(address, method="HEAD"), timeout=HUB_TIMEOUT).close()
    except HTTPError:
        pass  # it answered
    except OSError as error:
        advice = (
            "The demo needs no network; checkpoints must then be folders (--checkpoint DIR) or in the hub's cache"
        )
        reason = getattr(error, "reason", error)
        return CheckResult("hub", "note", f"{address} does not answer ({reason})", advice)
    return CheckResult("hub", "ok", f"{address} answers")


def _tokenizers() -> list[CheckResult]:
    from huggingface_hub import try_to_load_from_cache

    findings = [CheckResult("tokenizer", "ok", "pi0-tiny: embedded")]
    for family, repository in TOKENIZERS.items():
        is_cached = isinstance(try_to_load_from_cache(repository, "tokenizer_config.json"), str)
        advice = "" if is_cached else f"Comes with the model, or `hf download {repository} --include 'tokenizer*'`"
        described = f"{family}: {repository} {'is in the cache' if is_cached else 'is not in the cache'}"
        findings.append(CheckResult("tokenizer", "ok" if is_cached else "note", described, advice))
    return findings


def _extras() -> list[CheckResult]:
    """Return the optional dependencies by extra; Ray is one of them."""
    needed: dict[str, list[str]] = {}
    for requirement in requires("probe-kit") or ():
        match = re.match(r"([\w.-]+).*extra == ['\"]([\w-]+)['\"]", requirement)
        if match:
            needed.setdefault(match[2], []).append(match[1])
    return [_extra(name, packages) for name, packages in needed.items()]


def _extra(name: str, packages: list[str]) -> CheckResult:
    versions = {package: _installed_version(package) for package in packages}
    lacking = [package for package, version in versions.items() if version is None]
    if lacking:
        return CheckResult(f"extra {name}", "note", f"without {', '.join(lacking)}", f"`{install_command(name)}`")
    return CheckResult(
        f"extra {name}", "ok", ", ".join(f"{package} {version}" for package, version in versions.items())
    )


def _installed_version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
