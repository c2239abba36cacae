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
TRAIN = (
    "--policy.type=act --policy.push_to_hub=false --policy.device=cpu --policy.chunk_size=8 --policy.n_action_steps=5 "
    "--policy.dim_model=32 --policy.n_heads=2 --policy.dim_feedforward=32 --policy.n_encoder_layers=1 "
    "--policy.n_vae_encoder_layers=1 --policy.pretrained_backbone_weights=null --batch_size=4 --steps=20 "
    "--save_freq=20 --num_workers=0 --wandb.enable=false"
)
EVALUATE = "--env.type=pusht --env.episode_length=12 --eval.n_episodes=2 --eval.batch_size=1 --policy.device=cpu"
pytestmark = pytest.mark.skipif(not PYTHON, reason="LEROBOT_PYTHON names no Python with LeRobot")


def run(folder: Path, *command: str) -> str:
    """Run a command of LeRobot's environment; return its standard output."""
    env = {**os.environ, "HF_HUB_OFFLINE": "1", "SDL_VIDEODRIVER": "dummy", "OMP_NUM_THREADS": "1", "PYTHONPATH": ""}
    program = str(Path(PYTHON).with_name(command[0])) if command[0].startswith("lerobot") else PYTHON
    arguments = command[1:] if command[0].startswith("lerobot") else command
    done = subprocess.run([program, *arguments], cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def answer_all(arguments: list[str], out: Path) -> None:
    """Answer the page's questions by a script that knows how far the action is off."""
    ahead = look_ahead_of(arguments, "label", label.LabelOptions)
    task = recorded_or_task(ahead)
    _, preset = preset_of(task, None)
    options = parse(label.LabelOptions, arguments, "label", label._defaults(task, preset, None, ahead, None))
    with Session(label.make_plan(task, preset.config, options), out) as session:
        space = session.questions.space
        while (item := session.item) is not None:
            best = np.asarray(item.guide.obs)[-2:] + MOVED
            share = (best - item.action) / np.subtract(space.high, space.low)
            session.answer(item.number, np.where(np.abs(share) < 1 / 72, 0.0, np.sign(share)).astype(np.float32))
        session.finish()


def test_a_checkpoint_is_corrected_by_labels_and_evaluated_by_lerobot(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(tmp_path, str(HERE / "record.py"), "data")
    run(tmp_path, "lerobot-train", "--dataset.repo_id=tiny", "--dataset.root=data", "--output_dir=act", *TRAIN.split())
    checkpoint = "act/checkpoints/last/pretrained_model"
    write = ["--policy", checkpoint, "--dataset", "data", "--out", "situations", "--count", "60"]
    run(tmp_path, "-m", "lerobot_processor_cuelearner", "situations", *write)
    answer_all(["situations", "--cues", "left,right;up,down", "--labels", "60", "--out", "labels"], Path("labels"))
    assert main(["adapt", "--labels-from", "labels", "--out", "corrected"]) == 0
    export = ["export", "corrected", "--format", "lerobot", "--policy", checkpoint]
    assert main([*export, "--out", "checkpoint"]) == 0
    played = run(tmp_path, str(HERE / "play.py"), checkpoint, "checkpoint", "data").splitlines()[-1]
    found = json.loads(played)
    np.testing.assert_allclose(found["moves"], np.tile(MOVED, (12, 1)), atol=10)
    np.testing.assert_allclose(found["chunk"], np.tile(MOVED, (3, 1)), atol=10)
    assert found["places"] == [0, 1, 2, 3, 4, 0, 1, 0, 1, 2, 3, 4]  # a reset in the middle of a chunk
    assert found["added_ms"] < 1.0
    run(tmp_path, "lerobot-eval", "--policy.path=checkpoint", "--output_dir=evaluated", *EVALUATE.split())
    assert main([*export[:-1], "checkpoint", "--out", "twice"]) == 2
    assert "holds a correction already" in capsys.readouterr().err
