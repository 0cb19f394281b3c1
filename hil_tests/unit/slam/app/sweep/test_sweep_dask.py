"""A cluster that is not there, or does not help: one line, soon."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.patience import seconds
from slam.app.cli import main
from slam.app.errors import AppError
from slam.app.sweep import workers as sweep_dask
from slam.app.sweep.run import make_case, run_case


@pytest.fixture
def port() -> Iterator[int]:
    """Give a port that nobody listens on."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield taken.getsockname()[1]


def test_without_dask_the_remedy_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    out = tmp_path / "o.json"
    assert main(["sweep", "--dask", "tcp://127.0.0.1:8786", "--json", str(out)]) == 2
    text = capsys.readouterr()
    assert text.err == "uwb-slam: --dask: Dask is missing; pip install 'xethru-hil[dask]'\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("address", "code"), [("nowhere", 2), ("here://x:1", 2), ("", 2)])
def test_an_address_that_is_none_is_2(
    address: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    assert main(["sweep", "--dask", address, "--json", str(tmp_path / "o.json")]) == code
    text = capsys.readouterr()
    assert "write it as tcp://HOST:PORT" in text.err
    assert text.err.count("\n") == 1


def test_a_scheduler_that_does_not_answer_is_1_in_bounded_time(
    port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(sweep_dask, "PATIENCE_S", 0.5)
    address = f"tcp://127.0.0.1:{port}"
    assert main(["sweep", "--dask", address, "--json", str(tmp_path / "o.json")]) == 1
    text = capsys.readouterr()
    assert "no Dask scheduler answers there; start one with `dask scheduler`" in text.err
    assert text.err.count("\n") == 1


def test_somebody_else_at_the_port_is_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(sweep_dask, "PATIENCE_S", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(b"HTTP/1.0 400 Bad Request\r\n\r\n" * 4)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        assert main(["sweep", "--dask", address, "--json", str(tmp_path / "o.json")]) == 1
    thread.join(timeout=seconds(5))
    text = capsys.readouterr()
    assert "no Dask scheduler answers there" in text.err
    assert text.err.count("\n") == 1


def test_a_worker_of_another_version_refuses() -> None:
    with pytest.raises(AppError, match="another version of xethru-hil"):
        run_case(make_case("lab", "paper", 0), "of yesterday")
