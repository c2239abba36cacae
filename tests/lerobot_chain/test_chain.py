"""The chain by LeRobot's own commands: train, situations, labels, adapt, export, evaluate (`make test-lerobot`)."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cuelearner_jax.cli import label, main
from cuelearner_jax.cli.options import look_ahead_of, parse
from cuelearner_jax.cli.sources import preset_of, recorded_or_task
from cuelearner_jax.labelling.session import Session

HERE = Path(__file__).parent
PYTHON = os.environ.get("LEROBOT_PYTHON", "")  # a Python with LeRobot 0.6.1 and plugins/lerobot_processor_cuelearner
MOVED = np.array([40.0, -20.0])  # the executed action is this far off [pixels]
HAND_MOVED = np.array([0.0, 0.03, -0.02])  # so is the hand of an arm [m]
MJCF = HERE.parent / "export/arm.xml"
TRAIN = (
    "--policy.type=act --policy.push_to_hub=false --policy.device=cpu --policy.chunk_size=8 --policy.n_action_steps=5 "
    "--policy.dim_model=32 --policy.n_heads=2 --policy.dim_feedforward=32 --policy.n_encoder_layers=1 "
    "--policy.n_vae_encoder_layers=1 --policy.pretrained_backbone_weights=null --batch_size=4 --steps=20 "
    "--save_freq=20 --num_workers=0 --wandb.enable=false"
)
EVALUATE = "--env.type=pusht --env.episode_length=12 --eval.n_episodes=2 --eval.batch_size=1 --policy.device=cpu"
pytestmark = pytest.mark.skipif(not PYTHON, reason="LEROBOT_PYTHON names no Python with LeRobot")


def run(folder: Path, *command: str, refused: bool = False) -> str:
    """Run a command of LeRobot's environment; return its standard output, or why it is refused."""
    env = {**os.environ, "HF_HUB_OFFLINE": "1", "SDL_VIDEODRIVER": "dummy", "OMP_NUM_THREADS": "1", "PYTHONPATH": ""}
    program = str(Path(PYTHON).with_name(command[0])) if command[0].startswith("lerobot") else PYTHON
    arguments = command[1:] if command[0].startswith("lerobot") else command
    done = subprocess.run([program, *arguments], cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == refused, done.stderr[-3000:]
    return done.stderr.splitlines()[-1] if refused else done.stdout


def answer_all(arguments: list[str], out: Path, moved: np.ndarray = MOVED) -> list[str]:
    """Answer the page's questions by a script that knows how far the action is off; return the drawn trails."""
    ahead = look_ahead_of(arguments, "label", label.LabelOptions)
    task = recorded_or_task(ahead)
    _, preset = preset_of(task, None)
    options = parse(label.LabelOptions, arguments, "label", label._defaults(task, preset, None, ahead, None))
    trails = []
    with Session(label.make_plan(task, preset.config, options), out) as session:
        space = session.questions.space
        while (item := session.item) is not None:
            trails.append((item.trails or {}).get("asked", ""))
            best = np.asarray(item.guide.obs)[-len(moved) :] + moved
            share = (best - item.action) / np.subtract(space.high, space.low)
            session.answer(item.number, np.where(np.abs(share) < 1 / 72, 0.0, np.sign(share)).astype(np.float32))
        session.finish()
    return trails


def checkpoint_of(folder: Path, *arguments: str) -> str:
    """Record a dataset and train a policy; return its checkpoint."""
    run(folder, str(HERE / "record.py"), "data", *arguments)
    run(folder, "lerobot-train", "--dataset.repo_id=tiny", "--dataset.root=data", "--output_dir=act", *TRAIN.split())
    return "act/checkpoints/last/pretrained_model"


def test_a_checkpoint_is_corrected_by_labels_and_evaluated_by_lerobot(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    checkpoint = checkpoint_of(tmp_path)
    write = ["--policy", checkpoint, "--dataset", "data", "--out", "situations", "--count", "200", "--first", "15"]
    assert "wrote 60 situations" in run(tmp_path, "-m", "lerobot_processor_cuelearner", "situations", *write)
    answer_all(["situations", "--cues", "left,right;up,down", "--labels", "60", "--out", "labels"], Path("labels"))
    assert main(["adapt", "--labels-from", "labels", "--out", "corrected"]) == 0
    export = ["export", "corrected", "--format", "lerobot", "--policy", checkpoint]
    assert main([*export, "--out", "checkpoint"]) == 0
    plays = json.loads(run(tmp_path, str(HERE / "play.py"), checkpoint, "checkpoint", "data").splitlines()[-1])
    np.testing.assert_allclose(plays["moves"], np.tile(MOVED, (12, 1)), atol=10)
    np.testing.assert_allclose(plays["chunk"], np.tile(MOVED, (3, 1)), atol=10)
    assert plays["places"] == [0, 1, 2, 3, 4, 0, 1, 0, 1, 2, 3, 4]  # a reset in the middle of a chunk
    assert plays["added_ms"] < 1.0
    run(tmp_path, "lerobot-eval", "--policy.path=checkpoint", "--output_dir=evaluated", *EVALUATE.split())
    assert main([*export[:-1], "checkpoint", "--out", "twice"]) == 2
    again = ["-m", "lerobot_processor_cuelearner", "situations", "--policy", "checkpoint", *write[2:5], "again"]
    for said in (capsys.readouterr().err, run(tmp_path, *again, refused=True)):
        assert "holds a correction already" in said


def test_pictures_of_a_camera_that_moved_are_moved_back_without_labels(tmp_path):
    checkpoint = checkpoint_of(tmp_path)
    run(tmp_path, str(HERE / "record.py"), "later", "moved")
    camera = ["-m", "lerobot_processor_cuelearner", "camera", "--before", "data", "--policy"]
    line = run(tmp_path, *camera, checkpoint, "--after", "later", "--out", "back")
    assert line.startswith("observation.image: the picture moved by 7.3% to the right and 3.")
    steps = json.loads((tmp_path / "back/policy_preprocessor.json").read_text())["steps"]
    (step,) = [one for one in steps if one.get("class")]
    places = step["config"]["places"]["observation.image"]
    np.testing.assert_allclose(places, [[1, 0, 14 / 96], [0, 1, 6 / 96]], atol=4e-3)
    run(tmp_path, "lerobot-eval", "--policy.path=back", "--output_dir=evaluated", *EVALUATE.split())
    for policy, after, message in (
        (checkpoint, "data", "no camera moved between data and data"),
        ("back", "later", "back moves its pictures already: give the checkpoint that it was made from"),
    ):
        assert run(tmp_path, *camera, policy, "--after", after, "--out", "no", refused=True) == message


def test_the_hand_of_an_arm_is_corrected_where_people_think(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checkpoint = checkpoint_of(tmp_path, str(MJCF))
    write = ["--policy", checkpoint, "--dataset", "data", "--out", "situations", "--count", "60"]
    arm = ["--mjcf", str(MJCF), "--site", "grip", "--joints", "pan,lift,elbow,turn,flex,roll"]
    write += [*arm, "--joint-unit", "degrees", "--projection", "image=camera.json"]
    run(tmp_path, "-m", "lerobot_processor_cuelearner", "situations", *write)
    cues = "forward,back;left,right;up,down"
    trails = answer_all(["situations", "--cues", cues, "--labels", "60", "--out", "labels"], Path("labels"), HAND_MOVED)
    assert all('class="arrow motion"' in trail for trail in trails)
    assert main(["adapt", "--labels-from", "labels", "--out", "corrected"]) == 0
    assert main(["export", "corrected", "--format", "lerobot", "--policy", checkpoint, "--out", "checkpoint"]) == 0
    plays = json.loads(run(tmp_path, str(HERE / "play.py"), checkpoint, "checkpoint", "data").splitlines()[-1])
    print(f"added time an action: {plays['added_ms']:.2f} ms")
    for moves in (plays["moves"], plays["chunk"]):
        np.testing.assert_allclose(np.array(moves)[:, :3], np.tile(HAND_MOVED, (len(moves), 1)), atol=0.006)
        assert np.array(moves)[:, 3].tolist() == [0.0] * len(moves)
