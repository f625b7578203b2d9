#!/usr/bin/env bash
# transformers 5.5.4. With output_hidden_states=True, entry k + 1 of Qwen3-VL's hidden_states is what block k returned, BEFORE the features of
# DeepStack are added at the positions of the picture. Block k + 1 reads another vector there. A probe on hidden_states therefore reads, at pictures
# and behind the first blocks, a stream that no block ever saw; at words both are equal.
# Seen (four blocks, DeepStack behind the first three): largest difference at the picture 0, 0.07, 0.07, 0.07; at words 0, 0, 0, 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" transformers==5.5.4 torch==2.11.0
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet transformers==5.5.4 torch==2.11.0
fi
export HF_HUB_OFFLINE=1
cd "$folder"
cat >look.py <<'LOOK'
import torch
from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

PICTURE = 90
torch.manual_seed(0)
sizes = {"hidden_size": 32, "intermediate_size": 64}
rotary = {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1]}
heads = {"num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 8}
tower = {"depth": 4, "num_heads": 4, "patch_size": 4, "out_hidden_size": 32, "num_position_embeddings": 64}
config = Qwen3VLConfig(
    text_config={"vocab_size": 100, "num_hidden_layers": 4, "rope_parameters": rotary, **heads, **sizes},
    vision_config={**tower, **sizes, "deepstack_visual_indexes": [0, 1, 2], "spatial_merge_size": 2, "temporal_patch_size": 1},
    image_token_id=PICTURE,
    video_token_id=91,
    vision_start_token_id=92,
    vision_end_token_id=93,
)
model = Qwen3VLForConditionalGeneration(config).eval()
ids = torch.tensor([[1, 92, *[PICTURE] * 4, 93, 2, 3]])
at_picture = ids[0] == PICTURE
inputs_of_blocks = []
for block in model.model.language_model.layers:
    block.register_forward_pre_hook(
        lambda module, args, named: inputs_of_blocks.append(args[0] if args else named["hidden_states"]), with_kwargs=True
    )
with torch.no_grad():
    output = model(
        input_ids=ids,
        pixel_values=torch.randn(16, 3 * 4 * 4),
        image_grid_thw=torch.tensor([[1, 4, 4]]),
        mm_token_type_ids=(ids == PICTURE).int(),
        output_hidden_states=True,
    )
differences = []
for block, (hidden, read) in enumerate(zip(output.hidden_states, inputs_of_blocks, strict=False)):
    apart = (hidden - read)[0].abs()
    differences.append((float(apart[at_picture].max()), float(apart[~at_picture].max())))
    print(f"block {block}: hidden_states and what it reads differ by {differences[-1][0]:.3f} at the picture, {differences[-1][1]:.3f} at words")
same_at_words = all(words == 0 for _, words in differences)
raise SystemExit(not (same_at_words and differences[0][0] == 0 and all(picture > 0.01 for picture, _ in differences[1:])))
LOOK
env/bin/python look.py 2>look.err || {
    tail -n 5 look.err
    exit 1
}
