"""What several commands share of their options: a field is an option, the text below it its help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Generic, TypeVar

import tyro

from cuelearner_jax.config import RunConfig
from cuelearner_jax.guidance import registry as guidances

TaskT = TypeVar("TaskT")
Flag = tyro.conf.FlagCreatePairsOff


@dataclass(frozen=True)
class Training(Generic[TaskT]):
    """What train and sweep share."""

    run: Annotated[RunConfig[TaskT], tyro.conf.arg(name="")]
    out: Path
    """Folder for results and checkpoints."""
    resume: Flag[bool] = False
    """Go on with an interrupted run."""
    overwrite: Flag[bool] = False
    """Delete what an earlier run left in the folder."""
    labels_from: Path | None = None
    """Use the labels of this file instead of asking the teacher."""
    tuning: Flag[bool] = False
    """Evaluate on episodes set aside for choosing settings, not on those of reported figures."""

    @property
    def split(self) -> str:
        """Whose episodes evaluations are."""
        return "tuning" if self.tuning else "validation"

    @property
    def done(self) -> str:
        """What is told at the end."""
        return f"done: {self.out} (see it with: cuelearner report {self.out} --out {self.out}/report)"


def guidance_kinds() -> dict[str, str]:
    """Every kind of guidance with a line on it, or an empty one where there is none."""
    return dict.fromkeys(guidances.KINDS, "")


def asking_kind(kinds: tuple[str, ...], config: RunConfig) -> str:
    """The first of the kinds that asks a teacher, or else the first."""
    asking = [kind for kind in kinds if guidances.make(kind, config.sizes, obs_size=1).asks]
    return (asking or list(kinds))[0]
