"""The labelling page in a real browser, with real keys: nothing lost or doubled, how fast, and what it looks like.

    python benchmarks/labelling_page.py paced --task navigation --out paced.json        500 labels, 5 a second
    python benchmarks/labelling_page.py kills --task billiards --preset quickstart --out kills.json
    python benchmarks/labelling_page.py pictures --task navigation --preset quickstart
    python benchmarks/labelling_page.py pictures --task billiards --preset quickstart --more="--task.table regulation"
    python benchmarks/labelling_page.py pictures --task navigation --preset quickstart --guidance demonstration scalar
    python benchmarks/labelling_page.py paced --task pictures --labels 300 --out paced_pictures.json
    MUJOCO_GL=osmesa python benchmarks/labelling_page.py paced --task gymnasium:FetchReach-v4 --labels 300
    python benchmarks/labelling_page.py kills --task pictures
    python benchmarks/labelling_page.py pictures --task pictures
    MUJOCO_GL=osmesa python benchmarks/labelling_page.py pictures --task gymnasium:FetchReach-v4

The task `pictures` is a folder of plain pictures, written anew; a script that knows what they show answers about three
cues.

`paced`: a script presses keys at random, or as the pictures say; 10% are "don't know". Measured are a key's press to
the next question painted, while a model is being fitted and otherwise, and whether every press is in the file once.
Needs playwright and a Chromium (`--browser`).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import _photos
import numpy as np
from _photos import CUES
from _presses import Presses, presses_of
from playwright.sync_api import Browser, Page, sync_playwright  # pyright: ignore[reportMissingImports]

from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.provenance import provenance

# Times of each press: of the key, and of the first frame in which another question stands, its picture decoded.
WATCH = """
window.taken = [];
addEventListener("keydown", event => {
  const scene = document.querySelector("svg.scene"), name = window.cue && cue.keys[event.key];
  if (!scene || !name || /^(pick|film|help)/.test(name)) return;
  const began = performance.now(), item = scene.dataset.item;
  const fitting = document.body.innerText.includes("fitting");
  const paint = () => requestAnimationFrame(() => {
    const painted = new MessageChannel();
    painted.port1.onmessage = () => window.taken.push([performance.now() - began, fitting]);
    painted.port2.postMessage(0);
  });
  const changes = new MutationObserver(() => {
    const now = document.querySelector("svg.scene"), photo = now && now.querySelector("image.photo");
    if (now && now.dataset.item === item) return;
    changes.disconnect();
    if (photo) photo.decode().then(paint); else paint();
  });
  changes.observe(document, {childList: true, subtree: true});
}, true);
"""
PHOTOS = "pictures"  # the task that is a folder of plain pictures, written anew
ITEM = "() => { const one = document.querySelector('svg.scene'); return one ? +one.dataset.item : null; }"


@contextlib.contextmanager
def served(asked: argparse.Namespace, task: str, folder: Path, *more: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """The command, until it has told its address: the process and that."""
    named = [str(asked.photos), "--cues", CUES] if task == PHOTOS else [task]
    preset = asked.preset or ("" if task == PHOTOS or ":" in task else "paper")
    command = [sys.executable, "-m", "cuelearner_jax.cli", "label", *named, *(["--preset", preset] if preset else [])]
    command += ["--out", str(folder), *shlex.split(asked.more), *more]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    try:
        assert process.stdout is not None
        told = next((line for line in process.stdout if line.startswith("open ")), None)
        if told is None:
            raise SystemExit(f"the page did not start: {process.wait()}")
        yield process, told.split()[1]
    finally:
        process.kill()
        process.wait()


def entered(browser: Browser, address: str, **look: Any) -> Page:
    """The page with its first question."""
    known: dict[str, Any] = {"viewport": {"width": 1280, "height": 860}} | look
    page = browser.new_page(**known)
    page.add_init_script(WATCH)
    for _ in range(100):
        with contextlib.suppress(Exception):
            page.goto(address)
            break
        time.sleep(0.1)
    page.wait_for_selector("svg.scene")
    page.wait_for_function("() => cue.ready()")
    return page


def moved(page: Page, item: int, seconds: float = 30.0) -> None:
    """Wait for another question than this one, until it takes an answer."""
    page.wait_for_function(f"({ITEM})() !== {item} && cue.ready()", timeout=seconds * 1000)


def press(page: Page, presses: Presses) -> None:
    """Press keys, one after the other."""
    for number, key in enumerate(presses.keys):
        time.sleep(0.05 if number else 0.0)  # nobody presses two at once
        page.keyboard.press(key)


def check(folder: Path, pressed: dict[int, Presses], saved: int) -> dict[str, int]:
    """Press that the file lacks or has otherwise, and rows that nobody pressed."""
    found = label_files.found_in(folder)
    assert found is not None
    rows = label_files.history(found)
    items = [row["item"] for row in rows]
    answers = {row["item"]: None if row["answer"] is None else tuple(row["answer"]) for row in rows}
    lost = max(saved - len(set(items)), 0)
    other = sum(answers[item] != pressed[item].answer for item in answers if item in pressed)
    return {"rows": len(rows), "lost": lost, "doubled": len(items) - len(set(items)), "otherwise": other}


def paced(asked: argparse.Namespace, browser: Browser, work: Path) -> dict[str, Any]:
    """Labels at a pace: every press in the file once, and how long each took."""
    rng, pressed, answered = random.Random(0), {}, 0
    (task,) = asked.task
    folder = work / "labels"
    began = time.time()
    with served(asked, task, folder, "--labels", str(asked.labels)) as (process, address):
        opened, page = time.time() - began, entered(browser, address)
        start = time.perf_counter()
        for number in range(10**6):
            item = page.evaluate(ITEM)
            if item is None:
                break
            time.sleep(max(0.0, start + number / asked.rate - time.perf_counter()))
            presses = pressed[item] = presses_of(page, rng, asked.seen)
            press(page, presses)
            answered += presses.answer is not None
            moved(page, item)
        seconds = time.perf_counter() - start
        page.wait_for_function("() => document.body.innerText.includes('All labels are given')")
        taken = page.evaluate("window.taken")
        side = page.locator(".side").inner_text()
        process.send_signal(signal.SIGINT)
        status = process.wait(60)
    each = np.array([milliseconds for milliseconds, _ in taken])
    fitting = np.array([bool(running) for _, running in taken])
    quantiles = lambda values: [round(float(q), 1) for q in np.quantile(values, [0.5, 0.99, 1.0])]  # noqa: E731
    return {
        "opened_s": round(opened, 1),
        "presses": len(pressed),
        "answered": answered,
        "seconds": round(seconds, 1),
        "key_to_next_ms (median, p99, max)": quantiles(each),
        "while_fitting_ms (median, p99, max)": quantiles(each[fitting]) if fitting.any() else None,
        "presses_while_fitting": int(fitting.sum()),
        "own_overhead_s": round(float(each.sum() / 1000), 1),
        **check(folder, pressed, len(pressed)),
        "exit_status": status,
        "page": side.splitlines()[:6],
    }


def kills(asked: argparse.Namespace, browser: Browser, work: Path) -> dict[str, Any]:
    """The command killed at random moments while keys are pressed, and opened again on the same file."""
    rng, pressed, found = random.Random(1), {}, []
    (task,) = asked.task
    folder, saved = work / "labels", 0
    for number in range(asked.kills):
        with served(asked, task, folder, "--labels", "2000") as (process, address):
            page = entered(browser, address)
            end = time.perf_counter() + rng.uniform(0.3, 4.0)
            with contextlib.suppress(Exception):  # of a page whose server has gone
                while True:
                    item = page.evaluate(ITEM)
                    told = re.search(r"(\d+) answers saved", page.locator(".side").inner_text())
                    saved = max(saved, int(told[1]) if told else 0)
                    pressed[item] = presses_of(page, rng, asked.seen)
                    press(page, pressed[item])
                    if time.perf_counter() > end:
                        time.sleep(rng.uniform(0, 0.03))
                        process.kill()
                        break
                    moved(page, item, 5.0)
            process.wait()
            page.close()
        found.append(check(folder, pressed, saved))
        rows = label_files.history(folder / label_files.JSONL)
        pressed = {
            item: presses for item, presses in pressed.items() if item < len(rows)
        }  # the last may not have arrived
        print(number, found[-1], flush=True)
    return {"kills": len(found), **{name: sum(one[name] for one in found) for name in ("lost", "doubled", "otherwise")},
            "rows": found[-1]["rows"]}  # fmt: skip


LOOKS = {
    "light": {"color_scheme": "light"},
    "dark": {"color_scheme": "dark"},
    "phone_light": {"color_scheme": "light", "viewport": {"width": 390, "height": 844}},
    "phone_dark": {"color_scheme": "dark", "viewport": {"width": 390, "height": 844}},
}


def pictures(asked: argparse.Namespace, browser: Browser, work: Path) -> dict[str, Any]:
    """Each task's page in light and dark, on a desk and on a phone, once a model has been fitted."""
    asked.to.mkdir(parents=True, exist_ok=True)
    for task in asked.task:
        for kind in asked.guidance or [""]:
            more = ("--guidance", kind) if kind else ()
            called = (task.rpartition(":")[0].rpartition(".")[2] or task) + (f"_{kind}" if kind else "")
            with served(asked, task, work / called, "--labels", "500", *more) as (_, address):
                page = entered(browser, address)
                rng, wanted = random.Random(2), 0 if kind else 12
                while int(re.match(r"\d+", page.locator(".side").inner_text())[0]) < wanted:  # pyright: ignore[reportOptionalSubscript]
                    item = page.evaluate(ITEM)
                    press(page, presses_of(page, rng, asked.seen))
                    moved(page, item)
                if wanted:
                    page.wait_for_function("() => document.body.innerText.includes('model 1')", timeout=300_000)
                page.close()
                for name, look in LOOKS.items() if not kind else [("light", LOOKS["light"])]:
                    page = entered(browser, address, **look)
                    time.sleep(1.0)
                    page.screenshot(path=asked.to / f"label_{called}_{name}.png")
                    page.close()
    return {"pictures": sorted(str(file.name) for file in asked.to.glob("label_*.png"))}


def main() -> None:
    """Run one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("paced", "kills", "pictures"))
    parser.add_argument("--task", nargs="+", default=["navigation"])
    parser.add_argument("--preset", default="", help="(default: paper, of a folder or an environment its own)")
    parser.add_argument("--guidance", nargs="*", help="pictures: of these kinds instead of the task's own")
    parser.add_argument("--more", default="", help="further options of cuelearner label, in one word")
    parser.add_argument("--labels", type=int, default=500)
    parser.add_argument("--rate", type=float, default=5.0, help="presses a second")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--to", type=Path, default=Path("docs/figures"), help="folder for pictures")
    parser.add_argument("--browser", default=shutil.which("chromium"), help="a Chromium")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    asked.seen = asked.photos = None
    with tempfile.TemporaryDirectory() as work, sync_playwright() as driver:
        if PHOTOS in asked.task:
            asked.photos = Path(work) / "situations"
            asked.seen, _ = _photos.write(asked.photos, count=200)
        browser = driver.chromium.launch(executable_path=asked.browser, args=["--no-sandbox"])
        found = {"paced": paced, "kills": kills, "pictures": pictures}[asked.what](asked, browser, Path(work))
        browser.close()
    print(json.dumps(found, indent=1))
    if asked.out:
        asked.out.write_text(
            json.dumps({"task": asked.task, "preset": asked.preset, **found, **provenance()}, indent=1)
        )


if __name__ == "__main__":
    main()
