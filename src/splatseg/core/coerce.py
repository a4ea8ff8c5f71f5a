"""What callers give, made into what the functions work on, or refused in one sentence.

NumPy arrays, lists and whatever else gives itself as an array are taken wherever a tensor is asked
for, if what is meant is clear. What is not: complex numbers, text, tensors without values (meta)
or with few of them (sparse), floats where ids are asked for, 8 bit where floats are.
"""

import numbers
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from splatseg.errors import InputError, RangeError, ShapeError

Kind = Literal["float", "integer", "bool", "byte", "any"]
_WANTED: dict[Kind, str] = {
    "float": "floating-point values",
    "integer": "integers",
    "bool": "booleans",
    "byte": "8 bit values",
    "any": "numbers",
}
_REMEDIES: dict[tuple[Kind, str], str] = {
    ("float", "byte"): "; pass x / 255 for pixels, or x.float()",
    ("integer", "float"): "; pass x.round().int() if they are ids",
    ("integer", "bool"): "; pass x.int()",
    ("bool", "integer"): "; pass x > 0 for a mask",
    ("bool", "float"): "; pass x > 0.5 for a mask",
    ("byte", "float"): "; pass (x * 255).round().byte() for pixels in [0, 1]",
    ("byte", "bool"): "; pass x.byte() * 255 for pixels",
}
_MAX_INTEGER = 2**63 - 1
_WIDENED = {torch.uint16: torch.int32, torch.uint32: torch.int64}
"""Torch has these types and can do next to nothing with them."""


def describe(value: object) -> str:
    """A value in a few words, for the end of a sentence."""
    if isinstance(value, Tensor):
        where = "meta tensor" if value.is_meta else f"{_layout(value)}tensor".strip()
        return f"a {where} {_dtype_name(value)} of shape {tuple(value.shape)}"
    if isinstance(value, np.ndarray):
        return f"an array {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
        text = repr(value) if not isinstance(value, int) or abs(value) < 10**20 else "a huge int"
        return text if len(text) <= 40 else f"{text[:37]}..."
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"a {type(value).__name__}"


def as_tensor(name: str, value: object, kind: Kind = "any") -> Tensor:
    """Numbers as a dense tensor that holds them.

    Args:
        name: Of the argument, for the error.
        value: A tensor, which stays as it is if it can; an array, which is shared where it can
            be; numbers in lists, whose floats become float32.
        kind: ``float`` takes integers that are not 8 bit and booleans too, as float32;
            ``bool`` takes 8 bit too (not 0 is True); ``byte`` takes integers in 0 to 255.

    Raises:
        InputError: If it is no dense array of such numbers; the sentence says what to pass.
        RangeError: If an integer is too large.
    """
    tensor = value if isinstance(value, Tensor) else _from_array(name, value, kind)
    if type(tensor) is not Tensor or tensor.layout != torch.strided or tensor.is_meta:
        _check_dense(name, tensor)
    if tensor.is_complex():
        raise InputError(
            f"{name}: expected {_WANTED[kind]}, got complex ones ({_dtype_name(tensor)}); pass "
            "x.real or x.abs()."
        )
    if tensor.dtype == torch.uint64 and kind != "any":
        tensor = _signed(name, tensor)
    if kind == "any":
        return tensor
    tensor = tensor.to(_WIDENED.get(tensor.dtype, tensor.dtype))
    if tensor.is_floating_point():
        # 16 bit of torch's own and 8 bit floats have hardly any operations on a CPU.
        own = tensor.dtype not in (torch.float16, torch.float32, torch.float64)
        return _of_kind(name, tensor.float() if own else tensor, kind, "float")
    found = {torch.bool: "bool", torch.uint8: "byte"}.get(tensor.dtype, "integer")
    return _of_kind(name, tensor, kind, found)


def _of_kind(name: str, tensor: Tensor, kind: Kind, found: str) -> Tensor:
    """The tensor as what is wanted, if what it has can be that without a guess."""
    if found == kind or (kind, found) == ("integer", "byte"):
        return tensor
    if not tensor.numel():
        types = {"float": torch.float32, "integer": torch.int32, "bool": torch.bool}
        return tensor.to(types.get(kind, torch.uint8))
    if kind == "float" and found in ("integer", "bool"):
        return tensor.to(torch.float32)
    if (kind, found) == ("integer", "float") and bool((tensor == tensor.round()).all()):
        if not bool((tensor.abs() < _MAX_INTEGER).all()):
            raise RangeError(f"{name}: expected integers of 64 bits, got larger ones.")
        return tensor.to(torch.int64)
    if (kind, found) == ("bool", "byte"):
        return tensor != 0
    if (kind, found) == ("byte", "integer"):
        low, high = int(tensor.min()), int(tensor.max())
        if low < 0 or high > 255:
            raise RangeError(f"{name}: expected 8 bit values, 0 to 255, got {low} to {high}.")
        return tensor.to(torch.uint8)
    raise InputError(
        f"{name}: expected {_WANTED[kind]}, got {_dtype_name(tensor)}"
        f"{_REMEDIES.get((kind, found), '')}."
    )


def as_any_tensor(name: str, value: object) -> Tensor:
    """A dense tensor of any type, complex numbers included; arrays as `as_tensor` has them."""
    if not isinstance(value, Tensor):
        return as_tensor(name, value)
    _check_dense(name, value)
    return value


def as_array(name: str, value: object, dtype: "np.dtype[Any] | None") -> "np.ndarray[Any, Any]":
    """Numbers as a NumPy array of a type, where no value would change by it."""
    tensor = as_tensor(name, value).detach().cpu()
    known = tensor.dtype in (torch.float64, torch.float16) or not tensor.is_floating_point()
    array = (tensor if known else tensor.float()).numpy()
    if dtype is None or array.dtype == dtype:
        return array
    if not np.can_cast(array.dtype, dtype, "same_kind") or array.dtype.itemsize > dtype.itemsize:
        kept = array.dtype.kind in "iu" and dtype.kind in "iu"
        limits = np.iinfo(dtype) if kept else None
        if limits is None or (
            array.size and (array.min() < limits.min or array.max() > limits.max)
        ):
            raise InputError(f"{name}: expected {dtype} values, got {array.dtype}.")
    return array.astype(dtype)


def as_rows(name: str, index: object, count: int) -> slice | Tensor:
    """Which rows are meant: a slice, a mask (count,), or integer ids of rows.

    Raises:
        InputError: If it is none of these.
        RangeError: If there is no such row.
    """
    if isinstance(index, slice):
        for bound in (index.start, index.stop, index.step):
            if bound is not None and not isinstance(bound, numbers.Integral):
                raise InputError(f"{name}: expected a slice of integers, got {describe(bound)}.")
        if index.step is not None and int(index.step) < 1:
            raise RangeError(f"{name}: expected a slice with a step of 1 or more.")
        return index
    rows = index if isinstance(index, Tensor) else None
    if rows is None:
        expected = "a slice, a mask or ids of rows"
        if index is None or isinstance(index, (str, bytes, numbers.Number)):
            raise InputError(f"{name}: expected {expected}, got {describe(index)}.")
        rows = as_tensor(name, index)
        rows = rows if rows.numel() or rows.dtype == torch.bool else rows.long()
    if rows.dtype != torch.bool:
        rows = as_tensor(name, rows, "integer")
        # Eight bits would be taken for a mask by torch.
        rows = rows.long() if rows.dtype != torch.int32 else rows
    else:
        _check_dense(name, rows)
    wanted = (count,) if rows.dtype == torch.bool else ("any",)
    if rows.ndim != 1 or (rows.dtype == torch.bool and len(rows) != count):
        shown = ", ".join(str(length) for length in wanted)
        raise ShapeError(f"{name}: expected shape ({shown}), got {tuple(rows.shape)}.")
    if rows.dtype != torch.bool and len(rows):
        low, high = int(rows.min()), int(rows.max())
        if low < -count or high >= count:
            raise RangeError(
                f"{name}: expected ids of {count} rows, got {low if low < -count else high}."
            )
    return rows


def as_number(name: str, value: object) -> float:
    """A real number, as Python has it; what holds a single one is taken for it.

    Raises:
        InputError: If it is none.
        RangeError: If it is beyond what a float can hold.
    """
    value = _single(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{name}: expected a number, got {describe(value)}.")
    if isinstance(value, int) and abs(value) > _MAX_INTEGER:
        raise RangeError(f"{name}: expected a number that a float can hold, got a larger one.")
    return value


def as_integer(name: str, value: object) -> int:
    """A whole number, as Python has it; 640.0 is one.

    Raises:
        InputError: If it is none.
        RangeError: If it is beyond 64 bits.
    """
    value = _single(value)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"{name}: expected a whole number, got {describe(value)}.")
    if abs(value) > _MAX_INTEGER:
        raise RangeError(f"{name}: expected a whole number of 64 bits, got a larger one.")
    return value


def as_bool(name: str, value: object) -> bool:
    """True or False; 1 and 0 are taken for them."""
    value = _single(value)
    if not isinstance(value, int) or value not in (0, 1):
        raise InputError(f"{name}: expected True or False, got {describe(value)}.")
    return bool(value)


def as_path(name: str, value: object) -> Path:
    """A path, given as one or as text.

    Raises:
        InputError: If it is neither, is empty, or holds a character that no path has.
    """
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str):
        raise InputError(f"{name}: expected a path, got {describe(value)}.")
    if not text or "\0" in text:
        raise InputError(f"{name}: expected a path, got {describe(text)}.")
    return Path(text)


def as_text(name: str, value: object) -> str:
    """Text that files and names can hold.

    Raises:
        InputError: If it is none, or holds a null byte or half a character.
    """
    if not isinstance(value, str):
        raise InputError(f"{name}: expected text, got {describe(value)}.")
    if "\0" in value or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise InputError(f"{name}: expected text that UTF-8 can hold, got {describe(value)}.")
    return value


def _single(value: object) -> object:
    """A number out of an array or a tensor that holds a single one, else the value itself."""
    if isinstance(value, Tensor):
        dense = value.layout == torch.strided and not value.is_meta
        return value.item() if dense and value.ndim == 0 else value
    if isinstance(value, np.ndarray):
        return value.item() if value.ndim == 0 else value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, numbers.Integral) and not isinstance(value, int):
        return int(value)
    if isinstance(value, numbers.Real) and not isinstance(value, (int, float)):
        return float(value)
    return value


def _from_array(name: str, value: object, kind: Kind) -> Tensor:
    """A tensor of what is an array, gives itself as one, or is numbers in lists."""
    wanted = f"{name}: expected a tensor or an array of {_WANTED[kind]}"
    if isinstance(value, np.ma.MaskedArray):
        raise InputError(f"{wanted}, got a masked array; pass x.filled(...).")
    if isinstance(value, (list, tuple)):
        value = [_single(v) if isinstance(v, Tensor) else v for v in value]
        if value and all(isinstance(v, Tensor) for v in value):
            parts = [as_tensor(f"{name}[{i}]", part, kind) for i, part in enumerate(value)]
            if len({part.shape for part in parts}) > 1:
                raise ShapeError(f"{wanted}, got tensors of several shapes.")
            return torch.stack(parts)
    elif not isinstance(value, (np.ndarray, np.generic, numbers.Number)) and not (
        hasattr(value, "__array__") or hasattr(value, "__array_interface__")
    ):
        raise InputError(f"{wanted}, got {describe(value)}.")
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(f"{wanted}, got {describe(value)} that is none.") from error
    if array.dtype.kind not in "biufc":
        what = "text" if array.dtype.kind in "US" else describe(value)
        raise InputError(f"{wanted}, got {what}.")
    if array.dtype.kind == "f" and (array.dtype.itemsize > 8 or not isinstance(value, np.ndarray)):
        lists = isinstance(value, (list, tuple))
        array = array.astype(np.float32 if lists else np.float64)
    if array.dtype.kind == "u" and array.dtype.itemsize == 8:
        if array.size and int(array.max()) > _MAX_INTEGER:
            raise RangeError(f"{name}: expected integers below 2^63, got larger ones.")
        array = array.astype(np.int64)
    native = array.dtype.newbyteorder("=")
    if array.dtype.itemsize > 16:
        native = np.dtype(np.complex128)
    if not array.flags.writeable or any(stride < 0 for stride in array.strides):
        array = array.copy()
    return torch.from_numpy(np.ascontiguousarray(array, native) if array.ndim else array)


def _signed(name: str, tensor: Tensor) -> Tensor:
    """Unsigned 64 bit integers as signed ones."""
    signed = tensor.view(torch.int64)
    if signed.numel() and int(signed.min()) < 0:
        raise RangeError(f"{name}: expected integers below 2^63, got larger ones.")
    return signed


def _check_dense(name: str, tensor: Tensor) -> None:
    if tensor.is_nested or tensor.layout != torch.strided:
        kind = "nested" if tensor.is_nested else "sparse"
        remedy = "" if tensor.is_nested else "; pass x.to_dense()"
        raise InputError(f"{name}: expected a dense tensor, got a {kind} one{remedy}.")
    if tensor.is_meta:
        raise InputError(
            f"{name}: expected a tensor with values, got one of the device 'meta', which has none."
        )
    if tensor.is_quantized:
        raise InputError(
            f"{name}: expected plain values, got a quantised tensor; pass x.dequantize()."
        )


def _layout(tensor: Tensor) -> str:
    return "" if tensor.layout == torch.strided and not tensor.is_nested else "sparse "


def _dtype_name(tensor: Tensor) -> str:
    return str(tensor.dtype)
