"""The HTTP application: all routes, the web page, the OpenAPI description, errors of requests."""

from __future__ import annotations

import json
import secrets
from collections.abc import Collection
from pathlib import Path
from typing import Any, cast

from anyio import CapacityLimiter
from fastapi import Depends, FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware

from service.api import alarms, feeders, guide, models, system
from service.api.access import Authenticator
from service.api.dependencies import Answered, Backend, Forward, authorised
from service.api.description import BODY, TAGS, feeder_schemas
from service.api.errors import Guard, HeadAsGet, handlers, problem
from service.notify.delivery import Notifier

ACCESS_THREADS = 16
"""Largest number of requests that are authenticated at a time."""
MAX_BODY = 4 << 20
"""Largest request body, bytes."""
MAX_STREAMS = 100
"""Largest number of open event streams."""
GZIP_BYTES = 1000
"""Smallest response that is compressed, bytes."""
GZIP_LEVEL = 5
"""Level of the compression, 1 to 9."""
_WEB = Path(__file__).parent.with_name("web")


def create_api(
    backend: Backend,
    hosts: Collection[str] = (),
    *,
    max_streams: int = MAX_STREAMS,
    authenticator: Authenticator | None = None,
    notifier: Notifier | None = None,
    forward: Forward | None = None,
) -> FastAPI:
    """Return the HTTP application.

    `hosts` are host names for requests that change something, besides `localhost` and the machine's name.
    Without an authenticator every request has the identity `OPEN`, or that of its scope. `forward` passes
    requests to other processes.
    """
    app = FastAPI(
        title="gridsec",
        description="Monitors the voltages of distribution feeders and identifies manipulated meters.",
        version="1",
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        openapi_tags=TAGS,
        generate_unique_id_function=lambda route: route.name,
        responses={"default": {"model": models.Problem, "description": "Any error."}},
        dependencies=[Depends(authorised)],
    )
    app.state.authenticator, app.state.notifier = authenticator, notifier
    app.state.forward = forward
    app.state.access_threads = CapacityLimiter(ACCESS_THREADS)
    app.state.backend = backend
    app.state.probe = system.Probe(backend.store, authenticator)
    app.state.streams, app.state.viewers, app.state.max_streams = 0, 0, max_streams
    app.state.run = secrets.token_hex(4)
    app.add_middleware(GZipMiddleware, minimum_size=GZIP_BYTES, compresslevel=GZIP_LEVEL)
    app.add_middleware(HeadAsGet)
    app.add_middleware(Guard, max_body=MAX_BODY, hosts=hosts)
    for error, handler in handlers().items():
        app.add_exception_handler(error, handler)
    app.add_exception_handler(RequestValidationError, _validation_handler)
    app.add_exception_handler(Answered, _answered_handler)
    for router in (feeders.router, *alarms.routers, *system.routers):
        app.include_router(router)
    app.add_route(guide.ADDRESS, guide.show, include_in_schema=False)
    app.add_route(guide.DOCS, guide.show_docs, include_in_schema=False)
    app.mount("/", _Web(directory=_WEB, html=True), name="web")
    schema = json.loads(_described[0] if _described else _description(app))
    app.openapi = lambda: schema  # type: ignore[method-assign]  # FastAPI's way to extend the description
    app.state.queries = _queries(schema)
    return app


class _Web(StaticFiles):
    """The page. Browsers revalidate its files on every load, so that an upgrade takes effect at once."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response

    async def get_response(self, path: str, scope: Any) -> Response:
        """Return a file; 405 for a resource without the method: the page is mounted at every path."""
        if methods := _methods(scope["app"], scope["path"]):
            raise HTTPException(405, "Method Not Allowed", {"Allow": ", ".join(sorted(methods))})
        return await super().get_response(path, scope)


def _methods(app: FastAPI, path: str) -> frozenset[str]:
    """Methods of the resource at a path; a literal path goes before one with parameters."""
    queries: dict[tuple[str, str], frozenset[str]] = app.state.queries
    templates = {template for template, _ in queries}
    fitting = {path} & templates or {each for each in templates if _fits(each, path)}
    found = {method for template, method in queries if template in fitting}
    return frozenset(found | ({"HEAD"} if "GET" in found else set()))


def _fits(template: str, path: str) -> bool:
    """True if a path has the form of a template such as `/api/v1/feeders/{feeder}`."""
    parts, given = template.split("/"), path.split("/")
    return len(parts) == len(given) and all(
        bool(one) if each.startswith("{") else each == one for each, one in zip(parts, given, strict=True)
    )


_described: list[str] = []
"""Description of the first application of a process: all have the same routes, and it takes a second."""


def _description(app: FastAPI) -> str:
    """OpenAPI description, JSON, with errors as problems."""
    schema = app.openapi()
    error = {"$ref": "#/components/schemas/Problem"}
    for path in schema["paths"].values():
        for operation in path.values():
            operation["responses"].pop("422", None)
            operation["responses"]["default"]["content"] = {"application/problem+json": {"schema": error}}
    schemas = schema["components"]["schemas"]
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for name, shown in models.RENAMED.items():
        schemas[shown] = {**schemas.pop(name), "title": shown}
    schemas.update(feeder_schemas())
    put = schema["paths"]["/api/v1/feeders/{feeder}"]["put"]["requestBody"]
    put["content"]["application/json"]["schema"] = {"$ref": f"#/components/schemas/{BODY}"}
    text = json.dumps(schema)
    for name, shown in models.RENAMED.items():
        text = text.replace(f'"#/components/schemas/{name}"', f'"#/components/schemas/{shown}"')
    _described.append(text)
    return text


def _queries(schema: dict[str, Any]) -> dict[tuple[str, str], frozenset[str]]:
    """Return the names of the query parameters by path and method, from the OpenAPI description."""
    return {
        (path, method.upper()): frozenset(
            each["name"] for each in operation.get("parameters", ()) if each["in"] == "query"
        )
        for path, methods in schema["paths"].items()
        for method, operation in methods.items()
    }


async def _answered_handler(_request: Request, error: Exception) -> Response:
    return cast(Answered, error).response


async def _validation_handler(request: Request, error: Exception) -> Response:
    methods = _methods(request.app, request.url.path)
    if methods and request.method not in methods:
        # The path is literal and fits a parameter of another route, such as `ack` the id of an alarm.
        headers = {"Allow": ", ".join(sorted(methods))}
        return problem(request, 405, "Method Not Allowed", headers=headers)
    found = cast(RequestValidationError, error).errors()
    errors = [{"where": ".".join(str(part) for part in item["loc"]), "what": item["msg"]} for item in found]
    broken = any(item["type"] == "json_invalid" for item in found)
    detail = "; ".join(f"{item['where']}: {item['what']}" for item in errors)
    return problem(request, 400 if broken else 422, detail, errors=errors)
