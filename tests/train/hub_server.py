"""A hub on this machine, as far as an upload and a download ask it; repositories are folders."""

import base64
import hashlib
import json
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@contextmanager
def serving(folder):
    """Its URL; files are `folder/owner/name/file`."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *words):
            pass

        def answer(self, found, status=200):
            data = json.dumps(found).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def do_POST(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0))).decode()
            assert self.headers["Authorization"] == "Bearer hf_stub"
            if self.path == "/api/repos/create":
                asked = json.loads(body)
                name = f"{asked['organization']}/{asked['name']}"
                (folder / name).mkdir(parents=True, exist_ok=True)
                self.answer({"url": f"{url}/{name}"})
            elif self.path.endswith("/preupload/main"):
                files = [{"path": f["path"], "uploadMode": "regular"} for f in json.loads(body)["files"]]
                self.answer({"files": [one | {"shouldIgnore": False} for one in files]})
            elif self.path.endswith("/commit/main"):
                repository = folder / self.path.removeprefix("/api/models/").removesuffix("/commit/main")
                for line in map(json.loads, body.splitlines()):
                    if line["key"] == "file":
                        content = base64.b64decode(line["value"]["content"])
                        (repository / line["value"]["path"]).write_bytes(content)
                self.answer({"commitUrl": f"{url}{self.path}", "commitOid": "0" * 40})
            elif self.path == "/api/validate-yaml":
                self.answer({"warnings": [], "errors": []})
            else:
                self.answer({"error": f"no stub of POST {self.path}"}, 404)

        def do_GET(self):
            repository, _, name = self.path.lstrip("/").partition("/resolve/main/")
            path = folder / repository / name
            if not (name and path.is_file()):
                self.answer({"error": f"no stub of GET {self.path}"}, 404)
                return
            data = path.read_bytes()
            self.send_response(200)
            self.send_header("X-Repo-Commit", "0" * 40)
            self.send_header("ETag", f'"{hashlib.sha1(data).hexdigest()}"')
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(data)

        do_HEAD = do_GET  # noqa: N815

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield url
    finally:
        server.shutdown()
        server.server_close()
