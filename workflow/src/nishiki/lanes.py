"""Hold LANES neighbouring pixels as one value in compiled code, which reads like code for one pixel.

From a loop over pixels the compiler makes vector code that keeps the sums of a block in memory, where loading and
storing bound each addition; and it splits vectors of 512 bits in two. A value of type `Lanes` is one vector register
(several of a narrower processor), so that a loop over the lights adds up in registers:

    total = splat(zero)
    for j in range(lights):
        value = load(values, (j, start))
        total += choose(value > zero, value * value, zero)

+, -, *, / and the comparisons take lanes of one kind (float32 or float64), and lanes with one
number of their kind; & and | take the results of comparisons. Every lane is rounded as a single number is, and nothing
is added up across lanes: what a pixel gets depends neither on its neighbours nor on the width of the processor's
registers.
"""

import operator

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

LANES = 16  # of float32 in 64 bytes
BLOCK = 32  # pixels that kernels treat together: three planes of 96 lights fit the second-level cache, one the first


class Lanes(types.Type):
    """Type of LANES numbers of one kind."""


NUMBERS, WIDE, TRUTHS = Lanes("float32 lanes"), Lanes("float64 lanes"), Lanes("truths of lanes")
BIT, BYTE, INDEX = ir.IntType(1), ir.IntType(8), ir.IntType(32)
VECTORS = {
    kind: ir.VectorType(element, LANES)
    for kind, element in ((NUMBERS, ir.FloatType()), (WIDE, ir.DoubleType()), (TRUTHS, BIT))
}
SINGLE = {NUMBERS: types.float32, WIDE: types.float64}
BYTES = ir.VectorType(BYTE, LANES)


@register_model(Lanes)
class _Register(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, VECTORS[lanes])


def _spread(builder, number, kind):
    """Spread one number over all lanes."""
    nothing = ir.Constant(VECTORS[kind], ir.Undefined)
    first = builder.insert_element(nothing, number, INDEX(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(INDEX, LANES), None))


def _define(operation, build, kind, result):
    """Define an operator of lanes of one kind, or of such lanes and one number."""

    @infer_global(operation)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            fits = len(args) == 2 and kind in args and {*args} <= {kind, SINGLE.get(kind)}
            return signature(result, *args) if fits else None

    def lower(context, builder, sig, args):
        lanes = (
            value if given is kind else _spread(builder, value, kind)
            for given, value in zip(sig.args, args, strict=True)
        )
        return build(builder, *lanes)

    lower_builtin(operation, kind, kind)(lower)
    if kind in SINGLE:
        lower_builtin(operation, kind, SINGLE[kind])(lower)
        lower_builtin(operation, SINGLE[kind], kind)(lower)


def _arithmetic(name):
    return lambda builder, left, right: getattr(builder, name)(left, right)


def _comparison(symbol):
    return lambda builder, left, right: builder.fcmp_ordered(symbol, left, right)


for _kind in (NUMBERS, WIDE):
    for _operation, _name in (
        (operator.add, "fadd"),
        (operator.iadd, "fadd"),
        (operator.sub, "fsub"),
        (operator.mul, "fmul"),
        (operator.truediv, "fdiv"),
    ):
        _define(_operation, _arithmetic(_name), _kind, _kind)
    for _operation, _symbol in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
        _define(_operation, _comparison(_symbol), _kind, TRUTHS)
for _operation, _name in ((operator.and_, "and_"), (operator.or_, "or_")):
    _define(_operation, _arithmetic(_name), TRUTHS, TRUTHS)


def _readable(array, place):
    """Return whether the place is one of an array of neighbouring numbers: an index, or (row, index)."""
    dimensions = len(place) if isinstance(place, types.BaseTuple) else 1
    return isinstance(array, types.Array) and array.layout == "C" and array.ndim == dimensions <= 2


def _bytes_of(array):
    """Return the bytes of one number of an array."""
    return array.dtype.bitwidth // 8 if isinstance(array.dtype, types.Float) else 1


def _address(context, builder, kinds, values, vector):
    """Compute the address of the lanes at a place of an array, without a view of the row, whose counting takes time."""
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
    """Load LANES numbers of an array of floats from a place on; of bytes or truth values load which are not 0."""
    kinds = {types.float32: NUMBERS, types.float64: WIDE, types.uint8: TRUTHS, types.boolean: TRUTHS}
    if not _readable(array, place) or array.dtype not in kinds:
        return None
    result = kinds[array.dtype]

    def build(context, builder, sig, args):
        vector = BYTES if result is TRUTHS else VECTORS[result]
        value = builder.load(_address(context, builder, sig.args, args, vector), align=_bytes_of(array))
        return builder.icmp_unsigned("!=", value, ir.Constant(BYTES, None)) if result is TRUTHS else value

    return result(array, place), build


@intrinsic
def store(typing, array, place, value):
    """Write lanes into an array of their kind, or truths into one of bytes or truth values, from a place on."""
    kinds = (types.uint8, types.boolean) if value is TRUTHS else (SINGLE.get(value),)
    if not _readable(array, place) or array.dtype not in kinds:
        return None

    def build(context, builder, sig, args):
        lanes = builder.zext(args[2], BYTES) if value is TRUTHS else args[2]
        builder.store(lanes, _address(context, builder, sig.args, args, lanes.type), align=_bytes_of(array))
        return context.get_dummy_value()

    return types.void(array, place, value), build


@intrinsic
def splat(typing, number):
    """Fill all lanes with a float32 or float64 number."""
    kind = {single: kind for kind, single in SINGLE.items()}.get(number)
    if kind is None:
        return None
    return kind(number), lambda context, builder, sig, args: _spread(builder, args[0], kind)


@intrinsic
def choose(typing, condition, yes, no):
    """Select `yes` or `no` per lane, like numpy.where; each is lanes or a number of their kind.

    Single numbers are accepted, too, so that one function serves both.
    """
    kind = WIDE if {yes, no} & {WIDE, types.float64} else NUMBERS
    if condition not in (TRUTHS, types.boolean) or not {yes, no} <= {kind, SINGLE[kind]}:
        return None
    result = kind if condition is TRUTHS else SINGLE[kind]

    def build(context, builder, sig, args):
        sides = (
            value if given is result else _spread(builder, value, kind)
            for given, value in zip(sig.args[1:], args[1:], strict=True)
        )
        return builder.select(args[0], *sides)

    return result(condition, yes, no), build


def _call_llvm(name, value, arguments):
    """Call an intrinsic function of LLVM on lanes or single float64 numbers of one type."""
    vectors = {**VECTORS, types.float64: ir.DoubleType()}
    names = {NUMBERS: f"v{LANES}f32", WIDE: f"v{LANES}f64", types.float64: "f64"}
    if value not in names:
        return None

    def build(context, builder, sig, args):
        kind = ir.FunctionType(vectors[value], [vectors[value]] * arguments)
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{names[value]}")
        return builder.call(function, args)

    return value(*[value] * arguments), build


@intrinsic
def root(typing, value):
    """Compute the square roots of lanes, or of one number."""
    return _call_llvm("sqrt", value, 1)


@intrinsic
def smaller(typing, left, right):
    """Select the smaller number per lane; the other one where one is NaN.

    A store of `choose(left < right, left, right)` over `left` becomes a masked store, which some processors execute
    in microcode, many times slower.
    """
    return _call_llvm("minnum", left, 2)


@intrinsic
def larger(typing, left, right):
    """Select the larger number per lane; the other one where one is NaN."""
    return _call_llvm("maxnum", left, 2)


@njit(cache=True)
def store_rows(array, start, values):
    """Write lanes (a tuple) into the rows of an array (rows, numbers) of their kind, each from a place on."""
    for row in range(len(values)):
        store(array, (row, start), values[row])


@njit(cache=True)
def planes(count, width):
    """Make a float32 array (count, width) of zeros that begins where a register's worth of memory does.

    Otherwise every second access would touch two lines of the processor's cache, which takes twice as long. The width
    is to be a multiple of LANES.
    """
    memory = np.zeros(count * width + LANES, np.float32)
    first = (LANES - memory.ctypes.data // 4 % LANES) % LANES
    return memory[first : first + count * width].reshape(count, width)


def repeat_pixels(array, pixels):
    """Repeat the pixels of an array (lights, fewer pixels, ...): kernels take whole blocks of them."""
    return np.take(array, np.arange(pixels) % array.shape[1], axis=1)
