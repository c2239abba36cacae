"""The grid of a training where none is given: the rules that the command line and Python share."""

from __future__ import annotations

from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs.grid import Grid, seeds_of
from cuelearner_jax.task import Preset, Task, shape_of


def preset_kinds(task: Task, preset: Preset) -> tuple[str, ...]:
    """The kinds of guidance that a preset compares: those it names, or all that the task can have."""
    return preset.guidance or guidances.possible(shape_of(task, preset.config.task), taught=task.teacher is not None)


def asking_kind(kinds: tuple[str, ...]) -> str:
    """The first of the kinds that asks a teacher, or else the first."""
    asking = [kind for kind in kinds if guidances.resolve(kind).asks]
    return (asking or list(kinds))[0]


def suggested(task: Task, preset: Preset, taught: bool = True) -> Grid:
    """The grid that a preset's sweep trains; kinds that ask are left out where nobody answers (not `taught`)."""
    kinds = preset_kinds(task, preset)
    kinds = kinds if taught else tuple(kind for kind in kinds if not guidances.resolve(kind).asks)
    return Grid(kinds, seeds_of(preset.first_seed, preset.seeds), preset.labels)
