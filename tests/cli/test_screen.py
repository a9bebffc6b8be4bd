"""What reaches the user: streams, tables at 80 and 120 columns, progress, JSON without NaN."""

import io
import re
import time

import pytest

from hjepa_cli.output import screen as screen_module
from hjepa_cli.output.screen import Screen, layout, one_line


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def streams():
    return io.StringIO(), io.StringIO()


def screen_on(streams, **options):
    stdout, stderr = streams
    return Screen(stdout=stdout, stderr=stderr, **options)


def test_notes_go_to_stderr_and_results_to_stdout(streams):
    screen = screen_on(streams)
    screen.say("working")
    screen.result("data/desktop-0001")
    screen.table("T", ["a"], [[1]])
    assert streams[1].getvalue() == "working\n"
    assert streams[0].getvalue().startswith("data/desktop-0001\nT\n")


def test_json_keeps_stdout_for_the_document_alone(streams):
    screen = screen_on(streams, json=True)
    screen.say("working")
    screen.table("T", ["a"], [[1]])
    screen.result("done")
    with screen.progress("p", 1, "x") as p:
        p.advance()
    screen.emit({"b": 1, "a": [2.5, None]})
    assert streams[0].getvalue() == '{"b": 1, "a": [2.5, null]}\n'
    assert "working" in streams[1].getvalue() and "T" in streams[1].getvalue()


def test_quiet_shows_results_and_errors_only(streams):
    screen = screen_on(streams, quiet=True)
    screen.say("working")
    with screen.progress("p", 1, "x") as p:
        p.advance(loss=0.1)
    assert streams[1].getvalue() == ""
    screen.table("T", ["a"], [[1]])
    screen.error("broken", "mend it")
    assert "T" in streams[0].getvalue()
    assert streams[1].getvalue() == "error: broken\nhint: mend it\n"


@pytest.mark.parametrize("text", ["[/red] [bold]x", ":smile:", "[link=x]y[/link]", "50 % {x} %s"])
def test_user_strings_are_never_markup(streams, text):
    screen = screen_on(streams)
    screen.say(text)
    screen.result(text)
    screen.table(text, [text], [[text]])
    screen.error(text)
    stdout, stderr = (stream.getvalue() for stream in streams)
    assert stderr == f"{text}\nerror: {text}\n"
    assert stdout.splitlines()[:2] == [text, text]
    assert stdout.count(text) == 4  # result, title, heading, cell


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\nb", "a\\nb"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\u2028b\u202ec", "a\\u2028b\\u202ec"),
        ("θ̇ ≥ 0.9, größer", "θ̇ ≥ 0.9, größer"),
    ],
)
def test_one_line_escapes_what_could_break_a_line(text, shown):
    assert one_line(text) == shown
    assert len(one_line(text).splitlines()) == 1


def test_error_stays_one_line_per_part(streams):
    screen_on(streams).error("no file 'a\nb'", "x\ry")
    assert streams[1].getvalue() == "error: no file 'a\\nb'\nhint: x\\ry\n"


EVAL_COLUMNS = ["method", "D* (steps)", "95 % CI", "p*", "score D=1", "LQ ratio", "bits"]
EVAL_ROWS = [
    ["hjepa", "141", "130.1 - 150.3", "0.0152", "1.00", "0.98", "2064"],
    ["zero-true", "5.2", "4.9 - 5.5", "0.187", "0.51", "-", "-"],
]


@pytest.mark.parametrize("width", [40, 80, 120])
def test_tables_fit_the_width_and_lose_nothing(width):
    columns = EVAL_COLUMNS + [f"devices {snr} dB" for snr in range(10, 31, 5)]
    rows = [[*row, *(str(10_000 + index) for index in range(5))] for row in EVAL_ROWS]
    lines = layout(columns, rows, width)
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    for text in [*columns, *(cell for row in rows for cell in row)]:
        assert all(word in words for word in text.split())
    for row in rows:
        found = [line for line in lines if line.startswith(row[0])]
        assert found, "each block repeats the method"
        joined = " ".join(" ".join(line.split()[1:]) for line in found).split()
        assert joined == " ".join(row[1:]).split(), "cells stay in order, uncut"


def test_usual_eval_table_is_one_block_at_80_columns():
    lines = layout(EVAL_COLUMNS, EVAL_ROWS, 80)
    assert sum(line.startswith("hjepa") for line in lines) == 1


def test_numbers_align_right_and_texts_left():
    lines = layout(["name", "n"], [["a", "5"], ["bb", "1234"], ["c", "-"]], 80)
    assert lines == ["name     n", "----------", "a        5", "bb    1234", "c        -"]


def test_bounds_and_intervals_count_as_numbers():
    lines = layout(["D*"], [["> 320"], ["9.5 [8, 11]"], ["-"]], 80)
    assert lines == ["         D*", "-----------", "      > 320", "9.5 [8, 11]", "          -"]


def test_a_long_title_wraps(streams, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    screen_on(streams).table("words " * 40, ["a"], [[1]])
    assert max(map(len, streams[0].getvalue().splitlines())) <= 80


def test_long_texts_fold_but_numbers_do_not():
    path = "/very/long/path/" * 5
    lines = layout(["path", "bytes"], [[path, "123456789"]], 40)
    assert max(map(len, lines)) <= 40
    assert "".join(line.split()[0] for line in lines[2:]) == path
    assert max(map(len, lines)) == 40, "no more than needed"
    assert any(line.endswith("123456789") for line in lines)


def test_table_without_rows_shows_its_headings(streams):
    screen_on(streams).table("Nothing", ["a", "b"], [])
    assert streams[0].getvalue().splitlines()[:2] == ["Nothing", "a  b"]


def test_table_cells_show_undefined_values_as_a_dash(streams):
    screen_on(streams).table("T", ["a", "b", "c"], [[None, float("nan"), 0.012345]])
    assert streams[0].getvalue().splitlines()[-1].split() == ["-", "-", "0.0123"]


def test_heartbeat_lines_when_not_a_terminal(streams, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(screen_module.time, "monotonic", lambda: now[0])
    with screen_on(streams).progress("collect", 5000, "traj") as p:
        for _ in range(50):
            now[0] += 0.5
            p.advance(100, loss=0.5)
    assert streams[1].getvalue().splitlines() == [
        "collect 2000/5000 (40 %) 200 traj/s loss 0.5 eta 0:00:15",
        "collect 4000/5000 (80 %) 200 traj/s loss 0.5 eta 0:00:05",
        "collect 5000/5000 (100 %) 200 traj/s loss 0.5 in 0:00:25",
    ]


def test_heartbeat_rate_of_a_continued_run_counts_only_what_this_process_did(streams, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(screen_module.time, "monotonic", lambda: now[0])
    with screen_on(streams).progress("train", 100, "steps", done=90) as p:
        now[0] = 10.0
        p.advance(5)
    first = streams[1].getvalue().splitlines()[0]
    assert first == "train 95/100 (95 %) 0.500 steps/s eta 0:00:10"


def test_units_that_nobody_counts_are_shown_as_a_share(streams, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(screen_module.time, "monotonic", lambda: now[0])
    with screen_on(streams).progress("all stages", 467) as p:
        now[0] = 190.0
        p.advance(190)
        p.advance(277)
    lines = streams[1].getvalue().splitlines()
    assert lines == ["all stages 40 % eta 0:04:37", "all stages 100 % in 0:03:10"]


def test_a_failing_loop_prints_no_final_heartbeat(streams):
    with pytest.raises(RuntimeError), screen_on(streams).progress("p", 10, "x") as p:
        p.advance()
        raise RuntimeError
    assert streams[1].getvalue() == ""


def test_bar_on_a_terminal_shows_label_count_rate_loss_and_eta(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("COLUMNS", "100")
    stderr = Terminal()
    screen = Screen(stdout=io.StringIO(), stderr=stderr)
    with screen.progress("train [/x]", 4, "steps") as p:
        p.advance(2, loss=0.25)
        time.sleep(0.15)
        with screen.progress("inner", 3, "frames") as q:  # a nested bar is one more line
            q.advance(3)
        with screen.progress("share", 3) as q:
            q.advance(1)
        screen.say("a [/note]")
        p.advance(2, loss=0.125)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stderr.getvalue())
    assert "train [/x]" in text and "4/4" in text and "loss 0.125" in text
    assert re.search(r"\d steps/s", text) and re.search(r"\d:\d\d:\d\d", text)
    assert "inner" in text and "3/3" in text and "a [/note]\n" in text
    assert "33 %" in text and "1/3" not in text


def test_tables_and_results_stand_above_the_bars_of_a_terminal(monkeypatch):
    """Bars are drawn over again all the time: what is printed past them would be wiped out."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("LINES", "40")
    terminal = Terminal()  # stdout and stderr, as in a shell
    screen = Screen(stdout=terminal, stderr=terminal)
    with screen.progress("all stages", 2) as outer:
        with screen.progress("first", 3, "frames") as inner:
            inner.advance(3, loss=0.5)
        screen.table("counts", ["method", "n"], [["a", "1"], ["b", "2"], ["c", "3"]])
        screen.result("the result [/x]")
        outer.advance(2)
    shown = replay(terminal.getvalue(), 40)
    text = "\n".join(shown)
    for line in ("counts", "method  n", "a       1", "b       2", "c       3", "the result [/x]"):
        assert line in shown, text
    assert re.search(r"^first 3/3 loss 0\.5 in \d:\d\d:\d\d$", text, re.MULTILINE)
    assert text.count("first") == 1
    assert shown[-1].startswith("all stages") and "100 %" in shown[-1]


def replay(written, rows):
    """What a terminal shows in the end, of rich's moves of the cursor."""
    lines, row, column = [""] * rows, 0, 0
    for code, letter, character in re.findall(
        r"\x1b\[([0-9;?]*)([A-Za-z])|(.)", written, re.DOTALL
    ):
        if letter == "A":
            row -= int(code or 1)
        elif letter == "K" and code == "2":
            lines[row] = ""
        elif character == "\n":
            row, column = row + 1, 0
        elif character == "\r":
            column = 0
        elif character:
            lines[row] = lines[row][:column].ljust(column) + character + lines[row][column + 1 :]
            column += 1
    return [line.rstrip() for line in lines if line.strip()]


def test_forced_colours_do_not_turn_a_file_into_a_terminal(streams, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    screen = screen_on(streams)
    with screen.progress("p", 1, "x") as p:
        p.advance()
    screen.table("T", ["a"], [[1]])
    assert "\x1b" not in streams[0].getvalue() + streams[1].getvalue()
