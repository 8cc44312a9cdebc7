"""A SIMD value type for Numba: code that reads as scalar runs on `width` lanes at once.

    x = state.x[i]                      one float32 of every lane (an LLVM <width x float>)
    v = select(x < 0.5, x, 2.0 * x)     comparisons make masks; both sides are computed
    if any_lane(x < 0.5): ...           the only branch on lane values

Numbers mix freely with lanes. Operators: + - * / and unary -, comparisons, & | ~ on masks; min, max, abs,
math.sqrt. No operation mixes lanes, but `any_lane` and `highest` for decisions, or depends on the processor:
every one is rounded by IEEE 754 as written (no fast-math flag, no fused multiply-add), so that a lane's bits do
not depend on the instruction set.

This file knows nothing of agents. It stands on Numba's extension API; its tests pin the tested range.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils, extending
from numba.core.extending import (
    lower_builtin,
    models,
    register_model,
)
from numba.core.imputils import lower_cast
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature


def intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    """Numba's `intrinsic`, typed as it is called: without the typing context."""
    return extending.intrinsic(function)


# --- values -------------------------------------------------------------------------------------------------------

ELEMENT = {"float": ir.FloatType(), "int": ir.IntType(32), "mask": ir.IntType(1)}
SCALAR = {"float": types.float32, "int": types.int32, "mask": types.boolean}


class Lanes(types.Type):
    """`width` numbers of one kind ("float", "int" or "mask") as one value: a vector, or a plain number of one lane."""

    def __init__(self, kind: str, width: int) -> None:
        self.kind, self.width = kind, width
        super().__init__(f"{kind}x{width}")

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Conversion | None:
        if self.kind == "float" and isinstance(other, types.Float | types.Integer):
            return Conversion.safe
        if self.kind == "int" and isinstance(other, types.Integer):
            return Conversion.safe
        return None

    @property
    def llvm(self) -> ir.Type:
        return ELEMENT[self.kind] if self.width == 1 else ir.VectorType(ELEMENT[self.kind], self.width)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, lanes.llvm)


def _splat(builder: ir.IRBuilder, value: Any, width: int) -> ir.Value:
    if width == 1:
        return value
    empty = ir.Constant(ir.VectorType(value.type, width), ir.Undefined)
    first = builder.insert_element(empty, value, ir.IntType(32)(0))
    return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width))


def as_lanes(context: Any, builder: ir.IRBuilder, value: ir.Value, given: types.Type, lanes: Lanes) -> ir.Value:
    """`value` in every lane, unless it is lanes already."""
    if isinstance(given, Lanes):
        return value
    return _splat(builder, context.cast(builder, value, given, SCALAR[lanes.kind]), lanes.width)


@lower_cast(types.Number, Lanes)
def _number_to_lanes(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return as_lanes(context, builder, value, given, wanted)


# --- operators ----------------------------------------------------------------------------------------------------


def _define(
    function: Callable[..., Any],
    kinds: tuple[str, ...],
    emit: Callable[..., ir.Value],
    *,
    arguments: int = 2,
    result: str | None = None,
) -> None:
    """Gives `function` a meaning for lanes of `kinds` (and numbers beside them): `emit(builder, lanes, *values)`."""

    @infer_global(function)
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            lanes = [a for a in args if isinstance(a, Lanes) and a.kind in kinds]
            if len(args) != arguments or not lanes:
                return None
            if not all(a == lanes[0] or isinstance(a, types.Number) for a in args):
                return None
            return signature(Lanes(result or lanes[0].kind, lanes[0].width), *args)

    def implement(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        lanes = next(a for a in sig.args if isinstance(a, Lanes))
        values = [as_lanes(context, builder, v, t, lanes) for v, t in zip(values, sig.args, strict=True)]
        return emit(builder, lanes, *values)

    patterns = [(Lanes,)] if arguments == 1 else [(Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)]
    for pattern in patterns:
        lower_builtin(function, *pattern)(implement)


def _instruction(for_float: str, for_int: str) -> Callable[..., ir.Value]:
    return lambda builder, lanes, a, b: getattr(builder, for_float if lanes.kind == "float" else for_int)(a, b)


def _comparison(symbol: str) -> Callable[..., ir.Value]:
    def emit(builder: Any, lanes: Lanes, a: Any, b: Any) -> Any:
        if lanes.kind == "float":
            # as in IEEE 754 and NumPy: NaN differs from everything, and every other comparison with it fails
            return (builder.fcmp_unordered if symbol == "!=" else builder.fcmp_ordered)(symbol, a, b)
        return builder.icmp_signed(symbol, a, b)

    return emit


def _llvm_function(name: str) -> Callable[..., ir.Value]:
    def emit(builder: Any, lanes: Lanes, *values: Any) -> Any:
        kind = ir.FunctionType(lanes.llvm, [lanes.llvm] * len(values))
        suffix = "f32" if lanes.width == 1 else f"v{lanes.width}f32"
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}")
        return builder.call(function, values)

    return emit


NUMBERS = ("float", "int")
for _operator, _float, _int in (("add", "fadd", "add"), ("sub", "fsub", "sub"), ("mul", "fmul", "mul")):
    for _prefix in ("", "i"):  # x + y and x += y
        _define(getattr(operator, _prefix + _operator), NUMBERS, _instruction(_float, _int))
for _function in (operator.truediv, operator.itruediv):
    _define(_function, ("float",), lambda builder, lanes, a, b: builder.fdiv(a, b))
_define(operator.neg, ("float",), lambda builder, lanes, a: builder.fneg(a), arguments=1)
for _function, _symbol in (
    (operator.lt, "<"),
    (operator.gt, ">"),
    (operator.le, "<="),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _define(_function, NUMBERS, _comparison(_symbol), result="mask")
for _prefix in ("", "i"):
    _define(getattr(operator, _prefix + "and" + "_" * (not _prefix)), ("mask",), lambda b, lanes, x, y: b.and_(x, y))
    _define(getattr(operator, _prefix + "or" + "_" * (not _prefix)), ("mask",), lambda b, lanes, x, y: b.or_(x, y))
_define(operator.invert, ("mask",), lambda builder, lanes, a: builder.not_(a), arguments=1)
# As the vector units do it: the second operand where the comparison does not hold, NaN included.
# On ARM64 LLVM takes FMINNM for min(x, 0.0), which gives -0.0 for -0.0. Only the solver's `correction` has such a
# minimum, and there the sign of 0 is lost in the next sum.
_define(min, ("float",), lambda b, lanes, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))
_define(max, ("float",), lambda b, lanes, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))
_define(abs, ("float",), _llvm_function("fabs"), arguments=1)
_define(math.sqrt, ("float",), _llvm_function("sqrt"), arguments=1)


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """`a` in the lanes where `mask` holds, `b` in the others."""
    lanes = next((t for t in (a, b) if isinstance(t, Lanes)), Lanes("float", mask.width))

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        a, b = (as_lanes(context, builder, v, t, lanes) for v, t in zip(values[1:], sig.args[1:], strict=True))
        return builder.select(values[0], a, b)

    return lanes(mask, a, b), emit


@intrinsic
def select_mask(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """`select` of two masks."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return builder.select(*values)

    return mask(mask, a, b), emit


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether `mask` holds in any lane: one bool."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        bits = builder.bitcast(values[0], ir.IntType(mask.width))
        return builder.icmp_unsigned("!=", bits, bits.type(0))

    return types.boolean(mask), emit


@intrinsic
def highest(typingctx: Any, value: Any) -> Any:
    """The largest number of all lanes but NaN: one float32. Only for decisions that no lane's result depends on."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        lowest = as_lanes(context, builder, ir.Constant(ir.FloatType(), -math.inf), types.float32, value)
        best = builder.select(builder.fcmp_ordered("==", values[0], values[0]), values[0], lowest)
        half = value.width // 2
        # one half against the other, and again: LLVM's own reduction, without fast-math, is a chain of single numbers
        while half:
            places = ir.VectorType(ir.IntType(32), half)
            low = builder.shuffle_vector(best, best, ir.Constant(places, [*range(half)]))
            high = builder.shuffle_vector(best, best, ir.Constant(places, [*range(half, 2 * half)]))
            best = builder.select(builder.fcmp_ordered(">", low, high), low, high)
            half //= 2
        return best if value.width == 1 else builder.extract_element(best, ir.IntType(32)(0))

    return types.float32(value), emit


@intrinsic
def lane_bits(typingctx: Any, mask: Any) -> Any:
    """`mask` as an int64 whose bit l is lane l (widths up to 32)."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        bits = builder.bitcast(values[0], ir.IntType(mask.width))
        return builder.zext(bits, ir.IntType(64))

    return types.int64(mask), emit


@intrinsic
def lowest_bit(typingctx: Any, bits: Any) -> Any:
    """Index of the lowest set bit of an int64 that is not 0."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return builder.cttz(values[0], ir.IntType(1)(1))

    return types.intp(types.int64), emit
