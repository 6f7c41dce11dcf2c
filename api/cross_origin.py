"""What web pages of other origins may read: downloads at signed URLs, whoever's page it is, and the
rest of the API where the settings name the page's origin.

A signed URL is a secret of its own: whoever has it can fetch it without a browser, and no cookie or
key goes with it, so that a page learns nothing by it that its URL did not give away already. All
other calls need a key. Browsers send none by themselves, yet a page of anybody's must not even
learn that the service is there, and which keys are good. No answer allows credentials: a page has
a key only if it was given one.

Source: WHATWG Fetch, "HTTP extensions".
"""

from __future__ import annotations

from collections.abc import Collection

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_DOWNLOAD_EXPOSED = "Accept-Ranges, Content-Disposition, Content-Length, Content-Range, ETag"
_DOWNLOAD = {
    "Access-Control-Allow-Methods": "GET, HEAD, OPTIONS",
    "Access-Control-Allow-Headers": "If-None-Match, If-Range, Range",
    "Access-Control-Max-Age": "86400",
}
_CALL_EXPOSED = (
    f"{_DOWNLOAD_EXPOSED}, Idempotent-Replayed, Location, Retry-After, WWW-Authenticate, "
    "X-Request-Id"
)
_CALL = {
    "Access-Control-Allow-Methods": "DELETE, GET, HEAD, OPTIONS, POST",
    "Access-Control-Allow-Headers": "Authorization, Content-Type, Idempotency-Key, If-None-Match, "
    "If-Range, Range, X-Request-Id",
    "Access-Control-Max-Age": "600",
}


class CrossOrigin:
    """Says in each answer which pages may read it, and answers browsers that ask beforehand.

    downloads: how the paths of signed URLs begin. origins: whose pages may make any call.
    """

    def __init__(self, app: ASGIApp, downloads: str, origins: Collection[str]) -> None:
        self.app = app
        self.downloads = downloads
        self.origins = frozenset(origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI entry."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        asked = Headers(scope=scope)
        is_download = scope["path"].startswith(self.downloads)
        granted = "*" if is_download else asked.get("origin", "")
        if not is_download and granted not in self.origins:
            granted = ""
        if granted and scope["method"] == "OPTIONS" and "access-control-request-method" in asked:
            await Response(
                status_code=204,
                headers={
                    "Access-Control-Allow-Origin": granted,
                    **(_DOWNLOAD if is_download else {**_CALL, "Vary": "Origin"}),
                },
            )(scope, receive, send)
            return

        async def send_granted(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if granted:
                    headers["Access-Control-Allow-Origin"] = granted
                    headers["Access-Control-Expose-Headers"] = (
                        _DOWNLOAD_EXPOSED if is_download else _CALL_EXPOSED
                    )
                if self.origins and not is_download:
                    headers.add_vary_header("Origin")
            await send(message)

        await self.app(scope, receive, send_granted)
