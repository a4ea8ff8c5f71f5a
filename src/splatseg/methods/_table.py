"""The table of methods that README and documentation show, made from what methods declare."""

from collections.abc import Sequence

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError
from splatseg.methods._method import Method

BEGIN = "<!-- methods: made by scripts/methods_table -->"
END = "<!-- end of methods -->"


@boundary
def methods_table(methods: Sequence[Method]) -> str:
    """A Markdown table, a row a method."""
    rows = [
        f"| `{method.name}` | {', '.join(method.evidence)} | {method.returns} | {method.summary} "
        f"| {method.reference} |"
        for method in methods
    ]
    head = ["| method | evidence | gives | what it does | reference |", "| --- " * 5 + "|"]
    return "\n".join([*head, *rows])


@boundary
def with_table(text: str, table: str) -> str:
    """A page with the table between its two marks.

    Raises:
        FileFormatError: If the marks are not there.
    """
    before, mark, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (mark and end):
        raise FileFormatError(f"expected the marks {BEGIN!r} and {END!r}, got a page without.")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"
