"""Names that a format means something by are written as they are."""

from splatseg.tasks.score_tables import write_class_table

FIGURES = {
    "names_per_class": {"3": "salt & 50 % | a_b\\c\n~", "9": "plain"},
    "pixels_per_class": {"3": 10, "9": 5},
    "per_class": {"3": 0.5, "9": 1.0},
    "mIoU": 0.75,
}


def test_names_are_escaped(tmp_path) -> None:
    for name in ("t.csv", "t.md", "t.tex"):
        write_class_table(FIGURES, tmp_path / name)
    assert "| 3 | salt & 50 % \\| a_b\\c ~ | 10 | 0.5000 |\n" in (tmp_path / "t.md").read_text()
    latex = (tmp_path / "t.tex").read_text()
    name = r"salt \& 50 \% | a\_b\textbackslash{}c \textasciitilde{}"
    assert f"3 & {name} & 10 & 0.5000 \\\\\n" in latex
    assert '3,"salt & 50 % | a_b\\c\n~",10,0.5\n' in (tmp_path / "t.csv").read_text()
