"""Columns of numbers as text: XYZ, CSV, TXT, ASC, PTS.

Read: columns apart by comma, semicolon, tab or blanks; comments from # or // on; a header line, a PTS count line and
blank lines skipped; decimal commas where semicolons or tabs part the columns. Named columns x y z (nx ny nz) are found
by name; otherwise x y z are the first three. nan and inf are numbers here and are dropped where a cloud is checked.
Written: one row of blank-separated numbers per point.
"""

import codecs
import io
import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jprimfit.io.files import BadFile, Cloud, cloud_of_columns, replacing

# Lines that may stand before the first row of numbers without a comment sign.
MAX_HEADER_LINES = 30
COMMENT = re.compile(r"(#|//).*")


def read(path: Path) -> Cloud:
    """The points of a text file, with normals if it has columns for them; BadFile if it holds no rows of numbers."""
    lines = _decoded(path).splitlines()
    first, header, separator = _first_row(lines, path)
    decimal_comma = separator in (";", "\t") and "," in lines[first]
    rows = [line.replace(",", ".") if decimal_comma else line for line in lines[first:]]
    num_columns = len(_cells(rows[0], separator))
    columns = _named(header, num_columns)
    table = _table(rows, columns or range(num_columns), separator, first, path)
    if columns is None:
        return cloud_of_columns(table, path)
    return Cloud(table[:, :3], table[:, 3:] if len(columns) == 6 else None)


def _decoded(path: Path) -> str:
    data = path.read_bytes()
    if not data.strip():
        raise BadFile(f"{path} is empty: give a file with one 'x y z' row per point.")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    if b"\0" in data:
        raise BadFile(
            f"{path} holds binary data, not text: rename it to what it is, or export the scan as text or PLY."
        )
    return data.decode("utf-8-sig", errors="replace")


def _first_row(lines: list[str], path: Path) -> tuple[int, str, str | None]:
    """Row number of the first line of numbers, the header line before it ('' if none) and the separator."""
    header, num_skipped = "", 0
    for number, line in enumerate(lines):
        text = COMMENT.sub("", line).strip()
        separator = next((mark for mark in ";,\t" if mark in text), None)
        cells = _cells(text.replace(",", ".") if separator in (";", "\t") else text, separator)
        if cells and all(_is_number(cell) for cell in cells):
            if len(cells) == 1 and number + 1 < len(lines) and len(_cells(lines[number + 1], None)) >= 3:
                continue  # PTS: the number of points stands alone before them
            return number, header, separator
        if line.strip():
            header = COMMENT.sub("", line).strip() or line.strip().lstrip("#/ ")
            num_skipped += bool(text)
        if num_skipped > MAX_HEADER_LINES:
            break
    raise BadFile(f"{path} holds text but no row of numbers: give a file with one 'x y z' row per point.")


def _cells(line: str, separator: str | None) -> list[str]:
    """The cells of a line; what follows a comment sign is no cell, nor is the nothing behind a last separator."""
    cells = [cell.strip().strip('"') for cell in COMMENT.sub("", line).strip().split(separator)]
    return cells[:-1] if separator and cells and not cells[-1] else cells


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _named(header: str, num_columns: int) -> list[int] | None:
    """Columns of x y z, and nx ny nz if all are there, where the header names them one to one; else None."""
    separator = next((mark for mark in ";,\t" if mark in header), None)
    names = [re.sub(r"[\[(].*|[^a-z]", "", cell.lower().replace("normal", "n")) for cell in _cells(header, separator)]
    if len(names) != num_columns or not all(name in names for name in "xyz"):
        return None
    columns = [names.index(name) for name in "xyz"]
    if all(name in names for name in ("nx", "ny", "nz")):
        columns += [names.index(name) for name in ("nx", "ny", "nz")]
    return columns


def _table(
    rows: list[str], columns: list[int] | range, separator: str | None, first: int, path: Path
) -> Float[np.ndarray, "n c"]:
    """The numbers of the given columns of all rows; BadFile naming the line where one is no number."""
    for comments in (None, ("#", "//")):  # loadtxt is ten times faster where it need not look for comments
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of blank lines
                return np.loadtxt(
                    io.StringIO("\n".join(rows)),
                    delimiter=separator,
                    usecols=tuple(columns),
                    comments=comments,
                    quotechar='"',
                    ndmin=2,
                )
        except ValueError:
            continue
    for number, line in enumerate(rows, start=first + 1):
        cells = _cells(line, separator)
        if any(cells) and not (len(cells) > max(columns) and all(_is_number(cells[i]) for i in columns)):
            shown = line.strip()[:60]
            raise BadFile(
                f"{path} has no {len(columns)} numbers in line {number} ('{shown}'): correct or remove that line."
            )
    raise BadFile(f"{path} is no table of numbers: give a file with one 'x y z' row per point.")


def write(path: str | Path, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"] | None = None) -> None:
    """Writes one row per point, x y z and the normals if given, so that float64 values survive (17 digits)."""
    table = points if normals is None else np.concatenate([points, normals], axis=1)
    with replacing(path) as file:
        np.savetxt(file, table, fmt="%.17g")
