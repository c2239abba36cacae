"""The film on top of the README: keys pressed on the labelling page, and an arm before and after.

    MUJOCO_GL=osmesa python benchmarks/readme_film.py --out docs/figures/labels_correct_an_arm.gif

FetchReach's camera was moved by 8 cm (`examples/moved_camera.py`). A script presses the keys that a person who sees the
true goal would press; `cuelearner label`, `adapt` and `render` do the rest. Writes the commands beside the film, as
JSON. Needs the extra `gymnasium`, playwright and a Chromium (`--browser`).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from unittest import mock

import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence
from playwright.sync_api import Page, sync_playwright  # pyright: ignore[reportMissingImports]

from cuelearner_jax.cli import label, main
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.labelling import session
from cuelearner_jax.storage.provenance import provenance
from examples.moved_camera import reach

TASK, POLICY = "gymnasium:FetchReach-v4", "examples.moved_camera:moved"
WIDTH, HEIGHT, BAR = 720, 470, 44  # of the film and of the bar with words above the pictures [pixels]
PAPER, INK, BLUE, GREEN = (250, 250, 250), (33, 33, 33), (0, 114, 178), (0, 128, 96)
SHOWN = (0, 1, 2, 3, 4, 8, 16, 24, 32, 40, 48)  # questions of which the film shows the presses
KEY = (522, 352, 708, 458)  # where the film shows the key that was pressed [pixels]
GRIPPER = (120, 100, 400, 380)  # of a picture of the arm, where the gripper moves [pixels]
EPISODE = "3"
STEPS = 14  # of an episode that the film shows
FONT = Path(__import__("matplotlib").get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf"
SYMBOLS = {"ArrowLeft": "←", "ArrowRight": "→", "ArrowUp": "↑", "ArrowDown": "↓", " ": "space"}


class Shot(NamedTuple):
    """A picture of the page, the key that was just pressed, and what the key says."""

    picture: Image.Image
    key: str
    words: str
    number: int  # answers so far


class Watched(session.Session):
    """A session that a script can look into: it knows the true goal, as a person at the robot would."""

    opened: ClassVar[list[Watched]] = []

    def __init__(self, *how: Any, **more: Any) -> None:
        super().__init__(*how, **more)
        self.opened.append(self)


def keys_for(page: Page, asked: Watched) -> list[tuple[str, str]]:
    """The keys that answer the question on the page, and what each says."""
    item = asked.item
    assert item is not None
    best = reach(np.asarray(item.guide.obs)[None])[0]
    eps = float(asked.questions.space.from_unit(asked.plan.eps))
    said = np.asarray(relative_feedback(asked.questions.space, jnp.asarray(item.action), jnp.asarray(best), eps))
    keys: dict[str, str] = {}
    for key, name in page.evaluate("cue.keys").items():
        keys.setdefault(name, key)
    pressed = []
    for number, cue in enumerate(asked.questions.space.cues):
        if said[number]:
            more = said[number] > 0
            pressed.append((keys[f"pick-{number}-{'more' if more else 'less'}"], cue.words[0 if more else 1]))
    return [*pressed, (keys["rest"], "the rest is right")]


def pressed_keys(address: str, browser: str, labels: int, shots: list[Shot]) -> None:
    """Answers all questions on the page, and takes pictures of some."""
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport={"width": 980, "height": 760}, color_scheme="light")
        for _ in range(100):
            with contextlib.suppress(Exception):
                page.goto(address)
                break
            time.sleep(0.1)
        page.wait_for_selector("svg.scene")
        page.wait_for_function("() => cue.ready()", timeout=120_000)
        (asked,) = Watched.opened
        for number in range(labels):
            presses = keys_for(page, asked)
            if number in SHOWN:
                time.sleep(0.3)
                shots.append(Shot(picture_of(page), "", "", number))
            for key, words in presses:
                page.keyboard.press(key)
                time.sleep(0.15)
                if number in SHOWN and key != presses[-1][0]:
                    shots.append(Shot(picture_of(page), key, words, number))
            if number in SHOWN:
                shots.append(Shot(shots[-1].picture, *presses[-1], number + 1))
            if number + 1 < labels:
                for _ in range(1200):
                    if asked.number > number and page.evaluate("cue.ready()"):
                        break
                    time.sleep(0.05)
        page.get_by_text("finish", exact=True).click()
        page.wait_for_selector("#next", timeout=60_000)
        time.sleep(0.5)
        chromium.close()


def picture_of(page: Page) -> Image.Image:
    """The page as it looks now."""
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        page.screenshot(path=file.name)
        return Image.open(file.name).convert("RGB")


def labelled(folder: Path, browser: str, labels: int) -> tuple[list[str], list[Shot]]:
    """Runs `cuelearner label` to its end; returns its arguments and pictures of the page."""
    command = [TASK, POLICY, "--guidance", "reading", "--labels", str(labels), "--out", str(folder)]
    shots: list[Shot] = []
    answering: list[threading.Thread] = []

    def told(text: str) -> None:
        words = text.split()
        if words[0] == "open":
            how = words[1], browser, labels, shots
            answering.append(threading.Thread(target=pressed_keys, args=how, daemon=True))
            answering[0].start()

    with mock.patch.object(session, "Session", Watched), mock.patch.object(label.out, "print", told):
        label.run(command)
    answering[0].join()
    return ["label", *command], shots


def canvas(words: str, colour: tuple[int, int, int] = INK) -> Image.Image:
    """An empty frame with words on top."""
    frame = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    draw = ImageDraw.Draw(frame)
    draw.rectangle((0, 0, WIDTH, BAR), fill=colour)
    draw.text((WIDTH / 2, BAR / 2), words, (255, 255, 255), ImageFont.truetype(FONT, 17), anchor="mm")
    return frame


def side_by_side(words: str, colour: tuple[int, int, int], left: Image.Image, right: Image.Image | None) -> Image.Image:
    """A frame with one film, or two, and their names below; each shows the gripper and its goal."""
    frame = canvas(words, colour)
    draw, font = ImageDraw.Draw(frame), ImageFont.truetype(FONT, 15)
    named = [("before", left)] if right is None else [("before: beside the goal", left), ("after: at the goal", right)]
    room = WIDTH // len(named)
    for number, (name, picture) in enumerate(named):
        size = min(room - 16, HEIGHT - BAR - 40)
        shown = picture.crop(GRIPPER).resize((size, size), Image.Resampling.LANCZOS)
        middle = room * number + room // 2
        frame.paste(shown, (middle - size // 2, BAR + 8 + (HEIGHT - BAR - 40 - size) // 2))
        draw.text((middle, HEIGHT - 16), name, INK, font, anchor="mm")
    return frame


def with_key(shot: Shot, labels: int) -> Image.Image:
    """A frame of the page, and the key that was pressed."""
    frame = canvas(f"2  Say which way: {shot.number} of {labels} answers", BLUE)
    scale = WIDTH / shot.picture.width
    page = shot.picture.resize((WIDTH, round(shot.picture.height * scale)), Image.Resampling.LANCZOS)
    frame.paste(page.crop((0, 0, WIDTH, HEIGHT - BAR)), (0, BAR))
    if shot.key:
        draw, (left, top, right, bottom) = ImageDraw.Draw(frame), KEY
        draw.rounded_rectangle(KEY, 12, fill=(255, 255, 255), outline=INK, width=4)
        for text, size, share in ((SYMBOLS.get(shot.key, shot.key.upper()), 34, 0.36), (shot.words, 17, 0.76)):
            place = (left + right) / 2, top + share * (bottom - top)
            draw.text(place, text, INK, ImageFont.truetype(FONT, size), anchor="mm")
    return frame


def composed(before: list[Image.Image], shots: list[Shot], after: list[Image.Image], labels: int) -> list[Any]:
    """The frames of the film and how long each is shown [ms]."""
    first, last = (
        "1  The camera was moved: the arm stops beside its goal",
        f"3  After {labels} answers the arm reaches its goal",
    )
    told = [(side_by_side(first, INK, picture, None), 130) for picture in before]
    told[-1] = told[-1][0], 1300
    for shot in shots:
        slow = shot.number <= SHOWN[3]
        told.append((with_key(shot, labels), 650 if slow and shot.key else 380 if slow else 220))
    pairs = [(side_by_side(last, GREEN, *pair), 130) for pair in zip(before, after, strict=False)]
    pairs[-1] = pairs[-1][0], 2600
    return told + pairs


def save(frames: list[Any], file: Path, colours: int = 144) -> None:
    """Write an animated GIF of one palette for all frames."""
    shown, durations = zip(*frames, strict=True)
    sample = np.concatenate([np.asarray(picture) for picture in shown[:: max(1, len(shown) // 8)]])
    palette = Image.fromarray(sample).quantize(colours)
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in shown]
    indexed[0].save(file, save_all=True, append_images=indexed[1:], duration=list(durations), loop=0, optimize=True)


def rendered(commands: list[list[str]], folder: Path, *more: str) -> list[Image.Image]:
    """Runs `cuelearner render`; returns the frames of its film."""
    command = ["render", *more, "--episode", EPISODE, "--steps", str(STEPS), "--out", str(folder)]
    commands.append(command)
    if main(command):
        raise SystemExit("cuelearner render failed")
    (file,) = folder.glob("*.gif")
    with Image.open(file) as reel:
        return [frame.convert("RGB") for frame in ImageSequence.Iterator(reel)]


def film(asked: argparse.Namespace, work: Path) -> None:
    """Labels, corrects, renders, and writes the film."""
    command, shots = labelled(work / "labels", asked.browser, asked.labels)
    commands = [command]
    policy = str(work / "policy")
    commands.append(["adapt", POLICY, "--task", TASK, "--guidance", "reading", "--labels-from", str(work / "labels")])
    commands[-1] += ["--labels", str(asked.labels), "--out", policy]
    if main(commands[-1]):
        raise SystemExit("cuelearner adapt failed")
    films = [
        rendered(commands, work / who, policy, "--task", TASK, "--base", POLICY, "--policy", who)
        for who in ("base", "adapted")
    ]
    frames = composed(films[0], shots, films[1], asked.labels)
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    save(frames, asked.out)
    lines = [" ".join(["cuelearner", *(word.replace(f"{work}/", "runs/") for word in one)]) for one in commands]
    made = {"commands": lines, "frames": len(frames), "bytes": asked.out.stat().st_size, **provenance()}
    asked.out.with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n")
    print(f"{asked.out}: {len(frames)} frames, {asked.out.stat().st_size / 1e6:.2f} MB")


def run() -> None:
    """Makes the film."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labels", type=int, default=60)
    parser.add_argument("--browser", default=shutil.which("chromium"), help="a Chromium")
    parser.add_argument("--out", type=Path, default=Path("docs/figures/labels_correct_an_arm.gif"))
    asked = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "osmesa")
    with tempfile.TemporaryDirectory() as temporary:
        film(asked, Path(temporary))


if __name__ == "__main__":
    run()
