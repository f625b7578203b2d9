import numpy as np
import pytest
import torch

from probe_kit.errors import EmptyRoleError, RolesMismatchError, UnknownSiteError
from probe_kit.hooks.contract.roles import Roles, Span, pool
from probe_kit.hooks.contract.sites import view_names

ROLES = Roles.from_labels(["image.base", "image.base", "language", "language", "padding"])


def test_labels_become_spans_and_masks() -> None:
    assert ROLES.spans == (Span("image.base", 0, 2), Span("language", 2, 4), Span("padding", 4, 5))
    assert ROLES.mask("language").tolist() == [False, False, True, True, False]
    assert ROLES.valid.tolist() == [True, True, True, True, False]


def test_spans_with_a_gap_are_refused() -> None:
    with pytest.raises(ValueError, match="tile the sequence"):
        Roles((Span("image.base", 0, 2), Span("language", 3, 4)))


def test_pooled_views_equal_numpy_and_padding_enters_none() -> None:
    tokens = np.random.default_rng(0).normal(size=(3, 5, 7)).astype(np.float32)
    tokens[:, 4] = 1e9
    pooled = pool(torch.from_numpy(tokens), ROLES, ["mean", "last", "mean:image.base", "mean:language"]).numpy()
    expected = [tokens[:, :4].mean(1), tokens[:, 3], tokens[:, :2].mean(1), tokens[:, 2:4].mean(1)]
    np.testing.assert_allclose(pooled, np.stack(expected, axis=1), rtol=1e-5, atol=1e-6)


def test_bfloat16_is_reduced_in_float32() -> None:
    tokens = torch.full((300, 1), 1.0, dtype=torch.bfloat16)
    tokens[0] = 2.0
    mean = pool(tokens, Roles.from_labels(["action"] * 300), ["mean"])
    assert mean.dtype == torch.float32
    assert mean.item() == pytest.approx(301 / 300, abs=1e-6)


def test_a_view_without_a_token_is_an_error_and_not_a_zero() -> None:
    with pytest.raises(EmptyRoleError, match="mean:state"):
        pool(torch.zeros(5, 2), ROLES, ["mean:state"])


def test_roles_of_another_length_are_an_error() -> None:
    with pytest.raises(RolesMismatchError, match="6 tokens"):
        pool(torch.zeros(6, 2), ROLES, ["mean"])


def test_an_unknown_view_is_an_error() -> None:
    with pytest.raises(UnknownSiteError, match="median"):
        pool(torch.zeros(5, 2), ROLES, ["median"])


def test_every_role_but_padding_and_special_has_a_view() -> None:
    assert view_names(("image.base", "language", "special", "padding")) == (
        "mean",
        "last",
        "mean:image.base",
        "mean:language",
    )
