"""Check which values of the guide's configuration work together; one clear line for the first that does not."""

from __future__ import annotations

from cuelearner_jax.config.groups import GuideScalars, GuideSizes
from cuelearner_jax.config.parts import check_part
from cuelearner_jax.errors import UserError

LARGEST_ROUND = 1 << 30  # keeps budgets in whole rounds within 32-bit integers


def check_guide(sizes: GuideSizes, scalars: GuideScalars) -> None:
    """Raise UserError with one line for the first value of the guide's configuration that cannot work."""
    check_part(sizes, "sizes")
    check_part(scalars, "scalars")
    _check_choice(sizes)
    if sizes.labels_per_round > LARGEST_ROUND:
        raise UserError(f"sizes.labels_per_round is {sizes.labels_per_round}: give at most {LARGEST_ROUND}")
    check_multiple(sizes.fit_steps, sizes.validate_every, "sizes.fit_steps", "sizes.validate_every")


def _check_choice(sizes: GuideSizes) -> None:
    """Check the options that choose among several situations for a question."""
    if sizes.ask_all and sizes.candidates == 1:
        raise UserError(
            "sizes.ask_all asks about every candidate: give sizes.candidates above 1 too, or leave out sizes.ask_all"
        )
    if sizes.ask_all:
        check_multiple(sizes.labels_per_round, sizes.candidates, "sizes.labels_per_round", "sizes.candidates")
    elif sizes.candidates > 1 and sizes.ensemble == 1:
        raise UserError(
            f"sizes.candidates is {sizes.candidates}: questions are chosen by the disagreement of members, so give a "
            "sizes.ensemble above 1 too, or sizes.ask_all"
        )


def check_multiple(value: int, unit: int, name: str, unit_name: str) -> None:
    """Raise UserError unless a value is a multiple of `unit`."""
    if value % unit:
        raise UserError(f"{name} is {value}: give a multiple of {unit_name} ({unit})")
