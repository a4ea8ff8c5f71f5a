"""Phrases to trees."""

import pytest

from splatseg.errors import InputError
from splatseg.lift.referring.grammar import NounPhrase, parse_referring, singular

NAMES = {"mug", "book", "books", "desk", "office chair", "chair", "cactus", "vase", "top hat",
         "box", "stand"}  # fmt: skip


def shown(phrase: NounPhrase) -> str:
    """A tree in one line: [noun], * for a plural, ! for a negation."""
    orders = "".join(
        f"<{one.key}{'-' if one.descending else '+'}{one.rank}"
        + (f" {shown(one.landmark)}" if one.landmark else "")
        + ("!" if one.stands_out else "")
        + ">"
        for one in phrase.orders
    )
    number = "" if phrase.number is None else f"{phrase.number} "
    count = "#" if phrase.quantity == "count" else ""
    clauses = "".join(
        f"({'!' if one.negated else ''}{one.relation or one.words} "
        + (one.attribute or " & ".join(map(shown, one.landmarks)))
        + (f" {one.within}" if one.relation == "with" else "")
        + ")"
        for one in phrase.clauses
    )
    return f"{number}{count}{orders}[{phrase.noun}{'*' if phrase.plural else ''}]{clauses}"


@pytest.mark.parametrize(
    ("text", "trees"),
    [
        # Names
        ("red mug", ["[red mug]"]),
        ("The Red Mugs.", ["[red mug*]"]),
        ("books", ["[book*]"]),
        ("office chair", ["[office chair]"]),
        ("the top hat", ["[top hat]"]),
        ("glasses", ["[glasses]"]),
        ("vases", ["[vase*]"]),
        ("boxes", ["[box*]"]),
        ("box standing on the stand", ["[box](on [stand])"]),
        (
            "the stand left of the box that stands on the desk",
            ["[stand](left of [box](on [desk]))", "[stand](left of [box])(on [desk])"],
        ),
        ("three cactuses", ["3 [cactus*]"]),
        ("white mug on the desk (2)", ["[white mug](on [desk])"]),
        # Relations
        ("the mug left of the laptop", ["[mug](left of [laptop])"]),
        ("mug to the right of a laptop", ["[mug](right of [laptop])"]),
        ("mug on the left side of the laptop", ["[mug](left of [laptop])"]),
        ("the cat in front of the sofa", ["[cat](in front of [sofa])"]),
        ("cat behind the sofa", ["[cat](behind [sofa])"]),
        ("mug standing on top of the desk", ["[mug](on [desk])"]),
        ("bin underneath the desk", ["[bin](under [desk])"]),
        ("lamp over the desk", ["[lamp](above [desk])"]),
        ("chair next to the table", ["[chair](near [table])"]),
        ("chairs at the table", ["[chair*](near [table])"]),
        ("pen inside the mug", ["[pen](in [mug])"]),
        ("the mug between the laptop and the plant", ["[mug](between [laptop] & [plant])"]),
        ("the mug between the two books", ["[mug](between 2 [book*])"]),
        ("the mug between the books", ["[mug](between [book*])"]),
        ("the desk with a mug on it", ["[desk](with [mug] on)"]),
        ("the desk with a bin under it", ["[desk](with [bin] under)"]),
        ("desks without a laptop", ["[desk*](!with [laptop] on)"]),
        ("the one left of the laptop", ["[](left of [laptop])"]),
        ("red things on the desk", ["[red*](on [desk])"]),
        # Attachment: two readings, that of the nearest noun first
        (
            "the mug near the book on the desk",
            ["[mug](near [book](on [desk]))", "[mug](near [book])(on [desk])"],
        ),
        ("mug on the desk and near the book", ["[mug](on [desk])(near [book])"]),
        # Negation
        ("mug that is not red", ["[mug](!not red)"]),
        ("non-red mugs", ["[mug*](!not red)"]),
        ("the not dark red mug", ["[mug](!not dark red)"]),
        ("mugs which are red", ["[mug*](is red)"]),
        ("chairs not at the table", ["[chair*](!near [table])"]),
        ("the chair that isn't at the table", ["[chair](!near [table])"]),
        ("mugs except the red one", ["[mug*](!except [red])"]),
        ("mugs but not the red one", ["[mug*](!but not [red])"]),
        # Numbers
        ("two mugs", ["2 [mug*]"]),
        ("both mugs on the desk", ["2 [mug*](on [desk])"]),
        ("12 mugs", ["12 [mug*]"]),
        ("how many mugs are there", ["#[mug*]"]),
        ("how many mugs are there on the desk?", ["#[mug*](on [desk])"]),
        ("number of books on the desk", ["#[book*](on [desk])"]),
        ("all mugs on the desk", ["[mug*](on [desk])"]),
        # Orders
        ("largest plant", ["<size->[plant]".replace("->", "-1>")]),
        ("the two largest plants", ["2 <size-1>[plant*]"]),
        ("second smallest plant", ["<size+2>[plant]"]),
        ("the largest of the mugs", ["<size-1>[mug]"]),
        ("the small plant", ["<size+1!>[plant]"]),
        ("highest book", ["<elevation-1>[book]"]),
        ("leftmost mug on the desk", ["<lateral+1>[mug](on [desk])"]),
        ("the left mug", ["<lateral+1>[mug]"]),
        ("the mug on the right", ["<lateral-1>[mug]"]),
        ("the mug at the back", ["<depth-1>[mug]"]),
        ("the rear mug", ["<depth-1>[mug]"]),
        ("the front mug", ["<depth+1>[mug]"]),
        ("the bottom book", ["<elevation+1>[book]"]),
        ("the tallest plant", ["<height-1>[plant]"]),
        ("the shortest plant", ["<height+1>[plant]"]),
        ("the topmost book", ["<elevation-1>[book]"]),
        ("the lowest book", ["<elevation+1>[book]"]),
        ("the rightmost mug", ["<lateral-1>[mug]"]),
        ("the farthest chair", ["<depth-1>[chair]"]),
        ("the middle mug", ["<middle+1>[mug]"]),
        ("nearest mug", ["<depth+1>[mug]"]),
        ("second mug from the left", ["<lateral+2>[mug]"]),
        ("the 3rd mug from the right", ["<lateral-3>[mug]"]),
        ("the second mug", ["<lateral+-2>[mug]"]),
        ("the chair nearest the window", ["<distance+1 [window]>[chair]"]),
        ("chair that is closest to the window", ["<distance+1 [window]>[chair]"]),
        ("chair farthest away from the window", ["<distance-1 [window]>[chair]"]),
        ("the nearest chair to the window", ["<distance+1 [window]>[chair]"]),
        ("second closest chair to the window", ["<distance+2 [window]>[chair]"]),
        ("the second chair nearest the window", ["<distance+2 [window]>[chair]"]),
        ("three books on the upper desk", ["3 [book*](on <elevation-1>[desk])"]),
    ],
)
def test_trees(text: str, trees: list[str]) -> None:
    found = parse_referring(text, is_name=lambda words: words in NAMES)
    assert [shown(one) for one in found] == trees


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("mug or plant", "or plant"),
        ("mug left of", "its end"),
        ("two of the mugs", "of the mugs"),
        ("the mug near two chairs", "its end"),
        ("upper left mug", "left mug"),
        ("the mug between the laptop", "its end"),
        ("mug from the left", "its end"),
        ("desk with a mug on it of", "of"),
    ],
)
def test_what_is_no_phrase_is_one_sentence(text: str, place: str) -> None:
    with pytest.raises(InputError, match=f"which is not understood at '{place}'"):
        parse_referring(text, is_name=lambda words: words in NAMES)


def test_very_many_relations_are_refused() -> None:
    text = "mug " + " ".join(["near the book"] * 11)
    with pytest.raises(InputError, match="at most 5 relations"):
        parse_referring(text)
    assert len(parse_referring("mug " + " ".join(["near the book"] * 4))) == 14  # Catalan number


@pytest.mark.parametrize("word", ["plain", "red mug", "the mugs", "some mugs"])
def test_names_alone_are_plain(word: str) -> None:
    assert all(one.is_plain for one in parse_referring(word))


@pytest.mark.parametrize(
    "word", ["two mugs", "how many mugs", "largest mug", "mug on desk", "non-red mug"]
)
def test_what_refers_is_not_plain(word: str) -> None:
    assert not any(one.is_plain for one in parse_referring(word))


@pytest.mark.parametrize(
    ("word", "one"),
    [("berries", "berry"), ("mice", "mouse"), ("dishes", "dish"), ("bus", None), ("glass", None),
     ("cactus", None), ("scissors", None), ("gas", None), ("shelves", "shelf")],
)  # fmt: skip
def test_singulars(word: str, one: str | None) -> None:
    assert singular(word) == ((word, False) if one is None else (one, True))
