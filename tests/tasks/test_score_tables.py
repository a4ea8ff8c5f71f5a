"""Names that a format means something by are written as they are."""

import csv
import io

from splatseg.tasks.figures import write_class_table, write_confusion

FIGURES = {
    "names_per_class": {"3": "salt & 50 % | a_b\\c\n~", "9": "plain"},
    "pixels_per_class": {"3": 10, "9": 5},
    "per_class": {"3": 0.5, "9": 1.0},
    "mIoU": 0.75,
}


def test_names_are_escaped(tmp_path) -> None:
    for name in ("t.csv", "t.md", "t.tex"):
        write_class_table(FIGURES, tmp_path / name)
    assert (
        "| 3 | salt &amp; 50 % \\| a_b\\\\c ~ | 10 | 0.5000 |\n" in (tmp_path / "t.md").read_text()
    )
    latex = (tmp_path / "t.tex").read_text()
    name = r"salt \& 50 \% \textbar{} a\_b\textbackslash{}c \textasciitilde{}"
    assert f"3 & {name} & 10 & 0.5000 \\\\\n" in latex
    assert '3,"salt & 50 % | a_b\\c\n~",10,0.5\n' in (tmp_path / "t.csv").read_text()


def test_names_are_neither_formulas_nor_markup(tmp_path) -> None:
    names = ["=HYPERLINK(1)", "+1+cmd|' /C calc'!A0", "@SUM(1)", "-2", "\t=1", "'quoted", "\uff1d1"]
    names += ["<img src=x>", "![a](http://b)", "`c`", "plain"]
    figures = FIGURES | {
        "names_per_class": {str(i): name for i, name in enumerate(names)},
        "pixels_per_class": {str(i): 1 for i in range(len(names))},
        "per_class": {str(i): -0.5 for i in range(len(names))},
    }
    for name in ("t.csv", "t.md", "t.tex"):
        write_class_table(figures, tmp_path / name)
    rows = list(csv.reader(io.StringIO((tmp_path / "t.csv").read_text(), newline="")))[1:-1]
    assert all(row[1].startswith("'") for row in rows[:7])
    assert [row[1].removeprefix("'") for row in rows] == names
    assert {row[3] for row in rows} == {"-0.5"}, "numbers stay numbers"
    markdown = (tmp_path / "t.md").read_text()
    assert "<" not in markdown
    assert "| !\\[a\\](http://b) |" in markdown
    assert "| \\`c\\` |" in markdown
    assert "<" not in (tmp_path / "t.tex").read_text()

    matrix = {"names": {"1": "=A1"}, "true": ["1"], "predicted": ["1"], "counts": [[4]]}
    write_confusion({"confusion": matrix}, tmp_path / "c.csv")
    assert (tmp_path / "c.csv").read_text() == "true class,'=A1\n'=A1,4\n"
