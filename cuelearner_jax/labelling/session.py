"""A labelling session without its page: ask, save answers, take answers back, fit a model in the background.

An answer is on disk before the next question is shown, and nothing on disk is ever changed. Threads prepare questions
and fit models, so that nobody who answers has to wait. A session that is reopened replays the recorded actions and
continues where its file ends.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling.learner import Fitted, Row, step_back
from cuelearner_jax.labelling.plan import SessionPlan, begin, replay
from cuelearner_jax.labelling.questions import Item, Questions
from cuelearner_jax.storage import label_files, table
from cuelearner_jax.storage.label_files import ANSWERED, UNDONE, UNSURE
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import shape_of

PICTURES = 20  # number of past questions whose pictures are kept; undo redraws earlier ones
RECENT = 50  # number of answers from which the pace is computed


class Response(NamedTuple):
    """The recorded response to an item."""

    said: str  # one of `label_files.RESPONSES`
    obs: np.ndarray
    action: np.ndarray
    answer: np.ndarray | None
    seconds: float


class Record:
    """The newest response to each item, as in the label file."""

    def __init__(self, plan: SessionPlan, folder: Path) -> None:
        """Open or continue the folder's label file. Raises UserError if it holds labels of another session."""
        shape = shape_of(plan.task, plan.config.task)
        space = actions_of(shape)
        about, more = (plan.world, plan.form.name, space, plan.eps), {"session": plan.session(shape)}
        more |= {"meaning": plan.form.meaning(space), "written_by": provenance()}
        self._plan, self._writer = plan, label_files.LabelWriter(folder, *about, **more)
        self.path, self.trouble = self._writer.path, ""
        self.rows: dict[int, Response] = {}
        self.seconds = 0.0  # that all answers took, also those taken back
        for row in label_files.history(self.path):
            obs, action = (np.asarray(row[name], np.float32) for name in ("obs", "action"))
            answer = None if row.get("answer") is None else np.asarray(row["answer"], np.float32)
            self.rows[row.get("item", -1)] = Response(row["said"], obs, action, answer, row["seconds"])
            self.seconds += row["seconds"]
        if set(self.rows) != set(range(len(self.rows))):
            raise UserError(f"{self.path} was not written by the labelling page: give another --out")

    def save(self, item: Item, said: str, answer: np.ndarray | None, seconds: float) -> None:
        """Write a response to the disk, then use it. Raises UserError if the disk takes no more."""
        response = Response(said, np.asarray(item.guide.obs), item.action, answer, seconds)
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        person = {"seconds": round(seconds, 3), "who": self._plan.who, "when": now}
        try:
            self._writer.append(seed=self._plan.seed, item=item.number, **{**response._asdict(), **person})
        except OSError as error:
            self.trouble = f"this answer is not saved ({error.strerror or error}): make room, then answer again"
            raise UserError(self.trouble) from error
        self.trouble = ""
        self.rows[item.number] = response
        self.seconds += seconds

    def in_order(self) -> list[Response]:
        """Return the responses by the numbers of their items; may be called from any thread."""
        rows = self.rows.copy()
        return [rows[number] for number in sorted(rows)]

    def labels(self) -> list[Row]:
        """Return the answered items' observations, actions and answers, in order."""
        return [(row.obs, row.action, row.answer) for row in self.in_order() if row.answer is not None]

    def count(self, said: str) -> int:
        """Return the number of items with this response."""
        return sum(row.said == said for row in list(self.rows.values()))

    def per_minute(self) -> float | None:
        """Return the answers a minute over the last questions; None without any."""
        recent = [row for row in self.in_order() if row.said != UNDONE][-RECENT:]
        seconds, count = sum(row.seconds for row in recent), sum(row.said == ANSWERED for row in recent)
        return 60 * count / seconds if count and seconds > 0 else None

    def finish(self) -> Path:
        """Write the answers as Parquet and return that file. Raises UserError without an answer or on a full disk."""
        if not self.count(ANSWERED):
            raise UserError("there is no answer to save yet: answer a question, or stop with Ctrl-C")
        try:
            return table.finish(self.path.parent, label_files.SCHEMA)
        except OSError as error:
            raise UserError(f"not finished ({error.strerror or error}): make room, then finish again") from error

    def close(self) -> None:
        """Close the file. One without a response is deleted, so that other words or settings may take its folder."""
        self._writer.close()
        if not self.rows:
            self.path.unlink(missing_ok=True)


class Status(NamedTuple):
    """Progress of a session."""

    answered: int
    unsure: int
    labels: int  # number wanted
    per_minute: float | None  # answers a minute, over the last questions
    minutes_left: float | None
    fitting: bool
    newest: Fitted
    trouble: str  # why the last answer is not saved, or no question follows; empty: no problem
    seconds: float  # that all answers took


class Session(AbstractContextManager[Any, None]):
    """Asks questions, saves answers and fits models. Its methods may be called from any thread."""

    def __init__(self, plan: SessionPlan, folder: Path, tell: Callable[[str], None] = lambda words: None) -> None:
        """Open the label file in `folder`, which the caller keeps claimed, and prepare the first questions.

        `tell` gets progress lines. Raises UserError if the folder holds labels of another session, or the task cannot
        be drawn here.
        """
        tell("building the environment")
        env, check = plan.task.environment(plan.config.task), plan.task.pictures().check
        if check is not None:
            check(env)
        self.plan, self.record, self.questions = plan, Record(plan, folder), Questions(plan, env)
        self._learner = self.questions.learner
        # answers are handled one at a time; whoever waits for an item holds no other lock
        self._acting, self._lock = threading.Lock(), threading.RLock()
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="ahead")  # the only thread that makes items
        self._fits = ThreadPoolExecutor(1, thread_name_prefix="fit", initializer=step_back)
        self._listeners: list[Callable[[], object]] = []
        self._items: dict[int, Item] = {}
        self._file: Path | None = None
        self.number = 0  # of the current question
        try:
            self._replay(tell)
            tell("preparing questions")
            self._prepare(self.number)
            self._prepare(self.number + 1)
            # whether the task films situations
            self.films = self.questions.film(self._items[self.number], self._items[self.number].action) is not None
        except BaseException:
            self.record.close()
            raise
        self._next: Future[None] = self._ahead.submit(self._prepare, self.number + 1)
        self._since = time.monotonic()

    def _replay(self, tell: Callable[[str], None]) -> None:
        """Replay the file's items, fit a model to its answers, and make the question that comes next."""
        questions, rows = self.questions, self.record.in_order()
        if count := len(rows):
            tell(f"replaying {count} earlier questions")
        situations = list(replay(questions.env, questions.keys, [(row.obs, row.action) for row in rows]))
        if len(situations) <= count:
            tell("replaying the earlier situations gives other observations with this version: a new episode begins")
            situations = [begin(questions.env, jax.random.fold_in(questions.keys.start, count))]
        else:
            pairs = enumerate(zip(situations, rows, strict=False))
            self._items = {n: Item(n, at, row.action) for n, (at, row) in pairs}
        self.number = min((number for number in self._items if rows[number].said == UNDONE), default=count)
        if count:
            tell("fitting the model to their answers")
        self._learner.fit(self.record.labels())
        self._items[count] = questions.ask(count, situations[-1])

    def _prepare(self, number: int) -> None:
        """Make an item ready to be shown; the item before it exists already."""
        item = self._items.get(number) or self.questions.ask(number, self.questions.after(self._items[number - 1]))
        self._items[number] = self.questions.draw(item)

    def _show(self, number: int) -> None:
        """Move to an item that is ready, and start preparing the next one."""
        with self._lock:
            self.number, self._since = number, time.monotonic()
            if old := self._items.get(number - PICTURES):
                self._items[old.number] = old._replace(sketch=None, trails=None)
            self._next = self._ahead.submit(self._prepare, number + 1)

    def _fit(self) -> None:
        labels = self.record.labels()
        if not self._learner.is_due(len(labels)):
            return
        try:
            self._learner.fit(labels)
        except Exception as error:  # labels are still saved, whatever happens to the model
            problem = f"the last fit failed ({type(error).__name__}: {error})"
            self._learner.newest = self._learner.newest._replace(labels=len(labels), problem=problem)
        self._ahead.submit(self._use_fit)

    def _use_fit(self) -> None:
        """Show what the newest model makes of the questions that are ready."""
        for number in (self.number, self.number + 1):
            if number in self._items:
                self._items[number] = self.questions.refine(self._items[number])
        for listener in list(self._listeners):
            listener()

    @property
    def item(self) -> Item | None:
        """The current question; None once all are answered or the session is finished."""
        with self._lock:
            return None if self.is_done else self._items[self.number]

    @property
    def is_done(self) -> bool:
        """Whether all wanted labels are given, or the session was finished early."""
        enough = self.record.count(ANSWERED) >= self.plan.labels or 0 < len(self.plan.again) <= self.number
        return enough or self._file is not None

    def answer(self, number: int, answer: np.ndarray | None, seconds: float | None = None) -> bool:
        """Save an answer and move on. Return False if another question is current: the answer came too late.

        `number` is that of the item on the screen. `answer` has the form's encoding, (width,), but of a pair it is the
        choice alone: -1 for A, 1 for B, 0 for no difference. None: "don't know".
        `seconds` is the time since the question was shown (default: since it became the current question).

        Raises UserError if the answer could not be saved; it may be repeated.
        """
        with self._acting:
            with self._lock:
                if self.is_done or number != self.number:
                    return False
                took = time.monotonic() - self._since
                took = took if seconds is None or not 0 <= seconds <= took else seconds
                item = self._items[number]
                answer = None if answer is None else item.in_form(answer)
                self.record.save(item, UNSURE if answer is None else ANSWERED, answer, took)
            if self._is_ready(self._next):
                self._show(number + 1)
            if self._learner.is_due(self.record.count(ANSWERED)):
                self._fits.submit(self._fit)
            return True

    def _is_ready(self, preparing: Future[None]) -> bool:
        """Wait for a question. Return whether it can be shown; where not, the status says why."""
        if error := preparing.exception():
            why = f"your answers are saved, but the next question cannot be made ({type(error).__name__}: {error})"
            self.record.trouble = f"{why}: stop with Ctrl-C and repeat the command"
        return error is None

    def undo(self, number: int) -> bool:
        """Take back the answer before this question and ask it again.

        Return False if there is no such answer, or another question is current. Raises UserError on a full disk.
        """
        with self._acting:
            with self._lock:
                before = None if number == 0 or self._file else self._items.get(number - 1)
                if number != self.number or before is None:
                    return False
                self.record.save(before, UNDONE, None, time.monotonic() - self._since)
            if self._is_ready(self._ahead.submit(self._prepare, number - 1)):
                self._show(number - 1)
            return True

    def finish(self) -> Path:
        """End the session: write the answers as Parquet and return that file. Later answers are refused.

        Raises UserError if there is no answer yet or the disk is full; the session then continues.
        """
        with self._acting:
            self._file = self._file or self.record.finish()
            return self._file

    def status(self) -> Status:
        """Return the session's progress."""
        count, pace = self.record.count(ANSWERED), self.record.per_minute()
        counts = count, self.record.count(UNSURE), self.plan.labels
        minutes = (self.plan.labels - count) / pace if pace else None
        due, newest = self._learner.is_due(count), self._learner.newest
        return Status(*counts, pace, minutes, due, newest, self.record.trouble, self.record.seconds)

    def listen(self, listener: Callable[[], object]) -> Callable[[], None]:
        """Register a function that is called, from any thread, when a new model is in use.

        Returns a function that ends the registration.
        """
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def close(self) -> None:
        """Close the file and stop the threads, after any running fit."""
        self._fits.shutdown(wait=True, cancel_futures=True)
        self._ahead.shutdown(wait=True, cancel_futures=True)
        self.record.close()

    def __exit__(self, *_: object) -> None:
        self.close()
