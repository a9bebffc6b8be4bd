"""Commands in hints can be followed: every error that a test asks for is followed by its hint."""

import pytest
from command_line import commands_in, follow


@pytest.mark.parametrize(
    ("hint", "commands"),
    [
        ("hjepa models list", ["models list"]),
        ("free some disk space, then hjepa resume data/desktop-0001", ["resume data/desktop-0001"]),
        (
            "hjepa view --gap-steps 3, or hjepa view --delivery 0.1",
            ["view --gap-steps 3", "view --delivery 0.1"],
        ),
        ("hjepa resume runs/a shows it as it is; or choose another --out DIR", ["resume runs/a"]),
        ("run the same command again", []),
        ("hjepa ... --cluster local, or start one: dask scheduler", []),
        ("hjepa resume $'sc\\xe9'", None),
    ],
)
def test_commands_are_found(hint, commands) -> None:
    found = [" ".join(words) for words in commands_in(hint)]
    assert commands is None or found == commands


@pytest.mark.parametrize(
    "hint",
    [
        "hjepa modells list",
        "hjepa collect --steps none",
        "hjepa scale --no-such-flag",
        "hjepa resume nowhere",  # planned for real: what it needs must be there
        "hjepa data export --format tar",
    ],
)
def test_a_hint_that_cannot_be_followed_is_noticed(tmp_path, monkeypatch, hint) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(pytest.fail.Exception, match="hint"):
        follow(hint)
    follow("hjepa models list")
