import json
from pathlib import Path

import pytest
import torch
from transformers.generation.logits_process import TemperatureLogitsWarper, TopKLogitsWarper

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.families.shared.token_decoder import ALL, CHECKPOINT, TOP, chooser, top_of


def logits(rows: int) -> torch.Tensor:
    return torch.randn((rows, 400), generator=torch.Generator().manual_seed(0)) * 3


def test_without_temperature_the_likeliest_is_chosen() -> None:
    assert torch.equal(chooser(0, [1, 2])(logits(2)), logits(2).argmax(dim=1))


def test_draws_come_from_a_rows_own_seed_whatever_stands_beside_it() -> None:
    torch.manual_seed(1)
    row = logits(2)[1:]
    together = [chooser(0.7, [3, 4])(logits(2))[1] for _ in range(2)]
    assert together[0] == together[1] == chooser(0.7, [4])(row)[0]
    draw = chooser(0.7, [4])
    assert len({int(draw(row)[0]) for _ in range(20)}) > 1


def test_draws_follow_the_distribution_among_the_likeliest() -> None:
    row = logits(1)
    draw = chooser(0.7, [5])
    counts = torch.bincount(torch.cat([draw(row) for _ in range(4000)]), minlength=400)
    best = row[0].topk(TOP).indices
    assert int(counts.sum()) == int(counts[best].sum())
    expected = torch.softmax(row[0][best] / 0.7, dim=0)
    spread = (expected * (1 - expected) / 4000).sqrt()
    assert ((counts[best] / 4000 - expected).abs() < 5 * spread + 1e-9).all()


def test_draws_among_some_ids_only_never_leave_them_and_follow_their_distribution() -> None:
    row, among = logits(1), range(300, 316)
    draw = chooser(0.6, [6], top=None, among=among)
    counts = torch.bincount(torch.cat([draw(row) for _ in range(4000)]), minlength=400)
    assert int(counts[300:316].sum()) == 4000
    expected = torch.softmax(row[0, 300:316] / 0.6, dim=0)
    spread = (expected * (1 - expected) / 4000).sqrt()
    assert ((counts[300:316] / 4000 - expected).abs() < 5 * spread + 1e-9).all()


@pytest.mark.parametrize("temperature", [-0.1, float("inf"), float("nan")])
def test_a_meaningless_temperature_is_refused(temperature: float) -> None:
    with pytest.raises(UsageError, match="temperature"):
        chooser(temperature, [])


@pytest.mark.parametrize("top", [1, 5, 50])
def test_what_can_be_drawn_is_what_transformers_keeps_ties_of_the_last_one_included(top: int) -> None:
    """In bfloat16 many ids are as likely as the last of the kept ones."""
    row, among = logits(1).bfloat16(), range(100, 356)
    masked = torch.full_like(row, -torch.inf)
    masked[:, among.start : among.stop] = row[:, among.start : among.stop]
    ids = torch.zeros((1, 1), dtype=torch.long)
    theirs = TopKLogitsWarper(top)(ids, TemperatureLogitsWarper(0.6)(ids, masked.float()))
    kept = set(torch.isfinite(theirs[0]).nonzero().flatten().tolist())
    draw = chooser(0.6, [1], top, among)
    counts = torch.bincount(torch.cat([draw(row) for _ in range(4000)]), minlength=400)
    assert set(counts.nonzero().flatten().tolist()) <= kept
    expected = torch.softmax(theirs[0], dim=0)
    spread = (expected * (1 - expected) / 4000).sqrt()
    assert ((counts / 4000 - expected).abs() < 5 * spread + 1e-9).all()


def test_ties_with_the_last_of_the_kept_ones_are_kept() -> None:
    row = torch.tensor([[2.0, 1.0, 1.0, 0.0]])
    draw = chooser(1.0, [1], 2)
    assert {int(draw(row)[0]) for _ in range(200)} == {0, 1, 2}


def test_how_many_are_kept_is_the_checkpoints_word_or_the_librarys_default(tmp_path: Path) -> None:
    assert (top_of(ALL, [tmp_path]), top_of("7", [tmp_path]), top_of(CHECKPOINT, [tmp_path])) == (None, 7, TOP)
    file = tmp_path / "generation_config.json"
    stored = {"bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 32000, "transformers_version": "4.40.1"}
    for own, expected in (({}, TOP), ({"top_k": 20}, 20), ({"top_k": 0}, None), ({"top_p": 1.0}, TOP)):
        file.write_text(json.dumps(stored | own), encoding="utf-8")
        assert top_of(CHECKPOINT, [tmp_path / "adapter", tmp_path]) == expected


@pytest.mark.parametrize("own", [{"top_p": 0.9}, {"repetition_penalty": 1.2}, {"top_k": "many"}, {"top_k": -1}])
def test_a_draw_that_is_shaped_otherwise_is_refused(tmp_path: Path, own: dict[str, object]) -> None:
    (tmp_path / "generation_config.json").write_text(json.dumps(own), encoding="utf-8")
    with pytest.raises(CheckpointError, match=next(iter(own))):
        top_of(CHECKPOINT, [tmp_path])
    with pytest.raises(UsageError, match="expected a number from 1 on, all or checkpoint"):
        top_of("0", [tmp_path])
