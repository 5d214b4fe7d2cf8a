"""Numbers of LANES neighbouring pixels as one value of compiled code: it reads as that of one pixel.

Of a loop over pixels the compiler makes vector code that keeps the sums of a block in memory, where each addition is
bound by loading and storing; and it splits vectors of 512 bits in two. A value of type `Lanes` is one vector register
(several of a narrower processor), so that a loop over the lights adds up in registers:

    total = splat(zero)
    for j in range(lights):
        value = load(values, (j, start))
        total += choose(value > zero, value * value, zero)

+, -, *, / and the comparisons take lanes, and lanes with a float32 number; & and | take the results of comparisons.
Every lane is rounded as a float32 number is, and nothing is added up across lanes: what a pixel gets depends neither on
its neighbours nor on the width of the processor's registers.
"""

import operator

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

LANES = 16


class Lanes(types.Type):
    """Type of LANES float32 numbers."""


class Flags(types.Type):
    """Type of LANES truth values."""


NUMBERS, TRUTHS = Lanes("lanes"), Flags("flags of lanes")
FLOAT, BIT, BYTE, INDEX = ir.FloatType(), ir.IntType(1), ir.IntType(8), ir.IntType(32)
VECTORS = {NUMBERS: ir.VectorType(FLOAT, LANES), TRUTHS: ir.VectorType(BIT, LANES)}
BYTES = ir.VectorType(BYTE, LANES)


@register_model(Lanes)
@register_model(Flags)
class _Register(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, VECTORS[lanes])


def _spread(builder, number):
    """One number in all lanes."""
    vector = VECTORS[NUMBERS]
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, INDEX(0))
    return builder.shuffle_vector(
        first, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(INDEX, LANES), None)
    )


def _as_lanes(builder, kinds, values):
    return [value if kind is NUMBERS else _spread(builder, value) for kind, value in zip(kinds, values, strict=True)]


def _define(operation, result, build, operands=(NUMBERS, types.float32)):
    """An operator of lanes, or of lanes and one number."""

    @infer_global(operation)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            kinds = {NUMBERS, TRUTHS}
            if len(args) == 2 and kinds & {*args} and {*args} <= {*operands}:
                return signature(result, *args)
            return None

    def lower(context, builder, sig, args):
        values = _as_lanes(builder, sig.args, args) if operands[0] is NUMBERS else args
        return build(builder, *values)

    for left in operands:
        for right in operands:
            if {NUMBERS, TRUTHS} & {left, right}:
                lower_builtin(operation, left, right)(lower)


def _comparison(symbol):
    return lambda builder, left, right: builder.fcmp_ordered(symbol, left, right)


for _operation, _instruction in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define(_operation, NUMBERS, lambda builder, left, right, name=_instruction: getattr(builder, name)(left, right))
for _operation, _symbol in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _define(_operation, TRUTHS, _comparison(_symbol))
_define(operator.and_, TRUTHS, lambda builder, left, right: builder.and_(left, right), (TRUTHS,))
_define(operator.or_, TRUTHS, lambda builder, left, right: builder.or_(left, right), (TRUTHS,))


def _readable(array, place):
    """Whether the place is one of an array of neighbouring numbers: an index, or (row, index)."""
    dimensions = len(place) if isinstance(place, types.BaseTuple) else 1
    return isinstance(array, types.Array) and array.layout == "C" and array.ndim == dimensions <= 2


def _address(context, builder, kinds, values, vector):
    """Pointer to the lanes at a place of an array. No view of the row is made: counting its references takes time."""
    (array_type, place_type), (array, place) = kinds[:2], values[:2]
    numbers = context.make_array(array_type)(context, builder, array)
    if isinstance(place_type, types.BaseTuple):
        row, start = (
            context.cast(builder, builder.extract_value(place, k), place_type[k], types.intp) for k in range(2)
        )
        columns = builder.extract_value(numbers.shape, 1)
        start = builder.add(builder.mul(row, columns), start)
    else:
        start = context.cast(builder, place, place_type, types.intp)
    return builder.bitcast(builder.gep(numbers.data, [start]), vector.as_pointer())


@intrinsic
def load(typing, array, place):
    """LANES numbers of a float32 array from a place on; of an array of bytes or truth values, which are not 0."""
    if not _readable(array, place) or array.dtype not in (types.float32, types.uint8, types.boolean):
        return None
    result = NUMBERS if array.dtype == types.float32 else TRUTHS

    def build(context, builder, sig, args):
        vector = VECTORS[NUMBERS] if result is NUMBERS else BYTES
        value = builder.load(_address(context, builder, sig.args, args, vector), align=4 if result is NUMBERS else 1)
        return value if result is NUMBERS else builder.icmp_unsigned("!=", value, ir.Constant(BYTES, None))

    return result(array, place), build


@intrinsic
def store(typing, array, place, value):
    """Write lanes into a float32 array, or truth values into one of bytes or truth values, from a place on."""
    kinds = (types.float32,) if value is NUMBERS else (types.uint8, types.boolean)
    if value not in (NUMBERS, TRUTHS) or not _readable(array, place) or array.dtype not in kinds:
        return None

    def build(context, builder, sig, args):
        vector, align, lanes = VECTORS[NUMBERS], 4, args[2]
        if value is TRUTHS:
            vector, align, lanes = BYTES, 1, builder.zext(lanes, BYTES)
        builder.store(lanes, _address(context, builder, sig.args, args, vector), align=align)
        return context.get_dummy_value()

    return types.void(array, place, value), build


@intrinsic
def load_three(typing, array, row, start):
    """The three channels of LANES pixels from `start` on of a row of a float32 array (rows, pixels, 3)."""
    if not (
        isinstance(array, types.Array) and array.layout == "C" and array.ndim == 3 and array.dtype == types.float32
    ):
        return None

    def build(context, builder, sig, args):
        numbers = context.make_array(array)(context, builder, args[0])
        place = builder.add(builder.mul(args[1], builder.extract_value(numbers.shape, 1)), args[2])
        together = ir.VectorType(FLOAT, 3 * LANES)
        first = builder.gep(numbers.data, [builder.mul(place, ir.Constant(place.type, 3))])
        mixed = builder.load(builder.bitcast(first, together.as_pointer()), align=4)
        places = ir.VectorType(INDEX, LANES)
        channels = [
            builder.shuffle_vector(
                mixed, ir.Constant(together, ir.Undefined), ir.Constant(places, [3 * p + k for p in range(LANES)])
            )
            for k in range(3)
        ]
        return context.make_tuple(builder, sig.return_type, channels)

    return types.UniTuple(NUMBERS, 3)(array, types.intp, types.intp), build


@intrinsic
def splat(typing, number):
    """Lanes that all hold this float32 number."""
    return NUMBERS(types.float32), lambda context, builder, sig, args: _spread(builder, args[0])


@intrinsic
def choose(typing, condition, yes, no):
    """Of each lane, `yes` where the condition holds, else `no`; each lanes or a float32 number."""
    if condition is not TRUTHS or not {yes, no} <= {NUMBERS, types.float32}:
        return None

    def build(context, builder, sig, args):
        return builder.select(args[0], *_as_lanes(builder, sig.args[1:], args[1:]))

    return NUMBERS(condition, yes, no), build


@intrinsic
def root(typing, value):
    """Square roots."""

    def build(context, builder, sig, args):
        kind = ir.FunctionType(VECTORS[NUMBERS], [VECTORS[NUMBERS]])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{LANES}f32")
        return builder.call(function, args)

    return NUMBERS(NUMBERS), build


@njit(cache=True)
def planes(count, width):
    """New float32 array (count, width) of zeros that begins where a register's worth of memory does.

    Otherwise every second access would touch two lines of the processor's cache, which takes twice as long. The width
    is to be a multiple of LANES.
    """
    memory = np.zeros(count * width + LANES, np.float32)
    first = (LANES - memory.ctypes.data // 4 % LANES) % LANES
    return memory[first : first + count * width].reshape(count, width)


def repeated(array, pixels):
    """An array (lights, fewer pixels, ...) with its pixels repeated: kernels take whole blocks of them."""
    return np.take(array, np.arange(pixels) % array.shape[1], axis=1)
