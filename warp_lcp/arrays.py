# SPDX-License-Identifier: Apache-2.0
"""Numbers that users hand over: numpy, Warp, or anything with DLPack, checked and brought to a device."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from .errors import WarpLcpError


def read(caller: str, name: str, x: Any) -> Any:
    """A Warp array, or a numpy array of numbers in host memory."""
    if not isinstance(x, (wp.array, np.ndarray)) and hasattr(x, "__dlpack__"):
        try:
            x = wp.from_dlpack(x)
        except (RuntimeError, TypeError, ValueError, BufferError) as error:
            raise WarpLcpError(f"{caller}: {name} cannot be read through __dlpack__: {error}; give a numpy array") from error
    if isinstance(x, wp.array):
        if x.dtype not in (wp.float32, wp.float64):
            raise WarpLcpError(f"{caller}: {name} is of {wp.types.type_repr(x.dtype)}; give float64 or float32")
        return x
    try:
        x = np.asarray(x)
    except ValueError as error:
        raise WarpLcpError(f"{caller}: {name} is no array of numbers: {error}") from error
    if x.dtype.kind not in "fiu":
        raise WarpLcpError(f"{caller}: {name} is of {x.dtype}; give real numbers")
    return x


def is_single(x: Any) -> bool:
    return bool(x.dtype is wp.float32 if isinstance(x, wp.array) else x.dtype == np.float32)


def device_of(caller: str, device: Any, **arrays: Any) -> Any:
    """Where to solve: what the caller says, or where the arrays are."""
    if device is not None:
        return wp.get_device(device)
    places = {name: x.device for name, x in arrays.items() if isinstance(x, wp.array)}
    if any(place != next(iter(places.values())) for place in places.values()):
        raise WarpLcpError(f"{caller}: {' and '.join(f'{n} is on {d}' for n, d in places.items())}; move them together, or say device=")
    return next(iter(places.values()), None) or wp.get_device(None)


def check_strides(caller: str, name: str, x: Any, real: Any) -> None:
    """Kernels reach every problem of a batch [B, n, n]: the bytes from one to the next are a 32-bit number there.

    Beyond that they would read elsewhere, without a word. One problem alone may have any size.
    """
    batch, n = (x.shape[0], x.shape[-1]) if x.ndim == 3 else (1, x.shape[-1])
    most = math.isqrt((2**31 - 1) // wp.types.type_size_in_bytes(real))
    if batch > 1 and n > most:
        raise WarpLcpError(f"{caller}: {name} has {n} rows, and Warp takes batches of no more than {most}; solve the problems one by one")


def check_finite(caller: str, name: str, x: Any) -> None:
    """Every number in host memory is finite."""
    if isinstance(x, wp.array):
        if x.device is None or not x.device.is_cpu:
            return  # without reading it back: the kernel says NOT_A_NUMBER
        x = x.numpy()
    finite = np.isfinite(x)
    if not finite.all():
        where = [int(i) for i in np.argwhere(~finite)[0]]
        raise WarpLcpError(f"{caller}: {name}{where} is {x[tuple(where)]}; it must be finite")


def on_device(x: Any, real: Any, device: Any) -> wp.array:
    if not isinstance(x, wp.array):
        # Not copied where it can be used as it is: the kernels only read it.
        return wp.array(np.ascontiguousarray(x, dtype=wp.dtype_to_numpy(real)), dtype=real, device=device, copy=False)
    x = x.to(device)
    if x.dtype is not real:
        cast = wp.empty(x.shape, dtype=real, device=device)
        wp.utils.array_cast(x.contiguous(), cast)
        x = cast
    return x if x.is_contiguous else x.contiguous()
