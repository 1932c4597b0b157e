"""Who gets in: one secret, this host, this origin; files of the study only; what is hostile stays text."""

import itertools
import re
import socket
import threading
import time
from urllib.parse import quote, unquote

import httpx
import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from limbfit.cli import app as command_line
from limbfit.errors import InputError, RunError
from limbfit.studio.folder import StudyFolder
from limbfit.studio.guard import LARGEST_BODY, AccessGuard
from limbfit.studio.server import STATIC, create_app, serve_studio

PORT = 8123
HOST = f"127.0.0.1:{PORT}"
ORIGIN = f"http://{HOST}"


@pytest.fixture
def door():
    return AccessGuard("127.0.0.1", PORT)


@pytest.fixture
def app(study, door):
    return create_app(StudyFolder(study / "study.toml"), door)


@pytest.fixture
def stranger(app):
    """Whoever reaches the port, without the key."""
    return TestClient(app, base_url=ORIGIN, raise_server_exceptions=False)


@pytest.fixture
def page(app, door):
    """The page itself: the cookie of its first visit, and its origin where something is changed."""
    client = TestClient(app, base_url=ORIGIN, raise_server_exceptions=False)
    assert client.get("/", params={"token": door.token}).status_code == 200
    return client


def templates(app) -> list[tuple[str, str]]:
    """Every method and path that the application answers, parameters in braces."""
    found = set()

    def walk(holder):
        for route in getattr(holder, "routes", []):
            found.update((method, route.path) for method in getattr(route, "methods", None) or ())
            walk(getattr(route, "original_router", None))

    walk(app)
    return sorted(found)


def routes(app) -> list[tuple[str, str]]:
    """The same with a plain word for each parameter."""
    return sorted({(method, _filled(path, "1")) for method, path in templates(app)})


def _filled(path: str, word: str) -> str:
    """The path with the word for each parameter."""
    return re.sub(r"\{[^}]*\}", word, path)


def test_all_routes_are_known_to_these_tests(app):
    paths = {path for _, path in routes(app)}
    assert {"/", "/api/study", "/api/files/1", "/api/image/labels", "/api/identification/start"} <= paths
    assert len(paths) > 20


def test_nothing_is_answered_without_the_key(app, stranger):
    given = [
        *routes(app),
        ("GET", "/static/studio.js"),
        ("GET", "/web/vendor/three.min.js"),
        ("GET", "/none"),
    ]
    for method, path in given:
        answer = stranger.request(method, path, headers={"Origin": ORIGIN})
        assert answer.status_code == 401, (method, path)
        assert "stump" not in answer.text
        assert "set-cookie" not in answer.headers


@pytest.mark.parametrize("wrong", ["", "x", "é", "A" * 43, "{token}x", "x{token}", "{cut}"])
def test_a_wrong_key_opens_nothing(stranger, door, wrong):
    given = wrong.format(token=door.token, cut=door.token[:-1])
    assert stranger.get("/", params={"token": given}).status_code == 401
    stranger.cookies.set(door.cookie, quote(given))
    assert stranger.get("/api/study").status_code == 401


def test_the_key_counts_on_the_first_page_only(stranger, door):
    assert stranger.get("/api/study", params={"token": door.token}).status_code == 401
    answer = stranger.get("/", params={"token": door.token})
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert door.token not in answer.text
    assert stranger.get("/api/study").json()["name"] == "stump"


def test_keys_differ_and_are_long():
    keys = {AccessGuard("127.0.0.1", 1).token for _ in range(50)}
    assert len(keys) == 50
    assert min(map(len, keys)) >= 43
    assert AccessGuard("127.0.0.1", 1).token not in repr(AccessGuard("127.0.0.1", 1))


@pytest.mark.parametrize(
    "host",
    ["evil.example", f"evil.example:{PORT}", "127.0.0.1", "127.0.0.1:1", f"127.0.0.1.evil.example:{PORT}",
     f"[::1]:{PORT}", f"0.0.0.0:{PORT}", "", f"{HOST}, evil.example", f"{HOST}@evil.example"],
)  # fmt: skip
def test_names_that_resolve_to_this_machine_are_refused(page, host):
    """DNS rebinding: the browser believes to talk to another site, and says so in Host."""
    assert page.get("/api/study", headers={"Host": host}).status_code == 421
    assert page.post("/api/identification/start", headers={"Host": host, "Origin": ORIGIN}).status_code == 421


def test_both_names_of_this_machine_are_served(page):
    assert page.get("/api/study", headers={"Host": f"localhost:{PORT}"}).status_code == 200


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", f"http://evil.example:{PORT}", f"https://{HOST}", "http://127.0.0.1:1", "null",
     "", f"{ORIGIN}.evil.example", "file://"],
)  # fmt: skip
def test_other_origins_change_and_read_nothing(app, page, study, origin):
    before = (study / "study.toml").read_bytes()
    for method, path in routes(app):
        answer = page.request(method, path, headers={"Origin": origin}, json={})
        assert answer.status_code == 403, (method, path)
        assert "access-control-allow-origin" not in answer.headers
    assert (study / "study.toml").read_bytes() == before


def test_changes_need_an_origin(app, page):
    for method, path in routes(app):
        if method == "POST":
            assert page.post(path, json={}).status_code == 403, path


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_the_browser_says_where_a_request_comes_from(page, door, site):
    headers = {"Sec-Fetch-Site": site}
    assert page.get("/api/study", headers=headers).status_code == 403
    assert page.get("/static/studio.js", headers=headers).status_code == 403
    assert page.get("/", headers=headers).status_code == 403  # a link of another page has no key
    assert page.get("/", params={"token": door.token}, headers=headers).status_code == 200


def test_preflights_of_other_origins_get_no_leave(page):
    headers = {"Origin": "http://evil.example", "Access-Control-Request-Method": "POST"}
    answer = page.options("/api/identification/start", headers=headers)
    assert answer.status_code == 403
    assert not [name for name in answer.headers if name.startswith("access-control")]


def test_every_answer_says_what_it_may_load(page):
    for path in ("/", "/api/study", "/static/studio.js", "/api/none"):
        answer = page.get(path)
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"


def test_the_page_names_no_other_server():
    for file in STATIC.rglob("*"):
        if file.suffix in (".js", ".html", ".css") and "vendor" not in file.parts:
            text = file.read_text().replace("http://www.w3.org/2000/svg", "")
            assert "http://" not in text, file
            assert "https://" not in text, file
            assert "innerHTML" not in text, file
            assert "eval(" not in text, file


HOSTILE = [
    "..%2fsecret.txt",
    "..", "../study.toml", "%2e%2e%2fstudy.toml", "....//study.toml", "/etc/passwd", "..\\study.toml",
    "a\x00.stl", "link.txt", ".lock", "", "~", "skin.stl/../../study.toml",
]  # fmt: skip


def test_no_parameter_leads_out_of_the_results(app, page, study):
    """Each part of each path in turn is something hostile; what is secret is never in the answer."""
    (study / "secret.txt").write_text("TOPSECRET")
    surfaces = study / "results" / "surfaces"
    surfaces.mkdir(parents=True)
    (surfaces / "skin.stl").write_text("solid")
    (surfaces / "link.txt").symlink_to(study / "secret.txt")
    (surfaces / "linked").symlink_to(study)
    wide = [route for route in templates(app) if "{" in route[1]]
    assert len(wide) > 8
    ways = [("surfaces", name) for name in HOSTILE] + [("linked", "secret.txt"), ("..", "secret.txt")]
    for (method, template), (plain, hostile) in itertools.product(wide, ways):
        path = _with(template, plain, quote(hostile, safe=""))
        answer = page.request(method, path, headers={"Origin": ORIGIN}, follow_redirects=False)
        if answer.request.url.path != unquote(path):  # the client itself took the dots out
            continue
        assert answer.status_code in (307, 400, 404, 405, 409, 422), (method, path, answer)
        assert "TOPSECRET" not in answer.text
        assert "[study]" not in answer.text


def _with(template: str, plain: str, last: str) -> str:
    """The path with ``last`` as its last parameter and ``plain`` as the others."""
    head, _, tail = template.rpartition("{")
    return _filled(head, plain) + last + tail.partition("}")[2]


@pytest.mark.parametrize(
    "path", ["/static/../guard.py", "/static/%2e%2e/guard.py", "/web/../__init__.py", "/static//etc/passwd"]
)
def test_the_pages_own_files_are_all_it_serves(page, path):
    answer = page.get(path)
    assert answer.status_code == 404
    assert "import" not in answer.text


def test_links_out_of_the_results_are_not_followed(page, study):
    report = study / "results" / "report"
    report.mkdir(parents=True)
    (study / "secret.txt").write_text("TOPSECRET")
    (report / "report.html").symlink_to(study / "secret.txt")
    answer = page.get("/api/files/report/report.html")
    assert answer.status_code == 422
    assert "TOPSECRET" not in answer.text


def test_oversized_bodies_are_refused(page):
    headers = {"Origin": ORIGIN, "Content-Type": "application/json"}
    path = "/api/image/labels"
    stated = page.post(path, headers={**headers, "Content-Length": str(LARGEST_BODY + 1)}, content=b"{}")
    assert stated.status_code == 413
    wrong = page.post(path, headers={**headers, "Content-Length": "-1"}, content=b"{}")
    assert wrong.status_code in (400, 413)

    def endless():
        for _ in range(LARGEST_BODY // 65536 + 2):
            yield b" " * 65536

    unstated = page.post(path, headers=headers, content=endless())
    assert unstated.status_code in (400, 413)


@pytest.mark.parametrize(
    "runs",
    [
        [],
        [[0, 1]],
        [[0, 0, 1]],
        [[-1, 1, 1]],
        [[0, 1, 256]],
        [["0", [], 1]],
        [[0, 1, 1.5]],
        "all",
        None,
        [[1e30, 1, 1]],
    ],
)
def test_malformed_paintings_are_refused_in_one_line(page, runs):
    answer = page.post("/api/image/labels", headers={"Origin": ORIGIN}, json={"base": "x", "runs": runs})
    assert answer.status_code in (404, 422)
    assert "\n" not in answer.json()["error"]


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"null", b'{"until": 3}', b'{"shell": "rm"}', b"\xff", b"[" * 5000]
)
def test_malformed_requests_are_refused(page, body):
    for path in ("/api/identification/start", "/api/traces/1", "/api/image/labels"):
        answer = page.post(path, headers={"Origin": ORIGIN, "Content-Type": "application/json"}, content=body)
        assert answer.status_code in (400, 404, 422), (path, answer.status_code)
        assert isinstance(answer.json()["error"], str)


@pytest.mark.parametrize("stage", ["--help", "; rm -rf /", "report --force", "nonsense", "$(id)"])
def test_only_stages_can_be_asked_for(page, study, stage):
    for key, value in (("until", stage), ("start", stage), ("force", [stage])):
        answer = page.post("/api/identification/start", headers={"Origin": ORIGIN}, json={key: value})
        assert answer.status_code == 422
        assert "no stage is named" in answer.json()["error"]
    assert not (study / "results" / ".lock").exists()


def test_no_process_is_stopped_that_does_not_hold_the_study(page, study):
    """A study from elsewhere may name any process as its holder: nothing is sent to it."""
    (study / "results").mkdir()
    (study / "results" / ".lock").touch()
    (study / "results" / ".holder").write_text("process 1 (since 2026-01-01 00:00 UTC)")
    answer = page.post("/api/identification/stop", headers={"Origin": ORIGIN})
    assert answer.status_code == 409
    assert "nothing to stop" in answer.json()["error"]


def test_a_report_is_kept_apart_from_the_page(page, study):
    """Its scripts may run, but neither reach this server nor know its cookie."""
    report = study / "results" / "report"
    report.mkdir(parents=True)
    (report / "report.html").write_text("<script>fetch('/api/study')</script>")
    answer = page.get("/api/files/report/report.html")
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    assert "connect-src 'none'" in policy
    saved = page.get("/api/files/report/report.html", params={"download": True})
    assert saved.headers["content-disposition"].startswith("attachment")


def test_errors_hold_no_traceback(page, study, monkeypatch):
    (study / "study.toml").write_text("[study]\nname = 'x'\n")
    answer = page.get("/api/study")
    assert answer.status_code == 422
    assert "give either [image] or [surfaces]" in answer.json()["error"]
    monkeypatch.setattr("limbfit.studio.study_routes.find_running", lambda folder: 1 / 0)
    answer = page.get("/api/changes")
    assert answer.status_code == 500
    assert "ZeroDivisionError" in answer.json()["error"]
    assert "Traceback" not in answer.text


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.4", "::", "example.org"])
def test_other_addresses_must_be_asked_for_in_so_many_words(study, host):
    with pytest.raises(
        InputError, match="can be reached from other machines; leave out --host, or say --expose"
    ):
        serve_studio(study, host=host, browser=False, tell=print)


def test_even_then_it_is_one_address(study):
    with pytest.raises(InputError, match="name one address"):
        serve_studio(study, host="0.0.0.0", expose=True, browser=False, tell=print)


def test_a_taken_port_and_no_study_are_one_line_each(study, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(RunError, match=rf"port {port}: .*; give another --port"):
            serve_studio(study, port=port, browser=False, tell=print)
    found = CliRunner().invoke(command_line, ["studio", str(tmp_path / "none"), "--no-browser"])
    assert isinstance(found.exception, InputError)


def test_the_server_listens_on_loopback_and_says_where(study):
    """A real socket: the printed address opens the page, and no other address of this machine answers."""
    told: list[str] = []
    thread = threading.Thread(
        target=serve_studio, args=(study,), kwargs={"browser": False, "tell": told.append}, daemon=True
    )
    thread.start()
    until = time.monotonic() + 60
    while not told and time.monotonic() < until:
        time.sleep(0.05)
    address = httpx.URL(told[0])
    assert address.host == "127.0.0.1"
    with httpx.Client(base_url=f"http://127.0.0.1:{address.port}", timeout=60) as client:
        assert client.get("/").status_code == 401
        assert client.get(str(address)).status_code == 200
        assert client.get("/api/study").json()["name"] == "stump"
        assert "server" not in client.get("/api/study").headers
    for other in _own_addresses():
        with pytest.raises(OSError, match=r"refused|unreachable|timed out"):
            socket.create_connection((other, address.port), timeout=2).close()


def _own_addresses() -> list[str]:
    found = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    return sorted(one for one in found if not one.startswith("127."))
