"""Vector instructions in kernels, where the compiler finds none that are as good. Imports numba."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

CONTRACT = {"flags": ("contract",)}
"""Of a product and of the sum that it is part of: one instruction may do both."""


class Vectors:
    """Code of vectors for the body of an intrinsic of numba.

    Its arrays are flat, of float32 or float64, of bits of bfloat16 as uint16, or of bytes; an array is named by its
    place among the arguments.

    Args:
        lanes: numbers in a vector.
        generating: target, builder, signature and arguments that numba gives to the body.
    """

    def __init__(self, lanes: int, *generating: Any) -> None:
        self.target, self.builder, signature, self.given = generating
        self.lanes, self.kinds, self.index = lanes, signature.args, cgutils.intp_t
        self.floats, self.whole = (ir.VectorType(kind, lanes) for kind in (ir.FloatType(), ir.IntType(32)))

    def place(self, array: int, *steps: Any) -> Any:
        """Pointer to the element of an array that is some steps from its first, numbers or values."""
        pointer = cgutils.create_struct_proxy(self.kinds[array])(self.target, self.builder, value=self.given[array])
        return self.after(pointer.data, *steps)

    def after(self, pointer: Any, *steps: Any) -> Any:
        """Pointer that is some steps farther."""
        for step in steps:
            pointer = self.builder.gep(pointer, [ir.Constant(self.index, step) if isinstance(step, int) else step])
        return pointer

    def raw(self, pointer: Any, kind: ir.Type, align: int = 1) -> Any:
        """Value of some type at a pointer."""
        return self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()), align=align)

    def load(self, pointer: Any) -> Any:
        """Numbers at a pointer into an array, of float32 for one of bfloat16."""
        if pointer.type.pointee != ir.IntType(16):
            return self.raw(pointer, ir.VectorType(pointer.type.pointee, self.lanes), 4)
        bits = self.builder.zext(self.raw(pointer, self._narrow(16), 2), self.whole)
        return self.builder.bitcast(self.builder.shl(bits, self.constant(16)), self.floats)

    def store(self, value: Any, pointer: Any) -> None:
        """Keep numbers of float32 as an array has them (bfloat16: to the nearest, ties to even), or whole ones."""
        builder, element = self.builder, pointer.type.pointee
        if element == ir.IntType(8):
            value = builder.trunc(value, self._narrow(8))
        elif element == ir.IntType(16):
            bits = builder.bitcast(value, self.whole)
            odd = builder.and_(builder.lshr(bits, self.constant(16)), self.constant(1))
            rounded = builder.add(builder.add(bits, self.constant(0x7FFF)), odd)
            value = builder.trunc(builder.lshr(rounded, self.constant(16)), self._narrow(16))
        align = 1 if isinstance(element, ir.IntType) else 4
        builder.store(value, builder.bitcast(pointer, value.type.as_pointer()), align=align)

    def constant(self, number: float) -> Any:
        """Vector of a number: whole ones for an int."""
        return ir.Constant(self.floats if isinstance(number, float) else self.whole, [number] * self.lanes)

    def everywhere(self, value: Any) -> Any:
        """Vector of a value."""
        undefined = ir.Constant(ir.VectorType(value.type, self.lanes), ir.Undefined)
        first = self.builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
        return self.builder.shuffle_vector(first, undefined, ir.Constant(self.whole, [0] * self.lanes))

    def shuffled(self, a: Any, b: Any, lanes: Sequence[int]) -> Any:
        """Lanes of two vectors side by side."""
        return self.builder.shuffle_vector(a, b, ir.Constant(self.whole, list(lanes)))

    def call(self, name: str, kept: ir.Type, *given: Any) -> Any:
        """Value of an instruction of the compiler, by its name."""
        kind = ir.FunctionType(kept, [value.type for value in given])
        return self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), given)

    def plus(self, before: Any, a: Any, b: Any) -> Any:
        """Sum and product, one instruction where there is one."""
        return self.builder.fadd(before, self.builder.fmul(a, b, **CONTRACT), **CONTRACT)

    def repeat(
        self, count: Any, values: Sequence[Any], body: Callable[[Any, list[Any]], list[Any]], step: int = 1
    ) -> list[Any]:
        """Values after ``values = body(k, values)`` for each multiple ``k`` of a step below a count of one or more; no
        branches in it. Without a loop where the count is a number."""
        if isinstance(count, int):
            after = list(values)
            for multiple in range(0, count, step):
                after = body(ir.Constant(self.index, multiple), after)
            return after
        builder, entry = self.builder, self.builder.block
        loop, end = builder.append_basic_block(), builder.append_basic_block()
        builder.branch(loop)
        builder.position_at_end(loop)
        k, before = builder.phi(self.index), [builder.phi(value.type) for value in values]
        after = body(k, before)
        following = builder.add(k, ir.Constant(self.index, step))
        builder.cbranch(builder.icmp_signed("<", following, count), loop, end)
        begun = [ir.Constant(self.index, 0), *values]
        for value, first, further in zip([k, *before], begun, [following, *after], strict=True):
            value.add_incoming(first, entry)
            value.add_incoming(further, loop)
        builder.position_at_end(end)
        return after

    def _narrow(self, bits: int) -> ir.VectorType:
        return ir.VectorType(ir.IntType(bits), self.lanes)
