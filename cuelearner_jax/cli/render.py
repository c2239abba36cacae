"""`cuelearner render`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from cuelearner_jax.cli.options import Finished, Flag, check_numbers, out
from cuelearner_jax.cli.sources import source_and_options
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import filming
from cuelearner_jax.runs.policy_sources import LaneChoice


@dataclass(frozen=True, kw_only=True)
class Render(Finished, LaneChoice):
    """Draw a still and a film of a policy at work, or the picture of a question."""

    out: Path = Path("pictures")
    """Folder for the pictures. Existing files are not replaced without --overwrite."""
    steps: int = 4
    """Number of steps to film, over several episodes if needed."""
    episode: int = 0
    """Number of the episode to begin with, which sets its random start."""
    question: Flag[bool] = False
    """Draw only the episode's first situation with the policy's action, as the labelling page shows it."""
    film: str = "gif"
    """Format of the film: gif or mp4."""
    overwrite: Flag[bool] = False
    """Replace existing pictures of the same name."""


MOST = 100_000  # steps of a film, and the number of its first episode


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be drawn."""
    source, options = source_and_options(arguments, "render", Render)
    pictures, policy_name = source.task.pictures(), options.name_in(source, options.task)
    check_numbers(options, steps=(1, MOST), episode=(0, MOST))
    robot = "-".join(part for part in re.split(r"[^\w.-]+", options.robot or "") if part.strip("."))
    names = [source.folder.name, robot, options.scenario, policy_name]
    film, still, question = filming.files(options.out, "-".join(name for name in names if name), options.film)
    targets = (question,) if options.question else (film, still)
    if there := [file for file in targets if file.exists() and not options.overwrite]:
        raise UserError(f"{there[0]} exists: give --overwrite to replace it, or another --out")
    env = source.task.environment(options.task, "validation")
    policy, _ = options.lane_in(source, options.task, env)
    if options.question:
        filming.question(pictures, env, policy, options.episode, question)
        out.print(f"wrote {question}")
        return
    rewards = filming.film(pictures, env, policy, options.episode, options.steps, film, still)
    out.print(f"rewards {' '.join(f'{reward:g}' for reward in rewards)}; wrote {film} and {still}")
