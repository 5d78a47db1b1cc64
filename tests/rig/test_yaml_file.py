"""Rig files are read by libyaml where it is there, and by PyYAML's own parser where it is not."""

import pytest

import microdrivers.rig.yaml_file as yaml_file
from microdrivers.configs import shipped_rig
from microdrivers.core.errors import ConfigError

TEXT = """\
a: [1, -2.5, 1e-5, .inf, on, 12:30, 2025-01-01, 0x1F, 007]
b: {c: ~, d: 'it''s', "e": true}
f: |
  two
  lines
g:
- h:
    - i
"""


@pytest.fixture
def read(tmp_path, monkeypatch):
    """What a text holds, by either parser."""

    def call(text, *, own):
        file = tmp_path / "a.yaml"
        file.write_text(text, encoding="utf-8")
        with monkeypatch.context() as patch:
            if own:
                patch.setattr(yaml_file, "_FastCoreLoader", yaml_file._CoreLoader)
            return yaml_file.read_document(file)

    return call


@pytest.mark.parametrize("text", [TEXT, "", *(shipped_rig(name).read_text() for name in ("workstation", "microscope"))])
def test_both_find_the_same_values_at_the_same_places(read, text):
    assert read(text, own=False) == read(text, own=True)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("a: @x", "found character '@' that cannot start any token"),
        ("a: [1", "expected ',' or ']', but got '<stream end>'"),
        ("a: *b", "found undefined alias 'b'"),
    ],
)
def test_what_is_wrong_is_said_as_exactly(read, text, what):
    with pytest.raises(ConfigError) as caught:
        read(text, own=False)
    assert what in str(caught.value)
