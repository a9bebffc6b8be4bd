"""Tables of the documentation are what scripts/tables makes of the zoo and of docs/results."""

import importlib.machinery
import importlib.util
import re

import pytest
from command_line import ROOT

from hjepa_cli.storage import zoo

loader = importlib.machinery.SourceFileLoader("tables_script", str(ROOT / "scripts/tables"))
script = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
loader.exec_module(script)

pytestmark = pytest.mark.skipif(script.MODEL not in zoo.list_models(), reason="no model in the zoo")
NEEDS_SIONNA = {"results", "nr-devices"}


def blocks():
    return [
        (str(page.relative_to(ROOT)), name)
        for page in script.pages()
        for _, name, _ in script.BLOCK.findall(page.read_text(encoding="utf-8"))
    ]


@pytest.mark.parametrize(("page", "name"), blocks(), ids=str)
def test_a_block_is_what_the_script_makes(page, name):
    """Otherwise: scripts/tables"""
    if name in NEEDS_SIONNA:
        pytest.importorskip("sionna")
    text = (ROOT / page).read_text(encoding="utf-8")
    (block,) = (found for found in script.BLOCK.finditer(text) if found[2] == name)
    assert block[0] == f"{block[1]}\n{script.made(name)}\n\n{block[3]}"


def test_every_block_is_on_a_page_and_every_mark_is_a_block():
    used = {name.partition(" ")[0] for _, name in blocks()}
    assert used == set(script.BLOCKS)  # two blocks of a name on a page would be one test
    assert len(set(blocks())) == len(blocks())
    for page in script.pages():
        text = page.read_text(encoding="utf-8")
        assert len(re.findall("^<!-- table:", text, re.MULTILINE)) == len(
            script.BLOCK.findall(text)
        ), page


def test_every_method_was_trained_as_often():
    kept, paired = script.trainings()
    assert {"hjepa", "oracle", "hold", "chunk"} <= kept.keys() and len(paired) == len(kept) - 1
    assert len({tuple(by_seed) for by_seed in kept.values()}) == 1 and len(kept["hjepa"]) >= 5


def test_a_page_is_mended_and_the_rest_of_it_left_alone():
    before = "# A\n\n<!-- table: tolerated -->\nstale\n<!-- end -->\n\n| b |\n"
    after = script.rewritten(before)
    assert after.startswith("# A\n\n<!-- table: tolerated -->\n\n*D") and after.endswith("| b |\n")
    assert "stale" not in after and script.rewritten(after) == after
