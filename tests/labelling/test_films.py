"""The page that asks which of two films is better, asked by an HTTP client as a browser would."""

import threading
import urllib.error
import urllib.request
from http.cookiejar import CookieJar

import pytest

pytest.importorskip("nicegui")
from cuelearner_jax.labelling.films import film_page


def test_a_pair_is_shown_answered_once_and_only_to_who_knows_the_address(tmp_path):
    left, right = tmp_path / "a.gif", tmp_path / "b.gif"
    left.write_bytes(b"GIF89a left"), right.write_bytes(b"GIF89a right")
    told, verdicts = [], []
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))

    def get(path):
        return browser.open(told[0].split("?")[0] + path).read().decode()

    with film_page(told.append) as ask:
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(told[0].split("?")[0])
        assert "being made" in browser.open(told[0]).read().decode()
        asking = threading.Thread(target=lambda: verdicts.extend([ask(left, right), ask(right, left)]))
        asking.start()
        while "Left is better" not in (page := get("")):
            pass
        assert page.index("film/0/left") < page.index("film/0/right")
        assert (get("film/0/left"), get("film/0/right")) == ("GIF89a left", "GIF89a right")
        for word in ("right", "left"):  # the second is late
            browser.open(told[0].split("?")[0] + f"answer/0/{word}", data=b"")
        while "film/1/left" not in get(""):
            pass
        assert get("film/1/left") == "GIF89a right"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get("film/0/left")
        browser.open(told[0].split("?")[0] + "answer/1/same", data=b"")
        asking.join()
        assert verdicts == [1, 0]
        last = threading.Timer(0.2, lambda: verdicts.append(get("")))
        last.start()
    last.join()
    assert "It is decided" in verdicts[-1]
