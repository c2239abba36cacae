"""Pictures for the page and for files: sizes, colours and order of frames, and what is no picture."""

import base64
import io
import re

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from cuelearner_jax import pictures
from cuelearner_jax.errors import UserError

RED, GREEN, BLUE = (220, 30, 20), (20, 180, 60), (30, 50, 210)


def plain(colour, height=12, width=20):
    return np.full((height, width, 3), colour, np.uint8)


def file_of(image, kind="PNG", **options):
    file = io.BytesIO()
    Image.fromarray(image).save(file, format=kind, **options)
    return file.getvalue()


def shown(uri):
    """What a data URI shows: its media type and pixels."""
    head, _, data = uri.partition(";base64,")
    return head, np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def shown_by(sketch):
    return shown(re.search(r'href="([^"]+)"', sketch.still)[1])


def test_a_sketch_holds_the_picture_in_pixels():
    sketch = pictures.sketch(plain(RED), "a gripper")
    assert sketch.box == (0.0, 0.0, 20, 12)
    assert sketch.words == "a gripper"
    assert not sketch.movers
    head, seen = shown_by(sketch)
    assert head == "data:image/jpeg"
    assert seen.shape == (12, 20, 3)
    assert np.abs(seen - np.array(RED, float)).max() < 4


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_file_is_passed_on_as_it_is(kind):
    given = file_of(plain(BLUE), kind)
    uri = re.search(r'href="([^"]+)"', pictures.sketch(given).still)[1]
    assert uri == f"data:image/{kind.lower()};base64,{base64.b64encode(given).decode()}"


def test_a_picture_of_a_turned_camera_stands_upright():
    image = np.concatenate([plain(RED, 16, 16), plain(BLUE, 16, 16)])  # red above blue
    exif = Image.Exif()
    exif[0x0112] = 6  # shown, it is turned clockwise by a quarter: red on the right
    sketch = pictures.sketch(file_of(image, "JPEG", exif=exif, quality=95))
    assert sketch.box[2:] == (32, 16)
    seen = shown_by(sketch)[1]
    assert seen[8, 28, 0] > 150 > seen[8, 4, 0]


def test_a_clip_is_a_film_of_pictures_in_order():
    reel = pictures.clip([plain(RED), plain(GREEN), file_of(plain(BLUE))], 0.1, "it closed")
    assert (reel.period, reel.frames, reel.words) == (0.1, [], "it closed")
    assert [int(shown(uri)[1][5, 5].argmax()) for uri in reel.pictures] == [0, 1, 2]


def test_a_still_shows_six_frames_first_and_last_among_them(tmp_path):
    pictures.still([plain((10 * number, 0, 0)) for number in range(21)], tmp_path / "still.png")
    sheet = np.asarray(Image.open(tmp_path / "still.png"))
    assert sheet.shape == (24, 60, 3)
    assert [sheet[row, column, 0] for row in (5, 17) for column in (5, 25, 45)] == [0, 40, 80, 120, 160, 200]


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_a_film_shows_the_frames_at_their_rate(tmp_path, kind):
    frames = [plain(colour, 33, 49) for colour in (RED, GREEN, BLUE) for _ in range(10)]  # odd sides
    pictures.animate(frames, tmp_path / f"film.{kind}", fps=10)
    film = imageio.mimread(tmp_path / f"film.{kind}")
    assert 28 <= len(film) <= 31 if kind == "mp4" else len(film) >= 3  # a GIF may merge frames that are alike
    assert [int(np.asarray(frame)[16, 24, :3].argmax()) for frame in (film[0], film[len(film) // 2], film[-1])] == [
        0,
        1,
        2,
    ]


@pytest.mark.parametrize(
    ("image", "words"), [(np.zeros((4, 4, 3), np.float32), "float32 (4, 4, 3)"), (b"no picture", "cannot be read")]
)
def test_what_is_no_picture_is_named_in_one_line(image, words):
    with pytest.raises(UserError, match=re.escape(words)) as raised:
        pictures.sketch(image)
    assert "\n" not in str(raised.value)
