"""The decoder against a loop over points, and its parts."""

import numpy as np
import pytest
import torch

from splatseg.errors import ShapeError
from splatseg.methods.cosseg._fusion import FusionInputs, FusionShape, Scaling, decode, decode_all

SIZES = (11, 5, 2)
SHAPE = FusionShape(inputs=(4, 3, 5), decoded=(6, 7, 8), head=(9, 2))


def inputs(levels: int = 3) -> FusionInputs:
    rng = np.random.default_rng(1)
    return FusionInputs(
        levels=tuple(
            torch.from_numpy(rng.normal(size=(size, width)).astype(np.float16))
            for size, width in list(zip(SIZES, SHAPE.inputs, strict=True))[:levels]
        ),
        up=tuple(
            torch.from_numpy(rng.integers(SIZES[k + 1], size=SIZES[k])) for k in range(levels - 1)
        ),
    )


def leaky(values):
    return np.where(values > 0, values, 0.2 * values)


def looped(given: FusionInputs, weights, row: int):
    """One point, from the last level down."""
    rows = [row]
    for up in given.up:
        rows.append(int(up[rows[-1]]))
    decoded = None
    for level in range(len(given.levels) - 1, -1, -1):
        parts = [given.levels[level][rows[level]].float().numpy()]
        matrix = [weights[f"level{level}.own"].numpy()]
        if decoded is not None:
            parts.append(decoded)
            matrix.append(weights[f"level{level}.above"].numpy())
        joined = np.concatenate(parts) @ np.concatenate(matrix)
        decoded = leaky(joined + weights[f"level{level}.bias"].numpy())
    for layer in range(2):
        decoded = leaky(decoded @ weights[f"head{layer}.own"].numpy()
                        + weights[f"head{layer}.bias"].numpy())  # fmt: skip
    return decoded


@pytest.mark.parametrize("levels", [1, 3])
def test_against_a_loop(levels) -> None:
    given = inputs(levels)
    shape = FusionShape(
        inputs=SHAPE.inputs[:levels], decoded=SHAPE.decoded[:levels], head=SHAPE.head
    )
    weights = shape.start(np.random.default_rng(4))
    rows = torch.tensor([7, 0, 10])
    expected = np.stack([looped(given, weights, int(row)) for row in rows])
    np.testing.assert_allclose(decode(given, weights, rows).numpy(), expected, atol=1e-5)
    whole = decode_all(given, weights)
    np.testing.assert_allclose(whole[rows].numpy(), expected, atol=1e-5)
    assert whole.shape == (11, 2)


def test_whole_scenes_are_decoded_in_pieces(monkeypatch) -> None:
    given, weights = inputs(), SHAPE.start(np.random.default_rng(4))
    whole = decode_all(given, weights)
    monkeypatch.setattr("splatseg.methods.cosseg._fusion._ROWS", 3)
    torch.testing.assert_close(decode_all(given, weights), whole, rtol=0, atol=1e-6)


def test_all_weights_get_gradients() -> None:
    weights = SHAPE.start(np.random.default_rng(4))
    leaves = {name: value.requires_grad_() for name, value in weights.items()}
    decode(inputs(), leaves, torch.tensor([1, 2])).square().sum().backward()
    assert all(bool(leaf.grad.abs().sum() > 0) for leaf in leaves.values())


def test_first_weights_are_those_of_linear_layers() -> None:
    weights = SHAPE.start(np.random.default_rng(4))
    assert set(weights) == {
        "level2.own", "level2.bias", "level1.own", "level1.above", "level1.bias", "level0.own",
        "level0.above", "level0.bias", "head0.own", "head0.bias", "head1.own", "head1.bias",
    }  # fmt: skip
    assert weights["level1.above"].shape == (8, 7)
    bound = 1 / np.sqrt(3 + 8)
    largest = max(float(weights[f"level1.{name}"].abs().max()) for name in ("own", "above"))
    assert 0.8 * bound < largest <= bound


def test_scaling() -> None:
    values = torch.tensor([[1.0, 5.0, 1e9], [3.0, 5.0, -1e9]])
    scaling = Scaling.of(values)
    found = scaling(values)
    assert found.dtype == torch.float16
    torch.testing.assert_close(found.float(), torch.tensor([[-1.0, 0, 1], [1.0, 0, -1]]))
    assert float(scaling(torch.tensor([[1e9, 0.0, 0.0]]))[0, 0]) == 60000.0


def test_without_levels() -> None:
    with pytest.raises(ShapeError, match="at least one"):
        decode_all(FusionInputs(levels=(), up=()), {})
