"""A table of results that survives a kill: rows are kept in a journal as they come, the table is written at the end."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from microdrivers import __version__
from microdrivers.core.errors import ConfigError
from microdrivers.recording.output import whole_file
from microdrivers.recording.views import optional_module
from microdrivers.routines.analysis.one import COLUMNS, Row

SUFFIXES = (".csv", ".parquet")


class ResultsTable:
    """The table `file`, and beside it its journal `<file>.journal`: one JSON object a line, flushed to the disk.

    A journal that is found is gone on with: rows of files that have not changed since are not computed again, and a
    line that a kill has torn counts as none. Only one program at a time may have it.

    Attributes:
        rows: of the journal, by file.

    Raises:
        ConfigError: the table exists, cannot be written, has another suffix than .csv or .parquet, or its journal is in
            use, of another version of microdrivers, or no journal.
        UnsupportedError: .parquet without pyarrow.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.journal = file.with_name(f"{file.name}.journal")
        self.rows: dict[str, Row] = {}
        self._stamps: dict[str, list[int]] = {}
        self._seen: dict[str, list[int]] = {}
        if file.suffix not in SUFFIXES:
            raise ConfigError("the table's name must end in .csv or .parquet", file=str(file), remedy="rename it")
        if file.suffix == ".parquet":
            optional_module("pyarrow.parquet")
        if file.exists():
            raise ConfigError(
                "the table already exists, and is never overwritten", file=str(file), remedy="choose another --out"
            )
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.journal.open("a+b")
        except OSError as error:
            raise self._not_writable(error) from error
        try:
            self._lock()
            self._read()
        except BaseException:
            self._close_stream()
            raise

    def is_done(self, file: str) -> bool:
        """Whether the journal has this file's row, and the file is as it was then."""
        self._seen[file] = _stamp(file)
        return file in self.rows and self._stamps[file] == self._seen[file]

    def add(self, row: Row) -> None:
        """Keep a row; it is on the disk when this returns.

        Raises:
            ConfigError: it cannot be written.
        """
        name = str(row["file"])
        # As it was before it was analysed: if it has changed since, it is analysed again.
        self.rows[name], self._stamps[name] = row, self._seen.get(name, [])
        self._append({"row": row, "stamp": self._stamps[name]})

    def finish(self, files: Sequence[str]) -> None:
        """Write the rows of these files, sorted by file, and remove the journal.

        Raises:
            ConfigError: it cannot be written; the journal stays.
        """
        rows = [self.rows[name] for name in sorted(set(files))]
        try:
            with whole_file(self.file) as part:
                (_write_csv if self.file.suffix == ".csv" else _write_parquet)(part, rows)
            self.journal.unlink()
        except OSError as error:
            raise self._not_writable(error) from error

    def close(self) -> None:
        """Leave the journal to the next run, if there is anything in it."""
        if not self.rows:
            with contextlib.suppress(OSError):
                self.journal.unlink(missing_ok=True)
        self._close_stream()

    def _close_stream(self) -> None:
        with contextlib.suppress(OSError):  # what a full disk has refused is tried again, and has been told
            self._stream.close()

    def __enter__(self) -> ResultsTable:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------ the journal

    def _lock(self) -> None:
        if sys.platform == "win32":
            return
        import fcntl

        try:
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                "another program is filling this table",
                file=str(self.journal),
                remedy="wait for it, or choose another --out",
            ) from error

    def _read(self) -> None:
        self._stream.seek(0)
        whole, _, torn = self._stream.read().rpartition(b"\n")
        begin = {"journal": "microdrivers analyse", "microdrivers": __version__, "columns": list(COLUMNS)}
        if torn:
            self._stream.truncate(len(whole) + 1 if whole else 0)
        lines = whole.splitlines()
        if not lines:
            try:
                self._append(begin)
            except ConfigError:
                self.journal.unlink(missing_ok=True)
                raise
            return
        found = _parsed(lines[0])
        if found != begin:
            is_other = isinstance(found, dict) and found.get("journal") == begin["journal"]
            raise ConfigError(
                "this table was begun by another version of microdrivers, whose rows may differ" if is_other
                else "this is not a journal of `microdrivers analyse`",
                file=str(self.journal), remedy="remove it to begin anew, or choose another --out",
            )  # fmt: skip
        for line in lines[1:]:
            entry = _parsed(line)
            if isinstance(entry, dict) and isinstance(entry.get("row"), dict) and list(entry["row"]) == list(COLUMNS):
                name = entry["row"]["file"]
                self.rows[name], self._stamps[name] = entry["row"], entry["stamp"]

    def _append(self, entry: Mapping[str, Any]) -> None:
        try:
            self._stream.write(json.dumps(entry, ensure_ascii=False).encode() + b"\n")
            self._stream.flush()
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise self._not_writable(error) from error

    def _not_writable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"the table cannot be written: {error.strerror or error}",
            file=str(self.file),
            remedy="choose another --out, in a folder that may be written, on a disk with space left",
        )


def read_table(file: Path) -> list[dict[str, str]]:
    """The rows of a table in CSV, all cells as text."""
    with file.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _parsed(line: bytes) -> Any:
    with contextlib.suppress(ValueError):
        return json.loads(line)
    return None


def _stamp(file: str) -> list[int]:
    """What changes when the file does; empty if there is none."""
    try:
        status = Path(file).stat()
    except OSError:
        return []
    return [status.st_size, status.st_mtime_ns]


def _write_csv(file: Path, rows: Sequence[Row]) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow(int(cell) if isinstance(cell, bool) else cell for cell in row.values())


def _write_parquet(file: Path, rows: Sequence[Row]) -> None:
    arrow, parquet = optional_module("pyarrow"), optional_module("pyarrow.parquet")
    kinds = {str: arrow.string(), int: arrow.int64(), float: arrow.float64(), bool: arrow.bool_()}
    schema = arrow.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    parquet.write_table(arrow.Table.from_pylist(list(rows), schema=schema), str(file))
