#!/usr/bin/env bash
# lerobot 0.6.1. The words of a frame are taken from the ROW of meta/tasks.parquet whose position is the frame's task_index,
# not from the row whose column task_index has that number. A table in another order, with the same numbers in its column, gives frames the
# words of another task; get_task_index of the same object goes by the column and disagrees. lerobot's own tools write rows in order, so a
# table that was sorted or edited by hand meets this.
# Seen: as written: 'push the red block'; rows in the other order: 'lift the blue cup', get_task_index('push the red block') = 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" lerobot[dataset]==0.6.1
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet lerobot[dataset]==0.6.1
fi
export HF_HUB_OFFLINE=1
cd "$folder"
cat >look.py <<'LOOK'
from pathlib import Path

import numpy as np
import pandas as pd
from lerobot.datasets.lerobot_dataset import LeRobotDataset

folder = Path("recording")
state = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
recording = LeRobotDataset.create("local/recording", 10, {"observation.state": state}, root=folder, use_videos=False)
for words in ("push the red block", "lift the blue cup"):
    for _ in range(3):
        recording.add_frame({"observation.state": np.zeros(2, np.float32), "task": words})
    recording.save_episode()
recording.finalize()
as_written = LeRobotDataset("local/recording", root=folder)[0]["task"]
tasks = folder / "meta" / "tasks.parquet"
pd.read_parquet(tasks).iloc[::-1].to_parquet(tasks)
reordered = LeRobotDataset("local/recording", root=folder)
words, number = reordered[0]["task"], int(reordered[0]["task_index"])
print(f"as written: {as_written!r}; rows in the other order: frame 0 has task_index {number} and the words {words!r}")
print("get_task_index('push the red block') =", reordered.meta.get_task_index("push the red block"))
raise SystemExit(not (as_written == "push the red block" and number == 0 and words == "lift the blue cup"))
LOOK
env/bin/python look.py 2>look.err || {
    tail -n 5 look.err
    exit 1
}
