"""docs/recording-format.md lists every message as it is; run this file to write the list anew."""

from pathlib import Path

from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.schemas import Arrivals, Drops, fields_of, sample_types

DOCUMENT = Path(__file__).parents[2] / "docs" / "recording-format.md"
MARK = "<!-- messages: kept by tests/recording/test_recording_format.py -->\n"
PROTO = {
    "double": "double", "int": "sfixed64", "bool": "bool", "string": "string", "bytes": "bytes",
    "strings": "repeated string", "doubles": "repeated double", "ints": "repeated sfixed64",
}  # fmt: skip


def listed():
    shared = ", ".join(f"`{field.name}` {PROTO[field.kind]}" for field in fields_of(Sample))
    lines = ["| message | fields |", "|---|---|", f"| all samples | {shared} |"]
    kinds = [
        kind for kind in sample_types().values() if kind is not Frame and kind.__module__.startswith("microdrivers.")
    ]
    for kind in [*kinds, Arrivals, Drops]:
        own = [f for f in fields_of(kind) if f.name not in Sample.__struct_fields__]
        lines.append(f"| `{kind.__name__}` | {', '.join(f'`{f.name}` {PROTO[f.kind]}' for f in own)} |")
    return "\n" + "\n".join(lines) + "\n"


def test_the_document_lists_every_message():
    assert DOCUMENT.read_text(encoding="utf-8").partition(MARK)[2] == listed()


if __name__ == "__main__":
    text, mark, _ = DOCUMENT.read_text(encoding="utf-8").partition(MARK)
    DOCUMENT.write_text(text + mark + listed(), encoding="utf-8")
