"""The documents name functions, tests and files; they must exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/explanation/paper_map.md").read_text(encoding="utf-8")
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PLACES = sorted(set(re.findall(r"`([a-z_/]+\.py)(?:::(\w+))?`", TEXT)))


def test_the_map_is_not_empty():
    assert len(PLACES) > 50


@pytest.mark.parametrize(("file", "name"), PLACES)
def test_every_function_and_test_of_the_map_exists(file, name):
    within = ROOT / ("tests" if file.startswith("test_") else "hjepa_cli")
    (path,) = within.rglob(file)
    if name:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        defined = {getattr(node, "name", None) for node in tree.body}
        for node in tree.body:
            targets = getattr(node, "targets", [getattr(node, "target", None)])
            defined |= {getattr(target, "id", None) for target in targets}
        assert name in defined


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_to_files(document):
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8"))
    for link in links:
        assert (document.parent / link).exists(), link
