"""Who listens where a cluster should be may be silent, or no scheduler at all."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import Shell, assert_one_line_error, open_shell

pytest.importorskip("distributed")
from hjepa_cli.compute import executors

COLLECT = ("collect", "--preset", "smoke", "--out", "data", "--quiet", "--cluster")


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    monkeypatch.setattr(executors, "CONNECT_S", 1)
    return open_shell(tmp_path, monkeypatch, capsys)


@contextlib.contextmanager
def listening(answer: bytes | None) -> Iterator[str]:
    """Accept connections and say something at once; ``None`` says nothing, ``b""`` hangs up."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        kept = []

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    there, _ = server.accept()
                    kept.append(there)
                    if answer is not None:
                        there.sendall(answer)
                        there.close()

        threading.Thread(target=accept, daemon=True).start()
        yield f"127.0.0.1:{server.getsockname()[1]}"
        for one in kept:
            one.close()


@pytest.mark.parametrize("answer", [None, b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"HTTP/1.1 400\r\n\r\n"])
@pytest.mark.parametrize("scheme", ["", "tcp://"])
def test_a_listener_that_is_no_scheduler_is_soon_refused(hjepa, answer, scheme) -> None:
    with listening(answer) as address:
        began_s = time.process_time(), time.monotonic()
        failed = hjepa(*COLLECT, f"{scheme}{address}")
        assert time.monotonic() - began_s[1] < 60 and time.process_time() - began_s[0] < 10
    assert_one_line_error(failed, 2, "no Dask scheduler answers")


@pytest.mark.parametrize(
    "text", ["{}", "[]", "null", '{"address": 3}', "no json", '{"address": null}', "[" * 9999]
)
def test_a_file_that_no_scheduler_wrote_is_refused(hjepa, text) -> None:
    Path("s.json").write_text(text)
    assert_one_line_error(hjepa(*COLLECT, "s.json"), 2, "not the file of a Dask scheduler")


@pytest.mark.parametrize("text", ['{"address": ""}', '{"address": "x"}', '{"address": "tcp://:0"}'])
def test_an_address_that_is_none_is_refused(hjepa, text) -> None:
    Path("s.json").write_text(text)
    assert_one_line_error(hjepa(*COLLECT, "s.json"), 2, "no Dask scheduler answers")


def test_files_without_an_end_are_not_read(hjepa) -> None:
    for command in (
        [*COLLECT, "/dev/zero"],
        ["config", "show", "--config", "/dev/zero"],
        ["config", "show", "--plugin", "/dev/zero"],
        ["models", "info", "/dev/zero"],
        ["report", "/dev/zero"],
        ["data", "info", "/dev/zero"],
        ["resume", "/dev/zero"],
    ):
        failed = hjepa(*command)
        assert failed.code in (2, 65, 66) and "unexpected" not in failed.err, failed
