"""The front of a review: who is let in, and what is asked of it."""

import http.client
import json
from collections.abc import Iterator
from typing import Any

import pytest

import review_data
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.review.front import Front
from hodge_pipeline.review.routes import site
from hodge_pipeline.review.session import Session

graph_file, session = review_data.graph_file, review_data.session


def test_a_port_in_use_is_one_line(session: Session) -> None:
    front = Front(site(session))
    with pytest.raises(WorkspaceError, match="give another --port"):
        Front(site(session), front.port)
    front.close()


class Client:
    """Asks a front as a browser or a stranger would."""

    def __init__(self, session: Session) -> None:
        self.front = Front(site(session))
        self.host = f"127.0.0.1:{self.front.port}"

    def ask(self, method: str, name: str, body: Any = None, *, token: str = "", **headers: str) -> tuple[int, Any]:
        connection = http.client.HTTPConnection(self.host, timeout=20)
        path = f"/{token or self.front.token}/{name}"
        connection.request(method, path, None if body is None else json.dumps(body), headers)
        answer = connection.getresponse()
        text = answer.read()
        connection.close()
        return answer.status, json.loads(text) if answer.getheader("Content-Type") == "application/json" else text


@pytest.fixture
def client(session: Session) -> Iterator[Client]:
    made = Client(session)
    yield made
    made.front.close()


def test_a_stranger_gets_nothing(client: Client, session: Session) -> None:
    before = session.decisions.history
    mine = {"revision": 0, "verb": "disable", "rows": [1]}
    for headers in (
        {"token": "guessed"},
        {"token": client.front.token[:-1]},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": f"http://127.0.0.1:{client.front.port + 1}"},
        {"Host": "evil.example"},
        {"Host": f"evil.example:{client.front.port}"},
    ):
        for method, name, body in (("GET", "state", None), ("GET", "scene/", None), ("POST", "decide", mine)):
            status, text = client.ask(method, name, body, **headers)
            assert (status, text) == (403, b"forbidden\n"), (headers, name)
    status, _ = client.ask("GET", "scene", Upgrade="websocket", Connection="Upgrade", Origin="http://evil.example")
    assert status == 403
    assert session.decisions.history == before
    assert client.ask("GET", "state", Origin=f"http://{client.host}")[0] == 200


def test_the_front_listens_on_this_machine_alone(client: Client) -> None:
    assert client.front._server.server_address[0] == "127.0.0.1"


def test_two_pages_and_a_stale_write_through_the_front(client: Client) -> None:
    _, seen = client.ask("GET", "state")
    wish = {"revision": seen["revision"], "verb": "disable"}
    status, found = client.ask("POST", "decide", wish | {"rows": [1]})
    assert status == 200 and found["state"]["revision"] == seen["revision"] + 1
    status, refused = client.ask("POST", "decide", wish | {"rows": [2]})
    assert status == 409 and "look again" in refused["error"]
    assert client.ask("GET", "state")[1]["revision"] == seen["revision"] + 1


NONSENSE: list[tuple[str, str, Any]] = [
    ("POST", "decide", {"revision": 0, "verb": "disable", "rows": "all"}),
    ("POST", "decide", {"verb": "disable", "rows": [1]}),
    ("POST", "decide", ["disable"]),
    ("POST", "look", {"mode": "sideways"}),
    ("POST", "look", {"share": "half"}),
    ("POST", "look", {"share": float("nan")}),
    ("POST", "look", {"cut": [1]}),
    ("POST", "look", {"verdicts": 3}),
    ("POST", "select", {"row": float("inf")}),
    ("POST", "select", {"row": 10_000}),
    ("POST", "pick", {"frames": ["nobody"]}),
    ("POST", "register", {}),
    ("POST", "accept", {"revision": 0}),
    ("GET", "edges?sort=taste", None),
    ("GET", "edges?min_gap=wide", None),
    ("GET", "edges?colour=red", None),
    ("GET", "edge?row=-3", None),
    ("GET", "picture?row=1&number=7", None),
]


def test_what_makes_no_sense_is_refused_in_one_line(client: Client) -> None:
    for method, name, body in NONSENSE:
        status, answer = client.ask(method, name, body)
        assert status == 400 and answer["error"] and "\n" not in answer["error"], (name, body)


def test_a_body_too_large_is_not_read(client: Client) -> None:
    status, answer = client.ask("POST", "decide", {"note": "x" * 300_000})
    assert status == 400 and "bytes" in answer["error"]
