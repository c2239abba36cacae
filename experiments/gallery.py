"""Make the films of docs/gallery.md: each task before labels and after, side by side.

    python experiments/gallery.py --work runs/gallery

Run in the folder above this one. The commands of a film are those that a user types (`FILMS` below); what lies in the
folder of `--work` already is not made again. Each film shows the same episodes of both policies, in a GIF of at most
600 kB.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont, ImageSequence

from cuelearner_jax.cli import main as cuelearner

HERE = Path(__file__).resolve().parent
FIGURES = HERE.parent / "docs" / "figures" / "gallery"
MOST_BYTES = 600_000
BAR = 26  # height of the line of words over each picture [pixels]
LIGHT, INK = "#ffffff", "#222222"


@dataclass(frozen=True)
class Film:
    """Two renderings of the same episodes, and how their policies are made."""

    name: str
    words: tuple[str, str]  # over the two pictures
    before: str = ""  # arguments of `cuelearner render`
    after: str = ""
    make: tuple[tuple[str, str], ...] = ()  # (folder that the command writes, arguments of `cuelearner`)
    width: int = 360  # of each picture [pixels]
    period: int = 80  # from one picture to the next in the renderings [ms]
    slower: float = 1.0  # by this factor the film is played
    most: int = 120  # pictures
    ends: int = 120  # pictures of the rendering before labels, which then stands still: the end of its first episode


SCRIPTS = "cuelearner_envs.arm.scripts"
CAMERA = ("camera moved, no labels", "the same camera, 100 labels")


def _of_arm(skill: str, script: str, scenario: str) -> Film:
    """Return the film of the arm's script in a changed world, before 100 labels and after."""
    base = f"{SCRIPTS}:{script}"
    adapt = f"adapt {base} --task arm --task.skill {skill} --scenario {scenario} --labels 100"
    shown = f"WORK/{skill} --base {base}"
    return Film(
        skill,
        make=((skill, adapt),),
        before=f"{shown} --policy base --steps 150",
        after=f"{shown} --steps 150",
        words=CAMERA,
        width=320,
        slower=1.5,
    )


FILMS = (
    Film(
        "billiards",
        make=(("billiards", "sweep billiards --preset quickstart --seeds 2002:2003 --schedule.total-steps 600"),),
        before="WORK/billiards --guidance none --steps 3",
        after="WORK/billiards --guidance relative --steps 3",
        words=("600 shots, no labels", "600 shots, 100 labels"),
        period=90,
    ),
    Film(
        "navigation",
        before="navigation --policy heuristic --episode 1 --steps 65",
        after="docs/data/navigation_agent --episode 1 --steps 65",
        words=("straight to the goal, no labels", "an agent guided by 500 labels"),
        width=330,
        period=200,
        slower=0.5,
        ends=5,
    ),
    Film(
        "anymal",
        before="navigation --robot anymal --policy heuristic --episode 36 --steps 28",
        after="docs/data/navigation_agent --robot anymal --episode 36 --steps 28",
        words=("straight to the goal, no labels", "an agent guided by 500 labels"),
        width=360,
        period=200,
        slower=0.5,
    ),
    _of_arm("reach", "reach", "turned_camera"),
    _of_arm("push", "past", "hand_eye"),
    _of_arm("pick", "pick", "hand_eye"),
)


def main() -> int:
    """Make the films one after the other; stop at the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/gallery"), help="folder for policies and pictures")
    parser.add_argument(
        "--out", type=Path, default=FIGURES, help="folder for the films (default: docs/figures/gallery)"
    )
    parser.add_argument("--only", nargs="+", choices=[film.name for film in FILMS], help="films (default: all)")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for film in FILMS:
        if asked.only is None or film.name in asked.only:
            status = make_film(film, asked.work, asked.out / f"{film.name}.gif")
            if status:
                return status
    return 0


def make_film(film: Film, work: Path, to: Path) -> int:
    """Run the commands of one film and join its two renderings; return the first exit status that is not 0."""
    place = work / "films" / film.name
    sides = [place / side for side in ("before", "after")]
    commands = [(work / folder, f"cuelearner {words} --out WORK/{folder}") for folder, words in film.make]
    renderings = zip(sides, (film.before, film.after), strict=True)
    commands += [(side, f"cuelearner render {words} --out {side}") for side, words in renderings]
    for folder, command in commands:
        if not folder.exists():
            words = shlex.split(command.replace("WORK", str(work)))
            print(f"$ {shlex.join(words)}", flush=True)
            status = cuelearner(words[1:])
            if status:
                return status
    print(f"{to}: {join([next(side.glob('*.gif')) for side in sides], film, to):,} bytes")
    return 0


def join(files: Sequence[Path], film: Film, to: Path) -> int:
    """Write a film of two films side by side; return its size in bytes.

    Pictures become smaller until the film is small enough.
    """
    pairs = _pictures(files, film)
    for scale in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5):
        frames = [_beside(pair, film.words, round(film.width * scale)) for pair in pairs]
        palette = _below(frames[:: max(1, len(frames) // 6)]).quantize(128, method=Image.Quantize.MAXCOVERAGE)
        small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        durations = [round(film.slower * film.period)] * (len(small) - 1) + [1500]
        small[0].save(to, save_all=True, append_images=small[1:], duration=durations, loop=0, optimize=True)
        if to.stat().st_size <= MOST_BYTES:
            break
    return to.stat().st_size


def _below(frames: Sequence[Image.Image]) -> Image.Image:
    """Return pictures one below the other: of all their colours a palette is made."""
    height = frames[0].height
    whole = Image.new("RGB", (frames[0].width, height * len(frames)))
    for number, frame in enumerate(frames):
        whole.paste(frame, (0, number * height))
    return whole


def _pictures(files: Sequence[Path], film: Film) -> list[tuple[Image.Image, ...]]:
    """Return pairs of pictures, `film.period` milliseconds apart; a film that has ended stands still."""
    reels = []
    for file, ends in zip(files, (film.ends, film.most), strict=True):
        reel, time = [], 0
        with Image.open(file) as opened:
            for frame in ImageSequence.Iterator(opened):
                time += frame.info["duration"]
                reel += [frame.convert("RGB")] * max(0, -(-time // film.period) - len(reel))
        reels.append(reel[:ends])
    length = min(max(map(len, reels)), film.most)
    return list(zip(*((reel + [reel[-1]] * length)[:length] for reel in reels), strict=True))


def _beside(pair: Sequence[Image.Image], words: Sequence[str], width: int) -> Image.Image:
    """Return two pictures side by side, words over each."""
    height = round(width * pair[0].height / pair[0].width)
    whole = Image.new("RGB", (2 * width + 8, height + BAR), LIGHT)
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(15)
    for number, (picture, said) in enumerate(zip(pair, words, strict=True)):
        left = number * (width + 8)
        draw.text((left + 6, 4), said, fill=INK, font=font)
        whole.paste(picture.resize((width, height), Image.Resampling.LANCZOS), (left, BAR))
    return whole


if __name__ == "__main__":
    raise SystemExit(main())
