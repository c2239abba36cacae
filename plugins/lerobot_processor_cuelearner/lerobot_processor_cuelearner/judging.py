"""Whether a corrected checkpoint is better: a sequential test of the same episodes in two evaluations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

STAKES = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9)  # of the test's bets, as shares of its capital
DECIDED = 20.0  # capital that decides: each verdict is wrong once in 20 times at most, however often one looks


def judge(before: Path, after: Path) -> str:
    """Return in one line which of two folders of `lerobot-eval` has the better policy.

    Raises:
        SystemExit: a folder has no results, or the two do not hold the same tasks and numbers of episodes.
    """
    pair = [_successes(folder) for folder in (before, after)]
    sizes = [{task: len(each) for task, each in one.items()} for one in pair]
    if sizes[0] != sizes[1]:
        raise SystemExit(f"{before} and {after} hold other tasks or numbers of episodes: evaluate both alike")
    each = [[b - a for a, b in zip(pair[0][task], pair[1][task], strict=True)] for task in pair[0]]
    rounds = [[win for win in wins if win is not None] for wins in zip_longest(*each)]  # an episode of each task
    verdict, episodes = decide([sum(wins) / len(wins) for wins in rounds])
    rates = [sum(map(sum, one.values())) / sum(map(len, each)) for one in pair]
    what = f"{verdict} after {episodes} of {len(rounds)} pairs of episodes" + " of each task" * (len(each) > 1)
    return f"{what}: success {rates[0]:.2f} -> {rates[1]:.2f}"


def decide(wins: Sequence[float]) -> tuple[str, int]:
    """Return the verdict over differences of success (-1 to 1) in their order, and after how many it stood."""
    better, worse = [1.0] * len(STAKES), [1.0] * len(STAKES)
    for number, win in enumerate(wins, 1):
        better = [product * (1 + stake * win) for product, stake in zip(better, STAKES, strict=True)]
        worse = [product * (1 - stake * win) for product, stake in zip(worse, STAKES, strict=True)]
        if sum(better) >= DECIDED * len(STAKES):
            return "better", number
        if sum(worse) >= DECIDED * len(STAKES):
            return "worse", number
    return "not told apart", len(wins)


def _successes(folder: Path) -> dict[str, list[bool]]:
    try:
        tasks = json.loads((folder / "eval_info.json").read_text())["per_task"]
        return {f"{task['task_group']} {task['task_id']}": task["metrics"]["successes"] for task in tasks}
    except (OSError, ValueError, KeyError) as error:
        raise SystemExit(f"{folder} holds no results of lerobot-eval: {error}") from None
