#!/usr/bin/env bash
# av 15.1.0 (its wheel holds SVT-AV1, which lerobot 0.6.1 encodes videos of a data set with by default). For root, as in most containers, opening the
# encoder makes the thread that opens it a real-time one of the highest priority (SCHED_FIFO, 99). It stays so after the video is closed, and every
# process that it starts inherits it: simulators and workers of data loading then run before all other programs of the machine, which wait.
# Without root nothing changes. The only sign is a line of the encoder among its settings, that it failed to set a priority.
# Seen: before (0, 0), after (1, 99), a child process (1, 99)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" av==15.1.0 numpy==2.2.6
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet av==15.1.0 numpy==2.2.6
fi
cd "$folder"
cat >look.py <<'LOOK'
import os
import subprocess
import sys

import av
import numpy as np

NOW = "import os; print((os.sched_getscheduler(0), os.sched_getparam(0).sched_priority))"


def scheduling():
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


if os.geteuid() != 0:
    print("run it as root: without, the encoder changes nothing")
    sys.exit(2)
before = scheduling()
with av.open("clip.mp4", "w") as video:
    stream = video.add_stream("libsvtav1", rate=10)
    stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
    for level in range(8):
        picture = np.full((64, 64, 3), 30 * level, np.uint8)
        video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    video.mux(stream.encode())
after = scheduling()
child = subprocess.run([sys.executable, "-c", NOW], capture_output=True, text=True, check=True).stdout.strip()
os.sched_setscheduler(0, before[0], os.sched_param(before[1]))
print("policy and priority: before", before, "after", after, "a child process", child)
sys.exit(0 if before == (os.SCHED_OTHER, 0) and after == (os.SCHED_FIFO, 99) and child == str(after) else 1)
LOOK
"$folder/env/bin/python" look.py
