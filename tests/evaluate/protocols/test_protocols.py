"""Protocols as data: all are whole, switches are typed, compared and recorded."""

from dataclasses import fields

import pytest

from splatseg.errors import InputError, RangeError
from splatseg.evaluate.protocols import (
    PROTOCOLS,
    MapSwitches,
    PointSwitches,
    TargetSwitches,
    differences,
    find_protocol,
    recorded,
    switch_value,
)
from splatseg.io.benchmarks import LAYOUTS


def test_every_protocol_names_a_layout_and_records_every_switch() -> None:
    assert len({one.name for one in PROTOCOLS}) == len(PROTOCOLS)
    for one in PROTOCOLS:
        assert one.layouts, one.name
        assert set(one.layouts) <= set(LAYOUTS), one.name
        names = {field.name for field in fields(one.switches)}
        assert set(recorded(one.switches)) == names
        assert find_protocol(one.name) is one


def test_what_the_field_is_known_to_differ_in() -> None:
    """Of protocols.md, C0 and C1: these two are the same experiment but for what is said here."""
    spin, ludvig = find_protocol("spin-nerf"), find_protocol("spin-nerf-ludvig")
    assert spin.switches != ludvig.switches
    assert differences(spin.switches, ludvig.switches) == [
        "reference_scored True and False",
        "threshold 'fixed' and 'reference'",
    ]
    flat, solid = (find_protocol(f"lerf-ovs-{n}d").switches for n in (2, 3))
    assert isinstance(flat, TargetSwitches)
    assert isinstance(solid, TargetSwitches)
    assert (flat.decided, solid.decided) == ("pixels", "gaussians")
    assert (flat.box_filter, flat.majority, flat.relevancy_cut) == (30, 7, 0.4)
    assert solid.hits_at == (0.25, 0.5)
    for count in (19, 15, 10):
        points = find_protocol(f"scannet-{count}").switches
        assert isinstance(points, PointSwitches)
        assert len(points.class_ids) == count
    assert differences(spin.switches, MapSwitches())[:2] == [
        "answered 'select' and absent",
        "boundary_ratio 0.02 and absent",
    ]


def test_a_switch_is_typed_and_changes_the_protocol() -> None:
    spin = find_protocol("spin-nerf")
    typed = dict(
        switch_value(spin, text)
        for text in (
            "reference_scored=no", "averaging=pairs", "boundary_ratio=none", "hits_at=0.25,0.5",
            "majority=3", "relevancy_cut=0.25",
        )
    )  # fmt: skip
    other = spin.with_switches(typed).switches
    assert isinstance(other, TargetSwitches)
    assert (other.reference_scored, other.averaging, other.boundary_ratio) == (False, "pairs", None)
    assert (other.hits_at, other.majority, other.relevancy_cut) == ((0.25, 0.5), 3, 0.25)
    scannet = find_protocol("scannet-10")
    assert switch_value(scannet, "class_ids=1,2") == ("class_ids", (1, 2))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("reference_scored", "expected NAME=VALUE"),
        ("size=3", "expected NAME=VALUE with a name of"),
        ("reference_scored=maybe", "expected yes or no, got 'maybe'"),
        ("majority=few", "majority: expected a whole number, got 'few'"),
        ("relevancy_cut=high", "relevancy_cut: expected a number"),
    ],
)
def test_switches_that_are_none(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        switch_value(find_protocol("spin-nerf"), text)


def test_values_are_checked() -> None:
    spin = find_protocol("spin-nerf")
    with pytest.raises(InputError, match="averaging: expected one of"):
        spin.with_switches({"averaging": "median"})
    with pytest.raises(RangeError, match="relevancy_cut"):
        spin.with_switches({"relevancy_cut": 1.5})
    with pytest.raises(InputError, match="protocol spin-nerf has"):
        spin.with_switches({"class_ids": (1,)})
    with pytest.raises(RangeError, match="box_filter: expected 0 or more"):
        TargetSwitches(box_filter=-1)
    with pytest.raises(RangeError, match="frame_step"):
        PointSwitches(frame_step=0)
    with pytest.raises(InputError, match=r"did you mean .*lerf-ovs-2d"):
        find_protocol("lerf-ovs")
