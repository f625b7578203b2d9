""""""

import json
from pathlib import Path

import pytest
import torch

from probe_kit.hooks.families.ovis2_5.network import (
    PICTURE,
    PICTURE_BEGINS,
    PICTURE_ENDS,
    OvisConfig,
    OvisNetwork,
    build_ovis2_5,
    word_order,
)
from tests.support.vlm_checkpoints import write_ovis2_5


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> OvisNetwork:
    from probe_kit.models.building import initialise

    folder: Path = write_ovis2_5(tmp_path_factory.mktemp("ovis"))
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    built = build_ovis2_5(OvisConfig.from_values(values), torch.float32, "cpu")
    initialise(built, 2)
    return built.requires_grad_(False)


def test_the_patches_of_a_visual_word_follow_each_other() -> None:
    places = torch.arange(4 * 6).view(4, 6)
    assert word_order(places, 2)[:8].tolist() == [0, 1, 6, 7, 2, 3, 8, 9]


def test_pictures_of_a_batch_do_not_see_each_other(network: OvisNetwork) -> None:
    grid = torch.tensor([[1, 4, 6], [1, 2, 4]])
    patches = torch.randn(24 + 8, 3 * 32 * 32, generator=torch.Generator().manual_seed(0))
    together = network.visual_tokenizer(patches, grid)
    alone = [network.visual_tokenizer(patches[:24], grid[:1]), network.visual_tokenizer(patches[24:], grid[1:])]
    torch.testing.assert_close(together, torch.cat(alone), rtol=0, atol=1e-6)
    torch.testing.assert_close(together.sum(dim=1), torch.ones(8), rtol=0, atol=1e-5)


def test_words_stand_where_the_ids_say_and_marks_beside_them(network: OvisNetwork) -> None:
    ids = torch.tensor([[3, PICTURE_BEGINS, PICTURE, PICTURE, PICTURE_ENDS, 7]])
    patches, grid = torch.zeros(8, 3 * 32 * 32), torch.tensor([[1, 2, 4]])
    embeddings = network.embed(ids, patches, grid)[0]
    text, words = network.llm.get_input_embeddings().weight, network.vte.weight
    assert torch.equal(embeddings[[0, 5]], text[[3, 7]])
    assert torch.equal(embeddings[[1, 4]], words[[96, 97]])
    expected = network.visual_tokenizer(patches, grid) @ words[:96]
    torch.testing.assert_close(embeddings[2:4], expected, rtol=0, atol=1e-6)


def test_a_rotated_patch_is_not_where_it_was(network: OvisNetwork) -> None:
    """Another shape of grid with the same patches is another picture."""
    patches = torch.randn(16, 3 * 32 * 32, generator=torch.Generator().manual_seed(1))
    wide, tall = (network.visual_tokenizer(patches, torch.tensor([[1, *shape]])) for shape in ((2, 8), (8, 2)))
    assert (wide - tall).abs().max() > 1e-4
