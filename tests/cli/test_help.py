"""What `--help` shows."""

import pytest

COMMANDS = ("calibrate optics", "check", "status", "doctor", "reference", "move", "stop", "serve", "snap", "")


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_keep_their_lines(run, command):
    text = run(*command.split(), "--help").output
    assert "\\b" not in text
    lines = text.splitlines()
    start = next(number for number, line in enumerate(lines) if line.strip() in ("Example:", "Examples:"))
    assert lines[start + 1].strip().startswith("microdrivers ")
