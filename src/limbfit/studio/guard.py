"""Who may talk to the studio: one secret, known hosts, the page's own origin, bounded bodies.

What it is against: other users of the machine and other pages in the same browser. A page of another origin
can make the browser send requests to 127.0.0.1, by a name that resolves to it too (DNS rebinding): such
requests carry another ``Host`` or ``Origin``, and no cookie, since ours is ``SameSite=Strict``.
"""

import hmac
import secrets
from dataclasses import dataclass, field

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LARGEST_BODY = 16 << 20  # bytes of a request: a day's painting has less
_SAFE_METHODS = ("GET", "HEAD")
# The page's own files and nothing else. Workers and images of niivue are made in memory (blob:, data:).
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; font-src 'self'; "
    "connect-src 'self' data: blob:; worker-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": PAGE_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class AccessGuard:
    """Where the studio listens and what opens it."""

    host: str
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def hosts(self) -> frozenset[str]:
        """Values of ``Host`` that are this server; names that merely resolve to it are not."""
        names = {f"[{self.host}]" if ":" in self.host else self.host}
        if is_loopback(self.host):
            names |= {"127.0.0.1", "localhost"}
        found = {f"{name}:{self.port}" for name in names}
        return frozenset(found | (names if self.port == 80 else set()))

    @property
    def cookie(self) -> str:
        """The cookie's name; it holds the port because all ports of a host share their cookies."""
        return f"limbfit-studio-{self.port}"

    @property
    def address(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/?token={self.token}"

    def opens(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())


def is_loopback(host: str) -> bool:
    return host in ("127.0.0.1", "localhost", "::1")


class GuardMiddleware:
    """ASGI middleware that refuses everything that is not the page of this server."""

    def __init__(self, app: ASGIApp, guard: AccessGuard) -> None:
        self.app, self.guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no web sockets here
            await send({"type": "websocket.close", "code": 1008})
            return
        request = HTTPConnection(scope)
        token = request.query_params.get("token", "")
        is_entry = scope["path"] == "/" and scope["method"] in _SAFE_METHODS
        refused = self._refusal(request, token if is_entry else "")
        if refused:
            status, reason = refused
            await JSONResponse({"error": reason}, status)(scope, receive, _add_headers(send, ""))
            return
        cookie = ""
        if is_entry and self.guard.opens(token):
            cookie = f"{self.guard.cookie}={self.guard.token}; Path=/; HttpOnly; SameSite=Strict"
        await self.app(scope, _limit_body(receive), _add_headers(send, cookie))

    def _refusal(self, request: HTTPConnection, token: str) -> tuple[int, str] | None:
        """Status and reason why a request is refused; None where it is not."""
        headers = request.headers
        if headers.getlist("host") not in [[host] for host in self.guard.hosts]:
            return 421, "this is not the address that limbfit studio printed"
        origin = headers.get("origin")
        origins = {f"http://{host}" for host in self.guard.hosts}
        is_changing = request.scope["method"] not in _SAFE_METHODS
        if (origin is None and is_changing) or (origin is not None and origin not in origins):
            return 403, "requests from other pages are refused"
        site = headers.get("sec-fetch-site", "none")
        if site not in ("same-origin", "none") and (is_changing or not token):
            return 403, "requests from other pages are refused"
        if not self.guard.opens(token) and not self.guard.opens(request.cookies.get(self.guard.cookie, "")):
            return 401, "open the address that limbfit studio printed: it holds the key of this page"
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > LARGEST_BODY:
            return 413, f"requests have at most {LARGEST_BODY >> 20} MiB"
        return None


class TooLargeError(Exception):
    """A request without a content length had a larger body than is allowed."""


def _limit_body(receive: Receive) -> Receive:
    length = 0

    async def receive_limited() -> Message:
        nonlocal length
        message = await receive()
        length += len(message.get("body", b""))
        if length > LARGEST_BODY:
            raise TooLargeError
        return message

    return receive_limited


def _add_headers(send: Send, cookie: str) -> Send:
    """Every answer with the headers that keep it where it belongs; an answer's own policy stays."""

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
            if cookie:
                headers.append("Set-Cookie", cookie)
        await send(message)

    return send_with_headers
