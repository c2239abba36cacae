"""A script in the place of a person and a browser: it runs `cuelearner label` and presses the page's buttons."""

import asyncio
from unittest import mock

import numpy as np
from page_user import shown

from cuelearner_jax.cli import label
from cuelearner_jax.labelling import server
from cuelearner_jax.labelling.session import Session
from cuelearner_jax.spaces import UNSAID

VALUES = {1.0: "more", 0.0: "right", -1.0: "less"}


def labelled(arguments, ask):
    """Run `cuelearner label ARGUMENTS` to its end.

    Args:
        arguments: of the command line, as a shell would give them.
        ask: (observation (obs,), action (action,)) -> the answer (cues,): 1 more, 0 already right, -1 less, `UNSAID`.

    Returns the folder of the labels.
    """
    places = []

    def served(_, plan, asked, port, stopping, commands):
        with Session(plan, asked.out) as session:

            async def acts(user, pages):
                (page,) = pages
                while (item := await drawn(page, session)) is not None:
                    await answer(user, page, session, ask(np.asarray(item.guide.obs), item.action))
                user.find(marker="finish").click()

            async def finish():
                session.finish()

            shown(session, acts, finish)
            places[:] = [asked.out]
            return server.end_session(session, commands)

    with mock.patch.object(label, "_serve", served):
        label.run([*map(str, arguments)])
    return places[0]


async def drawn(page, session):
    """The question of the session, once the page shows it: an answer moves the session on before the page."""
    for _ in range(4000):
        if page._item is (item := session.item):
            return item
        await asyncio.sleep(0.002)
    raise AssertionError("the page does not show the question")


async def answer(user, page, session, said):
    """Press what says an answer, and waits for the next question."""
    number = session.number
    for name in pressed(page.controls, np.atleast_1d(said)):
        user.find(marker=name).click()
    for _ in range(4000):
        await asyncio.sleep(0.002)
        if session.number != number or session.is_done:
            return
    raise AssertionError(f"{said} was not taken")


def pressed(known, said):
    """The names of the controls that say an answer, in their order."""
    if len(said) == 1:
        return [{1.0: "+1", 0.0: "0", -1.0: "-1", UNSAID: "unsure"}[float(said[0])]]
    about = [number for number in range(len(said)) if said[number] != UNSAID]
    if "send" not in known:  # one cue a press
        if not about:
            return ["unsure"]
        return [f"only-{about[0]}-{VALUES[float(said[about[0]])]}"] if len(about) == 1 else ["rest"]
    return [*(f"pick-{number}-{VALUES[float(said[number])]}" for number in about), "send" if about else "unsure"]
