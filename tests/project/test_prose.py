"""Pages are short, in all and line by line; entries of the log begin with what came out of them."""

import re
import tomllib

import pytest
from command_line import ROOT

LOG = "docs/LOG.md"
GENERATED = "docs/reference/cli.md"
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md")),
]
OURS = [page for page in PAGES if page not in (LOG, GENERATED)]
README_WORDS, ALL_WORDS, PARAGRAPH_WORDS, COLUMNS, SENTENCE_WORDS = 1_000, 22_000, 90, 110, 30

MADE = re.compile(r"<!-- table: .*?<!-- end -->", re.DOTALL)
CODE = re.compile(r"^```.*?^```$|^ {4}\S[^\n]*$", re.DOTALL | re.MULTILINE)
TARGET = re.compile(r"\]\([^)]*\)")
ITEM = re.compile(r"\s*(?:[-*]|\d+\.) ")
NO_PROSE = re.compile(r"\s*(?:\||#|<|!\[|---)")


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def words(text):
    """Those with a letter, outside of code, of generated tables and of what links point to."""
    text = TARGET.sub("]", CODE.sub("", MADE.sub("", text)))
    return [word for word in text.split() if re.search(r"[^\W\d_]", word)]


def paragraphs(text):
    """Of prose: lists of lines; an item of a list is one, a table or a picture none."""
    found, lines = [], []
    for line in [
        *re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE).split("\n"),
        "",
    ]:
        code = line.startswith("    ") and not lines
        if not line.strip() or NO_PROSE.match(line) or ITEM.match(line) or code:
            found += [lines] if lines else []
            lines = []
        if line.strip() and not NO_PROSE.match(line) and not code:
            lines.append(line)
    return found


def test_the_readme_is_short():
    assert len(read("README.md").split()) <= README_WORDS


def test_all_pages_together_are_short():
    by_page = {page: len(words(read(page))) for page in OURS}
    assert sum(by_page.values()) <= ALL_WORDS, by_page


@pytest.mark.parametrize("page", OURS)
def test_paragraphs_are_short_and_lines_narrow(page):
    for lines in paragraphs(read(page)):
        assert len(" ".join(lines).split()) <= PARAGRAPH_WORDS, lines[0]
        for line in lines:
            assert len(line) <= COLUMNS or " " not in TARGET.sub("", line), line  # a link alone


def test_what_a_paragraph_is():
    text = "a\nb\n\n- c\n  d\n- e\n\n| t |\n|---|\n\n    code\n\n```python\nx\n```\nf\n"
    assert paragraphs(text) == [["a", "b"], ["- c", "  d"], ["- e"], ["f"]]
    assert words("One 2 [three](four.md#five) `six`\n\n    seven\n\n```\neight\n```\n") == [
        *("One", "[three]", "`six`"),
    ]


def entries():
    return re.findall(r"^## (\d{4}-\d\d-\d\d.*)\n+((?:.+\n)+)", read(LOG), re.MULTILINE)


def test_every_entry_of_the_log_begins_with_a_sentence_of_result():
    found = entries()
    assert len(found) == len(re.findall(r"^## ", read(LOG), re.MULTILINE)) > 30
    for title, first in found:
        sentence = first.strip()
        assert sentence.endswith(".") and not NO_PROSE.match(sentence), title
        assert not re.search(r"[.!?] [A-Z]", sentence) and not ITEM.match(sentence), title
        assert len(sentence.split()) <= SENTENCE_WORDS, (title, len(sentence.split()))


def test_a_gap_is_d_and_the_size_of_an_embedding_another():
    """D is steps between packets on every page, d the values of an embedding."""
    for page in OURS:
        assert not re.search(r"√D|D = 256|D, values|\[N, D\]", read(page)), page


def test_the_site_has_every_page_once():
    """No package is needed for this; ``make site`` builds it."""
    project = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]

    def leaves(items):
        for item in items:
            for value in item.values() if isinstance(item, dict) else [item]:
                yield from leaves(value) if isinstance(value, list) else [value]

    listed = sorted(f"docs/{page}" for page in leaves(project["nav"]))
    assert listed == sorted(page for page in PAGES if page.startswith("docs/"))
