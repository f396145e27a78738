"""The page and its two questions: what is in a scene, and what a changed game leads to."""

from __future__ import annotations

import json
import reprlib
import threading
from importlib import resources
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from epo_lightning.explore.edit import Edit
from epo_lightning.explore.session import Session
from epo_lightning.registry import ConfigError
from epo_lightning.schema import read

FILES = {"/": "text/html", "/page.css": "text/css", "/page.js": "text/javascript"}
"""Type of the file at every address. The page loads nothing else, so it works without a network."""


def application(session: Session) -> Starlette:
    """The web application of a session.

    - ``GET /scenes/<index>``: :meth:`~epo_lightning.explore.session.Session.describe`.
    - ``POST /solve`` with an :class:`~epo_lightning.explore.edit.Edit` as JSON:
      :meth:`~epo_lightning.explore.session.Session.solve`.

    A mistake in a request is answered with status 422 and ``{"error": message}``.
    """
    working = threading.Lock()  # the solver's buffers are those of one request at a time

    def file(request: Request) -> Response:
        kind = FILES[request.url.path]
        name = request.url.path.removeprefix("/") or "page.html"
        return Response(resources.files("epo_lightning.explore").joinpath(name).read_bytes(), media_type=kind)

    def scene(request: Request) -> Response:
        index = request.path_params["index"]
        if not index.isdecimal() or len(index) > 9:
            return _refusal(f"/scenes/{reprlib.repr(index)}: a scene is a whole number, counted from zero")
        with working:
            return _answer(session.describe, int(index))

    async def solve(request: Request) -> Response:
        try:
            values = json.loads(await request.body())
        except ClientDisconnect:
            return Response()
        except (ValueError, RecursionError) as error:
            return _refusal(f"the request is no JSON: {error}")
        if not isinstance(values, dict):
            return _refusal(f"the request must be an object with the changes of a game, not {reprlib.repr(values)}")

        def solved() -> Response:
            with working:
                return _answer(lambda: session.solve(read(Edit, values)))

        return await run_in_threadpool(solved)

    return Starlette(
        routes=[
            *(Route(address, file) for address in FILES),
            Route("/scenes/{index}", scene),
            Route("/solve", solve, methods=["POST"]),
        ]
    )


def _answer(question: Any, *words: Any) -> Response:
    try:
        return JSONResponse(question(*words))
    except ConfigError as error:
        return _refusal(str(error))


def _refusal(message: str) -> Response:
    return JSONResponse({"error": message}, status_code=422)
