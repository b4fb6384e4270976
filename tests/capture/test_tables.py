"""Text tables: every common form is read alike, every slip is named with its line."""

import re

import numpy as np
import pytest
from cases import each

from polar_bayes.errors import CaptureError
from polar_bayes.importers import columns as module
from polar_bayes.importers.columns import read_table


@pytest.fixture
def write(tmp_path):
    """A function that writes a table, text or bytes, and gives its path."""

    def write_table(content):
        path = tmp_path / "table.txt"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write_table


SAME_TABLE = {
    "tab": "angle\tlevel\n10\t1.5\n20\t2.5\n",
    "runs of tabs": "angle\t\tlevel\n10\t\t1.5\n20\t2.5\t\n",
    "comma": "angle,level\n10,1.5\n20,2.5\n",
    "comma and blank": "angle, level\n10, 1.5\n20, 2.5\n",
    "semicolon": "angle;level\n10;1.5\n20;2.5\n",
    "comma, many blanks": "angle , level\n10 ,1.5\n20  ,2.5\n",
    "blanks": "angle level\n  10  1.5\n  20  2.5\n",
    "decimal comma, semicolon": "angle;level\n10;1,5\n20;2,5\n",
    "decimal comma, tab": "angle\tlevel\n10\t1,5\n20\t2,5\n",
    "decimal comma, blank": "angle level\n10 1,5\n20 2,5\n",
    "quotes": '"angle","level"\n"10","1.5"\n"20","2.5"\n',
    "comments": "# a lamp\nangle,level # here\n\n10,1.5\n# dark\n20,2.5 # late\n",
    "byte order mark": "\ufeffangle,level\n10,1.5\n20,2.5\n",
    "carriage returns": "angle,level\r\n10,1.5\r\n20,2.5\r\n",
    "old carriage returns": "angle,level\r10,1.5\r20,2.5",
    "exponents": "angle,level\n1e1,15E-1\n+2.0e+1,.25e1\n",
    "Fortran exponents": "angle level\n1.0D+01 15d-1\n0.20D2 .25D1\n",
    "UTF-16": "angle\tlevel\r\n10\t1.5\r\n20\t2.5\r\n".encode("utf-16"),
    "units": "angle,level\n(°),mV\n10,1.5\n20,2.5\n",
    "text above": "Instrument: XY 3\nDate;7.3.2020;late\nangle;level\n10;1.5\n20;2.5\n",
    "names in a comment": "# 3 lamps\n# angle level\n10 1.5\n20 2.5\n",
    "names again": "angle,level\n10,1.5\nangle,level\n20,2.5\n",
    "blank lines and means": "angle;level\n10;1.5\n20;2.5\n;;\n;mean;2\nmean;2\n",
    "blanks at the end": "angle,level,,\n10,1.5,,\n20,2.5\n",
    "no last line break": "angle,level\n10,1.5\n20,2.5",
}


@each("form", SAME_TABLE)
def test_every_form_of_a_table_is_read_alike(write, form):
    table = read_table(write(SAME_TABLE[form]))
    assert table.names == ("angle", "level")
    np.testing.assert_array_equal(table.columns["angle"], [10.0, 20.0])
    np.testing.assert_array_equal(table.columns["level"], [1.5, 2.5])


@pytest.mark.thorough
def test_columns_without_names_are_numbered(write):
    assert read_table(write("1 2 3\n")).names == ("column_1", "column_2", "column_3")
    assert read_table(write("a,,c\n1,2,3\n")).names == ("a", "column_2", "c")


MARKED = {
    "1,234.5": ["1,234.5", "0.5"],
    "1.234,5": ["1.234,5", "0,5"],
    "1 234,5": ["1\N{NO-BREAK SPACE}234,5", "0,5"],
    "1'234.5": ["1'234.5", ".5"],
    "quoted": ['"1,234"', '"480"'],
}


@each("form", MARKED)
def test_marks_for_thousands_are_taken_off_and_counted(write, form):
    first, second = MARKED[form]
    separator = "," if form == "quoted" else ";"
    table = read_table(write(f"a{separator}b\n1{separator}{first}\n2{separator}{second}\n"))
    expected = [1234.0, 480.0] if form == "quoted" else [1234.5, 0.5]
    assert table.columns["b"].tolist() == expected
    assert table.notes == ("1 number freed of marks for thousands",)


def test_a_blank_is_no_reading_and_an_uncertainty_is_an_error(write):
    table = read_table(
        write("a\tb\tc\n1\t\t47.1±2.0\n\N{MINUS SIGN}2\t4\t47.1(20)\n3\tn/a\t5 +/- .5\n")
    )
    assert table.columns["a"].tolist() == [1.0, -2.0, 3.0]
    np.testing.assert_array_equal(table.columns["b"], [np.nan, 4.0, np.nan])
    assert table.columns["c"].tolist() == [47.1, 47.1, 5.0]
    np.testing.assert_allclose(table.errors["c"], [2.0, 2.0, 0.5])
    assert table.notes == (
        "2 blank cells of b taken as no reading",
        "3 readings of c with its error in the cell",
    )


def test_columns_are_chosen_by_name_in_the_order_asked(write):
    table = read_table(write("a b c\n1 2 3\n"), ["c", "a"])
    assert table.names == ("c", "a")
    assert table.columns["c"] == [3.0]


@pytest.mark.thorough
def test_the_printed_digits_and_lines_are_kept(write):
    table = read_table(write("# head\nlevel,other\n1.20,239\n\n-3e2,1.5e-3\n"))
    np.testing.assert_allclose(table.steps["level"], [0.01, 100.0], rtol=1e-15)
    np.testing.assert_allclose(table.steps["other"], [1.0, 1e-4], rtol=1e-15)
    assert table.lines == (3, 5)


@pytest.mark.thorough
def test_a_header_of_another_time_is_read(write):
    assert read_table(write(b"Winkel (\xb0)\tI\n1\t2\n")).names == ("Winkel (°)", "I")


REFUSED = [
    ("1 2\n3 x\n", "line 2, column column_2: 'x' is not a finite number", "correct it"),
    ("nan nan\n-- 2\n", "no line has a number for column_1", "give a line for each"),
    ("1 2\n3 inf\n", "line 2, column column_2: 'inf' is not", "correct it"),
    ("1 2\n3 1e999\n", "line 2, column column_2: '1e999' is not", "correct it"),
    ("1 2\n3 1e9999\n", "line 2, column column_2: '1e9999' is not", "correct it"),
    ("1 2\n3 1e-400\n", "line 2, column column_2: '1e-400' is not", "correct it"),
    ("1 2\n3 0e999\n", "line 2, column column_2: '0e999' is not", "correct it"),
    ("1 2\n3 1_0\n", "line 2, column column_2: '1_0' is not", "correct it"),
    ("1 2\n3 0x10\n", "line 2, column column_2: '0x10' is not", "correct it"),
    ("1 2\n3 ٣\n", "line 2, column column_2: '٣' is not", "correct it"),
    ("1 2\n3 4(0)\n", "line 2, column column_2: '4(0)' is not", "correct it"),
    ("1 2\n3 4±inf\n", "line 2, column column_2: '4±inf' is not", "correct it"),
    ("1 2\n3 __import__('os')\n", 'line 2, column column_2: "__import__', "correct it"),
    ("1 2\n3 " + "9" * 65 + "\n", "line 2, column column_2: '999", "correct it"),
    ("1O 20\n10 20\n", "line 1, column column_1: '1O' is not", "correct it"),
    ("a,b\ndeg,V2\n1,2\n", "line 2, column a: 'deg' is not", "a # before it"),
    ("a,b\n1,2\nx2,3\n", "line 3, column a: 'x2' is not", "a # before it"),
    ("1 2\n\n3\n", "line 3: it has another number of cells (1) than the first (2)", "one cell for"),
    ("a b\n1 2 3\n", "line 2: it has another number of cells (3) than the first (2)", "one cell"),
    ("1;2,5\n3;4.5\n", "line 1: decimal commas stand beside decimal points", "no mark for thous"),
    ("1;1,234.5\n2;1,5\n", "line 1: decimal commas stand beside", "no mark for thousands"),
    ("1;1,234.5\n2;1.234,5\n", "line 1: decimal commas stand", "no mark for thousands"),
    ("1;480\n2;1,009\n", "line 2: '1,009' could be a thousand, or have a decimal", "print all dec"),
    ("a a\n1 2\n", "line 1: two columns have the same name", "name each column once"),
    ("a \x1bb\n1 2\n", "line 1: a name is not printable text", "UTF-8"),
    (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "it is not text", "save the table as UTF-8 text"),
    ("a b\n1 2\n".encode("utf-16-le"), "it is not text", "save the table as UTF-8 text"),
    (b"PK\3\4 broken", "it cannot be read as .xlsx", "save the table as UTF-8 text"),
    ("", "the file is empty", "write it again"),
    ("# only\n\n", "it holds no rows", "give a line for each reading"),
    ("a b\n", "it holds names but no rows", "give a line for each reading"),
]


@each(("content", "what", "hint"), REFUSED)
def test_a_slip_is_named_with_its_line(write, content, what, hint):
    with pytest.raises(CaptureError, match=r"table\.txt: " + re.escape(what)) as caught:
        read_table(write(content))
    assert hint in caught.value.hint
    assert "\n" not in str(caught.value)


def test_an_unknown_column_is_answered_with_the_known_ones(write):
    with pytest.raises(CaptureError, match=r"table\.txt: there is no column 'S'; choose from a, b"):
        read_table(write("a b\n1 2\n"), ["a", "S"])


def test_a_table_too_large_is_not_read(write, monkeypatch):
    monkeypatch.setattr(module, "LARGEST_FILE", 5)
    with pytest.raises(CaptureError, match="the file is too large; give a table of at most 50 MB"):
        read_table(write("1 2\n3 4\n"))


def test_a_path_that_holds_no_table_is_named(tmp_path):
    with pytest.raises(CaptureError, match=r"gone\.txt: there is no such file; check the path"):
        read_table(tmp_path / "gone.txt")
    with pytest.raises(CaptureError, match="it is a folder or device; give the path of a file"):
        read_table(tmp_path)
    with pytest.raises(CaptureError, match="table: None is not a path; give the path of a file"):
        read_table(None)


@pytest.mark.thorough
def test_a_table_without_rights_is_named(write, monkeypatch):
    path = write("1 2\n")

    def refuse(*arguments):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "read_bytes", refuse)
    with pytest.raises(CaptureError, match=r"table\.txt: permission denied; check the path, its r"):
        read_table(path)


@pytest.mark.thorough
def test_a_long_table_is_read_in_reasonable_time(write):
    rows = 100_000
    table = read_table(write("angle,level\n" + "45.0,1.25\n" * rows))
    assert table.columns["level"].shape == (rows,)


@each("name", ["s1.txt", "p1.txt"])
def test_a_measured_table_is_read(measured, name):
    table = read_table(measured / "glass_fresnel" / name)
    assert table.names == ("column_1", "column_2")
    assert table.columns["column_2"].min() > 0.0
