"""A run's folder: what may be done to it, and what is left in it."""

import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import folders, formats

DESCRIBED = {
    "format": formats.FORMATS["config"],
    "task": {"name": "window", "half_width_deg": 28.0},
    "scalars": {"eps_deg": 20.0, "k_max": 50},
    "grid": {"guidance": ["none", "relative"], "seeds": [4, 9]},
    "split": "tuning",
}


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


def test_a_run_may_be_resumed_or_overwritten_and_nothing_else(out):
    refused(out, "not empty: give --resume to go on, --overwrite to delete it")
    folders.check_folder(out, DESCRIBED, resume=True, overwrite=False)
    folders.check_folder(out, DESCRIBED, resume=False, overwrite=True)
    refused(out, "give one of them", resume=True, overwrite=True)


def test_what_is_no_run_is_neither_resumed_nor_deleted(tmp_path):
    refused(tmp_path, "nothing to resume", resume=True)
    (tmp_path / "photo.txt").write_text("mine")
    refused(tmp_path, "nothing to resume", resume=True)
    refused(tmp_path, "not a run folder, so --overwrite will not delete it", overwrite=True)
    refused(tmp_path / "photo.txt", "not a run folder, so --overwrite will not delete it", overwrite=True)
    refused(tmp_path / "photo.txt", "not empty")


def test_resuming_with_other_options_names_them(out):
    now = {**DESCRIBED, "scalars": {"eps_deg": 6.0}, "grid": {**DESCRIBED["grid"], "seeds": [4, 8]}, "shard": [1, 2]}
    named = r"was run with other values of seeds, scalars\.eps_deg, scalars\.k_max, shard: give the same options"
    refused(out, named, now, resume=True)
    moved = {**DESCRIBED, "task": {**DESCRIBED["task"], "from": "elsewhere:TASK"}}
    folders.check_folder(out, moved, resume=True, overwrite=False)


def test_a_clean_start_deletes_the_run_and_never_what_links_lead_to(out, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "photo.txt").write_text("mine")
    (out / "a").symlink_to(elsewhere)
    (out / "z").symlink_to(tmp_path / "nowhere")
    folders.prepare_folder(out, {**DESCRIBED, "split": "validation"}, clean=False)
    assert (out / "none" / "results.jsonl").exists()
    assert formats.read("config", out / "config.json") == DESCRIBED
    folders.prepare_folder(out, {**DESCRIBED, "split": "validation"}, clean=True)
    assert [path.name for path in out.iterdir()] == ["config.json"]
    assert formats.read("config", out / "config.json")["split"] == "validation"
    assert (elsewhere / "photo.txt").read_text() == "mine"


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
