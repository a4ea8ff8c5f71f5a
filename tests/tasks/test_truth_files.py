"""Files of scores and points that `evaluate` reads beside label maps."""

import json

import pytest

from splatseg.errors import FileFormatError
from splatseg.tasks._figures import read_scores


def test_scores_are_read_by_id_and_0_means_none(tmp_path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"4": 1, "17": 0.25, "0": 0.5}))
    assert read_scores(tmp_path / "a.json") == {4: 1.0, 17: 0.25, -1: 0.5}


@pytest.mark.parametrize(
    "content",
    [
        f'{{"{"7" * 5000}": 1}}',
        f'{{"4": "{"x" * 999}"}}',
        f'{{"4": 1{"0" * 400}}}',
        '{"cup": 1}',
        '{"04": 1}',
        '{"4": true}',
        '{"4": NaN}',
        '{"4": [1]}',
    ],
)
def test_other_scores_are_refused_in_one_short_sentence(tmp_path, content) -> None:
    file = tmp_path / "a.json"
    file.write_text(content)
    with pytest.raises(FileFormatError, match=r"a\.json: .*expected") as caught:
        read_scores(file)
    assert len(str(caught.value)) < 300 + len(str(tmp_path))
