"""A session's answers: each is on disk before the next question is shown. Nothing on disk is ever changed."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling.plan import Plan
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import ANSWERED, UNDONE
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import shape_of

RECENT = 50  # number of answers from which the pace is computed


class Said(NamedTuple):
    """The recorded response to an item."""

    said: str  # one of `label_files.SAID`
    obs: np.ndarray
    action: np.ndarray
    answer: np.ndarray | None
    seconds: float


class Record:
    """The newest response to each item, as in the label file."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        """Open or continue the folder's label file. Raises UserError if it holds labels of another session."""
        shape = shape_of(plan.task, plan.config.task)
        space = actions_of(shape)
        named = plan.world, plan.form.name, space, plan.eps, plan.form.meaning(space), plan.session(shape)
        self._plan, self._writer = plan, label_files.LabelWriter(folder, *named, written_by=provenance())
        self.path, self.trouble = self._writer.path, ""
        self.rows: dict[int, Said] = {}
        for row in label_files.history(self.path):
            if row.get("item") is None:
                raise UserError(f"{self.path} was not written by the labelling page: give another --out")
            obs, action = (np.asarray(row[name], np.float32) for name in ("obs", "action"))
            answer = None if row.get("answer") is None else np.asarray(row["answer"], np.float32)
            self.rows[row["item"]] = Said(row["said"], obs, action, answer, row["seconds"])

    def save(self, number: int, said: Said) -> None:
        """Write a response to the disk, then use it. Raises UserError if the disk takes no more."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        person = {"said": said.said, "seconds": round(said.seconds, 3), "who": self._plan.who, "when": now}
        question = {"seed": self._plan.seed, "item": number, "obs": said.obs, "action": said.action}
        try:
            self._writer.append(**question, answer=said.answer, **person)
        except OSError as error:
            self.trouble = f"this answer is not saved ({error.strerror or error}): make room, then answer again"
            raise UserError(self.trouble) from error
        self.trouble = ""
        self.rows[number] = said

    def in_order(self) -> list[Said]:
        """Return the responses by the numbers of their items; may be called from any thread."""
        rows = self.rows.copy()
        return [rows[number] for number in sorted(rows)]

    def count(self, said: str) -> int:
        """Return the number of items with this response."""
        return sum(row.said == said for row in list(self.rows.values()))

    def per_minute(self) -> float | None:
        """Return the answers a minute over the last questions; None without any."""
        given = [row for row in self.in_order() if row.said != UNDONE][-RECENT:]
        seconds, heard = sum(row.seconds for row in given), sum(row.said == ANSWERED for row in given)
        return 60 * heard / seconds if heard and seconds > 0 else None

    def finish(self) -> Path:
        """Write the answers as Parquet and return that file. Raises UserError without an answer or on a full disk."""
        if not self.count(ANSWERED):
            raise UserError("there is no answer to save yet: answer a question, or stop with Ctrl-C")
        try:
            return label_files.finish(self.path.parent)
        except OSError as error:
            raise UserError(f"not finished ({error.strerror or error}): make room, then finish again") from error

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
