#!/usr/bin/env bash
# metaworld 3.1.1 (gymnasium 1.4.0, mujoco 3.3.0). An environment that gym.make("Meta-World/MT1", env_name="push-v3", seed=42) made ignores
# reset(seed=...), by which Gymnasium's API seeds an environment. Two resets with the seed 0 place the object 0.17 m apart. Another environment,
# made with the seed 42 again and reset with the seed 99, starts where the first one did with the seed 0: the seed of gym.make and the number of
# resets decide a start.
# Seen: reset(seed=0): [-0.0718 0.6802 0.0194]; again: [0.0949 0.6986 0.0194]; a new environment, reset(seed=99): [-0.0718 0.6802 0.0194]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" metaworld==3.1.1 gymnasium==1.4.0 packaging
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet metaworld==3.1.1 gymnasium==1.4.0 packaging
fi
cd "$folder"
cat >look.py <<'LOOK'
import gymnasium
import metaworld  # noqa: F401 - it registers Meta-World/MT1
import numpy as np


def starts(*seeds):
    environment = gymnasium.make("Meta-World/MT1", env_name="push-v3", seed=42, disable_env_checker=True)
    places = [environment.reset(seed=seed)[0][4:7] for seed in seeds]
    environment.close()
    return places


first, second = starts(0, 0)
(elsewhere,) = starts(99)
with np.printoptions(precision=4, suppress=True):
    print(f"reset(seed=0): {first}; again: {second}; a new environment, reset(seed=99): {elsewhere}")
raise SystemExit(not (not np.array_equal(first, second) and np.array_equal(first, elsewhere)))
LOOK
env/bin/python -W ignore look.py 2>look.err || {
    tail -n 5 look.err
    exit 1
}
