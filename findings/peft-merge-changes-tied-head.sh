#!/usr/bin/env bash
# peft 0.21.2 with transformers 5.5.4. A LoRA on the embedding of a network whose output head is tied to it changes the embedding alone while it
# is trained and loaded. merge_and_unload adds the factors to the one tensor that both share, so that the merged network puts out other logits.
# peft warns of "complications" when the LoRA is made, and says nothing when it merges; without a tied head both agree to rounding.
# Seen: largest difference of logits, merged against loaded: tied 3.5 (logits up to 0.55), not tied 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 "$folder/env"
    uv pip install --quiet --python "$folder/env/bin/python" peft==0.21.2 transformers==5.5.4 torch==2.11.0
else
    python3.12 -m venv "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet peft==0.21.2 transformers==5.5.4 torch==2.11.0
fi
export HF_HUB_OFFLINE=1
cd "$folder"
cat >look.py <<'LOOK'
import torch
from peft import LoraConfig, PeftModel, get_peft_model
from transformers import Qwen2Config, Qwen2ForCausalLM

SIZES = dict(vocab_size=64, hidden_size=32, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4, num_key_value_heads=2)
ids = torch.arange(2, 12)[None]
differences = {}
for tied in (True, False):
    torch.manual_seed(0)
    Qwen2ForCausalLM(Qwen2Config(**SIZES, tie_word_embeddings=tied)).save_pretrained("base")
    tuned = get_peft_model(Qwen2ForCausalLM.from_pretrained("base"), LoraConfig(r=2, target_modules=["embed_tokens"]))
    with torch.no_grad():
        for name, value in tuned.named_parameters():
            if "lora_" in name:
                value.copy_(0.1 * torch.randn(value.shape))
    tuned.save_pretrained("tuned")
    loaded = PeftModel.from_pretrained(Qwen2ForCausalLM.from_pretrained("base"), "tuned").eval()
    with torch.no_grad():
        before = loaded(input_ids=ids).logits
        after = loaded.merge_and_unload()(input_ids=ids).logits
    differences[tied] = float((after - before).abs().max())
    print(f"{'tied' if tied else 'not tied'}: merged against loaded {differences[tied]:.2g}, logits up to {float(before.abs().max()):.2g}")
raise SystemExit(not (differences[True] > 0.1 and differences[False] < 1e-4))
LOOK
env/bin/python look.py 2>look.err || {
    tail -n 5 look.err
    exit 1
}
