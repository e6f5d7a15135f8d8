"""An S3 server for tests, on 127.0.0.1 only: prints its port, ends when its standard input does.

`GET /_every/N` makes it answer every N-th request from then on with 500 or 503 (0: none), and tells how many requests
it was asked, how many it failed and how many bytes of objects and lists it sent until then.
"""

import sys
import threading

from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server


class Troubled:
    def __init__(self, application):
        self.application = application
        self.every = self.asked = self.failed = self.sent = 0
        self.lock = threading.Lock()

    def __call__(self, environ, start_response):
        if environ["PATH_INFO"].startswith("/_every/"):
            told = f"{self.asked} {self.failed} {self.sent}".encode()
            self.every, self.asked, self.failed, self.sent = int(environ["PATH_INFO"].rpartition("/")[2]), 0, 0, 0
            start_response("200 OK", [("Content-Length", str(len(told)))])
            return [told]
        with self.lock:
            self.asked += 1
            fails = self.every > 0 and self.asked % self.every == 0
            self.failed += fails
        if not fails:

            def counted(status, headers, *rest):
                if environ["REQUEST_METHOD"] == "GET":
                    with self.lock:
                        self.sent += int({name.lower(): value for name, value in headers}.get("content-length", 0))
                return start_response(status, headers, *rest)

            return self.application(environ, counted)
        environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        status = "503 Slow Down" if self.failed % 2 else "500 Internal Server Error"
        start_response(status, [("Content-Length", "0")])
        return [b""]


class Quiet(WSGIRequestHandler):
    protocol_version = "HTTP/1.1"

    def log(self, *words):
        pass


if __name__ == "__main__":
    server = make_server(
        "127.0.0.1",
        0,
        Troubled(DomainDispatcherApplication(create_backend_app)),
        threaded=True,
        request_handler=Quiet,
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(server.server_port, flush=True)
    sys.stdin.read()
