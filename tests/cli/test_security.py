"""Nothing that is read is ever executed, and nothing that is printed is ever interpreted."""

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "hjepa_cli").rglob("*.py"))
MODULES = {
    *("pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "yaml", "code"),
    *("builtins", "torch.serialization", "torch.hub", "torch.package", "torch.utils.model_zoo"),
    # Nothing is downloaded, at import or later; whom `--cluster` talks to, the user has named.
    *("urllib", "http", "socket", "ssl", "ftplib", "requests", "httpx", "huggingface_hub"),
}
CALLS = {"eval", "exec", "compile", "__import__"}  # as bare names; module.eval() is torch's
METHODS = {
    *("torch.load", "torch.save", "torch.jit.load", "numpy.load", "numpy.loadtxt"),
    *("numpy.genfromtxt", "numpy.fromregex", "pkgutil.resolve_name"),
    *("importlib.import_module", "importlib.util.spec_from_file_location"),
    *("runpy.run_path", "runpy.run_module", "os.system", "os.popen", "os.execv", "os.execvp"),
    *("subprocess.run", "subprocess.Popen", "subprocess.call", "subprocess.check_output"),
}

SOCKETS = (
    *("socket", "socket.socket", "socket.AddressFamily", "socket.getaddrinfo"),
    *("socket.SOCK_DGRAM", "socket.SOL_SOCKET", "socket.SO_RCVBUF", "socket.SO_SNDBUF"),
)
# Reviewed: public names come from a table in the same file; ffmpeg gets a list of arguments.
ALLOWED = {
    "hjepa_cli/__init__.py": ("importlib.import_module",),
    "hjepa_cli/cli/execution.py": ("importlib.import_module",),  # stages, by the list of commands
    "hjepa_cli/output/animation.py": ("subprocess.Popen",),
    # Datagrams go to and come from whom the user has named, and are parsed byte by byte.
    "hjepa_cli/wire/bench.py": ("socket.recvfrom", "socket.sendto"),
    "hjepa_cli/wire/drive.py": ("socket", "socket.socket"),
    "hjepa_cli/wire/relay.py": SOCKETS,
    "hjepa_cli/wire/server.py": SOCKETS,
    "hjepa_cli/stages/bench_link.py": ("subprocess.Popen",),  # this program itself, as serve
    "hjepa_cli/stages/stage.py": ("importlib.import_module",),  # places in the package's own code
    # The package's own extensions by a table; a file that the user names on the command line.
    "hjepa_cli/plugins.py": ("importlib.import_module", "exec()", "compile()"),
}


def violations(source: str) -> list[str]:
    """What a source does that could execute what it reads, or fetch something to read."""
    tree, aliases = ast.parse(source), dict[str, str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname: alias.name for alias in node.names if alias.asname}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Attribute):
            first, _, rest = ast.unparse(node).partition(".")
            names = [f"{aliases.get(first, first)}.{rest}"]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            names = [f"{node.func.id}()"]
        elif isinstance(node, ast.keyword) and node.arg in ("allow_pickle", "shell"):
            names = [f"{node.arg}="]
        else:
            continue
        found += [
            f"line {node.lineno}: {name}"
            for name in names
            if any(name == module or name.startswith(f"{module}.") for module in MODULES)
            or name in METHODS
            or (name.removesuffix("()") in CALLS and name.endswith("()"))
            or name.endswith("=")
        ]
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_read_is_executed(path: Path) -> None:
    reviewed = ALLOWED.get(path.relative_to(ROOT).as_posix(), ())
    found = violations(path.read_text(encoding="utf-8"))
    assert [line for line in found if line.split(": ")[1] not in reviewed] == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import yaml as y",
        "import torch\ntorch.load(path)",
        "from torch import load",
        "import numpy as np\nnp.load(path)",
        "np.save(path, allow_pickle=True)",
        "eval(text)",
        "exec(text)",
        "__import__(name)",
        "importlib.import_module(name)",
        "from importlib import import_module",
        "subprocess.run(line, shell=True)",
        "os.system(line)",
        "import torch as t\nt.load(path)",
        "import numpy\nnumpy.load(path)",
        "import numpy as n\nn.load(path)",
        "import os as o\no.system(line)",
        "from builtins import eval as e\ne(text)",
        "import torch.serialization",
        "from urllib import request",
        "import socket",
        "import requests",
    ],
)
def test_the_guard_sees_it(source: str) -> None:
    assert violations(source)


def test_the_guard_lets_models_be_evaluated() -> None:
    assert violations("model.eval()\nre.compile(text)\ntorch.compile(model)") == []


def test_dependencies_are_few_and_bounded() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert len(project["dependencies"]) <= 10
    for requirement in project["dependencies"]:
        assert ">=" in requirement and "<" in requirement.partition(">=")[2], requirement


def test_a_model_of_any_name_prints_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    """Names come from files: markup, control characters and line ends in them stay visible."""
    from hjepa_cli.output.screen import Screen

    screen = Screen()
    evil = "[/red]\x1b[2J\r\nhint: rm -rf ~\u202e"
    screen.table("t", ["name"], [[evil]])
    screen.result(evil)
    shown = capsys.readouterr().out
    assert "\x1b" not in shown and "\r" not in shown and "\u202e" not in shown
    assert "[/red]" in shown
    assert not any(line.startswith("hint:") for line in shown.splitlines())
