"""pi0's evaluation: settings of older files, units, pictures and states that no checkpoint file contains."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE, without_revision
from probe_kit.hooks.contract.state_layout import ARM_NUMBERS, laid_out
from probe_kit.hooks.families.pi0.old_layout import current_config, is_old_layout
from probe_kit.hooks.families.shared.lerobot.evaluation import Picture
from probe_kit.hooks.families.shared.lerobot.features import STATE
from probe_kit.hooks.families.shared.lerobot.flow import LerobotFlow
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser, Units
from probe_kit.hooks.families.shared.lerobot.window import PictureWindow, padded_top_left, squashed
from probe_kit.hooks.families.shared.statistics_bounds import FILES, NO_STATISTICS, StatisticsFile, statistics_in

EVALUATED_WITH: Mapping[str, str] = {"juexzz/INTACT-pi0-finetune-bridge": "bridge"}
"""Checkpoints whose units only their evaluation has, and the shipped statistics that it has."""


class EvaluatedPi0(LerobotFlow):
    """The settings that `Evaluation` decides of a pi0, and their defaults."""

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Also of lerobot's older layout."""
        return current_config(values, str(path)) if is_old_layout(values) else values

    def further_settings(self) -> dict[str, str]:
        """The settings that the evaluation decides."""
        evaluation, settings = self.evaluation, {}
        if (file := self._statistics) is not None:
            settings["statistics"] = file.sha256
        elif evaluation.statistics is not None:
            settings["statistics"] = evaluation.statistics
        if self.picture != "padded":
            settings["picture"] = self.picture
        if evaluation.openness != "measured":
            settings["openness"] = evaluation.openness
        return settings

    def units_of(self, feature: str, kind: str) -> Units:
        """The checkpoint's own; where it has none, those of its evaluation. Raises CheckpointError for both."""
        requested = self.evaluation.statistics
        if (
            requested is not None
            and (units := self._stored(feature, kind)) is not None
            and units.mode != "IDENTITY"
        ):
            raise CheckpointError(
                f"{self.checkpoint} holds the statistics of its {feature} itself ({units.source}), and "
                f"{requested} were given too; leave -M statistics out"
            )
        if requested == NO_STATISTICS:
            nothing = np.zeros(0, np.float32)
            return Normaliser("IDENTITY", nothing, nothing, 0.0, "-M statistics=none")
        if self._statistics is not None:
            part: Literal["proprio", "action"] = "proprio" if kind == "STATE" else "action"
            action_numbers = int(self.config.output_features["action"].shape[0])
            return self._statistics.bounds(part, self._state_numbers if kind == "STATE" else action_numbers)
        if (units := self.own_units(feature, kind)) is not None:
            return units
        raise CheckpointError(
            f"{self.checkpoint} leaves the units of its {feature} to its evaluation and has no "
            f"{' or '.join(FILES)}. Pass -M statistics=bridge, or a FILE with p01 and p99 of action and "
            "proprio, or none if its numbers are metres and radians"
        )

    def _stored(self, feature: str, kind: str) -> Units | None:
        try:
            return self.own_units(feature, kind)
        except CheckpointError:
            return None

    @cached_property
    def _statistics(self) -> StatisticsFile | None:
        """The chosen statistics; for a checkpoint without own ones, its folder's or evaluation's. Else None."""
        source = self.evaluation.statistics
        if source is None and self._stored(STATE, "STATE") is None and self._stored("action", "ACTION") is None:
            source = statistics_in(self.folder) or EVALUATED_WITH.get(str(without_revision(self.checkpoint)))
        return None if source in (None, NO_STATISTICS) else StatisticsFile.read(str(source))

    @cached_property
    def picture(self) -> Picture:
        """The way pictures get their size: as requested, or as the checkpoint's layout implies."""
        if self.evaluation.picture is not None:
            return self.evaluation.picture
        if self._statistics is not None:
            return "squashed"
        values = load_json(self.folder / CONFIG_FILE)
        return "padded-top-left" if is_old_layout(values) else "padded"

    def look(self, camera: str, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """(B, 3, H, W) in [0, 1]; squashed and padded ones at the network's resolution."""
        if self.picture == "padded":
            return super().look(camera, images)
        if self.window(camera) != PictureWindow():
            raise CheckpointError(
                f"{self.checkpoint} looks at a part of its pictures; -M picture={self.picture} cannot be combined "
                "with that. Leave it out"
            )
        height, width = self.config.image_resolution
        if self.picture == "squashed":
            return super().look(camera, [squashed(image, (height, width)) for image in images])
        return padded_top_left(super().look(camera, images), (height, width))

    def laid_out(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Seven numbers where the evaluation's statistics are of seven."""
        seven = self.evaluation.statistics is not None or self._statistics is not None
        return laid_out(states, self._state_numbers if seven else ARM_NUMBERS, self.evaluation.openness)
