"""When the lanes of a group are asked for labels, and when their guides are looked at: counting, on the host alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cuelearner_jax.asking import label_slots, share
from cuelearner_jax.config import GuideSizes, RunConfig, Schedule
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs.grid import Grid


def check(config: RunConfig, grid: Grid, given: bool = False) -> None:
    """Raises UserError for budgets that cannot be asked for in instalments; `given`: do labels come from a file?"""
    count, unit = len(config.schedule.ask_at), config.sizes.labels_per_round
    if count == 1 or not any(guidances.find(kind).asks for kind in grid.guidance):
        return
    if given:
        raise UserError(
            "--labels-from gives all labels before the first step, --schedule.ask-at asks for some later: give one"
        )
    if min(grid.labels) <= (count - 1) * unit:
        raise UserError(
            f"{min(grid.labels)} labels are no {count} instalments of whole rounds (sizes.labels_per_round {unit}): "
            f"give --labels above {(count - 1) * unit}, or fewer steps in --schedule.ask-at"
        )


@dataclass(frozen=True)
class Instalments:
    """The label rounds of lanes, counted from the first one of the first instalment.

    All lanes begin an instalment together; one that has its share waits until the others have theirs.
    """

    budgets: np.ndarray  # of the lanes (lanes,)
    sizes: GuideSizes
    schedule: Schedule

    @property
    def count(self) -> int:
        """Number of instalments."""
        return len(self.schedule.ask_at)

    @property
    def rounds(self) -> int:
        """Rounds of all instalments."""
        return self.end(self.count - 1)

    def begun(self, step: int) -> int:
        """The instalment (from 0) that is asked for before the training step after `step`, or was the last."""
        return sum(at <= step for at in self.schedule.ask_at) - 1

    def next_step(self, step: int) -> int:
        """The step at which training stops for labels, or ends, after `step`."""
        return min([at for at in self.schedule.ask_at if at > step], default=self.schedule.total_steps)

    def shares(self, instalment: int) -> np.ndarray:
        """Labels (lanes,) asked for once an instalment is done; -1: before the first."""
        if instalment < 0:
            return np.zeros(len(self.budgets), np.int32)
        of = {budget: share(int(budget), instalment, self.count, self.sizes) for budget in np.unique(self.budgets)}
        return np.array([of[budget] for budget in self.budgets], np.int32)

    def end(self, instalment: int) -> int:
        """Rounds made once an instalment is done."""
        return sum(self._length(earlier) for earlier in range(instalment + 1))

    def _length(self, instalment: int) -> int:
        asked = self.shares(instalment) - self.shares(instalment - 1)
        return label_slots(int(asked.max()), self.sizes) // self.sizes.labels_per_round

    def of_round(self, number: int) -> int:
        """The instalment that round `number` (from 1) belongs to."""
        return next(instalment for instalment in range(self.count) if number <= self.end(instalment))

    def asked(self, rounds: int) -> np.ndarray:
        """Labels (lanes,) asked for after so many rounds."""
        if rounds == 0:
            return self.shares(-1)
        instalment = self.of_round(rounds)
        done = (rounds - self.end(instalment - 1)) * self.sizes.labels_per_round
        return np.minimum(self.shares(instalment - 1) + done, self.shares(instalment))

    def examined(self, rounds: int, before: int) -> np.ndarray:
        """Whose guide (lanes,) is looked at after so many rounds, those since `before` having changed it.

        At every multiple of `guide_eval_every` labels of its own, and where its share of an instalment is asked.
        """
        earlier, now = self.asked(before), self.asked(rounds)
        every = self.schedule.guide_eval_every
        due = now == self.shares(self.of_round(rounds))
        return (now > earlier) & (due | (now % every == 0) if every else due)
