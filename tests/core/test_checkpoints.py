"""Options of interrupted work: which are the same although the program has grown."""

from splatseg.core.checkpoints import ABSENT, OptionDifference, option_differences


def found(recorded, wanted, defaults=None, recorded_defaults=None) -> dict[str, tuple]:
    differences = option_differences(
        recorded, wanted, defaults=defaults or {}, recorded_defaults=recorded_defaults or {}
    )
    assert all(isinstance(one, OptionDifference) for one in differences)
    return {one.name: (one.recorded, one.wanted) for one in differences}


def test_what_both_know_is_compared() -> None:
    assert found({"a": 1, "b": [2]}, {"a": 1, "b": [2]}) == {}
    # Defaults have no say where there are values.
    assert found({"a": 1}, {"a": 2}, {"a": 1}, {"a": 1}) == {"a": (1, 2)}


def test_what_came_later_counts_as_its_default() -> None:
    assert found({}, {"a": 1}, {"a": 1}) == {}
    assert found({}, {"a": 2}, {"a": 1}) == {"a": (1, 2)}
    assert found({}, {"a": 2}) == {"a": (ABSENT, 2)}
    # None is a value like others.
    assert found({}, {"a": None}, {"a": None}) == {}
    assert found({}, {"a": None}) == {"a": (ABSENT, None)}


def test_what_was_taken_away_may_have_been_at_its_default() -> None:
    assert found({"a": 1}, {}, {}, {"a": 1}) == {}
    assert found({"a": 2}, {}, {}, {"a": 1}) == {"a": (2, ABSENT)}
    assert found({"a": 1}, {}, {"a": 1}, {}) == {"a": (1, ABSENT)}


def test_groups_are_looked_into() -> None:
    recorded = {"group": {"a": 1, "gone": 5}}
    wanted = {"group": {"a": 2, "new": 7}}
    defaults, old = {"group": {"new": 7}}, {"group": {"gone": 5}}
    assert found(recorded, wanted, defaults, old) == {"a": (1, 2)}
    assert found(recorded, wanted, defaults) == {"a": (1, 2), "gone": (5, ABSENT)}
    # A whole group that came later, and one that became a plain value.
    assert found({}, wanted, {"group": {"a": 2, "new": 7}}) == {}
    assert found({"group": 3}, wanted) == {"group": (3, {"a": 2, "new": 7})}
