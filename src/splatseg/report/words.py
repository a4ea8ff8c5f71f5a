"""Counts as sentences and tables have them."""


def count_text(count: int) -> str:
    """A count with thin spaces between thousands."""
    return f"{count:,}".replace(",", "\N{THIN SPACE}")


def counted(count: int, noun: str) -> str:
    """A count with its noun, in the plural where it is not one.

    Example:
        >>> counted(1, "view"), counted(3, "view")
        ('1 view', '3 views')
    """
    return f"{count_text(count)} {noun}" + ("" if count == 1 else "s")
