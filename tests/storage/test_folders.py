"""A run's folder: what may be done to it, and what is left in it."""

import json

import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import folders, formats
from cuelearner_jax.storage.formats import FORMATS

DESCRIBED = {
    "format": FORMATS["config"],
    "task": {"name": "window", "half_width_deg": 28.0},
    "agent": {"directions": 16, "batch_size": 32, "q_layers": [32, 32]},
    "scalars": {"eps_deg": 20.0, "k_max": 50},
    "grid": {"guidance": ["none", "relative"], "seeds": [4, 9]},
    "split": "tuning",
}


def described(**parts):
    """`DESCRIBED` with other values."""
    changed = {name: {**DESCRIBED[name], **new} if isinstance(new, dict) else new for name, new in parts.items()}
    return {**DESCRIBED, **changed}


@pytest.fixture
def out(tmp_path):
    """The folder of an interrupted run."""
    folder = tmp_path / "run"
    folders.prepare_folder(folder, DESCRIBED, clean=False)
    (folder / "none").mkdir()
    (folder / "none" / "results.jsonl").write_text("{}\n")
    return folder


def refused(folder, message, now=DESCRIBED, resume=False, overwrite=False):
    """`check_folder` refuses with `message` and changes nothing."""
    looked_at = folder if folder.is_dir() else folder.parent
    before = probes.files_of(looked_at)
    with pytest.raises(UserError, match=message) as refusal:
        folders.check_folder(folder, now, resume, overwrite)
    assert "\n" not in str(refusal.value)
    assert probes.files_of(looked_at) == before


def test_a_missing_or_empty_folder_may_be_used(tmp_path):
    folders.check_folder(tmp_path, DESCRIBED, resume=False, overwrite=False)
    for overwrite in (False, True):
        folders.check_folder(tmp_path / "new", DESCRIBED, resume=False, overwrite=overwrite)
    assert list(tmp_path.iterdir()) == []


def test_a_run_may_be_resumed_or_overwritten_and_nothing_else(out):
    refused(out, "not empty: give --resume to go on, --overwrite to delete it")
    folders.check_folder(out, DESCRIBED, resume=True, overwrite=False)
    folders.check_folder(out, DESCRIBED, resume=False, overwrite=True)
    refused(out, "give one of them", resume=True, overwrite=True)


def test_nothing_to_resume(tmp_path):
    refused(tmp_path / "new", "nothing to resume", resume=True)
    refused(tmp_path, "nothing to resume", resume=True)
    (tmp_path / "photo.txt").write_text("mine")
    refused(tmp_path, "nothing to resume", resume=True)


def test_overwriting_never_deletes_what_is_no_run(tmp_path):
    (tmp_path / "photo.txt").write_text("mine")
    refused(tmp_path, "not a run folder, so --overwrite will not delete it", overwrite=True)
    refused(tmp_path / "photo.txt", "not a run folder, so --overwrite will not delete it", overwrite=True)
    refused(tmp_path / "photo.txt", "not empty")


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("agent.directions", described(agent={"directions": 32})),
        ("agent.q_layers", described(agent={"q_layers": [32]})),
        ("scalars.eps_deg", described(scalars={"eps_deg": 6.0})),
        ("grid.seeds", described(grid={"seeds": [4, 8]})),
        ("split", described(split="validation")),
        ("task.name", described(task={"name": "another"})),
        ("shard", described(shard=[1, 2])),
    ],
)
def test_resuming_with_another_option_names_it(out, name, other):
    refused(out, rf"was run with other values of {name}: give the same options", other, resume=True)


def test_resuming_names_several_options_and_those_that_only_one_side_has(out):
    other = described(scalars={"k_max": 3}, agent={"directions": 32, "batch_size": 8})
    refused(out, r"other values of agent\.batch_size, agent\.directions, scalars\.k_max: give", other, resume=True)
    refused(out, r"other values of scalars\.k_max: give", {**DESCRIBED, "scalars": {"eps_deg": 20.0}}, resume=True)
    refused(out, r"other values of scalars\.more: give", described(scalars={"more": 1}), resume=True)


def test_what_a_description_does_not_say_counts_as_the_default():
    defaults = {"scalars": {"answer": "best", "silence": 0.0}, "agent": {"frame": "raw"}}

    def apart(before, now):
        forth, back = (sorted(folders.differences(*pair, defaults)) for pair in ((before, now), (now, before)))
        assert forth == back
        return forth

    newer = described(scalars={"answer": "best", "silence": 0.0}, agent={"frame": "raw"})
    assert apart(DESCRIBED, newer) == []
    assert apart(DESCRIBED, described(scalars={"answer": "nearest"}, agent={"frame": "raw"})) == ["scalars.answer"]
    assert apart(DESCRIBED, described(agent={"frame": "action", "more": 1})) == ["agent.frame", "agent.more"]
    assert apart({"split": "tuning"}, {"split": "tuning", "sizes": {"frame": "raw"}}) == ["sizes"]


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[]", b"3", b"null", b"{}"])
def test_resuming_from_a_damaged_description_is_refused(out, content):
    (out / "config.json").write_bytes(content)
    refused(out, r"config\.json is damaged.*: restore it, or start anew with --overwrite", resume=True)
    folders.check_folder(out, DESCRIBED, resume=False, overwrite=True)  # as the message says


def test_a_clean_start_deletes_the_run_and_any_other_keeps_it(out):
    folders.prepare_folder(out, described(split="validation"), clean=False)
    assert (out / "none" / "results.jsonl").exists()
    assert formats.read("config", out / "config.json") == DESCRIBED
    folders.prepare_folder(out, described(split="validation"), clean=True)
    assert [path.name for path in out.iterdir()] == ["config.json"]
    assert json.loads((out / "config.json").read_text())["split"] == "validation"


def test_a_folder_inside_folders_is_made(tmp_path):
    folders.prepare_folder(tmp_path / "a" / "b", DESCRIBED, clean=True)
    assert formats.read("config", tmp_path / "a" / "b" / "config.json") == DESCRIBED


def test_a_folder_is_kept_for_one_process_and_free_afterwards(tmp_path):
    out = tmp_path / "a" / "run"
    with folders.claimed(out):
        with pytest.raises(UserError, match="is being written by another process"), folders.claimed(out):
            pass
        assert not folders.in_use(out)  # but for the lock
        folders.prepare_folder(out, DESCRIBED, clean=True)
        assert folders.in_use(out)
    assert [path.name for path in out.iterdir()] == ["config.json"]


def test_what_a_kill_leaves_before_the_first_word_stands_in_nobodys_way(tmp_path):
    (tmp_path / ".config.json.12-34.tmp").write_text('{"task": {"na')
    (tmp_path / folders.LOCK).write_text("process 1 on another")
    folders.check_folder(tmp_path, DESCRIBED, resume=False, overwrite=False)
    folders.prepare_folder(tmp_path, DESCRIBED, clean=False)
    folders.check_folder(tmp_path, DESCRIBED, resume=True, overwrite=False)


def test_a_clean_start_removes_links_and_never_what_they_lead_to(out, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "photo.txt").write_text("mine")
    (out / "a").symlink_to(elsewhere)
    (out / "z").symlink_to(tmp_path / "nowhere")
    folders.prepare_folder(out, DESCRIBED, clean=True)
    assert [path.name for path in out.iterdir()] == ["config.json"]
    assert (elsewhere / "photo.txt").read_text() == "mine"


def test_a_clean_start_that_is_cut_short_can_be_made_again(out, monkeypatch):
    def killed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(folders.shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        folders.prepare_folder(out, DESCRIBED, clean=True)
    folders.check_folder(out, DESCRIBED, resume=False, overwrite=True)
