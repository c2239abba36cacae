"""Arms that learn to reach, push (with and without a post) and pick from scratch, with labels and without.

    python experiments/arms.py --list
    python experiments/arms.py --scale smoke --out FOLDER --resume       # everything in seconds a piece, on a CPU
    python experiments/arms.py --out FOLDER --pieces push --resume       # on an accelerator

A piece is a sweep with a folder of its own. Every method trains the same `sac`. In `stored` each label corrects the
step that is executed, and these steps are half of every minibatch; with demonstrations this is RLPD (Ball et al.,
2023). `rlpd` fits a policy to as many demonstrations; half of all episodes and of every minibatch are that policy's.

After the pieces, or alone with --report, there is a report of each world (FOLDER/push/report): curves of success, the
steps to 80%, and the ratio to the steps of the agent alone.
"""

from __future__ import annotations

from functools import partial

from _pieces import SMOKE, Experiment, Options, Piece, Scale, run

SEEDS, BUDGETS = 8, (100, 500)


def steps(total: int, every: int) -> Options:
    """Return options for a number of training steps and an interval between evaluations."""
    return {
        "preset": "paper",
        "schedule.total-steps": total,
        "schedule.guidance-until": total,
        "schedule.eval-every": every,
        "schedule.checkpoint-every": total // 4,
        "agent.replay-capacity": total,
        "arbiter": "episodes",
    }


WORLDS: dict[str, Options] = {
    "reach": {**steps(32_000, 1_600), "task.skill": "reach"},
    "push": {**steps(480_000, 24_000), "task.skill": "push"},
    "push_free": {**steps(480_000, 24_000), "task.skill": "push", "task.obstacle": False},
    "pick": {**steps(480_000, 24_000), "task.skill": "pick"},
}
STORED: Options = {"preset": "corrected"}
RANDOM: Options = {**STORED, "scalars.mistake-probability": 0.5}
ENSEMBLE: Options = {"agent.critics": 10}


def variants(world: str) -> list[Piece]:
    """Return the variants compared in one world."""
    rows: list[tuple[str, str, tuple[int, ...], Options]] = [
        ("alone", "none", (), {}),
        ("alone_10", "none", (), ENSEMBLE),
        ("stored", "relative", BUDGETS, STORED),
        ("stored", "demonstration", BUDGETS, STORED),
        ("stored_random", "relative", (500,), RANDOM),  # control: answers at random
        ("rlpd", "demonstration", BUDGETS, ENSEMBLE),
    ]
    return [
        Piece(world, run, kind, (kind,), labels, SEEDS, {**WORLDS[world], **own}) for run, kind, labels, own in rows
    ]


PIECES = tuple(piece for world in WORLDS for piece in variants(world))
SCALES = {
    "paper": Scale("minutes to hours a piece on an accelerator"),
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=1,
        labels={100: 10, 500: 20},
        options={
            **SMOKE,
            "agent.actor-layers": 8,
            "agent.critic-layers": 8,
            "agent.batch-size": 8,
            "agent.replay-capacity": 160,
            "schedule.total-steps": 160,
            "schedule.guidance-until": 160,
            "schedule.eval-every": 160,
            "schedule.random-steps": 32,
            "schedule.learn-after": 32,
            "schedule.checkpoint-every": 160,
            "schedule.eval-envs": 2,
        },
        instead={"agent.critics": 3},
    ),
}
EXPERIMENT = Experiment("arm", PIECES, SCALES, report={}, metric=("--metric", "success", "--level", "0.8"))
main = partial(run, EXPERIMENT, __doc__ or "")


if __name__ == "__main__":
    raise SystemExit(main())
