"""The gallery: its films are small and on their page, and two renderings are joined frame by frame."""

import importlib
from pathlib import Path

import pytest
from PIL import Image, ImageSequence

ROOT = Path(__file__).parents[2]


@pytest.fixture
def gallery(monkeypatch):
    """The experiment as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    return importlib.import_module("gallery")


def test_every_film_is_small_and_on_the_page(gallery):
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    sizes = {film.name: (gallery.FIGURES / f"{film.name}.gif").stat().st_size for film in gallery.FILMS}
    assert all(f"(figures/gallery/{name}.gif)" in page for name in sizes)
    assert max(sizes.values()) <= gallery.MOST_BYTES
    assert sum(sizes.values()) <= 4_000_000
    for film in gallery.FILMS:
        for _, words in film.make:
            assert words in page.replace(" \\\n ", "")  # the commands of the page are those that made the films


def test_two_films_are_joined_and_the_shorter_stands_still(gallery, tmp_path):
    def film(name, *colours):
        frames = [Image.new("RGB", (20, 10), colour) for colour in colours]
        frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:], duration=100)
        return tmp_path / name

    files = film("a.gif", "red", "lime"), film("b.gif", "red", "blue", "yellow")
    of = gallery.Film("joined", words=("", ""), width=20, period=100)
    assert gallery.join(files, of, tmp_path / "joined.gif") == (tmp_path / "joined.gif").stat().st_size
    with Image.open(tmp_path / "joined.gif") as joined:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(joined)]
    near = lambda pixel, colour: max(abs(a - b) for a, b in zip(pixel, colour, strict=True)) < 60  # noqa: E731
    expected = [((255, 0, 0), (255, 0, 0)), ((0, 255, 0), (0, 0, 255)), ((0, 255, 0), (255, 255, 0))]
    for frame, (left, right) in zip(frames, expected, strict=True):
        low = frame.height - 5
        assert near(frame.getpixel((10, low)), left)
        assert near(frame.getpixel((38, low)), right)
