"""The server's HTTP interface (ARCHITECTURE.md, "Interfaces"): surveys and stops come in, maps go out.

    PUT /api/surveys/{survey}                         header: a survey without its stops
    PUT /api/surveys/{survey}/legs/{leg}/stops/{stop} one stop
    GET /api/surveys                                  names and numbers of stops
    GET /api/surveys/{survey}                         robotd-survey/1
    GET /api/surveys/{survey}/map                     robotd-map/1 of all stops; solving begins when a stop comes
    GET /api/surveys/{survey}/labels                  the labels to look for, one id a line, as the operator wrote them
    GET /api/recordings                               names, sizes and hashes of the complete ones
    GET /api/recordings/{name}                        {"received": bytes, "complete": bool}
    PUT /api/recordings/{name}                        a piece, see below
    GET /api/roof                                     how the roof cameras do, and where the robot is
    GET /healthz                                      no token needed

Every refusal is JSON, {"problems": ["...", ...]}. A PUT may carry the SHA-256 of its body (RFC 9530); it is answered
with the SHA-256 of what is on the disk, 201 if that is new and 200 if it was there. A stop with `If-Match: "SHA-256"`
replaces the content of that hash: so a robot takes back the sightings of a stop that its operator has rejected.

A piece of a recording carries `Content-Range: bytes FIRST-LAST/SIZE` (RFC 9110) and the SHA-256 of the whole as
`Repr-Digest` (RFC 9530). It is answered as the GET is, 201 if that completed the recording; 409 with "received" says
where to go on if the piece does not begin there.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import logging
import re
import signal
import socket
import ssl
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from ..errors import InputError, RobotdError, SolverError
from .jobs import MapJobs
from .recordings import PIECE_LIMIT, OffsetError, Plan, RecordingStore, TooLargeError
from .store import ConflictError, Store, StoreError, UnknownSurveyError

log = logging.getLogger("robotd.server")

BODY_LIMIT = 8 << 20  # bytes; a stop with 1000 sightings has 150 kB
BODY_S = 60.0  # s, for a body to come in
_DIGEST = re.compile(r"sha-256=:([A-Za-z0-9+/=]+):")


_RANGE = re.compile(r"bytes (\d{1,15})-(\d{1,15})/(\d{1,15})")


def create_app(
    store: Store, token: str | None, *, jobs: MapJobs | None = None, recordings: RecordingStore | None = None
) -> FastAPI:
    """The application.

    Parameters
    ----------
    store : Store
        Where records are kept.
    token : str or None
        Secret that every request under /api must carry as `Authorization: Bearer`; None: no secret.
    jobs : MapJobs, optional
        How maps are solved: by default in a worker process.
    recordings : RecordingStore, optional
        Where recordings are kept; without it they are not taken.
    """
    maps = jobs or MapJobs(store)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        maps.close()

    app = FastAPI(title="robotd-solver", docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)
    _add_refusals(app)
    api = APIRouter(prefix="/api", dependencies=[Depends(_guard(token))])

    @api.get("/surveys")
    async def surveys() -> JSONResponse:
        found = await asyncio.to_thread(store.surveys)
        return JSONResponse({"surveys": [{"survey": name, "stops": stops} for name, stops in found.items()]})

    @api.put("/surveys/{survey}")
    async def put_header(survey: str, request: Request) -> JSONResponse:
        body = await _body(request)
        return _taken(await asyncio.to_thread(store.put_header, survey, body), body)

    @api.put("/surveys/{survey}/legs/{leg}/stops/{stop}")
    async def put_stop(survey: str, leg: int, stop: int, request: Request) -> JSONResponse:
        if not (0 < leg < 10**6 and 0 < stop < 10**6):
            raise InputError(f"survey {survey!r} leg {leg} stop {stop}: expected numbers from 1 to 999999")
        body = await _body(request)
        replaces = request.headers.get("if-match", "").strip('"') or None
        new = await asyncio.to_thread(store.put_stop, survey, leg, stop, body, replaces)
        if new:
            maps.begin(survey)
        return _taken(new, body)

    @api.get("/surveys/{survey}")
    async def get_survey(survey: str) -> Response:
        body, _ = await asyncio.to_thread(store.survey, survey)
        return Response(body, media_type="application/json")

    @api.get("/surveys/{survey}/map")
    async def get_map(survey: str) -> Response:
        return Response(await maps.map(survey), media_type="application/json")

    @api.get("/surveys/{survey}/labels")
    async def get_labels(survey: str) -> Response:
        return Response(await asyncio.to_thread(store.labels, survey), media_type="text/plain")

    if recordings is not None:
        _add_recordings(api, recordings)

    @api.get("/roof")
    async def roof() -> Response:
        body = await asyncio.to_thread(store.roof_status)
        return Response(body, media_type="application/json")

    @app.get("/healthz")
    async def healthz() -> JSONResponse:
        return JSONResponse({"ok": True})

    app.include_router(api)
    return app


def _add_recordings(api: APIRouter, store: RecordingStore) -> None:
    @api.get("/recordings")
    async def known() -> JSONResponse:
        found = await asyncio.to_thread(store.list)
        entries = [{"name": name, "size": plan.size, "sha256": plan.sha256} for name, plan in found.items()]
        return JSONResponse({"recordings": entries})

    @api.get("/recordings/{name}")
    async def received(name: str, request: Request) -> JSONResponse:
        digest, size = request.query_params.get("sha256"), request.query_params.get("size", "")
        plan = Plan(int(size), digest) if digest is not None and size.isdecimal() else None
        count, complete = await asyncio.to_thread(store.received, name, plan)
        return JSONResponse({"received": count, "complete": complete})

    @api.put("/recordings/{name}")
    async def put_piece(name: str, request: Request) -> JSONResponse:
        found = _RANGE.fullmatch(request.headers.get("content-range", ""))
        whole = _DIGEST.search(request.headers.get("repr-digest", ""))
        if found is None or whole is None:
            raise InputError("expected Content-Range: bytes FIRST-LAST/SIZE and Repr-Digest: sha-256=:BASE64:")
        first, last, size = map(int, found.groups())
        body = await _body(request, PIECE_LIMIT)
        if last - first + 1 != len(body):
            raise HTTPException(400, f"the body has {len(body)} bytes, not those that Content-Range names")
        try:
            digest = base64.b64decode(whole[1], validate=True).hex()
        except ValueError:
            raise InputError("Repr-Digest: expected the SHA-256 in base64") from None
        try:
            count, complete = await asyncio.to_thread(store.put, name, Plan(size, digest), first, body)
        except OffsetError as error:
            return JSONResponse({"problems": list(error.problems), "received": error.received}, 409)
        return JSONResponse({"received": count, "complete": complete}, 201 if complete else 200)


def announce(url: str) -> None:
    """Tell whoever started the server where it is."""
    print(f"robotd-solver: listening on {url}", flush=True)


def serve(
    host: str,
    port: int,
    data: Path,
    token: str | None,
    ready: Callable[[str], None] = announce,
    *,
    recording_limit: int = 16 << 30,
    certificate: tuple[Path, Path] | None = None,
) -> None:
    """Serve until SIGTERM or Ctrl-C.

    Parameters
    ----------
    host, port
        Where to listen; port 0 takes a free one.
    data : Path
        Folder of the surveys.
    token : str or None
        As `create_app`; without one only this computer may be listened to.
    ready : callable
        Called with the server's address once it answers.
    recording_limit : int
        Bytes that a recording may have.
    certificate : tuple of two Path, optional
        Files (PEM) of the certificate and its key: serves https.

    Raises
    ------
    InputError
        If the address cannot be had, or the certificate cannot be used.
    """
    if token is None and host not in ("127.0.0.1", "::1", "localhost"):
        raise InputError(f"host {host}: without a token only 127.0.0.1 may be served; give --token-file")
    if certificate is not None:
        _check_certificate(*certificate)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    with listener:
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
        except OSError as error:
            raise InputError(
                f"cannot listen on {host} port {port}: {error.strerror or error}; name another one"
            ) from error
        name = f"[{host}]" if family == socket.AF_INET6 else host
        url = f"{'http' if certificate is None else 'https'}://{name}:{listener.getsockname()[1]}"
        config = uvicorn.Config(
            create_app(Store(data), token, recordings=RecordingStore(data, recording_limit)),
            log_level="warning",
            access_log=False,
            limit_concurrency=256,
            timeout_graceful_shutdown=5,  # s; a map that is being solved does not hold up the end
            ws="none",
            ssl_certfile=None if certificate is None else certificate[0],
            ssl_keyfile=None if certificate is None else certificate[1],
        )
        if threading.current_thread() is threading.main_thread():
            # uvicorn raises the signal again after its clean shutdown, which would cut ours short
            signal.signal(signal.SIGTERM, lambda *_: None)
        with suppress(KeyboardInterrupt):
            _Server(config, lambda: ready(url)).run(sockets=[listener])


def _check_certificate(certificate: Path, key: Path) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        why = error.strerror or error
        raise InputError(f"certificate {certificate} with key {key}: cannot be used: {why}; give PEM files") from error


class _Server(uvicorn.Server):  # type: ignore[misc]
    """Says when it is ready."""

    def __init__(self, config: Any, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        if self.started:
            self._ready()


def _guard(token: str | None) -> Callable[[Request], Any]:
    expected = None if token is None else f"Bearer {token}".encode()

    async def guard(request: Request) -> None:
        given = request.headers.get("authorization", "").encode("latin-1")
        if expected is not None and not hmac.compare_digest(given, expected):
            raise HTTPException(401, "missing or wrong token; send 'Authorization: Bearer <token>'")

    return guard


async def _body(request: Request, limit: int = BODY_LIMIT) -> bytes:
    """The request's body, checked against its hash if it names one; never more than `limit` bytes in memory."""
    chunks: list[bytes] = []
    size = 0
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                size += len(chunk)
                if size <= limit:
                    chunks.append(chunk)
                elif size > 8 * limit:  # until then read on, so that the sender comes to read the answer
                    break
    except TimeoutError:
        raise HTTPException(408, f"the body did not come within {BODY_S:g} s") from None
    if size > limit:
        raise HTTPException(413, f"the body has more than {limit} bytes; is that one record?")
    body = b"".join(chunks)
    named = _DIGEST.search(request.headers.get("content-digest", ""))
    if named and named[1] != base64.b64encode(hashlib.sha256(body).digest()).decode():
        raise HTTPException(400, "the body does not have the hash that its Content-Digest names; send it again")
    return body


def _taken(new: bool, body: bytes) -> JSONResponse:
    return JSONResponse({"sha256": hashlib.sha256(body).hexdigest()}, 201 if new else 200)


def _add_refusals(app: FastAPI) -> None:
    """Turn every error into JSON with the status that tells the sender what to do."""

    def refusal(status: int) -> Callable[[Request, Exception], Any]:
        async def answer(_: Request, error: Exception) -> JSONResponse:
            if status >= 500:
                log.error("%s", error)
            return JSONResponse({"problems": str(error).splitlines()}, status)

        return answer

    async def http(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        return JSONResponse({"problems": [str(error.detail)]}, error.status_code, headers=error.headers)

    async def invalid(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        problems = [f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()]
        return JSONResponse({"problems": problems}, 422)

    async def gone(_: Request, error: Exception) -> Response:
        return Response(status_code=400)  # nobody is there to read it

    async def bug(_: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"problems": [f"the server failed: {type(error).__name__}: {error}"]}, 500)

    statuses: dict[type[RobotdError], int] = {
        UnknownSurveyError: 404,
        ConflictError: 409,
        TooLargeError: 413,
        InputError: 422,
        SolverError: 422,
        StoreError: 507,
        RobotdError: 500,
    }
    for kind, status in statuses.items():
        app.add_exception_handler(kind, refusal(status))
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(ClientDisconnect, gone)
    app.add_exception_handler(Exception, bug)
