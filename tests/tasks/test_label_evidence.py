"""Which evidence is meant where label maps are wanted."""

import pytest
import torch

from splatseg.core import LabelMap
from splatseg.errors import InputError
from splatseg.io.evidence import create_evidence, save_label_map
from splatseg.tasks.work import find_label_maps


def labels(folder) -> None:
    create_evidence(folder, kind="labels")
    save_label_map(LabelMap(ids=torch.ones(2, 2, dtype=torch.int32)), folder, "a")


def test_the_only_label_maps_are_meant_whatever_else_is_there(tmp_path) -> None:
    with pytest.raises(InputError, match=r"^x: expected label maps by name \(there are none; "):
        find_label_maps([tmp_path], None, option="x")
    (tmp_path / "evidence").mkdir()
    create_evidence(tmp_path / "evidence" / "depth_scans", kind="depth")
    with pytest.raises(InputError, match=r"^evidence: expected label maps by name \(there are "):
        find_label_maps([tmp_path], None)
    labels(tmp_path / "labels_a")
    assert find_label_maps([tmp_path], None) == tmp_path / "labels_a"
    assert find_label_maps([tmp_path], "depth_scans").name == "depth_scans"
    with pytest.raises(InputError, match="^x: expected one of those at hand .*labels_a.* 'b'"):
        find_label_maps([tmp_path], "b", option="x")
    labels(tmp_path / "evidence" / "b")
    with pytest.raises(InputError, match=r"by name \(b, labels_a\), got none"):
        find_label_maps([tmp_path], None)
