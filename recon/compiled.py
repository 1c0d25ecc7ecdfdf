"""What a process holds of a kernel that comes from numba's cache: its machine code.

With the code numba also loads the kernel's intermediate form, which it needs only to compile
another kernel that calls this one. Unpacked, those of a flight's kernels take 16 MiB; so they stay
packed until then.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen


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


def keep_packed() -> None:
    """Let numba load kernels so from now on."""
    JITCPUCodegen._library_class = _Compact
