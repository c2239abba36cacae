"""A correction of proposed actions, as a function of the robot's state, the phase in the chunk, and the action.

    o = (state, phase, a),   e = 2 (a - low) / (high - low) - 1,   z = clip((o - mean) / deviation)
    a' = a + (high - low) scale (beta (1, e) + k((z, 2 e), known) alpha),   within `bound` of a and within low and high

k is a Gaussian kernel with a length for each input. A proposed action beyond the bounds is moved as far as the action
at the bounds is.
"""

from __future__ import annotations

import torch
from torch import Tensor

VERSION = 2  # of the arrays
LARGEST = 5.0  # standard deviations at which inputs are cut
ARRAYS = ("low", "high", "mean", "deviation", "known", "alpha", "length", "beta", "scale", "bound")
GOLDEN = ("golden_obs", "golden_action")  # observations (cases, obs), and the actions that JAX decided on
TOLERANCE = 1e-4  # largest difference of a golden case, as a share of each entry's range


class Correction:
    """A correction made of `ARRAYS`.

    low, high (action,); mean, deviation (obs,), with obs = state + 1 + action; length (z,), with z = obs + action;
    known (n, z), alpha (n, action), beta (action, 1 + action), scale () and bound ().
    """

    def __init__(self, arrays: dict[str, Tensor]) -> None:
        """Take the arrays. Raises ValueError for missing ones, or sizes that do not fit."""
        if missing := [name for name in ARRAYS if name not in arrays]:
            raise ValueError(f"the correction's arrays lack {', '.join(missing)}: export the correction again")
        self.arrays = {name: arrays[name].detach().to("cpu", torch.float32) for name in ARRAYS}
        self.action_size = len(self.arrays["low"])
        self.state_size = len(self.arrays["mean"]) - 1 - self.action_size
        if self.arrays["known"].shape[1] != len(self.arrays["mean"]) + self.action_size or self.state_size < 0:
            raise ValueError("the correction's arrays do not fit together: export the correction again")
        self._set(torch.device("cpu"))
        self._replay({name: arrays[name].float() for name in GOLDEN if name in arrays})

    def _set(self, device: torch.device) -> None:
        """Put the arrays on a device, with what does not depend on the input computed."""
        own = {name: array.to(device) for name, array in self.arrays.items()}
        self.low, self.high, self.mean, self.deviation = (own[name] for name in ARRAYS[:4])
        self.range, self.length, self.beta = own["high"] - own["low"], own["length"], own["beta"]
        self.known, self.alpha = own["known"] / own["length"], own["alpha"] * own["scale"]
        self.shift, self.gain = own["beta"][:, 0] * own["scale"], own["beta"][:, 1:].T * own["scale"]
        self.square, self.bound, self.device = (self.known**2).sum(-1), own["bound"], device

    def _replay(self, golden: dict[str, Tensor]) -> None:
        """Decide the golden cases again. Raises ValueError for other actions."""
        if len(golden) < len(GOLDEN):
            raise ValueError("the correction has no golden cases: export it again")
        self.arrays |= golden
        obs, expected = (golden[name] for name in GOLDEN)
        state, phase, proposed = obs.split([self.state_size, 1, self.action_size], -1)
        apart = float(((self(state, phase[:, 0], proposed) - expected) / self.range).abs().max())
        if not apart <= TOLERANCE:
            raise ValueError(
                f"the correction decides golden cases otherwise, by {apart:.1e} of a range: export it again"
            )

    @torch.no_grad()
    def __call__(self, state: Tensor, phase: Tensor, proposed: Tensor) -> Tensor:
        """Return corrected actions (n, action) for states (n, state), phases (n,) and proposed actions (n, action).

        Raises ValueError for other sizes: the arrays belong to another robot.
        """
        sizes = (state.shape[-1], proposed.shape[-1])
        if sizes != (self.state_size, self.action_size):
            raise ValueError(
                f"state and action have {sizes[0]} and {sizes[1]} entries, but the correction is of a robot with "
                f"{self.state_size} and {self.action_size}: use the checkpoint that it was exported for"
            )
        if proposed.device != self.device:
            self._set(proposed.device)
        exact = proposed.float()
        action = torch.clamp(exact, self.low, self.high)
        obs = torch.cat([state.to(exact), phase.to(exact)[:, None], action], -1)
        even = 2 * (action - self.low) / self.range - 1
        z = torch.clamp((obs - self.mean) / self.deviation, -LARGEST, LARGEST)
        x = torch.cat([z, 2 * even], -1) / self.length
        square = (x**2).sum(-1, keepdim=True) + self.square - 2 * x @ self.known.T
        change = self.shift + even @ self.gain + torch.exp(-0.5 * square.clamp(min=0)) @ self.alpha
        change = torch.clamp(change, -self.bound, self.bound)
        goal = torch.clamp(action + self.range * change, self.low, self.high)
        return (exact + (goal - action)).to(proposed.dtype)
