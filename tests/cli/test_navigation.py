"""The second task through the same commands: measured by whole episodes, in worlds of any style."""

WORLDS = ["--task.worlds", "8", "--task.max-steps"]
EVALUATE = ["evaluate", "navigation", "--policy", "uniform", *WORLDS, "20"]


def test_an_evaluation_of_the_short_episodes_alone_is_refused(refused, tmp_path):
    short = "steps is 1200 for 120 environments, 10 each, but an episode lasts up to 20: give steps 2400"
    refused([*EVALUATE, "--steps", "1200", "--envs", "120"], short, tmp_path)
    refused([*EVALUATE, "--steps", "10000", "--task.max-steps", "200"], "give steps 20000", tmp_path)
    refused([*EVALUATE, "--episodes", "12", "--envs", "12"], "leave out steps and envs", tmp_path)
    refused([*EVALUATE, "--episodes", "0"], "episodes is 0: give at least 1", tmp_path)
    refused(["evaluate", "billiards", "--episodes", "3"], "billiards counts steps, not episodes", tmp_path)
    few = ["--schedule.eval-envs", "10", "--schedule.eval-steps", "200"]
    sweep = ["sweep", "navigation", "--preset", "quickstart", *few, "--out", tmp_path / "none"]
    refused([*sweep, *WORLDS, "21"], "an episode lasts up to 21: give --schedule.eval-steps 210", tmp_path)
    refused([*sweep, "--task.worlds", "0"], "task.worlds is 0: give a number from 1", tmp_path)
