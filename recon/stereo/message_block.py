"""The innermost step of belief propagation, written for vector registers.

LLVM is given the vectors explicitly: left to find them in loops over arrays, it checks the
arrays for overlap at every label, which took ten times as long.

numba's cache on disk watches the file of the kernel that calls this, not this one: after a
change here, touch ``message_passing.py``.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 32
"""Cells that are updated together; LLVM spreads them over the registers that there are."""

_FAR = 16383


@intrinsic
def update_block(
    typingctx: Any,
    data: Any,
    arriving: Any,
    leaving: Any,
    mask: Any,
    scratch: Any,
    stride: Any,
    labels: Any,
    slopes: Any,
    cuts: Any,
) -> Any:
    """Write the four messages that leave LANES pixels of one colour of one row.

    Addresses of: the data of label 0, the four messages that arrive (from below, above,
    right, left), the four that leave (up, down, left, right), the lanes that exist (-1 or 0)
    and ``labels * 4 * LANES`` int16 of scratch. ``stride`` is bytes from label to label;
    ``slopes`` and ``cuts`` are the addresses of the smoothness of the four edges.
    """
    addresses = types.UniTuple(types.intp, 4)
    one = types.intp
    signature = types.void(one, addresses, addresses, one, one, one, one, addresses, addresses)
    return signature, _code


def _code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """LLVM of :func:`update_block`: lower envelope up the labels, then down."""
    data, arriving, leaving, mask, scratch, stride, labels, slopes, cuts = args
    block = _Block(builder)
    m_from = cgutils.unpack_tuple(builder, arriving, 4)
    m_to = cgutils.unpack_tuple(builder, leaving, 4)
    sources = (m_from[1], m_from[0], m_from[3], m_from[2])  # what each message must leave out
    exists = block.load(mask)
    slope = [block.load(a) for a in cgutils.unpack_tuple(builder, slopes, 4)]
    cut = [block.load(a) for a in cgutils.unpack_tuple(builder, cuts, 4)]
    row = ir.Constant(data.type, 2 * LANES)
    envelope = [block.variable(_FAR) for _ in range(4)]
    lowest = [block.variable(_FAR) for _ in range(4)]
    with cgutils.for_range(builder, labels) as loop:
        offset = builder.mul(loop.index, stride)
        total = block.load(builder.add(data, offset))
        arrived = {a: block.load(builder.add(a, offset)) for a in m_from}
        for message in arrived.values():
            total = builder.add(total, message)
        for k in range(4):
            rest = builder.sub(total, arrived[sources[k]])
            builder.store(block.least(builder.load(lowest[k]), rest), lowest[k])
            step = builder.add(builder.load(envelope[k]), slope[k])
            best = block.least(rest, step)
            builder.store(best, envelope[k])
            place = builder.add(builder.mul(loop.index, ir.Constant(data.type, 4)),
                                ir.Constant(data.type, k))  # fmt: skip
            block.save(best, builder.add(scratch, builder.mul(place, row)))
    after = [block.variable(_FAR) for _ in range(4)]
    with cgutils.for_range(builder, labels) as loop:
        label = builder.sub(builder.sub(labels, loop.index), ir.Constant(data.type, 1))
        offset = builder.mul(label, stride)
        for k in range(4):
            place = builder.add(builder.mul(label, ir.Constant(data.type, 4)),
                                ir.Constant(data.type, k))  # fmt: skip
            best = block.load(builder.add(scratch, builder.mul(place, row)))
            best = block.least(builder.sub(best, builder.load(lowest[k])), cut[k])
            best = block.least(best, builder.add(builder.load(after[k]), slope[k]))
            builder.store(best, after[k])
            block.save(builder.and_(best, exists), builder.add(m_to[k], offset))
    return context.get_dummy_value()


class _Block:
    """Builds the instructions on LANES 16-bit integers at once."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder
        self.type = ir.VectorType(ir.IntType(16), LANES)

    def load(self, address: Any) -> Any:
        """The lanes at an address, aligned or not."""
        return self.builder.load(self.builder.inttoptr(address, self.type.as_pointer()), align=2)

    def save(self, value: Any, address: Any) -> None:
        """Put the lanes at an address."""
        pointer = self.builder.inttoptr(address, self.type.as_pointer())
        self.builder.store(value, pointer, align=2)

    def variable(self, value: int) -> Any:
        """A local variable with this value in all lanes."""
        variable = cgutils.alloca_once(self.builder, self.type)
        self.builder.store(ir.Constant(self.type, [value] * LANES), variable)
        return variable

    def least(self, a: Any, b: Any) -> Any:
        """The lesser of each lane."""
        return self.builder.select(self.builder.icmp_signed("<", a, b), a, b)
