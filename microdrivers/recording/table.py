"""Tables of recorded values: CSV with named columns, lines that begin with `#` are comments, more columns allowed."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

from microdrivers.core.errors import ConfigError

_LARGEST_NUMBER = 1e9
_LATEST_S = 1e10
"""Of `time_s`: seconds of an epoch are fine, its milliseconds are none."""


_OTHER_SEPARATORS = {";": "semicolons", "\t": "tabs"}
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


class TableRow(NamedTuple):
    """One line of a table: its number in the file, its cells as text, and those of the numeric columns."""

    line: int
    cells: dict[str, str]
    numbers: dict[str, float]


class Table:
    """A table that has been read and checked, its `time_s` increasing.

    Args:
        file: CSV in UTF-8.
        columns: all that must be there. numeric: those of them that are numbers, `time_s` among them.
        positive: numeric columns that must lie above zero. may_be_nan: those in which NaN, or nothing, is a value.

    Raises:
        ConfigError: with file, line and column: a missing column, a value that is not a finite number, times that do
            not increase, a row with too few or too many cells, a column that is there twice, another separator, no
            rows at all, not a table.
    """

    def __init__(
        self,
        file: Path,
        *,
        columns: Sequence[str],
        numeric: Sequence[str],
        positive: Collection[str] = (),
        may_be_nan: Collection[str] = (),
    ) -> None:
        self.file = file
        self.header: list[str] = []
        self._columns = columns
        self._numeric = numeric
        self._positive = positive
        self._may_be_nan = may_be_nan
        try:
            self.rows = self._read()
        except (UnicodeDecodeError, csv.Error, OSError) as error:
            raise ConfigError(
                f"cannot be read as a table: {error}", file=str(file), remedy="save it as CSV in UTF-8"
            ) from error

    def error(self, row: TableRow, key: str, what: str, *, remedy: str) -> ConfigError:
        """An error that points at one cell."""
        return ConfigError(
            what, file=str(self.file), line=row.line, column=self.header.index(key) + 1, key=key, remedy=remedy
        )

    def _read(self) -> list[TableRow]:
        rows: list[TableRow] = []
        with self.file.open(encoding="utf-8-sig", newline="") as stream:
            for number, cells in enumerate(csv.reader(stream), start=1):
                if not cells or cells[0].lstrip().startswith("#"):
                    continue
                if not self.header:
                    self._take_header(number, [cell.strip() for cell in cells])
                    continue
                row = self._row(number, cells)
                if rows and row.numbers["time_s"] <= rows[-1].numbers["time_s"]:
                    raise self.error(
                        row, "time_s", "time does not increase",
                        remedy="sort the rows by time and remove repetitions",
                    )  # fmt: skip
                rows.append(row)
        if not rows:
            raise ConfigError("the table has no rows", file=str(self.file), line=1, remedy="add a row for each sample")
        return rows

    def _take_header(self, line: int, header: list[str]) -> None:
        separator = next((name for sign, name in _OTHER_SEPARATORS.items() if sign in "".join(header)), None)
        missing = [column for column in self._columns if column not in header]
        if missing and separator is not None:
            raise ConfigError(
                f"the cells are separated by {separator}, not by commas",
                file=str(self.file), line=line, column=1,
                remedy="save the table with commas between the cells, and points in the numbers (0.5)",
            )  # fmt: skip
        twice = [column for column in self._columns if header.count(column) > 1]
        if twice:
            raise ConfigError(
                f"column {', '.join(twice)} is there more than once",
                file=str(self.file), line=line, column=len(header) - header[::-1].index(twice[0]),
                remedy="keep one column of each name",
            )  # fmt: skip
        if missing:
            raise ConfigError(
                f"column {', '.join(missing)} is missing (found: {', '.join(header)})",
                file=str(self.file), line=line, column=1, remedy=f"the header must name {', '.join(self._columns)}",
            )  # fmt: skip
        self.header = header

    def _row(self, line: int, cells: list[str]) -> TableRow:
        if len(cells) < len(self.header):
            raise ConfigError(
                f"the row has {len(cells)} cells, the header {len(self.header)}",
                file=str(self.file), line=line, column=len(cells), remedy="complete the row",
            )  # fmt: skip
        if any(cell.strip() for cell in cells[len(self.header) :]):
            raise ConfigError(
                f"the row has {len(cells)} cells, the header {len(self.header)}",
                file=str(self.file), line=line, column=len(self.header) + 1,
                remedy="write numbers with a decimal point (0.5, not 0,5), and a name above each column",
            )  # fmt: skip
        row = TableRow(line, dict(zip(self.header, cells, strict=False)), {})
        for key in self._numeric:
            row.numbers[key] = self._number(row, key)
        return row

    def _number(self, row: TableRow, key: str) -> float:
        text = row.cells[key].strip()
        try:
            number = float(text or "nan")
        except ValueError:
            number = math.inf
        if math.isnan(number) and key in self._may_be_nan:
            return number
        if _DECIMAL_COMMA.fullmatch(text):
            raise self.error(
                row, key, f"{text!r} has a decimal comma", remedy="write numbers with a decimal point: 0.5, not 0,5"
            )
        largest = _LATEST_S if key == "time_s" else _LARGEST_NUMBER
        if largest <= abs(number) < math.inf:
            raise self.error(
                row, key, f"{text} is beyond {largest:g}", remedy="check the unit, which the column's name states"
            )
        if not abs(number) < largest or (key in self._positive and number <= 0):
            above = " above zero" if key in self._positive else ""
            raise self.error(
                row, key, f"{row.cells[key]!r} is not a finite number{above}",
                remedy="write a plain number in the unit that the column's name states",
            )  # fmt: skip
        return number
