"""`cuelearner export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import about, out, parse, source_of, taken, world_of
from cuelearner_jax.cli.shared_options import TaskT
from cuelearner_jax.config import digest, to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import contract, decisions
from cuelearner_jax.export.formats import FORMATS
from cuelearner_jax.runs import trained


@dataclass(frozen=True)
class Export(Generic[TaskT]):
    """A policy as a file for a robot, with a contract of what goes in and comes out; --check FOLDER replays one."""

    task: TaskT
    format: str
    """stablehlo, onnx or numpy, see above."""
    out: Path
    """Folder for the decision; it must not be there yet, or be empty."""
    policy: str = "agent"
    """Who acts, see above; it may not act at random nor ask a teacher."""
    guidance: str | None = None
    """Kind of guidance of the run (default: its last)."""
    labels: int | None = None
    """Label budget of the lane (default: the largest)."""
    bound_deg: float | None = None
    """Bound of a policy folder's lane (default: the largest) [deg]."""
    seed: int | None = None
    """Seed of the lane (default: the first)."""
    scenario: str | None = None
    """The changed world of this name, see above, whose observations the golden cases are; options of the task
    (--task.…) come on top of it."""


OPTIONS = {"export": Export}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be exported, or does not hold its contract."""
    folder, rest = taken(arguments, "--check", "the folders that were exported")
    if folder is not None:
        if rest:
            raise UserError(f"--check takes a folder and nothing else: leave out {rest[0]}")
        _check(Path(folder))
        return
    source, rest = source_of(arguments, "export", Export)
    kind = Export[source.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(world_of(source, rest), "stablehlo", Path("exported"), source.default_policy)
    formats = "formats (--format):\n" + "\n".join(f"  {name:<11}{one.about}" for name, one in FORMATS.items())
    told = f"{about(Export, source.task, policies=True)}\n\n{formats}"
    asked = parse(kind, rest, f"export {source.folder}", default, told)
    lane = {"guidance": asked.guidance, "labels": asked.labels, "seed": asked.seed, "bound-deg": asked.bound_deg}
    source.check(asked.policy, asked.task, **lane)
    if trained.POLICIES[asked.policy].taught:
        raise UserError(f"policy {asked.policy!r} asks the teacher, who looks at the true state: choose another policy")
    contract.check_request(asked.format, asked.out)
    env = source.task.environment(asked.task)
    policy = trained.one_policy(
        source, asked.task, asked.policy, asked.guidance, asked.labels, asked.seed, asked.bound_deg, env
    )
    written = contract.write(
        policy,
        env,
        lambda: decisions.observations(env, policy),
        asked.format,
        asked.out,
        {
            "subject": source.folder.name,
            "policy": asked.policy,
            **{name.replace("-", "_"): value for name, value in lane.items() if value is not None},
            "world": {"name": source.task.name, **to_json(asked.task)},
            "config": digest(to_json(source.config)),
        },
    )
    golden = written["golden"]
    out.print(
        f"{golden['cases']} golden cases replayed, largest difference {written['difference']:.1e} "
        f"({golden['steady']} of {golden['drawn']} decisions do not hang on the last digits); wrote {asked.out}"
    )


def _check(folder: Path) -> None:
    difference = contract.checked(folder)
    if others := contract.unlisted(folder):
        out.print(f"{folder} also holds what its contract does not list: {', '.join(others)}")
    out.print(f"{folder} is as it was exported; golden cases replayed, largest difference {difference:.1e}")
