"""Pages show names of others as they are, and a browser does nothing else for them."""

from html.parser import HTMLParser

from splatseg.core import ClassInfo, ClassTable
from splatseg.report.chart import Chart, Line
from splatseg.report.html import Commands, Curves, Legend, Report, Table, report_html

NAME = "wall\u202e\x1b[31m<script>alert(1)</script>"
SEEN = "wall\\u202e\\x1b[31m&lt;script&gt;alert(1)&lt;/script&gt;"


class _Found(HTMLParser):
    """Tags of a page, and its policy."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.policy: dict[str, str] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        self.tags.append(tag)
        self.addresses += [values[key] for key in ("src", "href") if key in values]
        assert not any(key.startswith("on") for key in values)
        if values.get("http-equiv") == "Content-Security-Policy":
            rules = (rule.split(maxsplit=1) for rule in values["content"].split(";"))
            self.policy = {rule[0]: rule[1] for rule in rules}


def page() -> str:
    classes = ClassTable(rows=(ClassInfo(id=1, name=NAME),))
    line = Line(name=NAME, points=((0.0, 1.0), (1.0, 2.0)))
    blocks = (
        Table(title=NAME, columns=(NAME,), rows=((NAME,),)),
        Legend(title="Classes", classes=classes),
        Curves(title="Curves", charts=(Chart(title=NAME, across=NAME, lines=(line,)),)),
        Commands(title="Commands", lines=("a", NAME)),
    )
    return report_html(Report(title=NAME, command=f"splatseg {NAME}", blocks=blocks))


def test_names_are_seen_as_they_are() -> None:
    found = page()
    assert SEEN in found
    assert not any(mark in found for mark in ("\u202e", "\x1b", "<script"))
    assert f"<pre>a\n{SEEN}</pre>" in found, "lines stay lines"


def test_a_browser_is_told_to_fetch_and_run_nothing() -> None:
    found = _Found()
    found.feed(page())
    assert found.policy["default-src"] == "'none'"
    assert found.policy["style-src"] == "'unsafe-inline'", "the page has its style within"
    assert found.policy["img-src"] == "data:"
    assert found.policy["base-uri"] == found.policy["form-action"] == "'none'"
    assert found.tags.index("meta") < found.tags.index("style"), "it holds for all that follows"
    assert "script" not in found.tags
    assert all(address.startswith(("data:", "#")) for address in found.addresses)
