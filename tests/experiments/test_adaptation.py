"""The study of adaptation: every piece is a command with options that exist, and is gone on with."""

import adaptation as study
import pytest
from _pieces import scaled

from cuelearner_jax.cli import adapt, main
from cuelearner_jax.errors import UserError
from cuelearner_jax.tasks import registry

AGENTS = {"navigation": "shipped:navigation", "billiards": "shipped:billiards"}


def bases(folder, task):
    """Write the seeds of a task's base agents."""
    (folder / task / "bases/none").mkdir(parents=True)
    (folder / task / "bases/none/config.json").write_text('{"grid": {"seeds": [5000, 5001]}}')


def corrections(scale, folder):
    """Every piece that asks, with its command line, of agents that are at hand."""
    for task in AGENTS:
        bases(folder, task)
    for piece in study.PIECES:
        own = scaled(piece, study.SCALES[scale])
        if own is not None and own.labels:
            command = study.commands("", own, folder, False)[0]
            yield own, [AGENTS[piece.world] if word.endswith("/bases/none") else word for word in command]


def test_every_piece_acts_in_a_world_of_its_task():
    assert len({piece.path for piece in study.PIECES}) == len(study.PIECES)
    for piece in study.PIECES:
        assert piece.run in (*registry.find(piece.world).scenarios, study.BASES, study.UNCHANGED)


@pytest.mark.parametrize("scale", ["smoke", pytest.param("paper", marks=pytest.mark.long)])
def test_every_correction_has_options_that_exist(scale, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    worlds = []

    def subject_of(source, world, *_):
        worlds.append(world)
        raise UserError("all options are read")

    monkeypatch.setattr(adapt, "subject_of", subject_of)
    commands = [command for _, command in corrections(scale, tmp_path)][:: 3 if scale == "smoke" else 1]
    for command in commands:
        main(command)
    assert len(worlds) == len(commands)
