#!/bin/bash
# lerobot 0.6.1 (numpy, datasets, av as pinned by its extra "dataset"), Python 3.12, Linux, CPU. No probe_kit.
#
# `lerobot-edit-dataset --operation.type modify_tasks --operation.task_replacements '{"red": "blue"}'` ("replace
# existing task strings") looks at the FIRST text in an episode's list of tasks only, and then gives all frames of the
# episode that one text. An episode of which two frames read "red" and two "green" (a task per frame is what
# `add_frame` takes) has four frames of one text afterwards: "green" is lost, although no rule names it, or "red"
# stays unreplaced and becomes "green". Which of both happens depends on PYTHONHASHSEED at recording, because the list
# comes from a set.
# Seen: recorded with hash seeds 0 to 5, words of the four frames before and after, such as
#   red red green green  ->  green green green green     (or  blue blue blue blue)
#
# Prints what it saw; exits 0 if it is still so, 1 if it changed.
set -u
work=$(mktemp -d); trap 'rm -rf "$work"' EXIT; cd "$work"
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 venv
    uv pip install --quiet --python venv/bin/python "lerobot[dataset]==0.6.1"
else
    python3.12 -m venv venv
    venv/bin/python -m pip install --quiet "lerobot[dataset]==0.6.1"
fi
export HF_HUB_OFFLINE=1 HF_HOME=$work/hf HF_LEROBOT_HOME=$work/lerobot OMP_NUM_THREADS=1
cat > record.py <<'P'
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset.create("local/words", 5, {"action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}}, root=sys.argv[1], use_videos=False)
for text in ("red", "red", "green", "green"):
    data.add_frame({"action": np.zeros(2, np.float32), "task": text})
data.save_episode(); data.finalize()
P
cat > words.py <<'P'
import sys
from pathlib import Path
import pandas as pd
root = Path(sys.argv[1])
tasks = pd.read_parquet(root / "meta/tasks.parquet")
texts = dict(zip(tasks["task_index"], tasks.index))
print(*(texts[n] for n in pd.read_parquet(next((root / "data").rglob("*.parquet")))["task_index"]))
P
lost=0
for seed in 0 1 2 3 4 5; do
    PYTHONHASHSEED=$seed ./venv/bin/python record.py set$seed >/dev/null 2>&1 || { echo "no data set"; exit 2; }
    before=$(./venv/bin/python words.py set$seed)
    ./venv/bin/lerobot-edit-dataset --repo_id local/words --root "$work/set$seed" --operation.type modify_tasks \
        --operation.task_replacements '{"red": "blue"}' >edit.log 2>&1 || { tail -2 edit.log; exit 2; }
    after=$(./venv/bin/python words.py set$seed)
    echo "hash seed $seed: $before  ->  $after"
    [ "$after" = "blue blue green green" ] || lost=$((lost + 1))
done
[ $lost -gt 0 ] && { echo "still so"; exit 0; }
echo "changed"; exit 1
