#!/usr/bin/env bash
# pybullet 3.2.7, renderer ER_TINY_RENDERER. A scene in which nothing moves is drawn again and again: the pictures alternate between two, which differ
# by 1 of 255 in a few pixels of a mesh. So a frame depends on how often the scene was drawn before, and a policy that sees it may act otherwise.
# Most postures show nothing of it. (Normals of meshes are normalised in place at every drawing, by our reading of the source.)
# Seen: values that differ from the first of six pictures: [0, 32, 0, 32, 0, 32], at most by 1
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
import sys

import numpy as np
import pybullet
import pybullet_data

JOINTS = [
    -0.7930566543893318, 0.6020140164773489, 0.580396618678762, -2.1103053961092484, 0.23764342016246592,
    2.9096964753289933, -0.3136641742627634, 0.0, 0.0, 0.01600502742418284, 0.015984479950240844, 0.0,
]
VIEW = [
    0.4839330716721562, 0.6025576106714327, -0.6346125652426732, 0.0,
    -0.8751050120653817, 0.33321435870130234, -0.3509407485791983, 0.0,
    0.0, 0.7251844709983897, 0.6885546332883005, 0.0,
    -0.14001680193046107, -0.2077521121672119, -0.3040301877564599, 1.0,
]
PROJECTION = [
    1.948711819001862, 0.0, 0.0, 0.0,
    0.0, 2.598282425335816, 0.0, 0.0,
    0.0, 0.0, -1.002002002002002, -1.0,
    0.0, 0.0, -0.02002002002002002, 0.0,
]

pybullet.connect(pybullet.DIRECT)
pybullet.setAdditionalSearchPath(pybullet_data.getDataPath())
robot = pybullet.loadURDF("franka_panda/panda.urdf", (-0.3, 0.0, 0.0), useFixedBase=True)
for joint, angle in enumerate(JOINTS):
    pybullet.resetJointState(robot, joint, angle)


def picture():
    rgba = pybullet.getCameraImage(
        640, 480, VIEW, PROJECTION, lightDirection=(0.2, -0.6, 1.5), lightColor=(1, 1, 1), shadow=0,
        lightAmbientCoeff=0.45, lightDiffuseCoeff=0.35, lightSpecularCoeff=0.05, renderer=pybullet.ER_TINY_RENDERER,
    )[2]
    return np.reshape(rgba, (480, 640, 4))[..., :3].astype(int)


pictures = [picture() for _ in range(6)]
differ = [int((pictures[0] != later).sum()) for later in pictures]
largest = max(int(abs(pictures[0] - later).max()) for later in pictures)
print("values that differ from the first of six pictures:", differ, "at most by", largest)
sys.exit(0 if differ[0::2] == [0, 0, 0] and min(differ[1::2]) > 0 and largest == 1 else 1)
LOOK
"$folder/env/bin/python" look.py
