import pytest
import torch

from probe_kit.errors import UsageError
from probe_kit.hooks.families.shared.sampling import TOP, chooser


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
