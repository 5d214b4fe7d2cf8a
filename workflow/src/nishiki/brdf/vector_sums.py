"""Sums of products of two rows in compiled code, in vector instructions and in an order that is written down.

Left to the compiler, a sum is either added one by one (slow) or in an order of the compiler's choice, which differs
between a kernel just compiled and the same kernel loaded from the cache.  Here LANES partial sums, each over every
LANES-th product, are added in halves: the same bytes everywhere, on processors of any vector length.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8


@intrinsic
def dot_rows(_context, matrix, i, j):
    """sum over k of matrix[i, k] matrix[j, k]; matrix: C-contiguous, its columns a multiple of LANES (not checked)."""
    real = matrix.dtype

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        columns = cgutils.unpack_tuple(builder, array.shape)[1]
        vector = ir.VectorType(context.get_value_type(real), LANES)
        rows = [builder.gep(array.data, [builder.mul(row, columns)]) for row in arguments[1:]]
        total = cgutils.alloca_once(builder, vector)
        builder.store(ir.Constant(vector, None), total)
        index = columns.type
        steps = ir.Constant(index, 0), columns, ir.Constant(index, LANES)
        with cgutils.for_range_slice(builder, *steps, index) as (k, _):
            places = [builder.bitcast(builder.gep(row, [k]), vector.as_pointer()) for row in rows]
            values = [builder.load(place, align=real.bitwidth // 8) for place in places]
            builder.store(builder.fadd(builder.load(total), builder.fmul(*values)), total)
        return _in_halves(builder, builder.load(total))

    return real(matrix, types.intp, types.intp), generate


def _in_halves(builder, vector):
    """The sum of a vector's elements: its upper half added to its lower, until one is left."""
    count = LANES
    while count > 1:
        count //= 2
        mask = ir.VectorType(ir.IntType(32), count)
        undefined = ir.Constant(vector.type, ir.Undefined)
        low, high = (
            builder.shuffle_vector(vector, undefined, ir.Constant(mask, list(range(first, first + count))))
            for first in (0, count)
        )
        vector = builder.fadd(low, high)
    return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))
