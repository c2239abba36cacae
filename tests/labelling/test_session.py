"""A session of labelling: nothing is lost or doubled, and its first round is that of a simulated teacher."""

import errno
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import page_task
import probes
import pytest
from sessions import ENV, expert, give, plan, settled, taught

from cuelearner_jax import asking
from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling import comparing
from cuelearner_jax.labelling.plan import Base, keys_of
from cuelearner_jax.labelling.session import Session
from cuelearner_jax.policies import Opaque, Uniform
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import JSONL, PARQUET


def lines(folder):
    return (folder / JSONL).read_bytes().count(b"\n") - 1  # without the head


def test_an_answer_is_on_the_disk_before_the_next_question_and_said_twice_counts_once(opened, tmp_path):
    session = opened()
    folder = tmp_path / "labels"
    for number in range(5):
        item = session.item
        assert item.number == number == lines(folder)
        told = [0.0, 1000.0, -1.0, math.nan, 0.0][number]  # by a browser: no time that cannot be
        assert session.answer(number, expert(item), seconds=told)
        assert lines(folder) == number + 1
        assert not session.answer(number, expert(item))  # a key that repeats, a second page, a message sent again
        assert lines(folder) == number + 1
        row = label_files.history(folder / JSONL)[-1]
        np.testing.assert_array_equal(np.float32(row["obs"]), item.guide.obs)
        np.testing.assert_array_equal(np.float32(row["action"]), item.action)
        assert (row["item"], row["said"], row["answer"], row["who"]) == (number, "answer", [*expert(item)], "anonymous")
        assert (0 <= row["seconds"] < 900, row["seed"]) == (True, 0)
        assert number not in (0, 4) or row["seconds"] == 0.0
    assert not session.answer(7, np.zeros(1))  # not asked yet
    assert lines(folder) == 5


def test_the_first_round_is_that_of_a_simulated_teacher(opened, tmp_path):
    session = opened()
    give(session, 10)
    status = settled(session, fits=1)
    guidance, guide, after = taught("relative")
    file = label_files.read(tmp_path / "labels")
    for name in ("obs", "action", "answer"):
        np.testing.assert_allclose(getattr(file.labels, name), getattr(after.labels, name)[:10], atol=1e-6)
    # The same labels and the same step of the same stream, though the fit after the first has another number there.
    inputs = guidance, ENV, probes.SCALARS, guide.replace(labels=after.labels), keys_of(0).session, jnp.asarray(1)
    chex.assert_trees_all_close(status.newest.model, jax.jit(asking.fit, static_argnums=0)(*inputs).model, atol=1e-4)
    assert (status.newest.labels, status.newest.number, status.newest.quality.count) == (10, 1, 2)


def test_later_questions_are_refined_by_the_newest_model(opened):
    session = opened()
    give(session, 10)
    newest = settled(session, fits=1).newest
    prepared = session.number + 1  # the question on the screen and the one ready ahead were asked before the fit
    give(session, 2)
    item = session.item
    assert item.number == prepared + 1
    base = Uniform().act(asking.question_keys(keys_of(0).session, item.number).base, None, item.guide.obs[None])
    act = jax.jit(session.plan.guidance.act)
    refined = act(newest.model, ENV, item.guide.obs[None], base, jnp.ones(1, bool), probes.SCALARS).actions[0]
    np.testing.assert_allclose(item.action, refined, atol=1e-5)
    assert np.abs(item.action - base[0]).max() > 0.01
    assert item.refined is not None


def test_not_knowing_counts_for_nothing_and_an_answer_can_be_taken_back(opened, tmp_path):
    session = opened()
    give(session, 2)
    assert session.answer(2, None)
    assert (session.status().answered, session.status().unsure, session.number) == (2, 1, 3)
    seen = session.item
    assert session.undo(3)
    assert not session.undo(3)
    assert session.number == 2
    assert session.undo(2)
    assert session.status().answered == 1
    again = session.item
    assert again.number == 1
    assert session.answer(1, -expert(again) + 1.0 if expert(again)[0] == 0 else -expert(again))
    assert session.answer(2, np.ones(1))
    np.testing.assert_array_equal(session.item.action, seen.action)
    np.testing.assert_array_equal(session.item.guide.obs, seen.guide.obs)
    file = label_files.read(tmp_path / "labels")
    assert file.people.item.tolist() == [0, 1, 2]
    assert file.labels.answer[2, 0] == 1.0
    assert file.labels.answer[1, 0] != expert(again)[0]
    assert file.counts == {"answer": 4, "unsure": 1, "undone": 2}
    assert not opened("first").undo(0)
    assert lines(tmp_path / "first") == 0


def test_a_session_opened_again_goes_on_where_it_stopped(opened, tmp_path):
    session = opened()
    give(session, 11)
    session.undo(11)
    before, _ = session.item, session.close()
    again = opened()
    assert again.item.number == before.number == 10
    np.testing.assert_array_equal(again.item.action, before.action)
    np.testing.assert_array_equal(again.item.guide.obs, before.guide.obs)
    assert again.status().answered == 10
    assert again.status().newest.labels == 10
    assert again.undo(10)
    assert again.number == 9
    give(again, 2)
    assert again.number == 11
    give(again, 9)
    assert again.is_done
    assert again.item is None
    assert not again.answer(20, np.zeros(1))
    assert label_files.read(tmp_path / "labels").people.item.tolist() == list(range(20))
    assert again.undo(20)
    assert again.item.number == 19


def test_a_line_that_a_kill_tore_is_asked_again(opened, tmp_path):
    give(opened(), 6)
    whole = (tmp_path / "labels" / JSONL).read_bytes()
    folder = tmp_path / "cut"
    folder.mkdir()
    (folder / JSONL).write_bytes(whole[:-1])
    assert opened("cut").number == lines(folder) == 5
    assert label_files.read(folder).people.item.tolist() == [0, 1, 2, 3, 4]


def test_where_the_disk_takes_no_more_nothing_moves_on_and_nothing_is_saved_later(opened, monkeypatch, tmp_path):
    session = opened()
    give(session, 1)

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("cuelearner_jax.storage.table.os.fsync", full)
        for _ in range(2):
            with pytest.raises(UserError, match=r"not saved \(No space left on device\): make room, then answer again"):
                session.answer(1, np.zeros(1))
    assert (session.number, session.status().answered) == (1, 1)
    assert "this answer is not saved" in session.status().trouble
    assert session.answer(1, np.ones(1))
    assert session.status().trouble == ""
    rows = label_files.history(tmp_path / "labels" / JSONL)
    assert [(row["item"], row["answer"]) for row in rows][1:] == [(1, [1.0])]
    session._next.result()
    monkeypatch.setattr(session.questions, "draw", lambda item: 1 / 0)  # question 3 is there already
    assert all([session.answer(2, np.ones(1)), session.answer(3, np.ones(1)), session.undo(3)])
    assert (session.number, lines(tmp_path / "labels")) == (3, 5)
    assert "saved, but the next question cannot be made (ZeroDivisionError" in session.status().trouble


def test_a_session_is_finished_once_and_takes_nothing_afterwards(opened, tmp_path):
    session = opened()
    with pytest.raises(UserError, match="no answer to save yet"):
        session.finish()
    give(session, 2)
    file = session.finish()
    assert (file, session.finish(), session.is_done, session.item) == (tmp_path / "labels" / PARQUET, file, True, None)
    assert not session.answer(2, np.ones(1))
    assert not session.undo(2)
    assert label_files.read(file).people.item.tolist() == [0, 1]


def test_files_of_something_else_are_refused(opened, tmp_path):
    opened()
    for asked, named in (({"seed": 1}, "session.seed"), ({"kind": "demonstration"}, "answers")):
        before = (tmp_path / "labels" / JSONL).read_bytes()
        with pytest.raises(UserError, match=f"holds labels of another {named}:"):
            Session(plan(**asked), tmp_path / "labels")
        assert (tmp_path / "labels" / JSONL).read_bytes() == before


def test_a_policy_is_asked_about_within_a_bound(opened):
    session = opened(base=Base(Opaque(page_task.left_of, on_host=True), "mine"), bound_deg=5.0)
    items = give(session, 10)
    for item in items:  # before the first fit: the policy's own actions
        np.testing.assert_allclose(item.action, page_task.left_of(np.asarray(item.guide.obs)[None])[0], atol=1e-6)
    settled(session, fits=1)
    moved = []
    for item in give(session, 6)[1:]:
        own = page_task.left_of(np.asarray(item.guide.obs)[None])[0]
        moved.append(np.degrees(np.arccos(np.clip(item.action @ own, -1, 1))))
    assert 0.1 < max(moved) <= 5.0 + 1e-3


def test_a_second_opinion_is_about_the_same_questions(opened, tmp_path):
    items = give(opened(), 8)
    file = label_files.read(tmp_path / "labels")
    again = tuple(label_files.history(tmp_path / "labels" / JSONL))
    with pytest.raises(UserError, match="question 2 of --again had another situation: the environment does not repeat"):
        opened("third", again=(again[0], again[1] | {"obs": again[0]["obs"]}), again_of="x")
    second = opened("second", again=again, again_of="x", who="other")
    for item in items:
        np.testing.assert_array_equal(second.item.guide.obs, item.guide.obs)
        np.testing.assert_array_equal(second.item.action, item.action)
        second.answer(item.number, expert(item) if item.number < 6 else np.ones(1) - np.abs(expert(item)))
    assert second.is_done
    theirs = label_files.read(tmp_path / "second")
    both = comparing.between(file, theirs)
    same = sum(bool(expert(item)[0] == (1 - abs(expert(item)[0]))) for item in items[6:])
    assert (both.count, both.value) == (8, (6 + same) / 8)
    assert theirs.people.who.tolist() == ["other"] * 8
    merged, left_out = comparing.merge([file, theirs])
    assert (merged.people.item.tolist(), left_out) == (list(range(16)), 0)
    all_pairs = comparing.between(merged, theirs)  # both people's answers with theirs
    assert (all_pairs.count, all_pairs.value) == (16, (8 + 6 + same) / 16)
    again, left_out = comparing.merge([file, file, merged])
    assert (len(again.seeds), left_out) == (16, 16)
    nobodys = [one._replace(people=None) for one in (file, merged)]
    assert [comparing.merge([one, file])[1] for one in nobodys] == [8, 8]
    assert comparing.merge([file, theirs, nobodys[0]])[1] == 8  # of people who agree both count
    place = lambda one, path, **more: one._replace(task=one.task | {"path": path, **more})  # noqa: E731
    here, there = place(file, "a", digest="1"), place(theirs, "b", digest="1")
    assert comparing.merge([here, there])[0].task["path"] == "a"  # one recording, which lay in two places
    for other, says in ((theirs._replace(eps=5.0), r"eps \(20.0, 5.0\)"), (place(theirs, "b"), r"path \(None, b\)")):
        with pytest.raises(UserError, match=f"^the files differ in {says}"):
            comparing.merge([file, other])
    narrower = file._replace(labels=file.labels.replace(obs=np.asarray(file.labels.obs)[:, :-1]))
    with pytest.raises(UserError, match="observations differ in size"):
        comparing.merge([file, narrower])


def test_on_the_page_a_coached_policy_learns_answers_afresh_and_holds_none_out(opened):
    learners = [opened(name, kind="dcoach").questions.learner for name in ("one", "other")]
    rows = lambda way: [(np.ones(ENV.obs_size, np.float32), np.float32([1, 0]), np.float32([way]))] * 10  # noqa: E731
    for learner, ways in zip(learners, ((1, -1), (-1,)), strict=True):  # one takes its first answers back
        for way in ways:
            learner.fit(rows(way))
    chex.assert_trees_all_equal(*(learner.newest.model for learner in learners))
    assert learners[0].newest.quality is None


def test_a_policy_that_gives_no_actions_is_named_before_a_question_is_asked(opened, tmp_path):
    nothing = Opaque(lambda obs: obs * np.where(obs.any(), np.nan, 1.0), on_host=True)
    with pytest.raises(UserError, match=r"policy .*lambda.* gave zero or not finite numbers"):
        opened(base=Base(nothing, "mine"))


def test_a_session_that_cannot_begin_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(Session, "_prepare", lambda self, number: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        Session(plan(), tmp_path / "labels")
    assert not (tmp_path / "labels" / JSONL).exists()
