#!/bin/bash
# obstore 0.12.1 (object_store 0.14), Python 3.12, seen in November 2026.
#
# 1. A plain put (no condition) that S3 answers with 409 "OperationAborted: a conflicting operation is in progress, try again" raises
#    AlreadyExistsError, the error of a put under the condition that nothing is there. Nothing was stored.
# 2. `from_url` drops what follows # or ? of an address, and reads %20 as a space: s3://bucket/run#2 is the place s3://bucket/run.
#    The constructor S3Store("bucket", prefix="run#2") takes the prefix as it is.
# 3. An upload in parts whose completion was done, and whose reply is lost, raises NotFoundError (a FileNotFoundError), of the clean-up that
#    follows. The object is there.
#
# Output seen:
#   plain put answered with 409: AlreadyExistsError, stored: False
#   prefixes: run#2 -> run, run?2 -> run, run%202 -> run 2; constructor: run#2
#   completed upload without a reply: NotFoundError, stored: True
#
# Exit code 0: still so; 1: it changed. The server is the script's own, on this machine's loopback, and ends with it.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
if command -v uv >/dev/null; then
    uv venv --quiet --python 3.12 env
    uv pip install --quiet --python env/bin/python obstore==0.12.1
else
    python3.12 -m venv env
    env/bin/python -m pip install --quiet obstore==0.12.1
fi
cat > look.py <<'P'
import socket
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import obstore
from obstore.exceptions import BaseError
from obstore.store import S3Store, from_url

stored = set()


class Server(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def reply(self, status, body=b"", **headers):
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def do_PUT(self):
        self.rfile.read(int(self.headers["Content-Length"]))
        if "partNumber" in self.path:
            self.reply(200, ETag='"part"')
        else:
            self.reply(409, b"<Error><Code>OperationAborted</Code><Message>Try again.</Message></Error>")

    def do_POST(self):
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if "uploads" in self.path:
            self.reply(200, b"<InitiateMultipartUploadResult><UploadId>1</UploadId></InitiateMultipartUploadResult>")
        else:  # done, and the line breaks before the reply
            stored.add(self.path.partition("?")[0])
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)

    def do_DELETE(self):
        self.reply(404, b"<Error><Code>NoSuchUpload</Code><Message>It is over.</Message></Error>")

    def log_message(self, *_):
        pass


server = ThreadingHTTPServer(("127.0.0.1", 0), Server)
Thread(target=server.serve_forever, daemon=True).start()
options = {
    "endpoint": f"http://127.0.0.1:{server.server_port}", "region": "us-east-1", "access_key_id": "nobody",
    "secret_access_key": "nothing", "client_options": {"allow_http": True}, "retry_config": {"max_retries": 0},
}
store = S3Store("bucket", prefix="run", **options)


def answer(key, content):
    try:
        obstore.put(store, key, content)
    except BaseError as error:
        return type(error).__name__, f"/bucket/run/{key}" in stored
    except FileNotFoundError:
        return "NotFoundError", f"/bucket/run/{key}" in stored
    return "no error", f"/bucket/run/{key}" in stored


small, large = answer("small", b"new"), answer("large", bytes(11 << 20))
typed = ("run#2", "run?2", "run%202")
read = {name: from_url(f"s3://bucket/{name}", **options).prefix for name in typed}
exact = S3Store("bucket", prefix="run#2", **options).prefix
print(f"plain put answered with 409: {small[0]}, stored: {small[1]}")
print("prefixes: " + ", ".join(f"{name} -> {prefix}" for name, prefix in read.items()) + f"; constructor: {exact}")
print(f"completed upload without a reply: {large[0]}, stored: {large[1]}")
same = (
    small == ("AlreadyExistsError", False)
    and list(read.values()) == ["run", "run", "run 2"] and exact == "run#2"
    and large == ("NotFoundError", True)
)
raise SystemExit(0 if same else 1)
P
env/bin/python look.py
