"""All measurements that need a GPU: parity, capture, probes, and how long the model waits.

    python benchmarks/on_gpu.py [--device cuda] [--only parity,capture]

Each part is a file of tests or a benchmark of this folder in a process of its own, so that none leaves memory
behind. One that fails is named at the end, the others run, and the exit code is then 1. Without a GPU the same
parts run on the CPU in their smallest form, the output says so, and the exit code is 0: that shows that they run,
and no more.

* parity: every family, an extraction, probes and copies to the host, on the device against the CPU.
* golden: every recorded reference that lies here, through the ordinary adapter, on the CPU, where it was recorded.
* capture: clean inference against capture in every family at a tenth of a billion parameters, in bfloat16.
* full: the same for three families at the released size, with a trace of what waits for the device (a GPU only).
* probes: a site at N = 300 and 3,440, numpy against torch on the device.
* waiting: the real loop with `--batch auto`.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PARITY = (
    "tests/hooks/test_on_device.py", "tests/extract/test_extraction.py",
    "tests/extract/rollout/test_episode_loop.py", "tests/train/test_probe_sweep.py",
)  # fmt: skip
ON_DEVICE = "device_changes and cuda or gpu"
GOLDEN = "reproduces or reproduced or every_recorded or everything_recorded"


def parts(device: str) -> dict[str, list[str]]:
    """The command of each part by name."""
    small = device == "cpu"
    pytest = [sys.executable, "-m", "pytest", "-q", "-m", "slow or not slow"]
    capture = ["--device", device]
    if small:
        capture += ["--families", "qwen3-vl", "--repeats", "1"]
    full = {"full": _benchmark("capture.py", "--host", "--full", "--trace", "trace.json", "--device", device)}
    return {
        "parity": [*pytest, *PARITY, "-k", "device_changes and cpu and not vl or gpu" if small else ON_DEVICE],
        "golden": [*pytest, "tests/hooks/test_verify.py" if small else "tests/hooks", "-k", GOLDEN],
        "capture": _benchmark("capture.py", "--host", *capture),
        **({} if small else full),
        "probes": _benchmark(
            "probes.py", "--device", device, "--sizes", "60" if small else "300,3440",
            *(["--permutations", "2", "--tokens", "8"] if small else []),
        ),
        "waiting": _benchmark(
            "waiting.py", "--device", device, "--subjects", "tiny" if small else "tiny,large,full",
            "--items", "4" if small else "40",
        ),
    }  # fmt: skip


def _benchmark(name: str, *arguments: str) -> list[str]:
    return [sys.executable, str(HERE / name), *arguments]


def found_device() -> str:
    """`cuda` where torch sees a GPU, else `cpu`."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def machine(device: str) -> str:
    """What the figures below were made with."""
    import torch

    name = torch.cuda.get_device_name(device) if device != "cpu" else "no GPU"
    return f"{name}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, torch {torch.__version__}"


def main() -> None:
    """Run every part and name those that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="default: cuda if there is one, else cpu")
    parser.add_argument("--only")
    options = parser.parse_args()
    device = options.device or found_device()
    commands = parts(device)
    selected = options.only.split(",") if options.only else list(commands)
    if unknown := [name for name in selected if name not in commands]:
        parser.error(f"--only {unknown[0]}; expected one of {', '.join(commands)}")
    print(machine(device), flush=True)
    if device == "cpu":
        print(
            "NO GPU HERE: the same parts on the CPU, as small as they go. Nothing below is a measurement.",
            flush=True,
        )
    environment = {**os.environ, **({"OMP_NUM_THREADS": "1"} if device == "cpu" else {})}
    failed = []
    for name in selected:
        print(f"\n== {name}: {' '.join(commands[name][1:])}", flush=True)
        if subprocess.run(commands[name], cwd=HERE.parent, env=environment, check=False).returncode:
            failed.append(name)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
