"""A page in a browser that is none; needs NiceGUI."""

import asyncio
import contextlib
import re

import numpy as np
from nicegui import ui
from nicegui.testing.user_simulation import user_simulation

from cuelearner_jax.labelling.page import Page


def shown(session, acts, finish=None):
    """Open the page of a session in a browser that is none, and has `acts` use it."""

    async def used():
        pages = set()
        async with user_simulation(root=lambda: Page(session, pages, finish, "cuelearner label") and None) as user:
            await user.open("/")
            await acts(user, pages)

    loop = asyncio.new_event_loop()
    try:
        loop.run_until_complete(used())
    finally:
        loop.close()  # `asyncio.run` would wait for the page's tasks for good where `acts` failed


async def press(user, name, moved):
    """Press a button and waits until that has moved the session on."""
    user.find(marker=name).click()
    for _ in range(400):
        await asyncio.sleep(0.01)
        if moved():
            return
    raise AssertionError(f"{name} did nothing")


@contextlib.contextmanager
def told_browser(user):
    """What the browser is told to run meanwhile."""
    sent, run = [], ui.run_javascript
    ui.run_javascript = lambda code, **how: sent.append(code)
    try:
        yield sent
    finally:
        ui.run_javascript = run


def tip(svg, name):
    """The tip of an arrow on the screen."""
    corners = re.search(rf'class="arrow {name}">.*?points="([^"]*)"', svg)[1]
    return np.array([float(part) for part in corners.split()[0].split(",")])
