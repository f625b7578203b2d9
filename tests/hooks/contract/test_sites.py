import pytest

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.runs.layout import StoredStream


@pytest.mark.parametrize("name", ["backbone.07.residual", "expert.03.residual@4", "expert.120.residual@12"])
def test_a_site_name_survives_parsing(name: str) -> None:
    assert str(Site.parse(name)) == name


@pytest.mark.parametrize("name", ["backbone", "backbone.7.residual", "backbone.07", "expert.03.residual@x", ""])
def test_another_form_is_refused(name: str) -> None:
    with pytest.raises(UnknownSiteError, match="expected <stream>"):
        Site.parse(name)


@pytest.mark.parametrize("iterations", [None, 3])
def test_a_stream_holds_the_sites_that_it_lists_and_no_other(iterations: int | None) -> None:
    stream = Stream(
        "expert", layers=3, width=8, iterations=iterations, quantities=("residual", "mlp", "final_norm")
    )
    every = {site for quantity in stream.quantities for site in stream.sites(quantity)}
    for name in ("expert", "backbone"):
        for layer in range(-1, 5):
            for quantity in (*stream.quantities, "attention"):
                for iteration in (None, -1, 0, 2, 3):
                    site = Site(name, layer, quantity, iteration)
                    assert stream.holds(site) == (site in every)


def test_a_stream_lists_its_sites_by_iteration_then_layer() -> None:
    assert [str(site) for site in Stream("expert", layers=2, width=8, iterations=2).sites()] == [
        "expert.00.residual@0",
        "expert.01.residual@0",
        "expert.00.residual@1",
        "expert.01.residual@1",
    ]
    assert [str(site) for site in Stream("backbone", layers=2, width=8).sites()] == [
        "backbone.00.residual",
        "backbone.01.residual",
    ]


def test_heads_are_a_quantity_of_every_block_that_is_captured_and_stored_nowhere() -> None:
    plain = Stream("backbone", layers=3, width=8)
    stream = Stream("backbone", layers=3, width=8, heads=2)
    assert [str(site) for site in stream.sites("heads")] == ["backbone.00.heads", "backbone.01.heads"]
    assert stream.captured == (*plain.captured, "heads")
    assert stream == plain
    assert StoredStream.of(stream, 5, ("mean",)) == StoredStream.of(plain, 5, ("mean",))
    assert "heads" not in str(StoredStream.of(stream, 5, ("mean",)).to_json())
    with pytest.raises(UnknownSiteError, match="the stream backbone has no quantity 'heads'"):
        plain.sites("heads")
