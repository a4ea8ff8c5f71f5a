"""NaN and infinity are refused where a value is made, with how many there are and the first."""

import pytest
import torch

from splatseg.core import Features, Labels, MaskSet
from splatseg.core.models import Boxes
from splatseg.core.renderable import PointLabels
from splatseg.errors import RangeError
from splatseg.evaluate import psnr, ssim
from splatseg.lift.vocabulary import relevancy
from splatseg_bench.scene import TruePoints

IDS = torch.tensor([1, 2], dtype=torch.int32)
SURE = torch.ones(2)
BROKEN = torch.tensor([1.0, float("nan")])
VALUES = {
    "confidence": lambda x: Labels(ids=IDS, confidence=x),
    "evidence": lambda x: Labels(ids=IDS, confidence=SURE, evidence=x),
    "effective_views": lambda x: Labels(ids=IDS, confidence=SURE, effective_views=x),
    "shares": lambda x: Labels(
        ids=IDS, confidence=SURE, candidates=IDS.unsqueeze(1), shares=x.unsqueeze(1)
    ),
    "values": lambda x: Features(values=x.unsqueeze(1)),
    "weights": lambda x: Features(values=SURE.unsqueeze(1), weights=x),
    "scores": lambda x: MaskSet.from_dense(torch.ones(2, 3, 4).bool(), scores=x),
    "boxes": lambda x: Boxes(words=(0,), boxes=x.repeat(2)[None], scores=torch.ones(1)),
    "scores of boxes": lambda x: Boxes(words=(0, 1), boxes=torch.ones(2, 4), scores=x),
    "confidence of points": lambda x: PointLabels(ids=IDS, confidence=x),
    "cosines": lambda x: relevancy(x, SURE),
    "negatives": lambda x: relevancy(SURE, x),
    "image": lambda x: psnr(x.reshape(1, 2, 1), SURE.reshape(1, 2, 1)),
    "truth": lambda x: ssim(SURE.reshape(1, 2, 1), x.reshape(1, 2, 1)),
}


@pytest.mark.parametrize("name", VALUES)
def test_not_a_number_is_refused(name: str) -> None:
    with pytest.raises(RangeError, match=f"{name.split()[0]}: . of . values are not finite.* at"):
        VALUES[name](BROKEN)


def test_truth_points_that_are_nowhere() -> None:
    with pytest.raises(RangeError, match=r"points: 1 of 6 .* nan at \(1, 2\)"):
        TruePoints(
            points=torch.tensor([[0.0, 0, 0], [0, 0, float("nan")]]),
            labels=Labels(ids=IDS, confidence=SURE),
        )
