"""`cuelearner render`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import check_numbers, out
from cuelearner_jax.cli.shared_options import Flag, Lane, Outside, TaskT, asked_of_source
from cuelearner_jax.runs import filming


@dataclass(frozen=True, kw_only=True)
class Render(Outside, Lane, Generic[TaskT]):
    """Draw a still and a film of a policy at work, or the picture of a question."""

    task: TaskT
    out: Path = Path("pictures")
    """Folder for the pictures. Existing files are not replaced without --overwrite."""
    steps: int = 4
    """Number of steps to film, over several episodes if needed."""
    episode: int = 0
    """Number of the episode to begin with, which sets its random start."""
    robot: str | None = None
    """Another robot, by its name (default: the task's own). With a folder, as anymal:FOLDER: one with your own walking
    policy."""
    scenario: str | None = None
    """A changed world, by its name. Options of the task (--task.…) come on top of it."""
    question: Flag[bool] = False
    """Draw only the episode's first situation with the policy's action, as the labelling page shows it."""
    film: str = "gif"
    """Format of the film: gif or mp4."""
    overwrite: Flag[bool] = False
    """Replace existing pictures of the same name."""


MOST_STEPS = 100_000  # one frame each
MOST_EPISODE = 2**32 - 1  # the episode's number is folded into a 32-bit key

OPTIONS = {"render": Render}


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be drawn."""
    source, asked = asked_of_source(arguments, "render", Render)
    pictures, policy_name = source.task.pictures(), asked.name_in(source, asked.task)
    check_numbers(asked, steps=(1, MOST_STEPS), episode=(0, MOST_EPISODE))
    robot = "-".join(part for part in re.split(r"[^\w.-]+", asked.robot or "") if part.strip("."))
    names = [source.folder.name, robot, asked.scenario, policy_name]
    files = filming.files(asked.out, "-".join(name for name in names if name), asked.film)
    wanted = (files.question,) if asked.question else (files.film, files.still)
    filming.check_free(*wanted, overwrite=asked.overwrite)
    env = source.task.environment(asked.task, "validation")
    policy = asked.policy_in(source, asked.task, env)
    if asked.question:
        filming.question(pictures, env, policy, asked.episode, files.question)
        out.print(f"wrote {files.question}")
        return
    rewards = filming.film(pictures, env, policy, asked.episode, asked.steps, files)
    out.print(f"rewards {' '.join(f'{reward:g}' for reward in rewards)}; wrote {files.film} and {files.still}")
