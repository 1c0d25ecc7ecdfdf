"""What a process holds of a kernel that comes from numba's cache: its machine code.

With the code numba also loads what it needs only to compile another kernel, so that comes later,
if at all: the kernel's intermediate form (those of a flight's kernels take 16 MiB unpacked), and
the rules of all operations that it can compile, with LLVM's compiler (30 MiB).

This replaces private functions of numba, and code that calls a symbol without an address ends
the process: a version of numba comes here only once its own loading has been compared.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.runtime import _nrt_python


class _Compact(JITCodeLibrary):  # type: ignore[misc]
    """One kernel's code."""

    _shared_module: Any  # the unpacked form; None until it is needed
    _packed = b""

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, Any]) -> Any:
        library = super()._unserialize(codegen, state)
        _, kind, data = state
        if kind == "object":
            library._shared_module, library._packed = None, data[1]
        return library

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None and self._packed:
            self._shared_module = llvm.parse_bitcode(self._packed)
        return super()._get_module_for_linking()


def _load_overload(cache: Any, signature: Any, target_context: Any) -> Any:
    """The kernel's code from its file, None without one; without the context's ``refresh``, which
    compiling calls itself."""
    with cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, target_context)


def load_code_alone() -> None:
    """Let numba load kernels so from now on."""
    for name, address in _nrt_python.c_helpers.items():  # as ``refresh`` does: code calls them
        llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)
    FunctionCache.load_overload = _load_overload
    JITCPUCodegen._library_class = _Compact
