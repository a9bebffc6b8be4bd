"""The commands of the wire as a person types them: mistakes, a real server, a real device."""

import contextlib
import json
import shutil
import signal
import subprocess
import sys
import time

import pytest
from command_line import ENVIRONMENT, assert_one_line_error, open_shell

from hjepa_cli.wire.server import open_socket

pytest.importorskip("onnxruntime")
MODEL = "desktop-h4m2l1"
HJEPA = [sys.executable, "-m", "hjepa_cli"]


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.fixture
def model(exported, tmp_path):
    return str(shutil.copytree(exported, tmp_path / "exported"))


def refused(shell, code, *arguments, says=()):
    with shell.untouched():
        assert_one_line_error(shell(*arguments), code, *says)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["export"], 2, ["--to DIR", "--check DIR"]),
        (["export", "--to", "new"], 2, ["which model?", "hjepa models list"]),
        (["export", "nothing", "--to", "new"], 66, ["nothing"]),
        (["export", MODEL, "--to", "new", "--check", "m"], 2, ["--to DIR", "--check DIR"]),
        (
            ["export", MODEL, "--to", "new", "--method", "hold", "--quiet"],
            *(2, ["cannot be exported as 'hold'"]),
        ),
        (["export", "--check", "nowhere"], 66, ["no exported model", "hjepa export MODEL"]),
        (["serve"], 2, ["--model"]),
        (["serve", "--model", "nowhere"], 66, ["no exported model"]),
        (["serve", "--model", "m", "--bind", "0.0.0.0:4747"], 2, ["without a key", "--key FILE"]),
        (["serve", "--model", "m", "--bind", "here"], 2, ["HOST:PORT"]),
        (["serve", "--model", "m", "--timeout", "0"], 2, ["more than 0"]),
        (["device", "--model", "m", "--server", "192.0.2.1:1"], 2, ["--key FILE"]),
        (["device", "--model", "m", "--server", "127.0.0.1:1", "--key", "k"], 66, ["k does not"]),
        (["device", "--model", "m", "--watchdog-ms", "100"], 2, ["from 0 to 80"]),
        (["device", "--model", "m", "--gap-steps", "9", "--innovation", "0.1"], 2, ["two rules"]),
        (["device", "--model", "m", "--longest", "9"], 2, ["--longest", "--innovation"]),
        (["link", "--listen", "127.0.0.1:4747"], 2, ["same address"]),
        (["link", "--uplink-loss", "1"], 2, ["less than 1"]),
        (["link", "--uplink-loss", "0.9", "--uplink-burst", "2"], 2, ["at most 0.666"]),
        (["link", "--uplink-trace", "nowhere"], 66, ["nowhere does not exist"]),
        (["bench-link", "--model", "nowhere"], 66, ["no exported model"]),
        (["bench-link", "--model", "m", "--lockstep", "--period-ms", "5"], 2, ["--lockstep"]),
    ],
)
def test_mistakes(shell, arguments, code, says):
    refused(shell, code, *arguments, says=says)
    if arguments[0] == "export":
        refused(shell, code, *arguments, "--dry-run", says=says)


def test_a_readable_key_is_refused(shell, tmp_path):
    (tmp_path / "key").write_bytes(bytes(32))
    (tmp_path / "key").chmod(0o640)
    refused(shell, 65, "serve", "--model", "m", "--key", "key", says=["0640", "chmod 600"])
    refused(shell, 65, "device", "--model", "m", "--key", "key", says=["0640"])


@pytest.mark.slow
def test_mistakes_with_a_model(shell, model, tmp_path):
    refused(shell, 65, "device", "--model", model, "--preset", "gym", says=["drives plant desktop"])
    refused(
        shell, 2, "device", "--model", model, "--camera", "nonsense", says=["--camera nonsense"]
    )
    refused(shell, 2, "device", "--model", model, "--actuator", "wheel", says=["--actuator wheel"])
    many = ("bench-link", "--model", model, "--lockstep", "--steps", "1000000000")
    refused(shell, 70, *many, says=["GB of memory"])
    refused(shell, 70, *many, "--dry-run", says=["GB of memory"])
    (tmp_path / "wide").mkdir()
    pillow = pytest.importorskip("PIL.Image")
    pillow.new("RGB", (640, 480)).save(tmp_path / "wide" / "0.png")
    arguments = ("device", "--model", model, "--camera", "wide", "--server", "127.0.0.1:9")
    outcome = shell(*arguments)
    assert outcome.code == 65 and "(480, 640, 3)" in outcome.err and "--crop" in outcome.err
    outcome = shell("device", "--model", model, "--server", "127.0.0.1:9", "--no-local")
    assert outcome.code == 69 and "no answer from 127.0.0.1:9" in outcome.err
    with open_socket(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        bind = f"127.0.0.1:{port}"
        refused(shell, 69, "serve", "--model", model, "--bind", bind, says=[bind, "another port"])


@contextlib.contextmanager
def serving(model, *more):
    command = [*HJEPA, "serve", "--model", model, "--bind", "127.0.0.1:0", "--json", "--quiet"]
    process = subprocess.Popen(
        [*command, *more], stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
    )
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def device(model, address, *more):
    command = [*HJEPA, "device", "--model", model, "--server", address, "--json", "--quiet"]
    return subprocess.run(
        [*command, "--period-ms", "20", *more],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        timeout=120,
    )


@pytest.mark.slow
def test_a_server_a_device_its_metrics_and_the_end(model):
    import urllib.request

    doors = ("--metrics", "127.0.0.1:0", "--websocket", "127.0.0.1:0")
    with serving(model, *doors) as (process, listening):
        ran = device(model, listening["serving"], "--steps", "150", "--number", "5")
        assert ran.returncode == 0, ran.stderr
        found = json.loads(ran.stdout)
        assert found["device"] == 5 and found["steps"] == 150 == sum(found["forces"].values())
        assert found["sent"] >= 2 and found["forces"]["planned"] > 0
        time.sleep(1.5)
        page = f"http://{listening['metrics']}/metrics"
        text = urllib.request.urlopen(page, timeout=10).read().decode()
        assert "hjepa_devices 0.0" in text and 'hjepa_events_total{event="byes"} 1.0' in text
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 143


@pytest.mark.slow
def test_another_model_and_another_version_of_the_model(model, tmp_path):
    other = shutil.copytree(model, tmp_path / "other")
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps(manifest | {"made_by": "somebody else"}))
    with serving(model) as (_, listening):
        ran = device(str(other), listening["serving"])
    assert ran.returncode == 65 and "runs another model" in ran.stderr


@pytest.mark.slow
def test_a_device_starts_without_torch(model):
    """Its imports are looked at in the process itself, after some steps of driving on its own."""
    program = (
        "import sys; from hjepa_cli.cli.app import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print(*sorted({'torch', 'scipy', 'matplotlib'} & set(sys.modules)), file=sys.stderr)"
    )
    arguments = ["device", "--model", model, "--server", "127.0.0.1:9", "--steps", "20", "--quiet"]
    ran = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        timeout=120,
    )
    assert ran.returncode == 0 and ran.stderr.split("\n")[-2] == "", ran.stderr
