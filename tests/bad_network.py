"""A network between robot and server that fails in every way: a forwarder on loopback, a fault for each connection."""

import contextlib
import select
import socket
import socketserver
import struct
import threading

FAULTS = ("gone", "reset", "500", "half", "lost", "slow")


class BadNetwork:
    """While it is entered, connections to `url` reach the server, or not.

    gone: closed before a byte is read. reset: read, then reset. 500: answered so, without asking the server. half: the
    server acts, half of its answer arrives. lost: the server acts, nothing arrives. slow: all in small pieces.

    Parameters
    ----------
    server : int
        The server's port.
    choose : callable
        Gives the fault of the next connection, or "ok".
    """

    def __init__(self, server, choose):
        self.server, self.choose = server, choose
        self.is_mended = False
        self.counts = dict.fromkeys(("ok", *FAULTS), 0)
        network = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self):
                with contextlib.suppress(OSError):
                    network.serve(self.request)

        self._listener = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self._listener.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._listener.server_address[1]}"
        self._thread = threading.Thread(target=self._listener.serve_forever, kwargs={"poll_interval": 0.05})

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._listener.shutdown()
        self._listener.server_close()
        self._thread.join()

    def serve(self, client):
        fault = "ok" if self.is_mended else self.choose()
        self.counts[fault] += 1
        if fault == "gone":
            return None
        request = whole_request(client)
        if fault == "500":
            client.sendall(b"HTTP/1.1 500 Oops\r\nContent-Length: 4\r\nConnection: close\r\n\r\noops")
        if fault in ("500", "reset"):
            return None if fault == "500" else reset(client)
        answer = b""
        with socket.create_connection(("127.0.0.1", self.server), 30) as upstream:
            upstream.sendall(request)
            while piece := upstream.recv(1 << 16):
                answer += piece
        if fault == "lost":
            return reset(client)
        if fault == "half":
            answer = answer[: len(answer) // 2]
        step = 40 if fault == "slow" else max(1, len(answer))
        for start in range(0, len(answer), step):
            client.sendall(answer[start : start + step])
            if fault == "slow":
                select.select([], [], [], 0.01)
        return None


def whole_request(client):
    data = b""
    while b"\r\n\r\n" not in data:
        data += received(client)
    head, _, body = data.partition(b"\r\n\r\n")
    length = next((int(line[15:]) for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:")), 0)
    while len(body) < length:
        body += received(client)
    return head + b"\r\n\r\n" + body


def received(client):
    data = client.recv(1 << 16)
    if not data:
        raise ConnectionError
    return data


def reset(client):
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
