"""Compile numerical functions to machine code with numba.

Numba takes a third of a second to import. Modules of kernels import it at their top; the functions that use these
modules therefore import them on their first call, so that ``import greenhouse_gym`` stays fast.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import os
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TypeVar

import numba
from numba.core import sigutils
from numba.core.types import Array

Function = TypeVar("Function", bound=Callable[..., object])

_SLOW = 3.0  # seconds of compilation after which a message is shown
_NOTICE = "compiling the numerical kernel %s; this takes some seconds, once on this machine"
_logger = logging.getLogger(__name__)

if not numba.config.CACHE_DIR:  # by default compiled code lies next to the sources, which a package should not touch
    _caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111  works without a home
    # numba compares the source of a kernel's own module only, but kernels use helpers of other modules
    _sources = sorted(Path(__file__).parents[1].glob("*/*kernel*.py"))
    _digest = hashlib.sha256(b"".join(source.read_bytes() for source in _sources)).hexdigest()[:12]
    numba.config.CACHE_DIR = str(Path(_caches) / "greenhouse-gym" / "numba" / _digest)


def kernel(signature: str, writes: Collection[str] = ()) -> Callable[[Function], Function]:
    """Return a decorator that compiles a function for one signature, or loads it from the cache on disk.

    The compiled function keeps the order of floating-point operations, checks no bounds and releases the GIL. The cache
    is in ``NUMBA_CACHE_DIR``, or in ``greenhouse-gym/numba`` in the user's cache folder; where that cannot be written,
    each process compiles.

    Args:
        signature: Types in numba's notation, such as ``"f8(f8[::1], i8)"``.
        writes: Names of the arrays that may not be read-only: those that the function changes, and those that it hands
            to helpers which other kernels call with such arrays, as numba compiles a helper once for each kind.
    """

    def compiled(function: Function) -> Function:
        notice = threading.Timer(_SLOW, _logger.warning, [_NOTICE, function.__name__])
        notice.daemon = True
        notice.start()
        types, result = sigutils.normalize_signature(signature)
        names = inspect.signature(function).parameters
        fixed = (kind.copy(readonly=True) if isinstance(kind, Array) else kind for kind in types)
        chosen = (a if name in writes else b for name, a, b in zip(names, types, fixed, strict=True))
        typed = result(*chosen)
        try:
            return _compile(function, typed, cache=True)
        except (RuntimeError, OSError):  # no folder can be written
            return _compile(function, typed, cache=False)
        finally:
            notice.cancel()

    return compiled


def inlined(function: Function) -> Function:
    """Decorate a helper that kernels call; it is compiled as a part of them and makes no arrays.

    Without numba's runtime, which counts references to arrays, a call takes nanoseconds less and compiles faster.
    """
    return _helper(function, runtime=False)


def allocating(function: Function) -> Function:
    """Decorate a helper that kernels call and that makes arrays."""
    return _helper(function, runtime=True)


def _helper(function: Function, runtime: bool) -> Function:
    result: Function = numba.njit(
        nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=runtime
    )(function)
    return result


def _compile(function: Function, signature: object, cache: bool) -> Function:
    result: Function = numba.njit(signature, cache=cache, nogil=True, error_model="numpy", no_cfunc_wrapper=True)(
        function
    )
    return result
