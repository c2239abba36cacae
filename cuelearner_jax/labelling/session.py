"""A labelling session without its page: choose questions, save answers, fit a model in the background.

An answer is on disk before the next question is shown. Threads prepare questions and fit models, so that nobody who
answers has to wait. A session that is reopened replays the recorded actions and continues where its file ends.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax import asking, user_code
from cuelearner_jax.asking import GuideState
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling import controls
from cuelearner_jax.labelling.evidence import PROGRAMS, EvidenceLearner
from cuelearner_jax.labelling.learner import Fitted, Learner
from cuelearner_jax.labelling.plan import Plan
from cuelearner_jax.labelling.programs import advance, begin, keys_of, lived, programs
from cuelearner_jax.policies import policy_name
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import ANSWERED, UNDONE, UNSURE
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import shape_of
from cuelearner_jax.types import Label, Reel, Sketch

RECENT = 50  # number of answers from which the pace is computed
KEPT = 20  # number of past questions whose pictures are kept; undo redraws earlier ones
NUMBERS = 2**31  # practice questions have numbers below 0, whose random numbers are counted down from this


class Item(NamedTuple):
    """A question: a situation and an action in it."""

    number: int  # from 0; below 0: a practice question
    guide: GuideState  # the guide's state in that situation
    action: np.ndarray  # (action,)
    sketch: Sketch | None = None  # None: not needed yet
    refined: np.ndarray | None = None  # the action refined by the newest model; None: no model yet
    # drawings of the `controls.outcomes`, as `Pictures.trails`; None: not drawn yet
    trails: dict[str, str] | None = None


class Said(NamedTuple):
    """The recorded response to an item."""

    said: str  # one of `label_files.SAID`
    obs: np.ndarray
    action: np.ndarray
    answer: np.ndarray | None
    seconds: float


class Status(NamedTuple):
    """Progress of a session."""

    answered: int
    unsure: int
    labels: int  # number wanted
    per_minute: float | None  # answers a minute, over the last `RECENT` questions
    minutes_left: float | None
    fitting: bool
    newest: Fitted
    trouble: str  # why the last answer is not saved; empty: no problem


class Session:
    """Asks questions, saves answers and fits models. Its methods may be called from any thread."""

    def __init__(
        self, plan: Plan, folder: Path, tell: Callable[[str], None] = lambda words: None, practice: int = 0
    ) -> None:
        """Open the label file and prepare the first questions; only the thread that fits may still compile then.

        Args:
            plan: the session's settings.
            folder: the folder of `labels.jsonl`. Keep the folder claimed (`storage.folders.claimed`).
            tell: called with progress lines, first when the folder's files are checked.
            practice: number of practice questions before the first one; their answers are not saved. None are asked
                where the file holds answers already.

        Raises:
            UserError: the folder holds labels of another session, or the task has no sketch.
        """
        self._pictures = plan.task.pictures()
        if self._pictures.sketch is None:
            raise UserError(
                f"{plan.task.name} has no sketches to show on the page: set `sketch` in the Pictures of its body"
            )
        if self._pictures.check is not None:
            self._pictures.check(plan.task.environment(plan.config.task))
        self.plan = plan
        shape = shape_of(plan.task, plan.config.task)
        self.space = space = actions_of(shape)
        named = plan.world, plan.form.name, space, plan.eps, plan.form.meaning(space), plan.session(shape)
        self._writer = label_files.LabelWriter(folder, *named, written_by=provenance())
        tell("building the environment")
        self.env = plan.task.environment(plan.config.task)
        by_evidence = plan.guidance.kind.by_evidence
        self._programs = PROGRAMS if by_evidence else programs(plan.guidance)
        self._keys = keys_of(plan.seed)
        slots = asking.label_slots(plan.labels, plan.config.sizes)
        start = asking.start(plan.guidance, self.env, slots, plan.labels, self._keys.model, self._keys.start)
        tell("compiling the model's fit")
        learner = EvidenceLearner if by_evidence else Learner
        self._learner = learner(plan, self.env, self._programs, start, self._keys.session)
        self._bound = None if plan.bound_deg is None else space.from_unit(plan.bound_deg)
        # answers are handled one at a time; whoever waits for an item holds no other lock
        self._acting = threading.Lock()
        self._lock = threading.RLock()
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="ahead")  # the only thread that makes items
        self._listeners: list[Callable[[], None]] = []
        self._rows: dict[int, Said] = {}
        self._items: dict[int, Item] = {}
        self._trouble = ""
        self._finished: Path | None = None
        self._replay(start, tell)
        self.practice = 0 if self._rows else practice
        self._prepare_practice(start)
        tell("preparing questions")
        self._ensure(self.number)
        self._ensure(self.number + 1)
        # whether the task films situations
        self.films = self.film(self.number, self._items[self.number].action) is not None
        self._next: Future[None] = self._ahead.submit(self._ensure, self.number + 1)
        self._since = time.monotonic()

    def _replay(self, start: GuideState, tell: Callable[[str], None]) -> None:
        """Replay the file's items, fit a model to its answers, and make the question that comes next."""
        for row in label_files.history(self._writer.path):
            if row.get("item") is None:
                raise UserError(f"{self._writer.path} was not written by the labelling page: give another --out")
            obs, action = (np.asarray(row[name], np.float32) for name in ("obs", "action"))
            answer = None if row.get("answer") is None else np.asarray(row["answer"], np.float32)
            self._rows[row["item"]] = Said(row["said"], obs, action, answer, row["seconds"])
        count = len(self._rows)
        if set(self._rows) != set(range(count)):
            raise UserError(
                f"{self._writer.path} lacks items, so the labelling page did not write it: give another --out"
            )
        if count:
            tell(f"replaying {count} earlier questions")
        told = [self._rows[number] for number in range(count)]
        found = list(lived(self.env, self._keys, [(row.obs, row.action) for row in told]))
        if len(found) <= count:
            tell("replaying the earlier situations gives other observations with this version: a new episode begins")
            found = [(None, None)] * count + [begin(self.env, jax.random.fold_in(self._keys.start, count))]
        for number, (state, obs) in enumerate(found[:count]):
            if obs is not None:
                self._items[number] = Item(number, start.replace(env=state, obs=obs), told[number].action)
        undone = [number for number in self._items if told[number].said == UNDONE]
        self.number, self._furthest = min(undone, default=count), count
        self._learner.fit(self._labels())
        state, obs = found[count]
        self._items[count] = self._asked(count, start.replace(env=state, obs=obs))

    def _prepare_practice(self, start: GuideState) -> None:
        """Make the practice questions, each in an episode of its own, and go to the first of them."""
        for number in range(-self.practice, 0):
            state, obs = begin(self.env, jax.random.fold_in(self._keys.start, number % NUMBERS))
            self._items[number] = self._asked(number, start.replace(env=state, obs=obs))
            self.number = min(self.number, number)

    # --- questions ---------------------------------------------------------------------------------------------------

    def _followed(self, item: Item) -> GuideState:
        key = asking.question_keys(self._keys.session, item.number).env
        state, obs = advance(self.env, key, item.guide.env, jnp.asarray(item.action))
        return item.guide.replace(env=state, obs=obs)

    def _asked(self, number: int, guide: GuideState) -> Item:
        if 0 <= number < len(self.plan.again):
            return Item(number, guide, self.plan.again[number])
        keys = asking.question_keys(self._keys.session, number % NUMBERS)
        guide = guide.replace(model=self._learner.newest.model)
        scalars, base = self.plan.config.scalars, self.plan.base.policy
        action = self._programs.question(self.env, scalars, base, guide, keys, self._bound)
        user_code.check_actions(np.isfinite(action), policy_name(base))
        return Item(number, guide, np.asarray(action))

    def _refined(self, item: Item) -> Item:
        newest = self._learner.newest
        action = jnp.asarray(item.action)
        refined = self._programs.refined(self.env, self.plan.config.scalars, newest.model, item.guide.obs, action)
        return item._replace(refined=np.asarray(refined) if newest.number else None)

    def _ensure(self, number: int) -> None:
        """Make an item ready to be shown; the item before it exists already."""
        assert self._pictures.sketch is not None
        item = self._items.get(number) or self._asked(number, self._followed(self._items[number - 1]))
        if item.sketch is None:
            item = item._replace(sketch=self._pictures.sketch(self.env, item.guide.env))
        if item.trails is None:
            item = item._replace(trails=self._trails(item))
        self._items[number] = self._refined(item)

    def _trails(self, item: Item) -> dict[str, str]:
        if self._pictures.trails is None:
            return {}
        outcomes = self.outcomes(item)
        drawn = self._pictures.trails(self.env, item.guide.env, jnp.asarray(np.stack([*outcomes.values()])))
        return dict(zip(outcomes, drawn, strict=True))

    def outcomes(self, item: Item) -> dict[str, np.ndarray]:
        """Return each answer's outcome for an item's action, see `controls.outcomes`."""
        return controls.outcomes(self.plan.form, self.space, item.action, self.plan.config.scalars.eps_deg)

    def _renew(self) -> None:
        """Update items for the newest model: remake prepared questions, refine the shown ones again."""
        coming, seen = self._items.get(self._furthest + 1), self._items.get(self.number)
        anew = coming and self._refined(self._asked(coming.number, coming.guide)._replace(sketch=coming.sketch))
        again = seen and self._refined(seen)
        with self._lock:
            if anew and self._furthest < anew.number:
                self._items[anew.number] = anew
            if again:
                self._items[again.number] = again
        self._tell_all()

    @property
    def place(self) -> Path:
        """The path of the label file."""
        return self._writer.path

    @property
    def legend(self) -> str:
        """The meaning of the picture's trails; empty where there are none."""
        return self._pictures.legend

    @property
    def simulates(self) -> bool:
        """Whether the task can film the outcome of any action."""
        return self._pictures.simulates

    @property
    def item(self) -> Item | None:
        """The current question; None once all are answered or the session is finished."""
        with self._lock:
            return None if self.done else self._items[self.number]

    @property
    def done(self) -> bool:
        """Whether all wanted labels are given, or the session was finished early."""
        enough = self._counted(ANSWERED) >= self.plan.labels or 0 < len(self.plan.again) <= self.number
        return enough or self._finished is not None

    # --- answers -----------------------------------------------------------------------------------------------------

    def answer(self, number: int, answer: np.ndarray | None, seconds: float | None = None) -> bool:
        """Save an answer and move on. Return False if another question is current: the answer came too late.

        Answers to practice questions are not saved.

        Args:
            number: number of the item that was on the screen.
            answer: in the form's encoding, (width,); None for "don't know".
            seconds: time from showing the question to the answer (default: since it became the current question) [s].

        Raises:
            UserError: the answer could not be saved. It may be given again.
        """
        with self._acting:
            with self._lock:
                if self.done or number != self.number:
                    return False
                took = time.monotonic() - self._since
                took = took if seconds is None or not 0 <= seconds <= took else seconds
                self._keep(self._items[number], UNSURE if answer is None else ANSWERED, answer, took)
            self._next.result()
            self._show(number + 1)
        self._fit_if_due()
        return True

    def _show(self, number: int) -> None:
        """Move to an item that is ready, and start preparing the next one."""
        with self._lock:
            self.number, self._since = number, time.monotonic()
            self._furthest = max(self._furthest, number)
            if passed := self._items.get(number - KEPT):
                self._items[passed.number] = passed._replace(sketch=None, trails=None)
            self._next = self._ahead.submit(self._ensure, number + 1)

    def undo(self, number: int) -> bool:
        """Take back the answer before this question and ask it again.

        Return False if there is no such answer, or another question is current. The first question has no way back to
        the practice questions. Raises UserError if the change cannot be saved.
        """
        with self._acting:
            with self._lock:
                before = None if number == 0 or self._finished else self._items.get(number - 1)
                if number != self.number or before is None:
                    return False
                self._keep(before, UNDONE, None, time.monotonic() - self._since)
            self._ahead.submit(self._ensure, number - 1).result()
            self._show(number - 1)
            return True

    def skip_practice(self) -> None:
        """Go to the first question that counts; do nothing after practice."""
        with self._acting:
            self._next.result()
            if self.number < 0:
                self._ahead.submit(self._ensure, 0).result()
                self._show(0)

    def finish(self) -> Path:
        """End the session: write the answers as Parquet and return that file. Later answers are refused.

        Raises UserError if there is no answer yet or the disk is full; the session then continues.
        """
        with self._acting:
            if self._finished is None:
                if not self._counted(ANSWERED):
                    raise UserError("there is no answer to save yet: answer a question, or stop with Ctrl-C")
                try:
                    self._finished = label_files.finish(self.place.parent)
                except OSError as error:
                    reason = error.strerror or error
                    raise UserError(f"not finished ({reason}): make room, then finish again") from error
            return self._finished

    def _keep(self, item: Item, said: str, answer: np.ndarray | None, seconds: float) -> None:
        if item.number < 0:
            return
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        person = {"item": item.number, "said": said, "seconds": round(seconds, 3), "who": self.plan.who, "when": now}
        obs = np.asarray(item.guide.obs)
        try:
            self._writer.append(seed=self.plan.seed, obs=obs, action=item.action, answer=answer, **person)
        except OSError as error:
            self._trouble = f"this answer is not saved ({error.strerror or error}): make room, then answer again"
            raise UserError(self._trouble) from error
        self._trouble = ""
        self._rows[item.number] = Said(said, obs, item.action, answer, seconds)

    # --- the model ---------------------------------------------------------------------------------------------------

    def _labels(self) -> Label:
        """Return the answers in the order of their items, as a padded `Label`."""
        with self._lock:
            rows = [self._rows[number] for number in sorted(self._rows)]
        return self._learner.padded([(row.obs, row.action, row.answer) for row in rows if row.answer is not None])

    def _fit_if_due(self) -> None:
        if self._learner.fit_later(self._labels, self._counted(ANSWERED), self._fitted):
            self._tell_all()

    def _fitted(self) -> None:
        self._ahead.submit(self._renew)
        self._fit_if_due()

    # --- for the page -------------------------------------------------------------------------------------------

    def film(self, number: int, action: np.ndarray) -> Reel | None:
        """Film the outcome of an action in an item's situation; None where the task has no films."""
        if self._pictures.reel is None:
            return None
        return self._pictures.reel(self.env, self._items[number].guide.env, jnp.asarray(action, jnp.float32))

    def _counted(self, said: str) -> int:
        with self._lock:
            return sum(one.said == said for one in self._rows.values())

    def status(self) -> Status:
        """Return the session's progress."""
        with self._lock:
            answered = self._counted(ANSWERED)
            given = [self._rows[number] for number in sorted(self._rows) if self._rows[number].said != UNDONE][-RECENT:]
            seconds, heard = sum(row.seconds for row in given), sum(row.said == ANSWERED for row in given)
            per_minute = 60 * heard / seconds if heard and seconds > 0 else None
            return Status(
                answered=answered,
                unsure=self._counted(UNSURE),
                labels=self.plan.labels,
                per_minute=per_minute,
                minutes_left=(self.plan.labels - answered) / per_minute if per_minute else None,
                fitting=self._learner.running,
                newest=self._learner.newest,
                trouble=self._trouble,
            )

    def listen(self, heard: Callable[[], None]) -> Callable[[], None]:
        """Register a function that is called, from any thread, when a fit begins or a new model is in use.

        Returns a function that ends the registration.
        """
        self._listeners.append(heard)
        return lambda: self._listeners.remove(heard)

    def _tell_all(self) -> None:
        for heard in list(self._listeners):
            heard()

    def close(self) -> None:
        """Close the file and stop the threads, after any running fit."""
        self._learner.close()
        self._ahead.shutdown(wait=True, cancel_futures=True)
        self._writer.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
