"""Processor steps of a corrected checkpoint: two remember the robot's state and the place in the chunk, one corrects.

    policy_preprocessor.json    ..., StateStep, normalizer_processor, ...
    policy_postprocessor.json   PlaceStep, unnormalizer_processor, CorrectStep, ...

Both files are loaded apart from each other. `CorrectStep` uses the newest steps of its `pair` in this process, which
are those loaded with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_processor_cuelearner.correction import VERSION, Correction
from lerobot_processor_cuelearner.kinematics import PREFIX, Hand

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]
_newest: dict[tuple[str, str], Any] = {}  # the step that was made last, by its pair and class


@dataclass
class _Step(ProcessorStep):
    """A step of a pair, which changes no features."""

    pair: str  # digest of the correction's arrays

    def __post_init__(self) -> None:
        _newest[self.pair, type(self).__name__] = self

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"pair": self.pair}

    def transform_features(self, features: Features) -> Features:
        """Return the features as they are."""
        return features


@dataclass
class StateStep(_Step):
    """Remember `observation.state`, before it is normalised, and shift what the policy sees of it."""

    state_shift: list[float] = field(default_factory=list)  # is added to each entry; empty: nothing
    state: Tensor | None = field(default=None, init=False, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with the shifted state. Raises ValueError for another robot's state."""
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        if (state := observation.get(OBS_STATE)) is None:
            return transition
        self.state = state.detach().reshape(-1, state.shape[-1])
        if not self.state_shift:
            return transition
        if state.shape[-1] != len(self.state_shift):
            raise ValueError(
                f"{OBS_STATE} has {state.shape[-1]} entries, but the correction is of a robot with "
                f"{len(self.state_shift)}: use the checkpoint that it was exported for"
            )
        observation = {**observation, OBS_STATE: state + torch.tensor(self.state_shift).to(state)}
        following = {**transition, TransitionKey.OBSERVATION: observation}
        return following  # pyright: ignore[reportReturnType]

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {**super().get_config(), "state_shift": self.state_shift}

    def reset(self) -> None:
        """Forget the state."""
        self.state = None


@dataclass
class PlaceStep(_Step):
    """Count the actions since the policy's newest chunk began.

    Policies put the actions of a chunk, which are views of one tensor, into a queue, and nothing tells a step when a
    policy is reset. An action that does not follow the one before it in the same tensor is the first of a chunk.
    """

    place: int = field(default=0, init=False)
    _last: tuple[int, int] = field(default=(0, -1), init=False, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition as it is."""
        action = transition.get(TransitionKey.ACTION)
        if isinstance(action, Tensor) and action.ndim < 3:
            where = action.untyped_storage().data_ptr(), action.storage_offset()
            follows = where[0] == self._last[0] and where[1] > self._last[1]
            self.place, self._last = self.place + 1 if follows else 0, where
        return transition

    def reset(self) -> None:
        """Expect a new chunk."""
        self.place, self._last = 0, (0, -1)


@dataclass
class CorrectStep(_Step):
    """Correct actions (batch, action), or chunks of actions (batch, time, action), in the robot's own units."""

    chunk: int = 1  # actions of a chunk that are executed
    version: int = VERSION
    correction: Correction | None = field(default=None, init=False, repr=False)
    hand: Hand | None = field(default=None, init=False, repr=False)  # None: actions are corrected entry by entry

    def __post_init__(self) -> None:
        """Find the pair. Raises ValueError for arrays of another version."""
        super().__post_init__()
        if self.version != VERSION:
            raise ValueError(f"the correction has version {self.version}, not {VERSION}: export it again")
        self._state = _newest.get((self.pair, StateStep.__name__))
        self._place = _newest.get((self.pair, PlaceStep.__name__))

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with its action corrected."""
        action = transition.get(TransitionKey.ACTION)
        if action is None:
            return transition
        if self.correction is None or self._place is None or self._state is None or self._state.state is None:
            raise RuntimeError("no state is known: load and run the checkpoint's preprocessor before its postprocessor")
        rows, state = action.reshape(-1, action.shape[-1]), self._state.state
        if action.ndim == 3:
            place = torch.arange(action.shape[1]).repeat(len(action))
            state = state.repeat_interleave(action.shape[1], 0)
        else:
            place = torch.full((len(rows),), self._place.place)
        phase = (place / max(self.chunk - 1, 1)).clamp(max=1.0)
        corrected = self.correction(state, phase, rows) if self.hand is None else self._by_hand(state, phase, rows)
        following = {**transition, TransitionKey.ACTION: corrected.reshape(action.shape)}
        return following  # pyright: ignore[reportReturnType]

    def _by_hand(self, state: Tensor, phase: Tensor, rows: Tensor) -> Tensor:
        """Return joint actions that lead the hand to corrected positions. Raises ValueError for another robot's."""
        correction, hand, state = self.correction, self.hand, state.to("cpu")
        assert correction is not None
        assert hand is not None
        if rows.shape[-1] != len(hand.joints):
            raise ValueError(
                f"an action has {rows.shape[-1]} entries, but the correction is of a robot with {len(hand.joints)}: "
                "use the checkpoint that it was exported for"
            )

        def change(place: np.ndarray) -> np.ndarray:
            proposed = torch.from_numpy(place).float()
            return (correction(state, phase, proposed) - proposed).numpy()

        joints = hand.move(rows.detach().to("cpu", torch.float32).numpy(), change)
        return torch.from_numpy(joints).to(rows)

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {**super().get_config(), "chunk": self.chunk, "version": self.version}

    def state_dict(self) -> dict[str, Tensor]:
        """Return the correction's arrays."""
        hand = {} if self.hand is None else self.hand.arrays
        own = {PREFIX + name: torch.from_numpy(array).float() for name, array in hand.items()}
        return own if self.correction is None else {**self.correction.arrays, **own}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take the arrays of the correction and of the hand. Raises ValueError where they do not fit."""
        self.correction = Correction(state)
        own = {name.removeprefix(PREFIX): array for name, array in state.items() if name.startswith(PREFIX)}
        self.hand = Hand({name: array.cpu().numpy() for name, array in own.items()}) if own else None
