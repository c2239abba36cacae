"""Who may talk to a page: this machine's browsers that know its token, and nobody else."""

import asyncio

import pytest

from cuelearner_jax.labelling.server import guard

TOKEN = "right"
HOST, ORIGIN, COOKIE = "127.0.0.1:8123", "http://127.0.0.1:8123", f"cuelearner-8123={TOKEN}"


async def inner(scope, receive, send):
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 200, "headers": [(b"x-own", b"1")]})
        await send({"type": "http.response.body", "body": b"hello"})
    else:
        await send({"type": "websocket.accept"})


def talk(kind="http", query="", **headers):
    """What comes back for one connection: its messages."""
    sent = []
    told = [(name.encode(), value.encode()) for name, values in headers.items() for value in [values] if value]
    scope = {"type": kind, "headers": told, "query_string": query.encode()}

    async def receive():
        return {"type": f"{kind}.connect"}

    async def send(message):
        sent.append(message)

    asyncio.run(guard(inner, 8123, TOKEN)(scope, receive, send))
    return sent


def test_the_token_of_the_address_lets_in_and_a_cookie_carries_it_on():
    first = talk(query=f"token={TOKEN}", host=HOST)
    headers = dict(first[0]["headers"])
    assert first[0]["status"] == 200
    assert headers[b"set-cookie"] == f"{COOKIE}; HttpOnly; SameSite=Strict; Path=/".encode()
    assert (headers[b"referrer-policy"], headers[b"x-frame-options"]) == (b"same-origin", b"DENY")
    later = talk(host=HOST, cookie=f"other=1; {COOKIE}")
    assert later[0]["status"] == 200
    assert b"set-cookie" not in dict(later[0]["headers"])
    opened = talk("websocket", host="localhost:8123", origin="http://localhost:8123", cookie=COOKIE)
    assert opened == [{"type": "websocket.accept"}]


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"host": HOST}, "the token is missing or wrong"),
        ({"host": HOST, "query": "token=wrong"}, "the token is missing or wrong"),
        ({"host": HOST, "cookie": f"cuelearner-8124={TOKEN}"}, "the token is missing or wrong"),
        ({"host": "evil.example:8123", "cookie": COOKIE}, "answers to 127.0.0.1 alone"),
        ({"query": f"token={TOKEN}"}, "answers to 127.0.0.1 alone"),
        ({"host": HOST, "origin": "http://evil.example", "cookie": COOKIE}, "answers no other site"),
        ({"host": HOST, "origin": "null", "query": f"token={TOKEN}"}, "answers no other site"),
    ],
)
def test_nobody_else_is_let_in(asked, says):
    head, body = talk(**asked)
    assert (head["status"], says in body["body"].decode()) == (403, True)
    (close,) = talk("websocket", **asked)
    assert (close["type"], says in close["reason"]) == ("websocket.close", True)
