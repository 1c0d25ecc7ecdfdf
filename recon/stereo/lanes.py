"""Layout and instructions for 32 pixels of one label at a time.

The cells of one column parity of a row lie side by side, (row, parity, label, cell), so that a SIMD
register holds one label of neighbouring pixels of one colour of a checkerboard and any number of
labels costs the same per label. A row of cells ends with at least one empty cell.

The innermost steps are written for vector registers: left to find them in loops over arrays, LLVM
checks the arrays for overlap at every label, which took ten times as long.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils

LANES = 32  # cells that are updated together; LLVM spreads them over the registers that there are
PARTS = 2  # parts of them whose 16-bit envelopes the registers of AVX2 hold at once


def cells_of(width: int) -> int:
    """Length of a row of cells of one parity: whole blocks, and at least one empty cell."""
    return ((width + 1) // 2 // LANES + 1) * LANES


class Lanes:
    """Builds the instructions on some integers at once: signed ones of 16 bits, unsigned of 8."""

    def __init__(self, builder: Any, bits: int, count: int) -> None:
        self.builder, self.bits_each, self.count = builder, bits, count
        self.type = ir.VectorType(ir.IntType(bits), count)

    def load(self, address: Any, bits: int = 0) -> Any:
        """The lanes at an address, aligned or not; stored as so many ``bits``, if not as here."""
        stored = ir.VectorType(ir.IntType(bits or self.bits_each), self.count)
        lanes = self.builder.load(self.builder.inttoptr(address, stored.as_pointer()), align=1)
        return lanes if stored == self.type else self.builder.zext(lanes, self.type)

    def save(self, value: Any, address: Any) -> None:
        pointer = self.builder.inttoptr(address, self.type.as_pointer())
        self.builder.store(value, pointer, align=1)

    def cut(self, wide: Any) -> Any:
        """The lanes of 16 bits in 8, those above 255 as 255 and those below 0 as 0."""
        none, most = (ir.Constant(wide.type, [n] * self.count) for n in (0, 255))
        wide = self.builder.select(self.builder.icmp_signed(">", wide, none), wide, none)
        wide = self.builder.select(self.builder.icmp_signed("<", wide, most), wide, most)
        return self.builder.trunc(wide, self.type)

    def constant(self, value: int) -> Any:
        """The same value in all lanes."""
        return ir.Constant(self.type, [value] * self.count)

    def splat(self, value: Any) -> Any:
        """A number known only when the code runs, in all lanes."""
        first = self.builder.insert_element(self.constant(0), value, ir.Constant(ir.IntType(32), 0))
        order = ir.Constant(ir.VectorType(ir.IntType(32), self.count), [0] * self.count)
        return self.builder.shuffle_vector(first, first, order)

    def variable(self, value: int) -> Any:
        """A local variable with this value in all lanes."""
        variable = cgutils.alloca_once(self.builder, self.type)
        self.builder.store(self.constant(value), variable)
        return variable

    def sum(self, a: Any, b: Any) -> Any:
        """The sum of 8-bit lanes, 255 where it is more."""
        return self._call("uadd.sat", a, b)

    def bits(self, a: Any) -> Any:
        """How many bits of each lane are set."""
        return self._call("ctpop", a)

    def _call(self, name: str, *lanes: Any) -> Any:
        kind = ir.FunctionType(self.type, (self.type,) * len(lanes))
        name = f"llvm.{name}.v{self.count}i{self.bits_each}"
        return self.builder.call(
            cgutils.get_or_insert_function(self.builder.module, kind, name), lanes
        )

    def least(self, a: Any, b: Any) -> Any:
        return self.builder.select(self._compare("<", a, b), a, b)

    def most(self, a: Any, b: Any) -> Any:
        return self.builder.select(self._compare(">", a, b), a, b)

    def _compare(self, how: str, a: Any, b: Any) -> Any:
        compare = self.builder.icmp_unsigned if self.bits_each == 8 else self.builder.icmp_signed
        return compare(how, a, b)
