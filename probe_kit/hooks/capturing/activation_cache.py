"""The activations of a capture, by site, one by one or stacked."""

from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any

import torch
from torch import Tensor

from probe_kit._terminal.notebook import rows_html
from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import Site


class ActivationCache(Mapping[Site, Tensor]):
    """The captured activations of one inference, a mapping from sites in the order in which they fired.

    `tape[site]` is what `capture` kept of it, (B, T, D) on the model's device unless it was reduced; the name of a
    site does as well as the site. fires: how often each tapped module was called.
    """

    def __init__(self) -> None:
        self._kept: dict[Site, Tensor] = {}
        self.fires: dict[str, int] = {}

    def __getitem__(self, site: Site | str) -> Tensor:
        """Raises UnknownSiteError for a site that was not captured or a name that is none."""
        activation = self._kept.get(Site.parse(site) if isinstance(site, str) else site)
        if activation is None:
            raise UnknownSiteError(f"{site} was not captured; the tape holds {self._contents() or 'nothing yet'}")
        return activation

    def __iter__(self) -> Iterator[Site]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    def __contains__(self, site: object) -> bool:
        try:
            return (Site.parse(site) if isinstance(site, str) else site) in self._kept
        except UnknownSiteError:
            return False

    # Like tensors, tapes are compared by identity.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def get(self, site: Site | str, default: Any = None) -> Any:  # Mapping's own waits for a KeyError
        """The activation, or `default` where the site was not captured."""
        return self[site] if site in self else default  # noqa: SIM401  (this is `get`)

    def stack(self, stream: str, quantity: str = "residual") -> Tensor:
        """All of one stream and quantity as one tensor.

        Returns (layers, B, T, D), or (layers, iterations, B, T, D) where sites have iterations; layers and
        iterations ascend, as many as were captured. Raises UnknownSiteError if none was, if a layer lacks an
        iteration that another has, or if shapes differ.
        """
        sites = sorted(
            (site for site in self._kept if (site.stream, site.quantity) == (stream, quantity)),
            key=lambda site: (site.layer, -1 if site.iteration is None else site.iteration),
        )
        if not sites:
            raise UnknownSiteError(
                f"no site {stream}.….{quantity} was captured; the tape holds {self._contents() or 'nothing yet'}"
            )
        layers = [list(of_layer) for _, of_layer in groupby(sites, key=lambda site: site.layer)]
        iterations = {site.iteration for site in sites}
        incomplete = [of_layer[0].layer for of_layer in layers if len(of_layer) != len(iterations)]
        if incomplete:
            raise UnknownSiteError(
                f"layers {incomplete} of {stream} lack iterations that others have; capture all of "
                f"{len(iterations)} iterations in every layer, or take single sites"
            )
        if len({self._kept[site].shape for site in sites}) > 1:
            raise UnknownSiteError(f"the sites of {stream} have different shapes; take them one by one")
        rows = [torch.stack([self._kept[site] for site in of_layer]) for of_layer in layers]
        stacked = torch.stack(rows)
        return stacked[:, 0] if iterations == {None} else stacked

    def _streams(self) -> list[tuple[str, str, int, int, tuple[int, ...], str]]:
        """Per stream and quantity: layers, iterations (0: none), shape of a site, dtype and device."""
        by_stream: dict[tuple[str, str], list[Site]] = {}
        for site in self._kept:
            by_stream.setdefault((site.stream, site.quantity), []).append(site)
        return [
            (
                stream, quantity, len({site.layer for site in sites}),
                len({site.iteration for site in sites} - {None}), tuple(self._kept[sites[0]].shape),
                f"{str(self._kept[sites[0]].dtype).removeprefix('torch.')} on {self._kept[sites[0]].device}",
            )
            for (stream, quantity), sites in by_stream.items()
        ]  # fmt: skip

    def _contents(self) -> str:
        return "; ".join(
            f"{stream}.{quantity}: {layers} layers" + (f" x {iterations} iterations" if iterations else "")
            for stream, quantity, layers, iterations, _, _ in self._streams()
        )

    def __repr__(self) -> str:
        return f"<ActivationCache of {len(self)} sites{': ' if self._kept else ''}{self._contents()}>"

    def _repr_html_(self) -> str:
        rows = [
            (stream, quantity, layers, iterations or "–", " × ".join(map(str, shape)), kind)
            for stream, quantity, layers, iterations, shape, kind in self._streams()
        ]
        columns = ("stream", "quantity", "layers", "iterations", "each (B × T × D)", "")
        note = "tape[site] or tape['backbone.03.residual'] for one of them, tape.stack(stream) for all layers"
        return rows_html(f"ActivationCache of {len(self)} sites", columns, rows, note)
