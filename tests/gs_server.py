"""A Google Cloud Storage server for tests, on 127.0.0.1 only: prints its port, ends when its standard input does."""

import logging
import sys

from gcp_storage_emulator.server import create_server

if __name__ == "__main__":
    logging.disable()
    server = create_server("127.0.0.1", 0, in_memory=True)
    server.start()
    print(server._api._httpd.server_port, flush=True)
    sys.stdin.read()
    server.stop()
