"""The documentation: every command parses, every example runs, the reference is the program's."""

import doctest
import importlib.machinery
import importlib.util
import re
import shlex
import subprocess
import tomllib
import warnings
from pathlib import Path

import pytest
from command_line import ROOT, open_shell

from hjepa_cli.storage.zoo import list_models

PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    *sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/**/*.md")),
)
NOT_RUN = re.compile(r"<!-- not run: [^>]+ -->\s*```\w*\n.*?```", re.DOTALL)
WITH_PLAN = (
    *("tune-law", "collect", "train-encoder", "train-hierarchy", "train-fusion"),
    *("eval", "scale", "survive", "view"),
    "reproduce",
    *("export", "serve", "device", "link", "bench-link"),
)
PLACEHOLDER = re.compile(r"[A-Z]{3,}|…|\.\.\.|[<>\[\]|]|\{")


def test_the_reference_of_the_command_line_is_current():
    """Otherwise: scripts/cli_reference > docs/reference/cli.md"""
    loader = importlib.machinery.SourceFileLoader("reference", str(ROOT / "scripts/cli_reference"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("reference", loader))
    loader.exec_module(module)
    assert (ROOT / "docs/reference/cli.md").read_text() == module.reference()


SHELL = re.compile(
    r"^ {4}((?:\.venv/bin/)?(?:hjepa|make|python3?|pip|torchrun|dask) [^\n#]*)", re.MULTILINE
)
INSTALL = re.compile(r"pip install (?:-e )?\"(?:hjepa|\.)\[(\w+)\]\"")
REQUIRE = re.compile(r'require\("\w+", "[^"]+", "(\w+)"')


def text_of(page):
    return NOT_RUN.sub("", (ROOT / page).read_text())


def commands():
    """All commands of the documentation, from indented and fenced blocks and from running text."""
    found = {}
    for page in PAGES:
        if page in ("docs/reference/cli.md", "docs/LOG.md"):  # headings; commands of their day
            continue
        text = text_of(page)
        lines = re.findall(r"^ {4}(?:\.venv/bin/)?(hjepa [^\n#]*)", text, re.MULTILINE)
        lines += re.findall(r"`(hjepa [^`\n]+)`", text)
        for line in lines:
            changes_the_shell = line.startswith("hjepa --")
            if not PLACEHOLDER.search(line) and not changes_the_shell:
                found.setdefault(line.strip(), page)
    return sorted(found.items())


@pytest.mark.parametrize(("line", "page"), commands(), ids=str)
def test_every_command_of_the_documentation_is_understood(
    tmp_path, monkeypatch, capsys, line, page
):
    """Run with --dry-run, or for real where that takes no time."""
    shell = open_shell(tmp_path, monkeypatch, capsys)
    _, *words = shlex.split(line)
    missing = [w for w in words if re.fullmatch(r"(desktop|gym)-h\d+m\d+l\d+", w)]
    if set(missing) - set(list_models()):
        pytest.skip("the zoo lacks this model")
    if words[0] in WITH_PLAN:
        outcome = shell(*words, *([] if "--dry-run" in words else ["--dry-run"]))
        allowed = (0, 66)  # an example may name a file of the reader's
    elif words[:2] == ["config", "show"] or words == ["models", "list"]:
        outcome, allowed = shell(*words), (0,)
    else:
        outcome, allowed = shell(*words, "--quiet"), (0, 66)
    assert outcome.code in allowed, (page, outcome)


def other_lines():
    """What command blocks and running text hold beside `hjepa …`, by page."""
    for page in PAGES:
        if page not in ("docs/reference/cli.md", "docs/LOG.md"):
            text = text_of(page)
            lines = SHELL.findall(text) + re.findall(r"`((?:make|python|torchrun) [^`\n]+)`", text)
            for line in dict.fromkeys(line.strip() for line in lines):
                if not line.removeprefix(".venv/bin/").startswith("hjepa "):
                    yield line, page


@pytest.mark.parametrize(("line", "page"), list(other_lines()), ids=str)
def test_every_other_command_of_the_documentation_names_what_is_there(
    tmp_path, monkeypatch, capsys, line, page
):
    """Targets of make, scripts, extras, pytest; what torchrun starts is planned."""
    if line.startswith("make "):
        arguments = [word for word in shlex.split(line)[1:] if word != "..."]
        done = subprocess.run(
            ["make", "--dry-run", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    elif line.startswith("torchrun "):
        _, _, of_hjepa = line.partition(" -m hjepa_cli ")
        outcome = open_shell(tmp_path, monkeypatch, capsys)(*shlex.split(of_hjepa), "--dry-run")
        assert outcome.code in (0, 66), outcome  # a run of the reader's
    elif "pip install" in line:
        assert INSTALL.search(line), line
    elif match := re.fullmatch(r"python (benchmarks/\w+\.py).*", line):
        assert (ROOT / match[1]).is_file()
    else:
        assert line in ("python3 -m venv .venv", ".venv/bin/python -m pytest"), (line, page)


def test_every_extra_that_is_named_exists():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    sources = [ROOT / page for page in PAGES] + sorted(ROOT.glob("hjepa_cli/**/*.py"))
    texts = [path.read_text() for path in sources]
    named = {extra for text in texts for how in (INSTALL, REQUIRE) for extra in how.findall(text)}
    assert {"plot", "video", "hdf5", "gym", "track", "cluster"} <= named <= set(extras)


def blocks():
    """Python blocks by page; ``>>>`` sessions of a page are one, other blocks stand alone."""
    for page in PAGES:
        code = re.findall(r"```python\n(.*?)```", text_of(page), re.DOTALL)
        if any(block.startswith(">>>") for block in code):
            yield page, "".join(block for block in code if block.startswith(">>>"))
        for block in code:
            plugin = "register(" in block  # its own test loads it, for one test alone
            if not (block.startswith(">>>") or plugin or "stable_baselines3" in block):
                yield page, block


@pytest.mark.parametrize(("page", "code"), list(blocks()), ids=lambda v: v if v in PAGES else "")
def test_every_python_block_runs(tmp_path, monkeypatch, page, code):
    if page == "docs/reference/python.md":
        pytest.skip("test_api.py runs it")
    if "hjepa_cli.gym" in code:
        pytest.importorskip("gymnasium")
    if "desktop-h4m2l1" in code and "desktop-h4m2l1" not in list_models():
        pytest.skip("the zoo lacks this model")
    monkeypatch.chdir(tmp_path)
    if code.startswith(">>>"):
        example = doctest.DocTestParser().get_doctest(code, {}, page, page, 0)
        runner = doctest.DocTestRunner()
        runner.run(example)
        assert runner.tries > 0 and runner.failures == 0
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(code, page, "exec"), {"__name__": "example"})


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        text = (ROOT / page).read_text()
        targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
        targets += re.findall(r"src=\"([^\":]+)\"", text)
        for target in targets:
            assert (ROOT / page).parent.joinpath(target).exists(), (page, target)


def test_links_into_a_page_lead_to_a_heading():
    for page in PAGES:
        for target, place in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", (ROOT / page).read_text()):
            lines = (
                (ROOT / page).parent.joinpath(target or Path(page).name).read_text().splitlines()
            )
            headings = [line.lstrip("# ").lower() for line in lines if line.startswith("#")]
            anchors = [re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in headings]
            assert place in anchors, (page, target, place)
