"""What calibration found: a verdict, an estimate of every unknown, and the corrected policy."""

from __future__ import annotations

from typing import Any, NamedTuple

CHANGED, UNCHANGED, UNEXPLAINED = "changed", "nothing changed", "none of these"


class Estimate(NamedTuple):
    """The estimate of one unknown after all answers, in the unknown's unit."""

    name: str
    unit: str
    mean: float
    low: float  # ends of the 95% interval
    high: float
    changed: bool  # True if the unknown is corrected; else the interval is for this unknown added alone

    def words(self) -> str:
        """Describe the estimate in one line."""
        return f"{self.name}: {self.mean:.4g} [{self.low:.4g}, {self.high:.4g}] {self.unit}"


class Result(NamedTuple):
    """The verdict of calibration, the estimates and the corrected policy."""

    verdict: str  # CHANGED, UNCHANGED or UNEXPLAINED
    changes: tuple[str, ...]  # names of the distortions that are corrected
    estimates: tuple[Estimate, ...]  # estimates of all unknowns
    evidence: dict[tuple[str, ...], float]  # evidence of each set of changes, less that of no change [nats]
    held_out: tuple[float, float]  # mean log probability of a held-out answer without and with the changes [nats]
    confirmed: tuple[int, int] | None  # answers for the corrected policy and against it; None: not asked
    refused: tuple[str, ...]  # names of the distortions that were not confirmed
    wrong: float  # share of answers about something else
    apart: float  # typical distance between teacher and corrected policy, in the space's unit
    more: int | None  # expected number of labels still needed; None: not known
    policy: Any  # the corrected policy, or its base where nothing changed

    def words(self) -> list[str]:
        """Describe the result, line by line."""
        if self.refused:
            named = f"The answers named {' and '.join(self.refused)}, but the last answers did not confirm this."
            return [f"{named} The policy stays as it was."]
        if self.verdict == UNEXPLAINED:
            return ["None of these changes explains the answers. The policy stays as it was."]
        if self.verdict == UNCHANGED:
            return ["The answers ask for no change. The policy stays as it was."]
        lines = [one.words() for one in self.estimates if one.changed]
        return [*lines, f"About {self.more} more labels are needed." if self.more else "No more labels are needed."]
