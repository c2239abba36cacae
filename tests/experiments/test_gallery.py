"""The gallery: its films are small and on their page, and two renderings are joined frame by frame."""

import importlib
from pathlib import Path

import pytest

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
