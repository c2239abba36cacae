"""What the registry knows of a kind of guidance before sizes and an environment are known."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.bundle import Guidance

NAME = re.compile(r"[a-z][a-z0-9_-]*")  # of kinds, also in files: neither a path nor a reference to code


@dataclass(frozen=True)
class Kind:
    """A kind of guidance."""

    name: str  # of options, folders and columns
    about: str  # in a few words
    make: Callable[[GuideSizes, Spaces], Guidance]
    form: AnswerForm | None = None  # of the answers that it asks for; None: it never asks
    needs: tuple[str, ...] = ()  # optional members of an environment without which it means nothing
    title: str = ""  # in figures, if other than the name
    colour: str | None = None  # in figures

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"a guidance is called {self.name!r}: give lower-case letters, digits, - and _")

    @property
    def asks(self) -> bool:
        """Does it ask a teacher?"""
        return self.form is not None
