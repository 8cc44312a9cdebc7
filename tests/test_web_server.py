"""The viewer's server: what it finds in a folder, whom it answers, and what it survives."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from sealing import seal
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from turgor.cli import main
from turgor.evolution.loop import evolve
from turgor.experiments import reproduce
from turgor.experiments.rows import Champion, write_rows
from turgor.task import make_task
from turgor.web import library as libraries
from turgor.web import server as servers
from turgor.web import watch
from turgor.web.library import Library
from turgor.web.server import Hub, Server, listen, make_app
from turgor.web.watch import Event

ROW = "{0},{1},1.5,0.5,0.4,0.1\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of a second of simulated time: escape-s0, escape-s1 and, in tries, flat."""
    out = tmp_path_factory.mktemp("web") / "runs"
    for seed in (0, 1):
        recipe = {"name": "escape", "body": "small", "seed": seed}
        evolve(make_task("escape", steps=20), 42, seed, out / f"escape-s{seed}", robust_repeats=3, recipe=recipe)
    evolve(make_task("flat", body="medium", steps=20, window=15), 23, 7, out / "tries" / "flat", robust_repeats=2)
    return out


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "runs"))


class Served:
    """A server in a thread, and a client of it."""

    def __init__(self, folder: Path, host: str = "127.0.0.1", token: str | None = None) -> None:
        listener = listen("127.0.0.1", 0)
        self.port = listener.getsockname()[1]
        self.library = Library(folder)
        app, self.hub = make_app(self.library, host=host, port=self.port, token=token)
        ready = threading.Event()
        self.server = Server(app, self.hub, ready.set)
        self._thread = threading.Thread(target=self.server.run, kwargs={"sockets": [listener]}, daemon=True)
        self._thread.start()
        assert ready.wait(20)
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=20)

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.client.get(path, **options)

    def close(self) -> None:
        self.client.close()
        self.server.should_exit = True
        self._thread.join(10)
        assert not self._thread.is_alive()


@contextlib.contextmanager
def served(folder: Path, **options: Any) -> Iterator[Served]:
    server = Served(folder, **options)
    try:
        yield server
    finally:
        server.close()


@pytest.fixture(scope="module")
def web(made: Path) -> Iterator[Served]:
    with served(made) as server:
        yield server


# --- what lies in a folder ----------------------------------------------------------------------------------------


def test_every_run_is_listed_with_its_numbers(web: Served, made: Path) -> None:
    found = web.get("/api/library").json()
    assert found["folder"] == "runs"
    assert found["problems"] == found["campaigns"] == []
    runs = {run["path"]: run for run in found["runs"]}
    assert set(runs) == {"escape-s0", "escape-s1", "tries/flat"}
    first, flat = runs["escape-s1"], runs["tries/flat"]
    assert [first[k] for k in ("name", "body", "condition", "controller", "strategy", "seed", "status", "unit")] == [
        *("escape", "small", "pressure", "linear", "cma-es", 1, "done", "m/s")
    ]
    assert (first["generation"], first["evaluations"], first["budget"], first["solved"]) == (2, 42, 42, False)
    assert first["fitness"] == float((made / "escape-s1" / "history.csv").read_text().splitlines()[-1].split(",")[2])
    assert first["kept"] == first["fitness"]
    assert first["robust"] == json.loads((made / "escape-s1" / "run.json").read_text())["result"]["robust_fitness"]
    assert (flat["body"], flat["solved"]) == ("medium", None)  # by its masses: it has no recipe


def test_a_run_tells_history_settings_and_champion(web: Served) -> None:
    found = web.get("/api/run/escape-s0").json()
    assert found["history"]["generation"] == [1, 2]
    assert set(found["history"]) == {"generation", "evaluations", "best", "median", "sigma", "seconds"}
    assert found["settings"]["population"] == 21
    assert found["task"]["masses"] == 10
    assert len(found["champion"]["robust"]) == 3
    assert found["champion"]["robust_solved"] == 0


def test_the_folder_may_be_one_run(made: Path) -> None:
    library = Library(made / "escape-s0")
    library.look()
    assert list(library.runs) == [""]
    assert library.details("")["history"]["generation"] == [1, 2]


def test_a_campaign_is_a_grid(folder: Path) -> None:
    assert libraries.MARK == reproduce.MARK
    (folder / "campaign.json").write_text('{"format": 1}')
    champion = Champion(
        **{"run": "escape-s0", "question": "rq2", "task": "escape", "body": "small", "condition": "pressure"},
        **{"change": "", "seed": 0, "evaluations": 42, "generation": 1, "best": 0.25, "robust": 0.125, "starts": 30},
        **{"robust_low": 0.1, "robust_high": 0.2, "solved": False, "solved_starts": 0, "escape_time": None},
        **{"tangled_starts": 0, "tangled_steps": 0, "steps": 20},
    )
    (folder / "tables").mkdir()
    write_rows(folder / "tables" / "champions.csv", Champion, [champion])
    library = Library(folder)
    library.look()
    (campaign,) = library.campaigns
    assert (campaign.path, campaign.runs, campaign.done, campaign.tables) == ("", 3, 3, True)
    groups = {(g.task, g.body, g.condition): g for g in library.grid("")["groups"]}
    escape = groups["escape", "small", "pressure"]
    assert escape.runs == ["escape-s0", "escape-s1"]  # of the table, and one that it does not have
    assert escape.robust == [0.125, library.runs["escape-s1"].robust]
    assert groups["flat", "medium", "pressure"].runs == ["tries/flat"]


def test_a_run_that_is_silent_for_long_was_interrupted(folder: Path) -> None:
    record = folder / "escape-s0" / "run.json"
    record.write_text(record.read_text().replace('"status": "done"', '"status": "running"'))
    library = Library(folder)
    library.look()
    assert library.runs["escape-s0"].status == "running"
    for file in (folder / "escape-s0").iterdir():
        os.utime(file, (time.time() - 1000,) * 2)
    ((kind, summary),) = library.look()
    assert (kind, summary.status) == ("run", "interrupted")


# --- what is wrong in a folder ------------------------------------------------------------------------------------


def _archive(path: Path, header: bytes, data: bytes = b"", compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("theta.npy", header + data)
        archive.writestr("solved.npy", header + data)


def _npy(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": dtype})
    return file.getvalue()


def _hole(path: Path, size: int) -> None:
    with open(path, "wb") as file:
        file.truncate(size)


def _pickled(path: Path) -> None:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"shape": (1,), "fortran_order": False, "descr": "|O"})
    _archive(path, file.getvalue(), pickle.dumps([print]))


def _replaced(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


BROKEN = {
    "cut": (lambda run: (run / "run.json").write_text('{"format": 1, "sta'), "run.json: expected JSON"),
    "empty": (lambda run: (run / "run.json").write_text(""), "run.json: expected JSON"),
    "list": (lambda run: (run / "run.json").write_text("[1]"), "run.json: Expected `object`"),
    "deep": (lambda run: (run / "run.json").write_text("[" * 100_000), "run.json: "),
    "bytes": (lambda run: (run / "run.json").write_bytes(bytes(range(256))), "run.json: expected JSON"),
    "format": (
        lambda run: _replaced(run / "run.json", '"format": 2', '"format": 9'),
        "a run of format 1 or 2; got format 9",
    ),
    "seed": (lambda run: _replaced(run / "run.json", '"seed":0', '"seed":1' + "0" * 30), "run.json: "),
    "seed 2": (
        lambda run: _replaced(run / "run.json", '"seed":0', '"seed":9007199254740993'),
        "seed: expected a whole number, 0 to 9007199254740992",
    ),
    "large record": (lambda run: _hole(run / "run.json", 6_000_000), "run.json: expected at most 5 MB; got 6.0 MB"),
    "large history": (lambda run: _hole(run / "history.csv", 10**10), "history.csv: expected at most 50 MB"),
    "columns": (lambda run: (run / "history.csv").write_text("a,b\n1,2\n"), "history.csv: expected the columns"),
    "numbers": (
        lambda run: (run / "history.csv").open("a").write("x,y,z,1,2,3\n"),
        "history.csv: expected rows of six numbers; got x,y,z,1,2,3",
    ),
    "large archive": (lambda run: _hole(run / "champion.npz", 60_000_000), "champion.npz: expected at most 50 MB"),
    "no archive": (lambda run: (run / "champion.npz").write_bytes(b"PK"), "champion.npz: expected arrays"),
    "bomb": (
        lambda run: _archive(run / "champion.npz", _npy((10_000_000,)), bytes(80_000_000), zipfile.ZIP_DEFLATED),
        "champion.npz: expected arrays written by turgor; got compressed arrays",
    ),
    "claim": (
        lambda run: _archive(run / "champion.npz", _npy((10**13,))),
        "got an array of shape [10000000000000] in 0 bytes",
    ),
    "objects": (lambda run: _pickled(run / "champion.npz"), "arrays written by turgor; got an array of object"),
    "link": (lambda run: (run / "champion.npz").unlink() or (run / "champion.npz").symlink_to("/etc/passwd"), "a link"),
    "pipe": (lambda run: (run / "run.json").unlink() or os.mkfifo(run / "run.json"), "run.json: expected a plain file"),
    "folder": (
        lambda run: (run / "run.json").unlink() or (run / "run.json").mkdir(),
        "run.json: expected a plain file",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_broken_run_is_told_and_the_others_are_shown(folder: Path, name: str) -> None:
    breaks, told = BROKEN[name]
    breaks(folder / "escape-s0")
    library = Library(folder)
    began = time.perf_counter()
    library.look()
    assert time.perf_counter() - began < 2
    assert set(library.runs) == {"escape-s1", "tries/flat"}
    ((path, problem),) = library.problems.items()
    assert path == "escape-s0"
    assert told in problem
    assert len(problem.splitlines()) == 1
    assert len(problem) < 400
    assert str(folder) not in problem
    with pytest.raises(libraries.Refused) as refused:
        library.details("escape-s0")
    assert refused.value.status == 422
    shutil.rmtree(folder / "escape-s0")  # and it heals
    library.look()
    assert library.problems == {}


def test_a_folder_full_of_wrong_things(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "escape-s0", tmp_path / "outside")
    (folder / "out").symlink_to(tmp_path / "outside")
    (folder / "etc").symlink_to("/etc")
    (folder / "round").symlink_to(folder)
    (folder / "nowhere").symlink_to(folder / "not here")
    shutil.copytree(folder / "escape-s0", folder / "1" / "2" / "3" / "4" / "5")
    os.mkdir(os.fsencode(folder) + b"/\xff\xfe")
    shutil.copytree(folder / "escape-s0", folder / "ä #?%2e&<b> \"'")
    library = Library(folder)
    library.look()
    assert set(library.runs) == {"escape-s0", "escape-s1", "tries/flat", "ä #?%2e&<b> \"'"}
    assert set(library.problems) == {"out", "etc", "'\\udcff\\udcfe'"}
    assert library.problems["out"] == "a link that leads out of the folder is not followed"


def test_more_runs_than_anybody_looks_at(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "MOST_RUNS", 2)
    library = Library(folder)
    library.look()
    assert len(library.runs) == 2
    assert "the rest is left out" in library.problems[""]


def test_a_run_with_functions_of_ones_own_is_told_without_its_task(tmp_path: Path) -> None:
    task = make_task("flat", steps=5)
    task = type(task)(
        **{name: getattr(task, name) for name in task.__struct_fields__ if name != "fitness"}, fitness=_own
    )
    evolve(task, 21, 0, tmp_path / "own", robust_repeats=1)
    library = Library(tmp_path)
    library.look()
    found = library.details("own")
    assert found["settings"].population == 21
    assert "expected the task to be passed" in found["problem"]


def _own(out: Any) -> Any:
    return out.position[:, :, 0].mean(axis=1)


# --- live ---------------------------------------------------------------------------------------------------------


def _begin(folder: Path, rows: int = 2) -> Path:
    """A run that still runs, with that many generations."""
    run = folder / "escape-s0"
    seal(run, status="running", history=None)
    text = "generation,evaluations,best,median,sigma,seconds\n"
    (run / "history.csv").write_text(text + "".join(ROW.format(k, 21 * k) for k in range(1, rows + 1)))
    return run / "history.csv"


@pytest.mark.parametrize("before", [0, 1, 5, 3000])
def test_new_rows_are_told_once(folder: Path, before: int) -> None:
    history = _begin(folder, before)
    library = Library(folder)
    library.look()
    assert library.runs["escape-s0"].generation == before
    with open(history, "a") as file:
        file.write(ROW.format(before + 1, 21 * before + 21) + ROW.format(before + 2, 21 * before + 42)[:9])
    run, rows = library.look()
    assert (run.kind, run.data.generation) == ("run", before + 1)
    assert rows == Event(
        "rows",
        {"path": "escape-s0", "rows": [(before + 1, 21 * before + 21, 1.5, 0.5, 0.4, 0.1)], "first": before},
    )
    assert library.look() == []
    with open(history, "a") as file:  # the half row is whole now
        file.write(ROW.format(before + 2, 21 * before + 42)[9:])
    assert [row[0] for row in library.look()[-1].data["rows"]] == [before + 2]


def test_of_a_long_history_only_the_end_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history = _begin(folder, 200_000)
    library = Library(folder)
    began = time.perf_counter()
    library.look()
    assert time.perf_counter() - began < 0.5
    parsed = []
    monkeypatch.setattr(watch, "_parse", lambda line, parse=watch._parse: parsed.append(line) or parse(line))
    with open(history, "a") as file:
        file.write(ROW.format(200_001, 21 * 200_001))
    library.look()
    assert len(parsed) == 1
    assert len(library.details("escape-s0")["history"]["generation"]) == libraries.MOST_ROWS


def test_a_history_that_is_written_anew_starts_again(folder: Path) -> None:
    history = _begin(folder, 50)
    library = Library(folder)
    library.look()
    new = history.with_name("new")
    new.write_text("generation,evaluations,best,median,sigma,seconds\n" + ROW.format(1, 21) + ROW.format(2, 42))
    os.replace(new, history)
    run, rows = library.look()
    assert run.data.generation == 2
    assert (rows.data["first"], [row[0] for row in rows.data["rows"]]) == (1, [2])


def test_runs_come_and_go(folder: Path) -> None:
    library = Library(folder)
    library.look()
    shutil.copytree(folder / "escape-s0", folder / "new")
    ((kind, summary),) = library.look()
    assert (kind, summary.path) == ("run", "new")
    shutil.rmtree(folder / "new")
    assert library.look() == [Event("gone", {"path": "new"})]


def _events(lines: Iterator[str]) -> Iterator[tuple[str, Any]]:
    kind = ""
    for line in lines:
        if line.startswith("event: "):
            kind = line[7:]
        elif line.startswith("data: "):
            yield kind, json.loads(line[6:])


def test_a_page_hears_what_is_new(folder: Path) -> None:
    history = _begin(folder)
    with served(folder) as web, web.client.stream("GET", "/api/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        lines = stream.iter_lines()
        assert next(lines) == "retry: 1000"
        with open(history, "a") as file:
            file.write("3,63,nan,-inf,0.4,0.2\n")
        (kind, summary), (kind2, rows) = (next(_events(lines)) for _ in range(2))
        assert (kind, summary["path"], summary["generation"], summary["fitness"]) == ("run", "escape-s0", 3, None)
        assert (kind2, rows["first"], rows["rows"]) == ("rows", 2, [[3, 63, None, None, 0.4, 0.2]])


# --- who may ask --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/api/run/%2e%2e/secret",
            "/api/run/..%2fsecret",
            "/api/run/a/%2e%2e/%2e%2e/secret",
            "/api/run/%2fetc/passwd",
        ),
        *("/api/run/a%5c..%5cb", "/api/run/a%00b", "/api/replay/%2e%2e", "/api/campaign/%2e%2e/x", "/api/run/C:/x"),
        *("/api/run/nowhere", "/api/run/tries", "/api/run/" + "a/" * 2000 + "b", "/api/run/" + "x" * 5000),
        *("/api/replay/nowhere", "/api/campaign/tries", "/api/campaign/", "/api/run/", "/api/nothing", "/nothing"),
        *("/static/%2e%2e/server.py", "/static/..%2fserver.py", "/static//etc/passwd", "/static/nothing.js"),
        "/api/replay/escape-s0?which=best'--",
    ],
)
def test_no_path_leads_out(web: Served, path: str) -> None:
    response = web.get(path)
    assert response.status_code in (400, 403, 404)
    assert list(response.json()) == ["error"]
    assert len(response.json()["error"].splitlines()) == 1
    assert "root:" not in response.text


def test_a_link_that_leads_out_is_refused(folder: Path) -> None:
    (folder / "etc").symlink_to("/etc")
    with served(folder) as web:
        assert web.get("/api/run/etc").status_code == 403
        assert web.get("/api/run/etc/ssl").status_code == 403


def test_headers_keep_the_page_to_itself(web: Served) -> None:
    for path in ("/", "/static/app.js", "/api/library", "/api/run/nowhere"):
        headers = web.get(path).headers
        assert "default-src 'self'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")
        assert "server" not in headers
        assert "access-control-allow-origin" not in headers
    assert web.client.post("/api/library").status_code == 405


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "localhost:1", "127.0.0.1.nip.io:{port}", ""])
def test_another_name_for_this_machine_is_refused(web: Served, host: str) -> None:
    response = web.get("/api/library", headers={"host": host.format(port=web.port)})
    assert response.status_code in (400, 403)
    assert "runs" not in response.text


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST", "127.0.0.1", "[::1]"])
def test_names_of_this_machine_are_taken(web: Served, host: str) -> None:
    assert web.get("/api/library", headers={"host": f"{host}:{web.port}"}).status_code == 200


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "file://", "http://[bad"])
def test_another_pages_origin_is_refused(web: Served, origin: str) -> None:
    for path in ("/api/events", "/api/library"):
        assert web.get(path, headers={"origin": origin}).status_code == 403
    with pytest.raises(InvalidStatus) as refused, connect(f"ws://127.0.0.1:{web.port}/api/play", origin=origin):  # ty: ignore[invalid-argument-type]
        pass
    assert refused.value.response.status_code == 403


def test_what_another_site_asks_is_refused(web: Served) -> None:
    for site, status in (("cross-site", 403), ("same-site", 403), ("same-origin", 200), ("none", 200)):
        assert web.get("/api/library", headers={"sec-fetch-site": site}).status_code == status
    assert web.get("/", headers={"sec-fetch-site": "cross-site"}).status_code == 200  # a link may lead here


def test_beyond_this_machine_the_token_is_asked_for(folder: Path) -> None:
    with served(folder, host="0.0.0.0", token="secret-token") as web:
        host = {"host": f"laptop.example:{web.port}"}  # any name reaches it
        for path in ("/", "/api/library", "/static/app.js", "/?token=", "/?token=secret", "/?token=%ff", "/api/events"):
            assert web.get(path, headers=host).status_code == 403
        for cookie in (f"turgor-{web.port}=wrong", "turgor-1=secret-token", f"turgor-{web.port}"):
            assert web.get("/api/library", headers={**host, "cookie": cookie}).status_code == 403
        with pytest.raises(InvalidStatus), connect(f"ws://127.0.0.1:{web.port}/api/play"):
            pass
        answer = web.get("/?token=secret-token", headers=host)
        assert answer.status_code == 200
        assert answer.headers["set-cookie"] == f"turgor-{web.port}=secret-token; HttpOnly; SameSite=Strict; Path=/"
        cookie = {**host, "cookie": f"a=b; turgor-{web.port}=secret-token"}
        assert web.get("/api/library", headers=cookie).status_code == 200
        assert "set-cookie" not in web.get("/", headers=cookie).headers


# --- what it survives ---------------------------------------------------------------------------------------------


def _listen_raw(port: int, buffer: int | None = None) -> socket.socket:
    """A client that asks for events, and reads when it likes."""
    client = socket.socket()
    if buffer is not None:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    client.settimeout(20)
    client.connect(("127.0.0.1", port))
    client.sendall(f"GET /api/events HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode())
    return client


def _wait(true: Any, seconds: float = 10) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_two_hundred_pages_hear_the_same(folder: Path) -> None:
    history = _begin(folder)
    with served(folder) as web, contextlib.ExitStack() as stack:
        clients = [stack.enter_context(_listen_raw(web.port)) for _ in range(200)]
        _wait(lambda: len(web.hub.clients) == 200)
        with open(history, "a") as file:
            file.write(ROW.format(3, 63))
        for client in clients:
            heard = b""
            while b"event: rows" not in heard:
                heard += client.recv(65536)
        assert web.get("/api/library").status_code == 200
        stack.close()
        _wait(lambda: not web.hub.clients)


def test_a_page_that_does_not_read_is_dropped_and_the_others_go_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(servers, "PATIENCE", 0.5)
    message = [Event("rows", {"path": "x", "rows": ["y" * 50_000]})]
    with served(folder) as web, _listen_raw(web.port, 4096) as deaf, _listen_raw(web.port) as hearing:
        _wait(lambda: len(web.hub.clients) == 2)
        loop = web.server.servers[0].get_loop()
        heard = 0
        for _ in range(500):
            loop.call_soon_threadsafe(web.hub.publish, message)
            end = heard + 50_000
            while heard < end:
                heard += len(hearing.recv(1 << 20))
        _wait(lambda: len(web.hub.clients) == 1)
        assert web.get("/api/library").status_code == 200
        loop.call_soon_threadsafe(web.hub.publish, message)
        assert hearing.recv(1)
        deaf.close()


def test_answers_are_not_held_back(web: Served) -> None:
    def seconds() -> float:
        began = time.perf_counter()
        assert web.get("/api/library").status_code == 200
        return time.perf_counter() - began

    assert min(seconds() for _ in range(20)) < 0.03  # Nagle and delayed acknowledgements: 0.04 s


def test_a_burst_of_changes_is_one_message() -> None:
    hub = Hub(Library("."))
    client = servers.Client()
    hub.clients.add(client)
    hub.publish([Event("gone", {"path": str(k)}) for k in range(1000)])
    assert client.messages.get_nowait() == b"event: library\ndata: {}\n\n"
    assert client.messages.empty()


def test_a_thousand_malformed_requests(folder: Path) -> None:
    rng = np.random.default_rng(0)
    with served(folder) as web:
        starts = [
            b"",
            b"GET ",
            b"GET /api/run/",
            b"GET / HTTP/1.1\r\nHost: ",
            b"GET /api/play HTTP/1.1\r\nUpgrade: websocket\r\n",
        ]
        for k in range(1000):
            noise = starts[k % len(starts)] + rng.bytes(int(rng.integers(1, 200))) + b"\r\n\r\n"
            with socket.create_connection(("127.0.0.1", web.port), timeout=10) as client:
                client.sendall(noise)
        assert web.get("/api/library").status_code == 200
        assert len(web.get("/api/library").json()["runs"]) == 3


# --- the command --------------------------------------------------------------------------------------------------


def _view(*argv: str) -> tuple[subprocess.Popen[str], str]:
    command = [sys.executable, "-m", "turgor", "view", *argv]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, process.stdout.readline()


def test_view_serves_until_ctrl_c(folder: Path) -> None:
    process, line = _view(str(folder), "--no-browser", "--port", "0")
    with process:
        found = re.fullmatch(rf"serving {re.escape(str(folder))} at (http://127\.0\.0\.1:\d+/)\n", line)
        assert found is not None, line
        assert len(httpx.get(f"{found[1]}api/library").json()["runs"]) == 3
        port = int(found[1].rpartition(":")[2].strip("/"))
        with _listen_raw(port) as client:  # a page is open
            assert client.recv(1000)
            began = time.monotonic()
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=20)
        assert (process.returncode, err) == (0, "")
        assert time.monotonic() - began < 4


def test_view_opens_the_page_and_prints_a_token_for_others(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []

    def open_page(address: str) -> None:
        opened.append(address)
        port, token = re.fullmatch(r"http://[^/]+:(\d+)/\?token=([\w-]{20,})", address).groups()  # ty: ignore[unresolved-attribute]
        assert httpx.get(f"http://127.0.0.1:{port}/").status_code == 403
        assert httpx.get(f"http://127.0.0.1:{port}/", params={"token": token}).status_code == 200
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("webbrowser.open", open_page)
    assert main(["view", str(folder), "--host", "0.0.0.0", "--port", "0"]) == 0
    assert opened
    assert f"at {opened[0]}\n" in capsys.readouterr().out


def test_the_next_free_port_is_taken() -> None:
    with contextlib.ExitStack() as stack:
        ports = [stack.enter_context(listen("127.0.0.1", None)).getsockname()[1] for _ in range(2)]
    assert 8417 <= ports[0] < ports[1] < 8437


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        (["view", "nowhere"], "nowhere: expected a folder of runs; got nothing there"),
        (["view", __file__], "expected a folder of runs; got a file"),
        (["view", ".", "--port", "x"], "--port: expected a whole number; got 'x'"),
        (["view", ".", "--port", "70000"], "--port: expected a port, 1 to 65535 (0: any); got 70000"),
        (["view", ".", "--host", "no such host"], "--host: expected a name or an address of this machine"),
        (["view", ".", "--host", "192.0.2.1"], "192.0.2.1: expected a free port, 8417 to 8436; got Cannot assign"),
    ],
)
def test_errors_of_view_are_one_line(argv: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line
