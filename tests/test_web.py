"""Requests to the server: over verified TLS, to the certificate that is meant, bounded in size and time."""

import asyncio
import socket
import ssl
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from robotd.bind import bind
from robotd.clock import now, run_virtual
from robotd.config import UploadConfig
from robotd.errors import ConfigError, InputError, UploadError
from robotd.web import ANSWER_LIMIT, WebServer
from tests.certificates import EXPIRED, VALID, certify, fingerprint, needs_openssl


@contextmanager
def serving(tls=None, answer=b"{}"):
    """A server on this computer; yields its address and the requests that reached it."""
    requests = []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_):
            pass

        def do_GET(self):
            requests.append((self.path, dict(self.headers)))
            self.send_response(200)
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.handle_error = lambda *_: None
    if tls is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(*tls)
        server.socket = context.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    scheme = "http" if tls is None else "https"
    try:
        yield f"{scheme}://127.0.0.1:{server.server_address[1]}", requests
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def get(server, **options):
    return asyncio.run(server.exchange("GET", "/api/surveys", **{"timeout_s": 10.0, **options}))


@needs_openssl
def test_the_token_goes_only_to_a_server_whose_certificate_is_valid_and_the_one_that_is_meant(tmp_path):
    good = certify(tmp_path, "good", "127.0.0.1", VALID)
    expired = certify(tmp_path, "expired", "127.0.0.1", EXPIRED)
    elsewhere = certify(tmp_path, "elsewhere", "10.1.2.3", VALID)
    pin = fingerprint(good[0])
    with serving(good) as (url, requests):
        for pins in ((), (pin,), ("0" * 64, pin)):
            assert get(WebServer(url, "t0ken", ca_file=good[0], pins=pins)) == (200, b"{}")
        assert {headers["Authorization"] for _, headers in requests} == {"Bearer t0ken"}
        requests.clear()
        for options, words in (
            ({"ca_file": good[0], "pins": ["0" * 64]}, f"another certificate than upload.pins, sha256 {pin}; add that"),
            ({}, "self-signed certificate; give the certificate that signed its own as upload.ca_file"),
            ({"pins": [pin]}, "self-signed certificate"),  # a pin narrows what is trusted, it does not replace trust
            ({"ca_file": good[1]}, r"upload.ca_file .*good.key cannot be used"),
            ({"ca_file": tmp_path / "none"}, "none cannot be used .No such file"),
        ):
            with pytest.raises(UploadError, match=words) as caught:
                get(WebServer(url, "t0ken", **options))
            assert not caught.value.permanent
        with pytest.raises(UploadError, match="not trusted"):
            WebServer(url, "t0ken").ask("GET", "/healthz", timeout_s=10.0)
        with pytest.raises(UploadError, match="cannot be reached"):
            get(WebServer(url.replace("https", "http"), None))
    for wrong, words in (
        (expired, "certificate has expired; renew its certificate, or see to the robot's clock"),
        (elsewhere, "IP address mismatch.*; write the name that its certificate is for into upload.url"),
    ):
        with serving(wrong) as (url, seen):
            for pins in ((), (fingerprint(wrong[0]),)):
                with pytest.raises(UploadError, match=words):
                    get(WebServer(url, "t0ken", ca_file=wrong[0], pins=pins))
            assert seen == []
    assert requests == []


def test_an_answer_that_is_too_long_is_cut_off_and_the_limit_itself_is_taken():
    with serving(answer=b"x" * ANSWER_LIMIT) as (url, _):
        assert get(WebServer(url, None)) == (200, b"x" * ANSWER_LIMIT)
        with pytest.raises(UploadError, match=f"its answer has more than {ANSWER_LIMIT - 1} bytes"):
            get(WebServer(url, None), limit=ANSWER_LIMIT - 1)


def test_a_prefix_in_the_address_stays_and_virtual_time_stands_still():
    async def main():
        status, _ = await WebServer(url + "/robots/", None).exchange("GET", "/api/x", timeout_s=5.0)
        assert (status, now()) == (200, 0.0)

    with serving() as (url, requests):
        run_virtual(main())
    assert requests[0][0] == "/robots/api/x"


def drip(listener):
    """A server that sends a byte now and then, and its headers never end."""
    connection, _ = listener.accept()
    with connection:
        connection.settimeout(0.01)
        connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
        while True:
            try:
                connection.sendall(b"x")
                if not connection.recv(4096):
                    return
            except TimeoutError:
                pass
            except OSError:
                return


def test_a_server_that_sends_drop_by_drop_is_left_after_the_time_limit_and_its_thread_ends():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = threading.Thread(target=drip, args=(listener,))
        server.start()
        with pytest.raises(UploadError, match=r"did not answer within 0\.2 s"):
            get(WebServer(f"http://127.0.0.1:{listener.getsockname()[1]}", None), timeout_s=0.2)
        server.join(10.0)
        assert not server.is_alive()
        for thread in threading.enumerate():
            if thread.name == "web":
                thread.join(10.0)
                assert not thread.is_alive()


def test_nothing_that_is_no_address_is_taken_and_passwords_are_not_repeated():
    for url in ("", "solver:8000", "ftp://solver", "http://", "https://s/?x=1", "http://s/#a", "http://s:99999/"):
        with pytest.raises(InputError, match="expected an address like https://"):
            WebServer(url, None)
    with pytest.raises(InputError, match="a user or a password") as caught:
        WebServer("https://me:s3cret@solver", None)
    assert "s3cret" not in str(caught.value)


def test_fingerprints_are_taken_as_openssl_writes_them_and_others_are_refused():
    shown = ":".join(["AB"] * 32)
    assert bind(UploadConfig, {"url": "https://s", "pins": [shown]}, "x").pins == ("ab" * 32,)
    for section, words in (
        ({"url": "https://s", "pins": ["AB:CD"]}, r"pins\[0\] = 'AB:CD'; expected 64 hexadecimal digits"),
        ({"url": "http://s", "pins": [shown]}, "expected https in url"),
        ({"url": "http://s", "ca_file": "x.pem"}, "expected https in url"),
        ({"pins": [shown]}, "expected https in url"),
    ):
        with pytest.raises(ConfigError, match=words):
            bind(UploadConfig, section, "x")
