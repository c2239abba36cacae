"""The processor step that shows a policy the pictures of a moved camera as the camera gave them before.

It stands in policy_preprocessor.json before the normaliser; `camera.write` puts it there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep
from torch import Tensor


@dataclass
class PictureStep(ProcessorStep):
    """Show the policy the pictures of each camera as it gave them before it moved."""

    places: dict[str, list[list[float]]]  # camera -> (2, 3): from a place before to the place now, both from -1 to 1

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with other pictures. Raises ValueError where a camera is missing."""
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        if absent := self.places.keys() - observation.keys():
            raise ValueError(f"{min(absent)} is missing: use the checkpoint of the robot with this camera")
        back = {key: moved_back(observation[key], torch.tensor(one)) for key, one in self.places.items()}
        following = {**transition, TransitionKey.OBSERVATION: {**observation, **back}}
        return following  # pyright: ignore[reportReturnType]

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"places": self.places}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the features as they are."""
        return features


def moved_back(pictures: Tensor, places: Tensor) -> Tensor:
    """Return pictures (..., channels, height, width) in which a place shows what is where `places` (2, 3) leads.

    What was not in the picture repeats its edge.
    """
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    matrix = places.to(flat).expand(len(flat), -1, -1)
    grid = torch.nn.functional.affine_grid(matrix, list(flat.shape), align_corners=False)
    shown = torch.nn.functional.grid_sample(flat, grid, padding_mode="border", align_corners=False)
    return shown.reshape(pictures.shape)
