"""Choices among the lanes of a run or policy folder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

from cuelearner_jax.runs import trained
from cuelearner_jax.runs.trained import PolicySource


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """Choice of a folder's policy, and of its lanes but for their seeds."""

    policy: str | None = None
    """Name of the acting policy, as for evaluate (default: the agent, or the adapted policy)."""
    guidance: str | None = None
    """Kind of guidance of the lane (default: that of the lane with the best validated reward)."""
    labels: int | None = None
    """Label budget of the lane (default: that of the best lane; of a policy folder the largest)."""
    bound_deg: float | None = None
    """Bound of a policy folder's lane (default: the largest) [deg]."""

    def name_in(self, source: PolicySource, world: Any) -> str:
        """Return the policy's name. Raises UserError if the source has no such policy, or none for that world."""
        name = self.policy or source.default_policy
        source.check(name, world, guidance=self.guidance)
        return name


@dataclass(frozen=True, kw_only=True)
class Lane(Lanes):
    """Choice of a folder's policy, and of its lane."""

    seed: int | None = None
    """Seed of the lane (default: that of the best lane; of a policy folder the first)."""

    def settled(self, source: PolicySource, name: str) -> Self:
        """Return the choice with the lane that is taken by default, see `trained.chosen_lane`."""
        seeds = () if self.seed is None else (self.seed,)
        kind, labels, seeds = trained.chosen_lane(source, name, (self.guidance, self.labels, seeds))
        return replace(self, guidance=kind, labels=labels, seed=seeds[0] if seeds else None)

    def policy_in(self, source: PolicySource, world: Any, env: Any) -> Any:
        """Return the single policy. Raises UserError if there is no such lane."""
        name = self.policy or source.default_policy
        return trained.one_policy(source, world, name, self.guidance, self.labels, self.seed, self.bound_deg, env)


@dataclass(frozen=True, kw_only=True)
class BaseLanes(Lanes):
    """Choice of the lanes of the folder to adapt."""

    seeds: tuple[int, ...] = ()
    """Seeds of the lanes to adapt, each with labels of its own (default: the best lane's)."""
