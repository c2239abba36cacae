"""The page in headless Chromium, with real keys; left out where there is none."""

import shutil

import numpy as np
import pytest
from sessions import served

from cuelearner_jax.storage import label_files

playwright = pytest.importorskip("playwright.sync_api")
pytest.importorskip("nicegui")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")]
ITEM = "() => { const one = document.querySelector('svg.scene'); return one ? +one.dataset.item : null; }"


@pytest.fixture
def browser():
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


def entered(browser, address, width=1000, height=800, **how):
    page = browser.new_page(viewport={"width": width, "height": height}, **how)
    page.goto(address)
    page.wait_for_selector("svg.scene")
    page.wait_for_function("() => cue.ready()")
    return page


def moved(page, item):
    page.wait_for_function(f"({ITEM})() !== {item} && cue.ready()")


@pytest.mark.long
def test_every_key_is_in_the_file_once(browser, tmp_path):
    rng, folder = np.random.default_rng(0), tmp_path / "labels"
    values = {"ArrowLeft": 1.0, "ArrowUp": 0.0, "ArrowRight": -1.0, "ArrowDown": None, "a": 1.0, " ": 0.0, "D": -1.0}
    pressed = []
    with served(folder) as (_, address):
        page = entered(browser, address)
        for number in range(12):
            assert page.evaluate(ITEM) == number
            pressed.append(str(rng.choice(list(values))))
            page.keyboard.press(pressed[-1])
            moved(page, number)
        for _ in range(5):  # a key that is held down repeats itself
            page.keyboard.down("ArrowLeft")
        page.keyboard.up("ArrowLeft")
        pressed.append("ArrowLeft")
        moved(page, 12)
        page.wait_for_timeout(200)
        assert page.evaluate(ITEM) == 13
        page.keyboard.press("f")
        page.wait_for_function("() => ['True', 'False'].includes(document.querySelector('.film-words').textContent)")
        page.keyboard.press("Backspace")
        moved(page, 13)
        assert page.evaluate(ITEM) == 12
        page.get_by_text("already right", exact=False).first.click()
        pressed[-1] = "ArrowUp"
        moved(page, 12)
        page.keyboard.press("h")
        page.get_by_text("Each answer is saved before").wait_for()
        said = sum(values[key] is not None for key in pressed)
        assert f"{said} of 20" in page.locator(".side").inner_text()
    rows = [row for row in label_files.history(folder / label_files.JSONL) if row["said"] != "undone"]
    assert [row["item"] for row in rows] == [*range(13), 12]
    found = {row["item"]: None if row["answer"] is None else row["answer"][0] for row in rows}
    assert found == {number: values[key] for number, key in enumerate(pressed)}
    assert all(0 <= row["seconds"] < 60 for row in rows)
