#!/usr/bin/env bash
# pybullet 3.2.7, loadURDF. Two things about a mesh file that is changed between two loads in one process:
# 1. The new file collides, and the old one is drawn. A robot whose mesh was edited, loaded into a new server, pushes with a shape that no picture shows.
# 2. setPhysicsEngineParameter(enableFileCaching=0) reads the drawn mesh anew too. It is a setting of the process, although it names a server: servers
#    that connect later, and never set it, read all meshes again at every load. The Panda then takes 0.3 s in place of 0.05.
# Seen: height of the hand's collision box and pixels of the hand, before the edit (0.1, 356), after it (0.192, 356), without the cache (0.192, 1603).
# A later server with its default, after another edit: (0.376, 6015), as if it had the cache off.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" pybullet==3.2.7 numpy==2.2.6
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet pybullet==3.2.7 numpy==2.2.6
fi
cd "$folder"
cat >look.py <<'LOOK'
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data

HAND = 8
arm = Path(shutil.copytree(Path(pybullet_data.getDataPath()) / "franka_panda", "arm")).resolve()
urdf = arm / "panda.urdf"
urdf.write_text(urdf.read_text().replace("package://", f"{arm}/"))
PROJECTION = pybullet.computeProjectionMatrixFOV(fov=60, aspect=1, nearVal=0.01, farVal=5)
BESIDE = pybullet.computeViewMatrix((0.7, 0, 0.9), (0.09, 0, 0.95), (0, 0, 1))


def double_the_hand():
    for mesh in arm.rglob("hand.obj"):
        rows = mesh.read_text().splitlines()
        for at, row in enumerate(rows):
            if re.match(r"v\s", row):
                rows[at] = "v " + " ".join(str(2 * float(number)) for number in row.split()[1:4])
        mesh.write_text("\n".join(rows) + "\n")


def load(cache=None):
    server = pybullet.connect(pybullet.DIRECT)
    if cache is not None:
        pybullet.setPhysicsEngineParameter(enableFileCaching=cache, physicsClientId=server)
    robot = pybullet.loadURDF(str(urdf), useFixedBase=True, physicsClientId=server)
    low, high = pybullet.getAABB(robot, HAND, physicsClientId=server)
    flags = pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
    camera = pybullet.getCameraImage(
        120, 120, BESIDE, PROJECTION, renderer=pybullet.ER_TINY_RENDERER, flags=flags, physicsClientId=server
    )
    pybullet.disconnect(physicsClientId=server)
    links = (np.reshape(camera[4], -1) >> 24) - 1
    return round(high[2] - low[2], 3), int((links == HAND).sum())


before = load()
double_the_hand()
edited, uncached = load(), load(cache=0)
double_the_hand()
later = load()
for name, (height, pixels) in zip(
    ("before", "after an edit", "without the cache", "a later server after another edit"),
    (before, edited, uncached, later),
):
    print(f"{name}: the hand collides in a box {height} m high and is drawn in {pixels} pixels")
stale = edited[0] > before[0] and edited[1] == before[1]
sys.exit(0 if stale and uncached[1] > edited[1] and later[1] > uncached[1] else 1)
LOOK
"$folder/env/bin/python" look.py
