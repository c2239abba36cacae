"""Access control of the labelling page: browsers of this machine that know the page's address.

A page of another site can make a browser send requests to 127.0.0.1, and a domain name of that site can resolve to
127.0.0.1 (DNS rebinding). So the host and origin headers are checked, and a secret token is required: first in the
page's address, afterwards in a cookie.
"""

from __future__ import annotations

import secrets
from typing import Any

from fastapi.requests import HTTPConnection
from fastapi.responses import PlainTextResponse
from starlette.websockets import WebSocketClose

HEADERS = (
    (b"referrer-policy", b"no-referrer"),  # the address contains the token
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
)


class Gate:
    """An ASGI application that checks each connection before passing it to another application."""

    def __init__(self, app: Any, port: int, token: str) -> None:
        """Admit connections to `127.0.0.1:port` or `localhost:port` that present the token."""
        self.app, self.token, self.cookie = app, token, f"cuelearner-{port}"  # browsers share cookies among ports
        self.hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Handle one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        refusal, entering = self.refusal(scope)
        if refusal is None:
            await self.app(scope, receive, self._marked(send, entering) if scope["type"] == "http" else send)
        elif scope["type"] == "websocket":
            await WebSocketClose(1008, refusal)(scope, receive, send)
        else:
            await PlainTextResponse(f"{refusal}\n", 403)(scope, receive, send)

    def refusal(self, scope: Any) -> tuple[str | None, bool]:
        """Return why a connection is refused (None: admitted), and whether its address carried the token."""
        told = HTTPConnection(scope)
        hosts = [host.lower() for host in told.headers.getlist("host")]
        if len(hosts) != 1 or hosts[0] not in self.hosts:
            return "this page answers to 127.0.0.1 alone: open the address that the command printed", False
        sites = {f"http://{host}" for host in self.hosts}
        if any(origin.lower() not in sites for origin in told.headers.getlist("origin")):
            return "this page answers no other site", False
        if any(self._right(token) for token in told.query_params.getlist("token")):
            return None, True
        if self._right(told.cookies.get(self.cookie, "")):
            return None, False
        return "the token is missing or wrong: open the address that the command printed when it started last", False

    def _right(self, token: str) -> bool:
        return secrets.compare_digest(token.encode(), self.token.encode())

    def _marked(self, send: Any, entering: bool) -> Any:
        """Return `send` with headers that keep the page's address and content private."""
        cookie = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        extra = [*HEADERS, *([(b"set-cookie", cookie.encode())] if entering else [])]

        async def marked(message: Any) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        return marked
