#!/usr/bin/env bash
# lerobot 0.6.1 with metaworld 3.0.0, the version that its extra names, and mujoco 3.8.1. Two things about its Meta-World:
# 1. A picture size is taken and declared (observation_space), and pictures are 480 x 480 all the same. A policy that is built from the declared
#    space gets pictures of another size than its configuration says.
# 2. The default task of its configuration, metaworld-push-v2, is in no version of the simulator that it installs: EnvConfig's default cannot be made.
# Seen: declared (84, 84, 3), shown (480, 480, 3); default task 'metaworld-push-v2': KeyError('push-v2')
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" lerobot[metaworld]==0.6.1 mujoco==3.8.1 packaging
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet lerobot[metaworld]==0.6.1 mujoco==3.8.1 packaging
fi
export HF_HUB_OFFLINE=1 MUJOCO_GL=${MUJOCO_GL:-osmesa} # needs Debian's libosmesa6, or MUJOCO_GL=egl with libegl1
cd "$folder"
cat >look.py <<'LOOK'
from lerobot.envs.configs import EnvConfig
from lerobot.envs.metaworld import MetaworldEnv

environment = MetaworldEnv("push-v3", obs_type="pixels_agent_pos", observation_width=84, observation_height=84)
declared = environment.observation_space["pixels"].shape
shown = environment.reset(seed=0)[0]["pixels"].shape
configuration = EnvConfig.get_known_choices()["metaworld"]()
try:
    configuration.create_envs(n_envs=1)
    default = "can be made"
except KeyError as error:
    default = repr(error)
print(f"declared {declared}, shown {shown}; default task {configuration.task!r}: {default}")
raise SystemExit(not (declared == (84, 84, 3) and shown == (480, 480, 3) and default == "KeyError('push-v2')"))
LOOK
env/bin/python -W ignore look.py 2>look.err | grep declared || {
    tail -n 5 look.err
    exit 1
}
