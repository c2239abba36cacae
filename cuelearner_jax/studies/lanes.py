"""Choices among the lanes of a run or policy folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cuelearner_jax.runs import trained
from cuelearner_jax.runs.trained import PolicySource


@dataclass(frozen=True, kw_only=True)
class LanesChoice:
    """Choice of a folder's policy, and of its lanes but for their seeds."""

    policy: str | None = None
    """Name of the acting policy, as for evaluate (default: the agent, or the adapted policy)."""
    guidance: str | None = None
    """Kind of guidance of the lane (default: the run's last)."""
    labels: int | None = None
    """Label budget of the lane (default: the largest)."""
    bound_deg: float | None = None
    """Bound of a policy folder's lane (default: the largest) [deg]."""

    def name_in(self, source: PolicySource, world: Any) -> str:
        """Return the policy's name. Raises UserError if the source has no such policy, or none for that world."""
        name = self.policy or source.default_policy
        source.check(name, world, guidance=self.guidance)
        return name


@dataclass(frozen=True, kw_only=True)
class LaneChoice(LanesChoice):
    """Choice of a folder's policy, and of its lane."""

    seed: int | None = None
    """Seed of the lane (default: the first)."""

    def lanes_in(self, source: PolicySource, world: Any, env: Any) -> tuple[list[Any], list[dict[str, Any]]]:
        """Return the single policy and what chooses its lane, see `trained.several`."""
        name, seeds = self.policy or source.default_policy, () if self.seed is None else (self.seed,)
        return trained.several(source, world, name, self.guidance, self.labels, seeds, self.bound_deg, env)

    def policy_in(self, source: PolicySource, world: Any, env: Any) -> Any:
        """Return the single policy. Raises UserError if there is no such lane."""
        return self.lanes_in(source, world, env)[0][0]


@dataclass(frozen=True, kw_only=True)
class BaseLanes(LanesChoice):
    """Choice of the lanes of the folder to adapt."""

    seeds: tuple[int, ...] = ()
    """Seeds of the lanes to adapt, each with labels of its own (default: the first lane)."""
