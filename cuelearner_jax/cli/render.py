"""`cuelearner render`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import about, out, parse, source_of, world_of
from cuelearner_jax.cli.shared_options import Flag, TaskT
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import filming, trained


@dataclass(frozen=True)
class Render(Generic[TaskT]):
    """A still and a film of a policy at work, or the picture of a question."""

    task: TaskT
    out: Path
    """Folder for the pictures; films and stills of the same name are not overwritten."""
    policy: str = "agent"
    """Who acts, see above."""
    guidance: str | None = None
    """Kind of guidance of the run (default: its last)."""
    labels: int | None = None
    """Label budget of the lane (default: the largest)."""
    bound_deg: float | None = None
    """Bound of a policy folder's lane (default: the largest) [deg]."""
    seed: int | None = None
    """Seed of the lane (default: the first)."""
    steps: int = 4
    """Steps to film; a new episode follows the end of one."""
    episode: int = 0
    """Which random start."""
    robot: str | None = None
    """Another robot, see above (default: the task's own); with a folder, as anymal:FOLDER, one with your own walking
    policy."""
    scenario: str | None = None
    """The changed world of this name, see above; options of the task (--task.…) come on top of it."""
    question: Flag[bool] = False
    """Instead: the situation that the episode begins with and the policy's action, as a person is asked about it."""
    film: str = "gif"
    """gif or mp4."""
    overwrite: Flag[bool] = False
    """Replace pictures of the same name."""


MOST_STEPS = 100_000  # a frame each
MOST_EPISODE = 2**32 - 1  # is folded into a key

OPTIONS = {"render": Render}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be drawn."""
    source, rest = source_of(arguments, "render", Render)
    kind = Render[source.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(world_of(source, rest), Path("pictures"), policy=source.default_policy)
    asked = parse(kind, rest, f"render {source.folder}", default, about(Render, source.task, policies=True))
    source = source.on(asked.robot)
    pictures = source.task.pictures()
    lane = {"guidance": asked.guidance, "labels": asked.labels, "seed": asked.seed, "bound-deg": asked.bound_deg}
    source.check(asked.policy, asked.task, **lane)
    for name, least, most in (("steps", 1, MOST_STEPS), ("episode", 0, MOST_EPISODE)):
        if not least <= getattr(asked, name) <= most:
            raise UserError(f"--{name} is {getattr(asked, name)}: give a number from {least} to {most:,}")
    robot = "-".join(part for part in re.split(r"[^\w.-]+", asked.robot or "") if part.strip("."))
    names = [source.folder.name, robot, asked.scenario, asked.policy]
    files = filming.files(asked.out, "-".join(name for name in names if name), asked.film)
    wanted = (files.question,) if asked.question else (files.film, files.still)
    filming.check_free(*wanted, overwrite=asked.overwrite)
    env = source.task.environment(asked.task, "validation")
    policy = trained.one_policy(
        source, asked.task, asked.policy, asked.guidance, asked.labels, asked.seed, asked.bound_deg, env
    )
    if asked.question:
        filming.question(pictures, env, policy, asked.episode, files.question)
        out.print(f"wrote {files.question}")
        return
    rewards = filming.film(pictures, env, policy, asked.episode, asked.steps, files)
    out.print(f"rewards {' '.join(f'{reward:g}' for reward in rewards)}; wrote {files.film} and {files.still}")
